//! Tests of metrics, dashboards and traces. Their own process, as metrics are counted per process.

#![allow(clippy::unwrap_used, clippy::panic, reason = "tests fail by panicking")]

#[path = "../archive_support/mod.rs"]
mod archive_support;
#[path = "../http_support/mod.rs"]
mod http_support;
#[path = "../metrics_support/mod.rs"]
mod metrics_support;
#[path = "../../src/jobs/broker/nats_server.rs"]
mod nats;
#[path = "../tools/mod.rs"]
mod tools;
#[path = "../trace_support/mod.rs"]
mod trace_support;

mod dashboards;
mod metrics;
mod traces;
