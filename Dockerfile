# syntax=docker/dockerfile:1
# molmesh in a container, for CPUs (`cpu`) and NVIDIA's GPUs (`gpu`): docs/deploy.md says how to run it.
#
#   docker build --target cpu -t molmesh:cpu .
#   docker run --rm --read-only -p 8080:8080 -v molmesh:/data molmesh:cpu
#
# `deploy/container/build.sh` builds both with whatever builder is at hand, also without a registry, and `check.sh`
# beside it runs what was built.

# Debian trixie: the stable release, so that libc, the Vulkan loader and what drivers need get their security updates. The driver is
# mounted from the host and needs no newer libc than this (glibc 2.41; NVIDIA's libraries ask for 2.10); a binary built on
# bookworm runs here as well. Pin by digest for releases: `debian:trixie-slim@sha256:…`.
ARG BASE_IMAGE=docker.io/library/debian:trixie-slim
# Built where it will run: no symbol is newer than the base's libc. Pin by digest likewise.
ARG RUST_IMAGE=docker.io/library/rust:1.95-slim-trixie
# Where the viewer is built. Pin by digest likewise.
ARG NODE_IMAGE=docker.io/library/node:20-slim
# Where the binary and the notices come from: `build` compiles them here, `prebuilt` takes what lies in dist/image.
ARG BINARY=build

# ------------------------------------------------------------------------------------------------- what goes in
FROM ${NODE_IMAGE} AS viewer
WORKDIR /build
COPY . .
RUN --mount=type=cache,target=/root/.npm sh web/build.sh

FROM ${RUST_IMAGE} AS build
# Python collects the licences of what is linked.
RUN apt-get update && apt-get install -y --no-install-recommends python3 && rm -rf /var/lib/apt/lists/*
WORKDIR /build
COPY . .
COPY --from=viewer /build/web/dist web/dist
# The caches stay on the builder; what is wanted is laid out as it will lie in the image.
RUN --mount=type=cache,target=/usr/local/cargo/registry \
    --mount=type=cache,target=/build/target \
    cargo build --release --locked --bin molmesh \
    && deploy/container/stage.sh target/release/molmesh /stage

FROM scratch AS prebuilt
COPY dist/image/ /stage/

FROM ${BINARY} AS binary

# The archive is asked over TLS: the list of certificates, without the programs that Debian keeps it with.
FROM ${BASE_IMAGE} AS certificates
RUN apt-get update && apt-get install -y --no-install-recommends ca-certificates \
    && install -D -m 0644 /etc/ssl/certs/ca-certificates.crt /parts/etc/ssl/certs/ca-certificates.crt \
    && install -D -m 0644 /usr/share/doc/ca-certificates/copyright /parts/usr/share/doc/ca-certificates/copyright \
    # What of a package is here without dpkg's knowledge is noted where scanners look for it.
    && mkdir -p /parts/var/lib/dpkg/status.d && dpkg-query --status ca-certificates >/parts/var/lib/dpkg/status.d/ca-certificates

# ------------------------------------------------------------------------------------------------------- for CPUs
FROM ${BASE_IMAGE} AS cpu
# 65532 is the customary number of a user that owns nothing. Nobody here becomes somebody else: no file keeps a setuid bit.
RUN groupadd --gid 65532 molmesh \
    && useradd --uid 65532 --gid 65532 --no-create-home --home-dir /nonexistent --shell /usr/sbin/nologin molmesh \
    && install -d -o molmesh -g molmesh -m 0750 /data \
    && find / -xdev -type f -perm /6000 -exec chmod a-s {} + \
    && rm -f /var/log/*.log /var/log/apt/* /etc/passwd- /etc/group- /etc/shadow- /etc/gshadow-
COPY --from=certificates /parts/ /
COPY deploy/container/molmesh.toml /etc/molmesh/molmesh.toml
COPY --from=binary /stage/ /
# A binary that does not fit this libc is found out here.
RUN ["molmesh", "--version"]
ARG VERSION=unknown
ARG REVISION=unknown
ARG CREATED=1970-01-01T00:00:00Z
ARG SOURCE=
LABEL org.opencontainers.image.title="molmesh" \
      org.opencontainers.image.description="Molecules in, proven surface meshes out: an HTTP service and a command line" \
      org.opencontainers.image.licenses="MIT OR Apache-2.0" \
      org.opencontainers.image.version="${VERSION}" \
      org.opencontainers.image.revision="${REVISION}" \
      org.opencontainers.image.created="${CREATED}" \
      org.opencontainers.image.source="${SOURCE}" \
      org.opencontainers.image.documentation="docs/deploy.md"
USER 65532:65532
VOLUME /data
EXPOSE 8080 9090
# The first mesh is computed before the service is ready; a GPU's pipelines are built before that.
HEALTHCHECK --interval=10s --timeout=4s --start-period=30s --retries=3 CMD ["molmesh", "healthcheck"]
# SIGTERM, the default, drains; see server.drain_timeout_ms.
STOPSIGNAL SIGTERM
ENTRYPOINT ["molmesh"]
# Every command in the image reads it: `docker run … molmesh:cpu doctor` examines what the service would be.
ENV MOLMESH_CONFIG=/etc/molmesh/molmesh.toml
CMD ["serve"]

# ----------------------------------------------------------------------------------------------- for NVIDIA's GPUs
# NVIDIA's Vulkan driver opens libEGL.so.1 before anything else and does not start without it, display or none. Debian's
# package wants all of Mesa beside it (200 MB); the library itself is two files.
FROM ${BASE_IMAGE} AS egl
WORKDIR /deb
RUN apt-get update && apt-get download libegl1 libglvnd0 && mkdir -p /parts/var/lib/dpkg/status.d \
    && for deb in *.deb; do \
        dpkg-deb --extract "$deb" /parts \
        && dpkg-deb --field "$deb" >"/parts/var/lib/dpkg/status.d/$(dpkg-deb --field "$deb" Package)" || exit 1; \
    done \
    && rm -rf /parts/usr/share/lintian /parts/usr/share/bug

FROM cpu AS gpu
USER 0:0
# The loader, and what libGLX_nvidia.so.0, which is the Vulkan driver, is linked with.
RUN apt-get update \
    && apt-get install -y --no-install-recommends libvulkan1 libx11-6 libxext6 \
    && rm -rf /var/lib/apt/lists/* /var/cache/apt/* /var/log/*.log /var/log/apt/* /var/cache/ldconfig/aux-cache
COPY --from=egl /parts/ /
# Who the drivers are. The toolkit mounts its own over these where the host has them; where both are read, molmesh sees
# that a device comes twice.
COPY deploy/container/nvidia_icd.json /usr/share/vulkan/icd.d/nvidia_icd.json
COPY deploy/container/10_nvidia.json /usr/share/glvnd/egl_vendor.d/10_nvidia.json
RUN ldconfig && rm -f /var/cache/ldconfig/aux-cache
# What NVIDIA's container toolkit is to mount: Vulkan is `graphics`, nvidia-smi `utility`, libcuda, which the driver opens
# when it is there, `compute`.
ENV NVIDIA_VISIBLE_DEVICES=all NVIDIA_DRIVER_CAPABILITIES=graphics,utility,compute
USER 65532:65532
