#!/usr/bin/env bash
# Builds the images molmesh:cpu and molmesh:gpu from the Dockerfile, with docker or podman, whichever is at hand.
#
#   deploy/container/build.sh                          everything in containers, as `docker build` does it
#   deploy/container/build.sh --binary FILE            with a binary that was built here
#   deploy/container/build.sh --base-from-debootstrap  over a Debian made here: no registry of images is asked
#   deploy/container/build.sh --target cpu             one image alone
#
# The viewer is in the image that is built in containers; a binary that was built here has it if `make web` ran before it was
# built (`make release` does so). Such a binary must not need a newer libc than the base has; the build fails if it does. Beside the
# images, dist/molmesh-TARGET.cdx.json says what is in them. The environment may set
# SUITE (trixie), BASE_IMAGE, RUST_IMAGE, NODE_IMAGE, and SOURCE, the address of the sources for the image's label.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."
# shellcheck source=deploy/container/engine.sh
source deploy/container/engine.sh

targets=(cpu gpu)
binary=
debootstrap=false
while [ $# -gt 0 ]; do
    case $1 in
    --target) targets=("$2") && shift 2 ;;
    --binary) binary=$2 && shift 2 ;;
    --base-from-debootstrap) debootstrap=true && shift ;;
    *) echo "unknown argument $1; the head of this file says what there is" >&2; exit 2 ;;
    esac
done

pick_engine
arguments=(
    --build-arg "VERSION=$(sed -nE 's/^version = "(.*)"/\1/p' Cargo.toml | head -1)"
    --build-arg "REVISION=$(git rev-parse HEAD 2>/dev/null || echo unknown)"
    --build-arg "CREATED=$(date --utc --date="@${SOURCE_DATE_EPOCH:-$(git log -1 --format=%ct 2>/dev/null || date +%s)}" +%FT%TZ)"
    --build-arg "SOURCE=${SOURCE:-}"
)
if [ -n "$binary" ]; then
    deploy/container/stage.sh "$binary" dist/image
    arguments+=(--build-arg BINARY=prebuilt)
fi
if $debootstrap; then
    suite=${SUITE:-trixie}
    command -v debootstrap >/dev/null || install_packages debootstrap
    mkdir -p target/container
    deploy/container/debian-base.sh "$suite" target/container/base.tar
    BASE_IMAGE=localhost/molmesh-base:$suite
    "${engine[@]}" import target/container/base.tar "$BASE_IMAGE" >/dev/null
    rm target/container/base.tar
fi
if [ -n "${BASE_IMAGE:-}" ]; then arguments+=(--build-arg "BASE_IMAGE=$BASE_IMAGE"); fi
if [ -n "${RUST_IMAGE:-}" ]; then arguments+=(--build-arg "RUST_IMAGE=$RUST_IMAGE"); fi
if [ -n "${NODE_IMAGE:-}" ]; then arguments+=(--build-arg "NODE_IMAGE=$NODE_IMAGE"); fi
if [ "${engine[0]}" = podman ]; then
    # OCI's own format has no health check. The steps need the host's network, and no daemon's help to become root.
    arguments+=(--format docker --isolation chroot --network host)
fi

for target in "${targets[@]}"; do
    "${engine[@]}" build "${arguments[@]}" --target "$target" --tag "molmesh:$target" .
done
