#!/bin/sh
# Compiles the library molmesh with counters of executed branches, and every other crate as usual. Cargo calls it as
# RUSTC_WORKSPACE_WRAPPER: `rustc.sh RUSTC ARGUMENTS`. Needs no nightly compiler.
case " $* " in
*" --crate-name molmesh "*" --crate-type lib "*)
    exec "$@" -Cpasses=sancov-module -Cllvm-args=-sanitizer-coverage-level=3 \
        -Cllvm-args=-sanitizer-coverage-inline-8bit-counters
    ;;
*) exec "$@" ;;
esac
