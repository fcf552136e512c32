#!/bin/sh
# Cargo for `cargo auditable`, as `xtask/release.sh` calls it. `cargo auditable` wraps rustc in the crates of the workspace, so that Cargo would
# compile all of them again, though the wrapper changes programs only. As a wrapper of rustc in every crate it is no reason for that; as a
# setting, because build scripts watch the variable.
set -eu
WRAPPER=$RUSTC_WORKSPACE_WRAPPER
unset RUSTC_WORKSPACE_WRAPPER
exec cargo --config "build.rustc-wrapper=\"$WRAPPER\"" "$@"
