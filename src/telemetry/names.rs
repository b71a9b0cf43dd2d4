//! Every metric of the service. The comment of each is its help text too.
//!
//! Names follow Prometheus: prefix `molmesh_`, base units, `_total` on counters, no ids as labels. Those of HTTP are named as
//! OpenTelemetry names them, those of the process as every exporter does.

use super::metrics::{Kind, Label, Metric};

macro_rules! metrics {
    ($($(#[doc = $help:literal])+ $constant:ident = $name:literal, $kind:ident $(, $label:ident: $values:literal)*;)+) => {
        $($(#[doc = $help])+ pub const $constant: &str = $name;)+

        /// Every metric, in the order in which they are documented.
        pub const METRICS: &[Metric] = &[$(
            Metric::new(
                $name,
                Kind::$kind,
                &[$(Label { name: stringify!($label), values: $values }),*],
                &[$($help),+],
            )
        ),+];
    };
}

metrics! {
    /// Time of a request until its answer is sent, to the last byte.
    HTTP_DURATION = "http_server_request_duration_seconds", Histogram,
        method: "GET|HEAD|POST|OPTIONS|PUT|DELETE|PATCH|other", route: "paths of the interface, or `unmatched`",
        status: "HTTP statuses, or `none` where the client left first";
    /// Requests that are being answered.
    HTTP_ACTIVE = "http_server_active_requests", Gauge,
        method: "GET|HEAD|POST|OPTIONS|PUT|DELETE|PATCH|other";
    /// Bytes of a request's body that were read.
    HTTP_REQUEST_SIZE = "http_server_request_body_size_bytes", Histogram,
        method: "GET|HEAD|POST|OPTIONS|PUT|DELETE|PATCH|other", route: "paths of the interface, or `unmatched`",
        status: "HTTP statuses, or `none` where the client left first";
    /// Bytes of an answer's body that were sent.
    HTTP_RESPONSE_SIZE = "http_server_response_body_size_bytes", Histogram,
        method: "GET|HEAD|POST|OPTIONS|PUT|DELETE|PATCH|other", route: "paths of the interface, or `unmatched`",
        status: "HTTP statuses, or `none` where the client left first";
    /// Open connections.
    CONNECTIONS = "molmesh_connections", Gauge;
    /// Requests refused by a limit, by the slug of the problem's type, or by the timeout that has none.
    REJECTED = "molmesh_requests_rejected_total", Counter, reason: "slugs of problem types, `header-timeout`, `write-timeout`";
    /// Response bodies that are being sent.
    BODIES_OPEN = "molmesh_response_bodies_open", Gauge;
    /// Clients whose quotas are counted one by one.
    QUOTA_CLIENTS = "molmesh_quota_clients", Gauge;
    /// Jobs accepted, by mode and by whether they took part in work that was in the house.
    JOBS_SUBMITTED = "molmesh_jobs_submitted_total", Counter, mode: "sync|async", dedup: "yes|no";
    /// Jobs that ended.
    JOBS_FINISHED = "molmesh_jobs_finished_total", Counter, outcome: "successful|failed|dismissed|panicked";
    /// Promised jobs that have not ended.
    JOBS_OPEN = "molmesh_jobs_open", Gauge;
    /// Promised jobs of earlier processes that were taken up again.
    JOBS_RECOVERED = "molmesh_jobs_recovered_total", Counter;
    /// Jobs that another backend served in place of the chosen one.
    JOBS_FALLBACK = "molmesh_jobs_fallback_total", Counter;
    /// Time per stage of a job.
    STAGE_DURATION = "molmesh_job_stage_duration_seconds", Histogram,
        stage: "queue|check|read|select|bin|field|classify|scan|interpolate|emit|write|measure|roundtrip|encode";
    /// Results of synchronous requests that were not kept.
    RESULTS_NOT_KEPT = "molmesh_results_not_kept_total", Counter, reason: "busy|failed";
    /// Jobs that wait.
    QUEUE_DEPTH = "molmesh_queue_depth", Gauge;
    /// How long the oldest job has waited.
    QUEUE_AGE = "molmesh_queue_oldest_age_seconds", Gauge;
    /// How long a job that is accepted now would wait.
    QUEUE_WAIT = "molmesh_queue_estimated_wait_seconds", Gauge;
    /// Bytes of uploads and meshes held in memory.
    MEMORY_HELD = "molmesh_memory_held_bytes", Gauge;
    /// Samples at which the density was evaluated.
    VOXELS = "molmesh_voxels_processed_total", Counter;
    /// Triangles of finished meshes.
    TRIANGLES = "molmesh_triangles_emitted_total", Counter;
    /// 1 while the device accepts jobs, else 0.
    DEVICE_UP = "molmesh_device_up", Gauge, device: "numbers of devices in use";
    /// Time that a device spent on jobs: upload, computation and readback.
    DEVICE_BUSY = "molmesh_device_busy_seconds_total", Seconds, device: "numbers of devices in use";
    /// Failures of a device after which its state was discarded.
    DEVICE_LOST = "molmesh_device_lost_total", Counter, device: "numbers of devices in use";
    /// Rebuilds of a device after failures, including failed attempts.
    DEVICE_REBUILDS = "molmesh_device_rebuilds_total", Counter, device: "numbers of devices in use";
    /// Bytes of device memory held, in use and pooled.
    DEVICE_MEMORY = "molmesh_device_memory_bytes", Gauge, device: "numbers of devices in use";
    /// Jobs waiting for or running on a device.
    DEVICE_WAITING = "molmesh_device_jobs", Gauge, device: "numbers of devices in use";
    /// Jobs that a device finished or that failed because of it.
    DEVICE_JOBS = "molmesh_device_jobs_total", Counter, device: "numbers of devices in use", outcome: "finished|failed";
    /// Submissions shared by several jobs.
    DEVICE_SHARED = "molmesh_device_shared_submissions_total", Counter, device: "numbers of devices in use";
    /// Partitions of multi-device jobs that a device finished.
    DEVICE_PARTITIONS = "molmesh_device_partitions_total", Counter, device: "numbers of devices in use";
    /// Results asked for: of those that memory misses, the store is asked.
    CACHE_REQUESTS = "molmesh_cache_requests_total", Counter, tier: "memory|store", result: "hit|miss";
    /// Bytes kept in the store.
    STORE_BYTES = "molmesh_store_bytes", Gauge, folder: "folders of the store";
    /// Objects kept in the store.
    STORE_OBJECTS = "molmesh_store_objects", Gauge, folder: "folders of the store";
    /// Objects that the store removed by itself.
    STORE_REMOVED = "molmesh_store_removed_total", Counter, reason: "ttl|cap";
    /// Operations of the store that failed.
    STORE_ERRORS = "molmesh_store_errors_total", Counter, op: "operations of a store";
    /// Questions for an entry of the archive.
    ARCHIVE_REQUESTS = "molmesh_archive_requests_total", Counter, source: "local|cache|remote",
        result: "known|found|absent|unchanged|stale|corrupt|failed|too-large|unavailable";
    /// Time of fetching an entry from the remote archive, every attempt and pause included.
    ARCHIVE_FETCH = "molmesh_archive_fetch_seconds", Histogram, result: "found|unchanged|absent|too-large|unavailable";
    /// 1 while a host of the remote archive is left alone, else 0.
    ARCHIVE_BREAKER = "molmesh_archive_breaker_open", Gauge, host: "hosts of `archive.url`";
    /// Bytes of copies of archive entries on disk.
    ARCHIVE_KEPT = "molmesh_archive_cache_bytes", Gauge;
    /// Spans sent to the trace collector, by the result of their batch. Spans dropped from a full queue are logged instead.
    TRACE_SPANS = "molmesh_trace_spans_total", Counter, result: "exported|failed";
    /// Panics that were caught.
    PANICS = "molmesh_panics_total", Counter, place: "job|http";
    /// 1, labelled with the version.
    BUILD_INFO = "molmesh_build_info", Gauge, version: "the version of this process";
    /// Processor time of the process, of all its threads.
    PROCESS_CPU = "process_cpu_seconds_total", Seconds;
    /// Memory of the process that is in RAM.
    PROCESS_RESIDENT = "process_resident_memory_bytes", Gauge;
    /// Address space of the process.
    PROCESS_VIRTUAL = "process_virtual_memory_bytes", Gauge;
    /// Open file descriptors.
    PROCESS_FDS = "process_open_fds", Gauge;
    /// File descriptors that may be open.
    PROCESS_MAX_FDS = "process_max_fds", Gauge;
    /// Threads of the process.
    PROCESS_THREADS = "process_threads", Gauge;
    /// When the process was started, in seconds since 1970.
    PROCESS_START = "process_start_time_seconds", Gauge;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_follow_the_conventions() {
        let mut names: Vec<&str> = METRICS.iter().map(|metric| metric.name).collect();
        for metric in METRICS {
            let name = metric.name;
            let counts = matches!(metric.kind, Kind::Counter | Kind::Seconds);
            assert_eq!(name.ends_with("_total"), counts, "{name}");
            assert_eq!(metric.kind == Kind::Seconds, name.ends_with("_seconds_total"), "{name}");
            let known = ["molmesh_", "http_server_", "process_"].iter().any(|prefix| name.starts_with(prefix));
            assert!(known, "{name}");
            assert!(metric.help().ends_with('.') && metric.help().len() > 12, "{name}: {}", metric.help());
            for label in metric.labels {
                assert!(!["id", "job", "request", "trace"].contains(&label.name), "{name}: {}", label.name);
            }
        }
        let all = names.len();
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), all);
    }
}
