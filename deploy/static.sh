#!/usr/bin/env bash
# Builds the command line alone (`mesh` and `render` on the CPU; no service, no GPU) as one static file, dist/molmesh, which runs on
# any Linux of this processor's kind. Installs the standard library for musl and Debian's musl-tools where they are absent; ends
# with 3 where they cannot be had, and with what the build ends with where that fails.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
# shellcheck source=deploy/container/engine.sh
source deploy/container/engine.sh

impossible() {
    echo "$1" >&2
    exit 3
}

[ "$(uname -s)" = Linux ] || impossible "a static executable is built on Linux alone"
target=$(uname -m)-unknown-linux-musl
if [ ! -d "$(rustc --print sysroot)/lib/rustlib/$target/lib" ]; then
    rustup target add "$target" || impossible "Rust's standard library for $target is not installed and cannot be got by rustup"
fi
# The allocator is C.
command -v musl-gcc >/dev/null || (install_packages musl-tools) || impossible "there is no musl-gcc"
cargo build --release --locked --bin molmesh --no-default-features --features cli --target "$target"
mkdir -p dist
# Symbols stay, so that backtraces have names. Under another name first: whoever runs the old one keeps it.
strip --strip-debug -o dist/molmesh.new "target/$target/release/molmesh"
mv dist/molmesh.new dist/molmesh
# What has to go with it where it is handed on.
python3 deploy/notices.py --target "$target" --features cli >dist/molmesh.THIRD-PARTY.txt
