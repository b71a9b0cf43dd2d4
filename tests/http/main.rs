//! Tests of the HTTP service, its store, jobs, archive and OpenAPI document.

#![allow(clippy::unwrap_used, clippy::panic, reason = "tests fail by panicking")]

#[path = "../access_support/mod.rs"]
mod access_support;
#[path = "../archive_support/mod.rs"]
mod archive_support;
#[path = "../bcif_support/mod.rs"]
mod bcif_support;
#[path = "../cli_support/mod.rs"]
mod cli_support;
#[path = "../http_support/mod.rs"]
mod http_support;
#[path = "../../src/jobs/broker/nats_server.rs"]
mod nats;
#[path = "../openapi_support/mod.rs"]
mod openapi_support;
#[path = "../store_support/mod.rs"]
mod store_support;
#[path = "../tools/mod.rs"]
mod tools;

mod access;
mod api;
mod archive_http;
mod auto;
mod bad_input;
mod batches;
mod cluster;
mod codings;
mod config;
mod config_limits;
mod config_schema;
#[cfg(target_os = "linux")]
mod crash;
mod defaults;
mod devices;
mod job_list;
mod jobs;
mod jobs_durable;
mod lifecycle;
mod limits;
mod maps;
#[cfg(target_os = "linux")]
mod memory;
mod namespaces;
mod openapi;
mod openapi_clients;
mod openapi_statuses;
mod origins;
mod pictures;
mod raw_sockets;
mod ready;
mod recorded_bytes;
mod results;
mod schemathesis;
mod service_s3;
mod shares;
mod slow_readers;
mod spacing;
mod stop;
mod store;
mod tilesets;
