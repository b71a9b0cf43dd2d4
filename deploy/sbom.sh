#!/usr/bin/env bash
# Writes and checks bills of materials: dist/molmesh.cdx.json for the binary and dist/molmesh-IMAGE.cdx.json for each
# named image. Installs cargo-cyclonedx into target/tools if it is missing. Usage: deploy/sbom.sh [cpu] [gpu]
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
# shellcheck source=deploy/container/engine.sh
source deploy/container/engine.sh

version=0.5.9
target=x86_64-unknown-linux-gnu
export PATH="$PWD/target/tools/bin:$PATH"
if ! cargo cyclonedx --version 2>/dev/null | grep -qF "$version"; then
    cargo install --locked --root target/tools "cargo-cyclonedx@$version"
fi
bash tests/tools/setup.sh

SOURCE_DATE_EPOCH=${SOURCE_DATE_EPOCH:-$(git log -1 --format=%ct 2>/dev/null || date +%s)}
export SOURCE_DATE_EPOCH
mkdir -p dist
# cargo-cyclonedx always writes beside the manifest of each package.
trap 'rm -f molmesh.crates.json */molmesh.crates.json crates/*/molmesh.crates.json target/root.tar' EXIT
cargo cyclonedx -qq --format json --spec-version 1.5 --target "$target" --override-filename molmesh.crates
python3 deploy/sbom.py molmesh.crates.json >dist/molmesh.cdx.json
files=(dist/molmesh.cdx.json)
for image in "$@"; do
    pick_engine
    made=$("${engine[@]}" create --no-healthcheck "molmesh:$image")
    "${engine[@]}" export --output target/root.tar "$made"
    "${engine[@]}" rm "$made" >/dev/null
    python3 deploy/sbom.py molmesh.crates.json --root target/root.tar --name "molmesh:$image" >"dist/molmesh-$image.cdx.json"
    files+=("dist/molmesh-$image.cdx.json")
done
target/test-tools/venv/bin/python deploy/check_sbom.py "${files[@]}"
