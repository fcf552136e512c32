#!/bin/sh
# Makes the source distribution of the Python package in a folder: `xtask/release.sh` calls this. maturin takes the files of the crates and of
# the package; what else their build reads is added here: cargo's settings, and the stub of MuJoCo, which
# maturin leaves out as every file that ends in `.so`.
set -eu
MATURIN=$1
OUT=$2
WORK=$(mktemp -d)
trap 'rm -r "$WORK"' EXIT

sh xtask/share.sh
"$MATURIN" sdist --manifest-path python/Cargo.toml --out "$WORK"
FILE=$(cd "$WORK" && echo *.tar.gz)
tar --extract --file "$WORK/$FILE" --directory "$WORK"
FOLDER=$WORK/${FILE%.tar.gz}
cp -r .cargo LICENSE* "$FOLDER/"
cp -r crates/swm-mujoco/stub "$FOLDER/crates/swm-mujoco/"
tar --create --sort=name --owner=0 --group=0 --numeric-owner --mtime="@$SOURCE_DATE_EPOCH" --directory "$WORK" "${FILE%.tar.gz}" |
  gzip -9 --no-name > "$OUT/$FILE"
