#!/usr/bin/env bash
# Builds the images molmesh:cpu and molmesh:gpu from the Dockerfile with docker or podman.
#
#   deploy/container/build.sh                          builds everything in containers, like `docker build`
#   deploy/container/build.sh --binary FILE            uses a binary from this machine
#   deploy/container/build.sh --base-from-debootstrap  creates the Debian base here, without an image registry
#   deploy/container/build.sh --target cpu             builds one image
#
# A binary from this machine contains the web page if `make web` ran before its build, as `make release` does. It must
# not need a newer libc than the base; otherwise the image build fails. Environment variables: SUITE (trixie),
# BASE_IMAGE, RUST_IMAGE, NODE_IMAGE, and SOURCE (address of the sources for the image label). Exits with 3 if this
# machine cannot install what is missing, create the base, or run a container of it.
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
    *) echo "unknown argument $1; see the usage at the top of this file" >&2; exit 2 ;;
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
    # Podman has a mode without this privilege, but check.py enters the network of a container.
    unshare --net true || impossible "this machine does not permit network namespaces"
    command -v debootstrap >/dev/null || install_packages debootstrap
    mkdir -p target/container
    deploy/container/debian-base.sh "$suite" target/container/base.tar
    BASE_IMAGE=localhost/molmesh-base:$suite
    { "${engine[@]}" import target/container/base.tar "$BASE_IMAGE" >/dev/null &&
        "${engine[@]}" run --rm --network none --ulimit nofile=1024:1024 --ulimit nproc=4096:4096 \
            "$BASE_IMAGE" true; } ||
        impossible "this machine cannot run containers"
    rm target/container/base.tar
fi
if [ -n "${BASE_IMAGE:-}" ]; then arguments+=(--build-arg "BASE_IMAGE=$BASE_IMAGE"); fi
if [ -n "${RUST_IMAGE:-}" ]; then arguments+=(--build-arg "RUST_IMAGE=$RUST_IMAGE"); fi
if [ -n "${NODE_IMAGE:-}" ]; then arguments+=(--build-arg "NODE_IMAGE=$NODE_IMAGE"); fi
if [ "${engine[0]}" = podman ]; then
    # The OCI format has no health check. Build steps use the host's network and need no daemon to run as root.
    arguments+=(--format docker --isolation chroot --network host)
fi

for target in "${targets[@]}"; do
    "${engine[@]}" build "${arguments[@]}" --target "$target" --tag "molmesh:$target" .
done
