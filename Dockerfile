# syntax=docker/dockerfile:1
# molmesh on CPUs: `docker build --target cpu -t molmesh .`, then
# `docker run --rm -p 8080:8080 -v molmesh:/data molmesh`.

FROM rust:1.95-slim-bookworm AS build
WORKDIR /build
COPY . .
# The caches stay on the builder; the binary is copied out of the one that holds it.
RUN --mount=type=cache,target=/usr/local/cargo/registry \
    --mount=type=cache,target=/build/target \
    cargo build --release --locked --bin molmesh \
    && cp target/release/molmesh /usr/local/bin/molmesh

FROM debian:bookworm-slim AS cpu
# 65532 is the customary number of a user that owns nothing.
RUN groupadd --gid 65532 molmesh && useradd --uid 65532 --gid 65532 --no-create-home --shell /usr/sbin/nologin molmesh \
    && install -d -o molmesh -g molmesh /data
COPY --from=build /usr/local/bin/molmesh /usr/local/bin/molmesh
# The archive is asked over TLS.
COPY --from=build /etc/ssl/certs/ca-certificates.crt /etc/ssl/certs/ca-certificates.crt
COPY LICENSE-MIT LICENSE-APACHE /usr/share/doc/molmesh/
USER 65532:65532
VOLUME /data
EXPOSE 8080 9090
HEALTHCHECK --interval=10s --timeout=3s --start-period=5s CMD ["molmesh", "healthcheck"]
# SIGTERM, the default stop signal, drains. Inside a container every interface is the container's own.
ENTRYPOINT ["molmesh"]
CMD ["serve", "--listen", "0.0.0.0:8080", "--metrics-listen", "0.0.0.0:9090", "--data-dir", "/data", "--log", "json"]
