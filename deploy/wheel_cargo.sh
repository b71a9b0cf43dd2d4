#!/bin/sh
# Cargo for maturin: builds the extension and the command together with the whole workspace, as the tests do, so that
# their dependencies are compiled once. maturin's variables, and the PATH that wheel.sh extends, would have pyo3
# compiled again.
set -eu
[ "$1" = rustc ] || exec cargo "$@"
exec env -u PYO3_CONFIG_FILE -u PYO3_NO_PYTHON -u PYO3_PYTHON -u PYO3_ENVIRONMENT_SIGNATURE -u PYTHON_SYS_EXECUTABLE \
    PATH="${PATH#*/test-tools/venv/bin:}" \
    cargo build --locked --workspace --lib --bin molmesh --target-dir target --message-format json-render-diagnostics
