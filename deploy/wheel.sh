#!/usr/bin/env bash
# Builds a wheel for this machine: the Python package, and the command molmesh with the service and its web page if that
# was built before. Needs maturin, which `make tools` installs, and on Linux auditwheel.
#
#   deploy/wheel.sh [PROFILE]   writes it to dist (profile: release)
#   deploy/wheel.sh dev         for the tests: takes their build and writes it to target/python
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
profile=${1:-release}
export PATH="$PWD/target/test-tools/venv/bin:$PATH" PYTHONUTF8=1

case $(uname -s) in
Linux) end= strip=(strip --strip-all) ;;
Darwin) end= strip=(strip) ;;
*) end=.exe strip=() ;;
esac
out=dist options=(--profile "$profile" --strip) folder=$profile
if [ "$profile" = dev ]; then
    # maturin would build the extension alone, whose dependencies have fewer features than in the tests.
    export CARGO=$PWD/deploy/wheel_cargo.sh
    out=target/python folder=debug options=(--profile dev --compression-method stored)
    "$CARGO" rustc
else
    cargo build --locked --profile "$profile" --bin molmesh --target-dir target
fi

# maturin puts the folder of this name into the wheel; pip copies `scripts` and `data` into the environment.
data=python/molmesh._molmesh.data
trap 'rm -rf "$data"' EXIT
doc=$data/data/share/doc/molmesh
rm -rf "$data"
mkdir -p "$data/scripts" "$doc"
cp "target/$folder/molmesh$end" "$data/scripts/"
if [ ${#strip[@]} -gt 0 ]; then "${strip[@]}" "$data/scripts/molmesh$end"; fi
cp LICENSE-MIT LICENSE-APACHE "$doc/"
python3 deploy/notices.py --package molmesh-python >"$doc/THIRD-PARTY.txt"

# Without patchelf, maturin finds the manylinux tag that holds for the extension. The command may need a newer glibc.
build() {
    rm -f "$out"/molmesh-*.whl
    maturin build --locked --manifest-path python/Cargo.toml --target-dir target "${options[@]}" --out "$out" "$@"
    wheel=$(echo "$out"/molmesh-*.whl)
}
build
if [ "$(uname -s)" = Linux ]; then
    tag=$(auditwheel show --json "$wheel" | python3 -c 'import json, sys; print(json.load(sys.stdin)["overall_tag"])')
    if [[ $wheel != *"$tag"* ]]; then build --compatibility "${tag%_"$(uname -m)"}"; fi
    [[ $wheel == *"$tag"* ]] || { echo "the tag of $wheel does not hold: expected $tag" >&2 && exit 1; }
fi
