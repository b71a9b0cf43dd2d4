#!/usr/bin/env bash
# Builds the command line alone (`mesh` and `render` on the CPU; no service, no GPU) as one static file, dist/molmesh, which runs on
# any Linux of this processor's kind and starts in a third of the time: nothing has to be found, mapped and bound first.
# Installs the standard library for musl and Debian's musl-tools where they are absent.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
# shellcheck source=deploy/container/engine.sh
source deploy/container/engine.sh

if [ "$(uname -s)" != Linux ]; then
    echo "a static executable is built on Linux alone" >&2
    exit 1
fi
target=$(uname -m)-unknown-linux-musl
if [ ! -d "$(rustc --print sysroot)/lib/rustlib/$target/lib" ]; then
    if ! command -v rustup >/dev/null; then
        echo "Rust's standard library for $target is not installed, and there is no rustup to get it" >&2
        exit 1
    fi
    rustup target add "$target"
fi
# The allocator is C.
command -v musl-gcc >/dev/null || install_packages musl-tools
cargo build --release --locked --bin molmesh --no-default-features --features cli --target "$target"
mkdir -p dist
# Symbols stay, so that backtraces have names. Under another name first: whoever runs the old one keeps it.
strip --strip-debug -o dist/molmesh.new "target/$target/release/molmesh"
mv dist/molmesh.new dist/molmesh
# What has to go with it where it is handed on.
python3 deploy/notices.py --target "$target" --features cli >dist/molmesh.THIRD-PARTY.txt
