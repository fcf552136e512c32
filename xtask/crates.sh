#!/bin/sh
# Packs the crates as the Rust registry takes them, in a folder, which is replaced: `make crates` calls this. There the name `swm` belongs to
# others, so the package of the facade is named `stable-worldmodel` in a copy of the commit; its library and its program stay `swm`.
set -eu
OUT=$1
rm -rf "$OUT"
mkdir -p "$OUT/source"
git archive HEAD | tar --extract --directory "$OUT/source"
cd "$OUT/source"
sed -i 's/^swm = { /&package = "stable-worldmodel", /' Cargo.toml
sed -i 's/^name = "swm"$/name = "stable-worldmodel"/; t renamed; b; :renamed; n; :rest; n; b rest' crates/swm/Cargo.toml
printf '\n[lib]\nname = "swm"\n' >> crates/swm/Cargo.toml
# In the order in which they are published: a crate after those that it needs. Nothing is compiled; nothing is sent.
CARGO_TARGET_DIR=$OUT cargo package --quiet --workspace --no-verify --allow-dirty --exclude swm-extension-test --exclude swm-fuzz --exclude gemm \
  --exclude swm-python --exclude workspace-hack --exclude xtask
