#!/usr/bin/env bash
# Builds molmesh without GPU support as the static file dist/molmesh, which runs on any Linux with the same processor
# architecture. Installs the standard library for musl, and Debian's musl-tools and g++, if they are missing. Exits with
# 3 if these are not available, and with another status if the build or a check of the file fails.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
# shellcheck source=deploy/container/engine.sh
source deploy/container/engine.sh

fail() {
    echo "deploy/static.sh: $*" >&2
    exit 1
}

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
cargo build --release --locked --bin molmesh --no-default-features --target "$target"
mkdir -p dist
# Symbols stay for backtraces. The rename replaces the file without disturbing running processes.
strip --strip-debug -o dist/molmesh.new "target/$target/release/molmesh"
headers=$(readelf --program-headers --wide dist/molmesh.new)
[[ $headers != *INTERP* ]] || fail "the file needs a loader"
code=0
dist/molmesh.new mesh samples/4pti.pdb -o - --format stl --backend gpu >/dev/null 2>&1 || code=$?
[ "$code" -eq 6 ] || fail "--backend gpu ends with $code, expected 6"
# musl and the C++ code give the recorded bytes. Other processors round differently.
read -r recorded_on <tests/http/recorded_bytes.txt
if [ "$recorded_on" = "linux $(uname -m) fma" ] && grep -qw fma /proc/cpuinfo; then
    mapfile -t rows < <(grep -E '^/surface\.(glb|obj|stl)\?resolution' tests/http/recorded_bytes.txt)
    [ ${#rows[@]} -gt 0 ] || fail "tests/http/recorded_bytes.txt has no meshes"
    for row in "${rows[@]}"; do
        read -r address _ recorded <<<"$row"
        file=${address#/surface.}
        IFS='&' read -ra parameters <<<"${file#*\?}"
        digest=$(dist/molmesh.new mesh samples/4pti.pdb -o - --format "${file%%\?*}" "${parameters[@]/#/--}" --quiet | sha256sum)
        [ "${digest%% *}" = "$recorded" ] || fail "$address has other bytes than in tests/http/recorded_bytes.txt"
    done
else
    echo "SKIPPED: the recorded bytes are those of another arithmetic; the meshes were not checked" >&2
fi
mv dist/molmesh.new dist/molmesh
# Licence notices that must accompany the file.
python3 deploy/notices.py --target "$target" --no-default-features >dist/molmesh.THIRD-PARTY.txt
