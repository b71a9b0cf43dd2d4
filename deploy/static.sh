#!/usr/bin/env bash
# Builds molmesh without GPU support as the static file dist/molmesh, which runs on any Linux with the same processor
# architecture. Installs the standard library for musl, and Debian's musl-tools and g++, if they are missing. Exits with
# 3 if these are not available, and with the build's status if the build fails.
#
# `static.sh dev` builds for the tests, with little optimization: only target/TARGET/debug/molmesh.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
# shellcheck source=deploy/container/engine.sh
source deploy/container/engine.sh

[ "$(uname -s)" = Linux ] || impossible "a static executable can be built on Linux only"
target=$(uname -m)-unknown-linux-musl
if [ ! -d "$(rustc --print sysroot)/lib/rustlib/$target/lib" ]; then
    rustup target add "$target" || impossible "Rust's standard library for $target is missing and rustup cannot install it"
fi
# The allocator and the cryptography are written in C.
command -v musl-gcc >/dev/null || install_packages musl-tools
# The compression of meshes is written in C++. Debian has no C++ compiler for musl. That of the host works, because the
# code uses only memory allocation from the C++ standard library.
command -v g++ >/dev/null || install_packages g++
cxx=CXX_${target//-/_}
export "$cxx=${!cxx:-g++}"
profile=${1:-release}
if [ "$profile" = dev ]; then export CARGO_PROFILE_DEV_OPT_LEVEL=0; fi
cargo build --profile "$profile" --locked --bin molmesh --no-default-features --target "$target"
if [ "$profile" = dev ]; then
    # A build without changes counts as new.
    touch "target/$target/debug/molmesh"
    exit
fi
mkdir -p dist
# Symbols stay for backtraces. The rename replaces the file without disturbing running processes.
strip --strip-debug -o dist/molmesh.new "target/$target/release/molmesh"
mv dist/molmesh.new dist/molmesh
# Licence notices that must accompany the file.
python3 deploy/notices.py --target "$target" --no-default-features >dist/molmesh.THIRD-PARTY.txt
