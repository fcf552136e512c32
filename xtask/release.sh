#!/bin/sh
# Makes the files of a release in a folder, which is replaced: `make release` calls this.
set -eu
OUT=$1
VERSION=$(sed -n 's/^version = "\(.*\)"$/\1/p' Cargo.toml | head -1)
HOST=$(rustc -vV | sed -n 's/^host: //p')
NAME=stable-worldmodel-$VERSION-$HOST
rm -rf "$OUT"
mkdir -p "$OUT/$NAME"

# Only the program is compiled and linked again: all libraries are those of other builds. The option strips it, and makes Cargo do so; the list
# of dependencies stays.
CARGO=$PWD/xtask/auditable_cargo.sh cargo-auditable auditable rustc --release --locked -p swm --bin swm -- -C strip=symbols
cp "$CARGO_TARGET_DIR/release/swm" "$OUT/$NAME/"
# Dates inside packages are that of the commit, so that equal sources give equal packages. Build scripts of C libraries watch the variable: set
# before, it would compile everything again.
SOURCE_DATE_EPOCH=$(git log -1 --format=%ct)
export SOURCE_DATE_EPOCH
auditable2cdx "$OUT/$NAME/swm" > "$OUT/$NAME.cdx.json"
sh xtask/changes.sh "$VERSION" > "$OUT/$NAME/CHANGES.md"
cp "$OUT/$NAME/CHANGES.md" "$OUT/"
cp README.md CHANGELOG.md CITATION.cff LICENSE* "$OUT/$NAME/"
# Where the program looks for it.
mkdir -p "$OUT/$NAME/share/swm"
cp -r zoo "$OUT/$NAME/share/swm/"
for shell in bash zsh fish; do "$OUT/$NAME/swm" completions $shell > "$OUT/$NAME/swm.$shell"; done
"$OUT/$NAME/swm" man --output "$OUT/$NAME/man" > /dev/null
tar --create --xz --sort=name --owner=0 --group=0 --numeric-owner --mtime="@$SOURCE_DATE_EPOCH" --directory "$OUT" --file "$OUT/$NAME.tar.xz" "$NAME"
sh xtask/deb.sh "$OUT/$NAME" "$OUT" "$VERSION"
lintian --allow-root --fail-on error,warning "$OUT"/*.deb
cp Containerfile "$OUT/"
rm -r "${OUT:?}/$NAME"

for folder in $WHEELS; do cp "$folder"/*.whl "$OUT/"; done
sh xtask/sdist.sh "$PYTHON_VENV/bin/maturin" "$OUT"
(cd "$OUT" && sha256sum -- * > SHA256SUMS && sha256sum --check --quiet SHA256SUMS)
ls -l "$OUT"
