#!/bin/sh
# Runs rustc with AddressSanitizer, the coverage counters of libFuzzer and checks of overflow: `RUSTC_WORKSPACE_WRAPPER` of the
# nightly checks. Cargo calls it for crates of the workspace only and keeps what it compiles apart, so the libraries of ordinary
# builds are used as they are, and a fault in one of them is found only where it reaches code of ours, the allocator or libc.
set -eu
rustc=$1
shift
case " $* " in
*" --crate-name ___ "* | *" --crate-name build_script_"* | *" --crate-type proc-macro "*)
    # Questions of cargo, and what runs while it builds.
    exec "$rustc" "$@"
    ;;
*" --crate-name "*) ;;
*) exec "$rustc" "$@" ;;
esac
# Sanitizers are unstable flags. As a variable of cargo, RUSTC_BOOTSTRAP would compile libraries again.
export RUSTC_BOOTSTRAP=1
exec "$rustc" "$@" -Zsanitizer=address -Cdebug-assertions -Coverflow-checks -Cdebuginfo=line-tables-only -Cstrip=none \
    -Cpasses=sancov-module -Cllvm-args=-sanitizer-coverage-level=4 -Cllvm-args=-sanitizer-coverage-inline-8bit-counters \
    -Cllvm-args=-sanitizer-coverage-pc-table -Cllvm-args=-sanitizer-coverage-trace-compares
