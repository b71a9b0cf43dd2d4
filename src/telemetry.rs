//! Logs and metric names. The one place that installs global state: the log subscriber, the panic hook and the
//! metrics recorder.
//!
//! Names follow Prometheus: prefix `molmesh_`, base units, `_total` on counters, no ids as labels. Durations are
//! seconds.

use std::sync::OnceLock;

use metrics_exporter_prometheus::{Matcher, PrometheusBuilder, PrometheusHandle};
use thiserror::Error;
use tracing_subscriber::EnvFilter;
use tracing_subscriber::util::SubscriberInitExt as _;

use crate::config::{LogConfig, LogFormat};

/// Time of a request until its answer is sent, by method, route and status.
pub const HTTP_DURATION: &str = "http_server_request_duration_seconds";
/// Open connections.
pub const CONNECTIONS: &str = "molmesh_connections";
/// Jobs accepted, by mode (`sync`, `async`) and whether they took part in work that was in the house (`dedup`).
pub const JOBS_SUBMITTED: &str = "molmesh_jobs_submitted_total";
/// Jobs ended, by outcome: `successful`, `failed`, `dismissed`, `panicked`.
pub const JOBS_FINISHED: &str = "molmesh_jobs_finished_total";
/// Promised jobs that have not ended.
pub const JOBS_OPEN: &str = "molmesh_jobs_open";
/// Promised jobs of earlier processes that were taken up again.
pub const JOBS_RECOVERED: &str = "molmesh_jobs_recovered_total";
/// Results of synchronous requests that were not kept, by reason: `busy`, `failed`.
pub const RESULTS_NOT_KEPT: &str = "molmesh_results_not_kept_total";
/// Jobs that another backend served in place of the chosen one.
pub const JOBS_FALLBACK: &str = "molmesh_jobs_fallback_total";
/// 1 while the device takes jobs, else 0, by device number.
pub const DEVICE_UP: &str = "molmesh_device_up";
/// Jobs that a device ended, by device and outcome: `finished`, or `failed` for the device's sake.
pub const DEVICE_JOBS: &str = "molmesh_device_jobs_total";
/// Times that a device was built anew after a failure.
pub const DEVICE_REBUILDS: &str = "molmesh_device_rebuilds_total";
/// Submissions that several jobs shared, by device.
pub const DEVICE_SHARED: &str = "molmesh_device_shared_submissions_total";
/// Jobs of which a device made a part, by device.
pub const DEVICE_SPREAD: &str = "molmesh_device_spread_jobs_total";
/// Bytes of a device's memory that are held, in use and pooled.
pub const DEVICE_HELD: &str = "molmesh_device_memory_held_bytes";
/// Jobs that wait for a device or run on it.
pub const DEVICE_WAITING: &str = "molmesh_device_jobs";
/// Time per stage.
pub const STAGE_DURATION: &str = "molmesh_job_stage_duration_seconds";
/// Jobs that wait.
pub const QUEUE_DEPTH: &str = "molmesh_queue_depth";
/// How long the oldest job has waited.
pub const QUEUE_AGE: &str = "molmesh_queue_oldest_age_seconds";
/// How long a job that is accepted now would wait.
pub const QUEUE_WAIT: &str = "molmesh_queue_estimated_wait_seconds";
/// Requests refused by a limit, by the limit's problem type.
pub const REJECTED: &str = "molmesh_requests_rejected_total";
/// Clients whose quotas are counted one by one.
pub const QUOTA_CLIENTS: &str = "molmesh_quota_clients";
/// Bytes of uploads and meshes held in memory.
pub const MEMORY_HELD: &str = "molmesh_memory_held_bytes";
/// Samples at which the density was evaluated.
pub const VOXELS: &str = "molmesh_voxels_processed_total";
/// Triangles of finished meshes.
pub const TRIANGLES: &str = "molmesh_triangles_emitted_total";
/// Bytes kept in the store, by folder.
pub const STORE_BYTES: &str = "molmesh_store_bytes";
/// Objects kept in the store, by folder.
pub const STORE_OBJECTS: &str = "molmesh_store_objects";
/// Objects that the store removed by itself, by reason: `ttl` or `cap`.
pub const STORE_REMOVED: &str = "molmesh_store_removed_total";
/// Operations of the store that failed, by operation.
pub const STORE_ERRORS: &str = "molmesh_store_errors_total";
/// Results asked for, by tier (`memory`, then `store`) and result (`hit`, `miss`).
pub const CACHE_REQUESTS: &str = "molmesh_cache_requests_total";
/// Questions for an entry of the archive, by source (`local`, `cache`, `remote`) and result.
pub const ARCHIVE_REQUESTS: &str = "molmesh_archive_requests_total";
/// Time of fetching an entry from the remote archive, every attempt and pause included, by result.
pub const ARCHIVE_FETCH: &str = "molmesh_archive_fetch_seconds";
/// 1 while a host of the remote archive is left alone, else 0, by host.
pub const ARCHIVE_BREAKER: &str = "molmesh_archive_breaker_open";
/// Bytes of copies of archive entries on disk.
pub const ARCHIVE_KEPT: &str = "molmesh_archive_cache_bytes";
/// Panics that were caught, by place.
pub const PANICS: &str = "molmesh_panics_total";
/// 1, labelled with the version.
pub const BUILD_INFO: &str = "molmesh_build_info";

