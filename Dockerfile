# syntax=docker/dockerfile:1
# Container images for CPUs (`cpu`) and NVIDIA GPUs (`gpu`). docs/operate/container.md explains their use.
#
#   docker build --target cpu -t molmesh:cpu .
#   docker run --rm --read-only -p 8080:8080 -v molmesh:/data molmesh:cpu
#
# `deploy/container/build.sh` builds both with docker or podman, also without an image registry.
# `deploy/container/check.py` tests the images.

# Debian trixie is the stable release, so libc, the Vulkan loader and libraries of drivers receive security updates. The
# driver is mounted from the host and works with this libc (glibc 2.41; NVIDIA's libraries need 2.10). A binary built on
# bookworm runs here as well. Pin the digest for releases: `debian:trixie-slim@sha256:…`.
ARG BASE_IMAGE=docker.io/library/debian:trixie-slim
# The same Debian release as the base, so no symbol is newer than its libc. Pin the digest for releases.
ARG RUST_IMAGE=docker.io/library/rust:1.95-slim-trixie
# Builds the web page. Pin the digest for releases.
ARG NODE_IMAGE=docker.io/library/node:20-slim
# Source of the binary and the licence notices: `build` compiles them here, `prebuilt` copies dist/image.
ARG BINARY=build

# ------------------------------------------------------------------------------------------------- image content
FROM ${NODE_IMAGE} AS viewer
WORKDIR /build
COPY . .
RUN --mount=type=cache,target=/root/.npm sh web/build.sh

FROM ${RUST_IMAGE} AS build
# Meshes are compressed by C++ code. Python collects the licences of linked crates.
RUN apt-get update && apt-get install -y --no-install-recommends g++ python3 && rm -rf /var/lib/apt/lists/*
WORKDIR /build
COPY . .
COPY --from=viewer /build/web/dist web/dist
# The caches stay on the builder. stage.sh arranges the files as in the image.
RUN --mount=type=cache,target=/usr/local/cargo/registry \
    --mount=type=cache,target=/build/target \
    cargo build --release --locked --bin molmesh \
    && deploy/container/stage.sh target/release/molmesh /stage

FROM scratch AS prebuilt
COPY dist/image/ /stage/

FROM ${BINARY} AS binary

# Certificates for TLS connections to the archive, without Debian's tools for them.
FROM ${BASE_IMAGE} AS certificates
RUN apt-get update && apt-get install -y --no-install-recommends ca-certificates \
    && install -D -m 0644 /etc/ssl/certs/ca-certificates.crt /parts/etc/ssl/certs/ca-certificates.crt \
    && install -D -m 0644 /usr/share/doc/ca-certificates/copyright /parts/usr/share/doc/ca-certificates/copyright \
    # Scanners find packages that were copied without dpkg in this folder.
    && mkdir -p /parts/var/lib/dpkg/status.d && dpkg-query --status ca-certificates >/parts/var/lib/dpkg/status.d/ca-certificates

# ------------------------------------------------------------------------------------------------------- for CPUs
FROM ${BASE_IMAGE} AS cpu
# 65532 is the customary id of an unprivileged user. No file keeps a setuid bit.
RUN groupadd --gid 65532 molmesh \
    && useradd --uid 65532 --gid 65532 --no-create-home --home-dir /nonexistent --shell /usr/sbin/nologin molmesh \
    && install -d -o molmesh -g molmesh -m 0750 /data \
    && find / -xdev -type f -perm /6000 -exec chmod a-s {} + \
    && rm -f /var/log/*.log /var/log/apt/* /etc/passwd- /etc/group- /etc/shadow- /etc/gshadow-
COPY --from=certificates /parts/ /
COPY deploy/container/molmesh.toml /etc/molmesh/molmesh.toml
COPY --from=binary /stage/ /
# Fails if the binary does not run with this libc.
RUN ["molmesh", "--version"]
ARG VERSION=unknown
ARG REVISION=unknown
ARG CREATED=1970-01-01T00:00:00Z
ARG SOURCE=
LABEL org.opencontainers.image.title="molmesh" \
      org.opencontainers.image.description="Watertight molecular-surface meshes from PDB, mmCIF, BinaryCIF, PQR and XYZ files: an HTTP service and a command line" \
      org.opencontainers.image.licenses="MIT OR Apache-2.0" \
      org.opencontainers.image.version="${VERSION}" \
      org.opencontainers.image.revision="${REVISION}" \
      org.opencontainers.image.created="${CREATED}" \
      org.opencontainers.image.source="${SOURCE}" \
      org.opencontainers.image.documentation="docs/operate/container.md"
USER 65532:65532
VOLUME /data
EXPOSE 8080 9090
# The first mesh is computed before the service is ready; a GPU's pipelines are built before that.
HEALTHCHECK --interval=10s --timeout=4s --start-period=30s --retries=3 CMD ["molmesh", "healthcheck"]
# SIGTERM, the default, drains; see server.drain_timeout_ms.
STOPSIGNAL SIGTERM
ENTRYPOINT ["molmesh"]
# Every command in the image reads this file: `docker run … molmesh:cpu doctor` checks the service's configuration.
ENV MOLMESH_CONFIG=/etc/molmesh/molmesh.toml
CMD ["serve"]

# ----------------------------------------------------------------------------------------------- for NVIDIA's GPUs
# NVIDIA's Vulkan driver needs libEGL.so.1 even without a display. Debian's package depends on Mesa (200 MB), but the
# library itself consists of two files.
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
# The Vulkan loader, and the libraries that the Vulkan driver (libGLX_nvidia.so.0) is linked with.
RUN apt-get update \
    && apt-get install -y --no-install-recommends libvulkan1 libx11-6 libxext6 \
    && rm -rf /var/lib/apt/lists/* /var/cache/apt/* /var/log/*.log /var/log/apt/* /var/cache/ldconfig/aux-cache
COPY --from=egl /parts/ /
# Driver manifests. NVIDIA's toolkit mounts the host's manifests over these if they exist. If both are read, molmesh
# detects the duplicate device.
COPY deploy/container/nvidia_icd.json /usr/share/vulkan/icd.d/nvidia_icd.json
COPY deploy/container/10_nvidia.json /usr/share/glvnd/egl_vendor.d/10_nvidia.json
RUN ldconfig && rm -f /var/cache/ldconfig/aux-cache
# Capabilities that NVIDIA's container toolkit mounts: `graphics` for Vulkan, `utility` for nvidia-smi, `compute` for
# libcuda, which the driver loads if it exists.
ENV NVIDIA_VISIBLE_DEVICES=all NVIDIA_DRIVER_CAPABILITIES=graphics,utility,compute
USER 65532:65532
