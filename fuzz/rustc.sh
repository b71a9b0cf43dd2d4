#!/bin/sh
# Compiles the libraries behind the targets with counters of executed branches, and every other crate as usual. Cargo
# calls it as RUSTC_WORKSPACE_WRAPPER: `rustc.sh RUSTC ARGUMENTS`. Needs no nightly compiler.
for library in molmesh molmesh_structure molmesh_formats molmesh_pipeline molmesh_surface; do
    case " $* " in
    *" --crate-name $library "*" --crate-type lib "*)
        exec "$@" -Cpasses=sancov-module -Cllvm-args=-sanitizer-coverage-level=3 \
            -Cllvm-args=-sanitizer-coverage-inline-8bit-counters
        ;;
    esac
done
exec "$@"