/// Buckets of durations, seconds: from a cached answer to the deadline, about three a decade.
const BUCKETS: [f64; 16] =
    [0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0];

/// Why logs or metrics cannot be set up.
#[derive(Debug, Error)]
pub enum TelemetryError {
    /// The log filter cannot be read.
    #[error("log.filter `{filter}` is not valid: {reason}")]
    Filter {
        /// The filter.
        filter: String,
        /// The parser's words.
        reason: String,
    },
    /// Another logger or recorder is installed in this process.
    #[error("{what} cannot be installed: {reason}")]
    Install {
        /// `the log` or `the metrics recorder`.
        what: &'static str,
        /// The library's words.
        reason: String,
    },
}

/// Whether logs could be set up so.
///
/// # Errors
/// [`TelemetryError::Filter`].
pub fn check_logs(config: &LogConfig) -> Result<(), TelemetryError> {
    filter(config).map(|_filter| ())
}

fn filter(config: &LogConfig) -> Result<EnvFilter, TelemetryError> {
    EnvFilter::try_new(&config.filter)
        .map_err(|e| TelemetryError::Filter { filter: config.filter.clone(), reason: e.to_string() })
}

/// Sends logs to standard error and panics to the log.
///
/// # Errors
/// [`TelemetryError`].
pub fn init_logs(config: &LogConfig) -> Result<(), TelemetryError> {
    let filter = filter(config)?;
    let builder = tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr);
    let installed = match config.format {
        LogFormat::Pretty => {
            builder.with_ansi(std::io::IsTerminal::is_terminal(&std::io::stderr())).finish().try_init()
        }
        LogFormat::Json => builder.json().flatten_event(true).finish().try_init(),
    };
    installed.map_err(|e| TelemetryError::Install { what: "the log", reason: e.to_string() })?;
    std::panic::set_hook(Box::new(|info| {
        let place = info.location().map(ToString::to_string).unwrap_or_default();
        tracing::error!(place, message = info.payload_as_str().unwrap_or("no message"), "panic");
    }));
    Ok(())
}

/// The recorder of this process, installed by the first caller.
///
/// # Errors
/// [`TelemetryError::Install`] if somebody else installed another one.
pub fn recorder() -> Result<PrometheusHandle, TelemetryError> {
    static RECORDER: OnceLock<Result<PrometheusHandle, String>> = OnceLock::new();
    let installed = RECORDER.get_or_init(|| {
        let handle = [HTTP_DURATION, STAGE_DURATION, ARCHIVE_FETCH]
            .into_iter()
            .try_fold(PrometheusBuilder::new(), |builder, name| {
                builder.set_buckets_for_metric(Matcher::Full(name.to_owned()), &BUCKETS)
            })
            .and_then(PrometheusBuilder::install_recorder)
            .map_err(|e| e.to_string())?;
        describe();
        Ok(handle)
    });
    installed.clone().map_err(|reason| TelemetryError::Install { what: "the metrics recorder", reason })
}

