#!/usr/bin/env bash
# Renders the three kustomizations with kubectl and validates the result with the schemas of Kubernetes. A negative
# control must be rejected. Uses the installed kubectl, or Debian's in a container on the base from
# deploy/container/build.sh.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")"
# shellcheck source=deploy/container/engine.sh
source ../container/engine.sh

render() { kubectl kustomize "$1"; }
if ! command -v kubectl >/dev/null; then
    pick_engine
    options=()
    if [ "${engine[0]}" = podman ]; then options=(--isolation chroot --network host); fi
    printf 'FROM %s\nRUN apt-get update && apt-get install -qy --no-install-recommends kubernetes-client\n' \
        "${BASE_IMAGE:-localhost/molmesh-base:trixie}" |
        "${engine[@]}" build "${options[@]}" --tag molmesh-kubectl - >/dev/null
    # The container never runs: kubectl and its libraries are extracted and started with Debian's loader.
    root=$(mktemp -d)
    trap 'rm -rf "$root"' EXIT
    made=$("${engine[@]}" create molmesh-kubectl true)
    "${engine[@]}" export "$made" | tar -C "$root" -xf - usr lib64 lib bin
    "${engine[@]}" rm "$made" >/dev/null
    render() {
        "$root"/usr/lib64/ld-linux-x86-64.so.2 --library-path "$root/usr/lib/x86_64-linux-gnu" "$root/usr/bin/kubectl" kustomize "$1"
    }
fi

bash ../../tests/tools/setup.sh
out=../../target/kubernetes
mkdir -p "$out"
validate() { ../../target/test-tools/venv/bin/python ../../tests/tools/check_manifest.py; }
for overlay in base scaled gpu; do
    render "$overlay" >"$out/$overlay.yaml"
    echo "$out/$overlay.yaml" | validate | python3 -c '
import json, sys
found = json.load(sys.stdin)
kinds = sorted(document["kind"] for document in found["documents"])
wrong = found["errors"] or len(kinds) < 7
sys.exit(f"{sys.argv[1]}: {found}") if wrong else print(f"{sys.argv[1]:7} {len(kinds)} documents: " + " ".join(kinds))' "$overlay"
done
sed 's/ containerPort: 8080/ containerPort: http/' "$out/base.yaml" >"$out/spoiled.yaml"
echo "$out/spoiled.yaml" | validate | python3 -c '
import json, sys
sys.exit("an invalid manifest was accepted") if not json.load(sys.stdin)["errors"] else print("invalid manifest rejected, as expected")'