/// Gives every metric its help text, and those that exist from the start a value.
fn describe() {
    use metrics::{Unit, counter, describe_counter, describe_gauge, describe_histogram, gauge};
    describe_histogram!(HTTP_DURATION, Unit::Seconds, "Time of a request until its answer is sent");
    describe_gauge!(CONNECTIONS, "Open connections");
    describe_counter!(JOBS_SUBMITTED, "Jobs accepted");
    describe_counter!(JOBS_FINISHED, "Jobs ended, by outcome");
    describe_counter!(RESULTS_NOT_KEPT, "Results of synchronous requests that were not kept");
    describe_gauge!(JOBS_OPEN, "Promised jobs that have not ended");
    describe_counter!(JOBS_RECOVERED, "Promised jobs of earlier processes that were taken up again");
    describe_counter!(JOBS_FALLBACK, "Jobs that another backend served in place of the chosen one");
    describe_gauge!(DEVICE_UP, "1 while the device takes jobs");
    describe_counter!(DEVICE_JOBS, "Jobs that a device ended, by outcome");
    describe_counter!(DEVICE_REBUILDS, "Times that a device was built anew after a failure");
    describe_counter!(DEVICE_SHARED, "Submissions that several jobs shared");
    describe_counter!(DEVICE_SPREAD, "Jobs of which a device made a part");
    describe_gauge!(DEVICE_HELD, Unit::Bytes, "Bytes of a device's memory that are held");
    describe_gauge!(DEVICE_WAITING, "Jobs that wait for a device or run on it");
    describe_histogram!(STAGE_DURATION, Unit::Seconds, "Time per stage of a job");
    describe_gauge!(QUEUE_DEPTH, "Jobs that wait");
    describe_gauge!(QUEUE_AGE, Unit::Seconds, "How long the oldest job has waited");
    describe_gauge!(QUEUE_WAIT, Unit::Seconds, "How long a job that is accepted now would wait");
    describe_counter!(REJECTED, "Requests refused by a limit");
    describe_gauge!(QUOTA_CLIENTS, "Clients whose quotas are counted one by one");
    describe_gauge!(MEMORY_HELD, Unit::Bytes, "Bytes of uploads and meshes held in memory");
    describe_counter!(VOXELS, "Samples at which the density was evaluated");
    describe_counter!(TRIANGLES, "Triangles of finished meshes");
    describe_gauge!(STORE_BYTES, Unit::Bytes, "Bytes kept in the store");
    describe_gauge!(STORE_OBJECTS, "Objects kept in the store");
    describe_counter!(STORE_REMOVED, "Objects that the store removed by itself, by reason");
    describe_counter!(STORE_ERRORS, "Operations of the store that failed");
    describe_counter!(CACHE_REQUESTS, "Results asked for, by tier and result");
    describe_counter!(ARCHIVE_REQUESTS, "Questions for an entry of the archive, by source and result");
    describe_histogram!(ARCHIVE_FETCH, Unit::Seconds, "Time of fetching an entry from the remote archive");
    describe_gauge!(ARCHIVE_BREAKER, "1 while a host of the remote archive is left alone");
    describe_gauge!(ARCHIVE_KEPT, Unit::Bytes, "Bytes of copies of archive entries on disk");
    describe_counter!(PANICS, "Panics that were caught");
    describe_gauge!(BUILD_INFO, "1, labelled with the version");
    gauge!(BUILD_INFO, "version" => env!("CARGO_PKG_VERSION")).set(1.0);
    for gauge_name in [CONNECTIONS, JOBS_OPEN, QUEUE_DEPTH, QUEUE_AGE, QUEUE_WAIT, MEMORY_HELD, QUOTA_CLIENTS] {
        gauge!(gauge_name).set(0.0);
    }
    for counter_name in [VOXELS, TRIANGLES, JOBS_FALLBACK, JOBS_RECOVERED] {
        counter!(counter_name).increment(0);
    }
    for reason in ["ttl", "cap"] {
        counter!(STORE_REMOVED, "reason" => reason).increment(0);
    }
    for tier in ["memory", "store"] {
        for result in ["hit", "miss"] {
            counter!(CACHE_REQUESTS, "tier" => tier, "result" => result).increment(0);
        }
    }
    for place in ["job", "http"] {
        counter!(PANICS, "place" => place).increment(0);
    }
}
