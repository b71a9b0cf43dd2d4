//! All metrics of the service. The doc comment of a metric is also its help text.
//!
//! Names follow the conventions of Prometheus: prefix `molmesh_`, base units, `_total` for counters, no ids as labels.
//! HTTP metrics have the names of OpenTelemetry, process metrics those of the Prometheus client libraries.

use super::metrics::{Label, Metric, MetricKind};

macro_rules! metrics {
    ($($(#[doc = $help:literal])+ $constant:ident = $name:literal, $kind:ident $(, $label:ident: $values:literal)*;)+) => {
        $($(#[doc = $help])+ pub const $constant: &str = $name;)+

        /// All metrics, in the order of the documentation.
        pub const METRICS: &[Metric] = &[$(
            Metric {
                name: $name,
                kind: MetricKind::$kind,
                labels: &[$(Label { name: stringify!($label), values: $values }),*],
                // Every line of a doc comment begins with a space.
                help: concat!($($help),+).trim_ascii(),
            }
        ),+];
    };
}

metrics! {
    /// Time from a request to the last byte of its response.
    HTTP_DURATION = "http_server_request_duration_seconds", Histogram,
        method: "GET|HEAD|POST|OPTIONS|PUT|DELETE|PATCH|other", route: "paths of the interface, or `unmatched`",
        status: "HTTP statuses, or `none` where the client left first";
    /// Requests in progress.
    HTTP_ACTIVE = "http_server_active_requests", Gauge,
        method: "GET|HEAD|POST|OPTIONS|PUT|DELETE|PATCH|other";
    /// Bytes read of a request body.
    HTTP_REQUEST_SIZE = "http_server_request_body_size_bytes", Histogram,
        method: "GET|HEAD|POST|OPTIONS|PUT|DELETE|PATCH|other", route: "paths of the interface, or `unmatched`",
        status: "HTTP statuses, or `none` where the client left first";
    /// Bytes sent of a response body.
    HTTP_RESPONSE_SIZE = "http_server_response_body_size_bytes", Histogram,
        method: "GET|HEAD|POST|OPTIONS|PUT|DELETE|PATCH|other", route: "paths of the interface, or `unmatched`",
        status: "HTTP statuses, or `none` where the client left first";
    /// Open connections.
    CONNECTIONS = "molmesh_connections", Gauge;
    /// Requests rejected by a limit, by the slug of the problem type where there is one.
    REJECTED = "molmesh_requests_rejected_total", Counter,
        reason: "slugs of problem types, `head-too-large`, `header-timeout`, `write-timeout`";
    /// Response bodies that are being sent.
    BODIES_OPEN = "molmesh_response_bodies_open", Gauge;
    /// Clients with a quota of their own.
    QUOTA_CLIENTS = "molmesh_quota_clients", Gauge;
    /// Accepted jobs, by mode. `dedup` is `yes` for jobs that joined an identical queued or running job.
    JOBS_SUBMITTED = "molmesh_jobs_submitted_total", Counter, mode: "sync|async", dedup: "yes|no";
    /// Completed jobs, by outcome.
    JOBS_FINISHED = "molmesh_jobs_finished_total", Counter, outcome: "successful|failed|dismissed|panicked";
    /// Asynchronous jobs that wait for a worker; with `broker.url`, jobs that wait or run on any node.
    BROKER_QUEUED = "molmesh_broker_jobs_queued", Gauge;
    /// 1 while jobs can be dispatched to the NATS server and claimed, else 0.
    BROKER_UP = "molmesh_broker_up", Gauge;
    /// Claims of jobs whose earlier claim expired or was returned. During an update it also counts jobs of other
    /// releases, which a node returns every 5 s.
    BROKER_REDELIVERIES = "molmesh_broker_redeliveries_total", Counter;
    /// Claims that the NATS server did not answer or rejected. They are repeated.
    BROKER_CLAIM_ERRORS = "molmesh_broker_claim_errors_total", Counter;
    /// Unfinished asynchronous jobs that were dispatched again, such as those of an earlier process.
    JOBS_RECOVERED = "molmesh_jobs_recovered_total", Counter;
    /// Jobs that a fallback backend ran instead of the selected one.
    JOBS_FALLBACK = "molmesh_jobs_fallback_total", Counter;
    /// Time of each stage of a job.
    STAGE_DURATION = "molmesh_job_stage_duration_seconds", Histogram,
        stage: "queue|check|read|select|exact|pockets|bin|field|classify|scan|refine|interpolate|emit|write|\
                improve|cavities|simplify|index|clip|measure|roundtrip|color|draw|png|encode";
    /// Results of synchronous requests that were not stored.
    RESULTS_NOT_STORED = "molmesh_results_not_stored_total", Counter, reason: "busy|failed";
    /// Jobs that wait for a worker, in all lanes.
    QUEUE_DEPTH = "molmesh_queue_depth", Gauge;
    /// Time for which the oldest job in the queue has waited.
    QUEUE_AGE = "molmesh_queue_oldest_age_seconds", Gauge;
    /// Estimated time that a new request would wait in the queue: the longer one of short and long requests.
    QUEUE_WAIT = "molmesh_queue_estimated_wait_seconds", Gauge;
    /// Bytes of uploads, jobs and meshes held in memory.
    MEMORY_HELD = "molmesh_memory_held_bytes", Gauge;
    /// Bytes of the memory budget in use: those held, buffers of connections, and structures that are kept.
    MEMORY_USED = "molmesh_memory_used_bytes", Gauge;
    /// Bytes of the memory budget, `limits.memory_bytes`.
    MEMORY_LIMIT = "molmesh_memory_limit_bytes", Gauge;
    /// Grid points at which the density was evaluated.
    GRID_POINTS = "molmesh_grid_points_evaluated_total", Counter;
    /// Triangles of finished meshes.
    TRIANGLES = "molmesh_triangles_emitted_total", Counter;
    /// 1 while the device accepts jobs, else 0.
    DEVICE_UP = "molmesh_device_up", Gauge, device: "numbers of devices in use";
    /// Time that a device spent on jobs: upload, computation and readback.
    DEVICE_BUSY = "molmesh_device_busy_seconds_total", Seconds, device: "numbers of devices in use";
    /// Failures of a device after which its state was discarded.
    DEVICE_LOST = "molmesh_device_lost_total", Counter, device: "numbers of devices in use", reason: "failed|hung";
    /// Rebuilds of a device after failures, including failed attempts.
    DEVICE_REBUILDS = "molmesh_device_rebuilds_total", Counter, device: "numbers of devices in use";
    /// Bytes of device memory and readback buffers held, in use, pooled and reserved.
    DEVICE_MEMORY = "molmesh_device_memory_bytes", Gauge, device: "numbers of devices in use";
    /// Jobs waiting for or running on a device.
    DEVICE_WAITING = "molmesh_device_jobs", Gauge, device: "numbers of devices in use";
    /// Jobs that a device finished or that failed because of it.
    DEVICE_JOBS = "molmesh_device_jobs_total", Counter, device: "numbers of devices in use", outcome: "finished|failed";
    /// Submissions shared by several jobs.
    DEVICE_SHARED = "molmesh_device_shared_submissions_total", Counter, device: "numbers of devices in use";
    /// Partitions of multi-device jobs that a device finished.
    DEVICE_PARTITIONS = "molmesh_device_partitions_total", Counter, device: "numbers of devices in use";
    /// Lookups of results. A miss in memory is followed by a lookup in the store.
    CACHE_REQUESTS = "molmesh_cache_requests_total", Counter, tier: "memory|store", result: "hit|miss";
    /// Lookups of structures in memory. A miss reads the file.
    STRUCTURE_CACHE_REQUESTS = "molmesh_structure_cache_requests_total", Counter, result: "hit|miss";
    /// Bytes of structures that are kept in memory.
    STRUCTURE_CACHE_BYTES = "molmesh_structure_cache_bytes", Gauge;
    /// Bytes of temporary files, which hold the indexes of tilesets, and archives of batches.
    SCRATCH_BYTES = "molmesh_scratch_bytes", Gauge;
    /// Bytes in the store.
    STORE_BYTES = "molmesh_store_bytes", Gauge, folder: "folders of the store";
    /// Objects in the store.
    STORE_OBJECTS = "molmesh_store_objects", Gauge, folder: "folders of the store";
    /// Job records in quarantine because they cannot be read.
    RECORDS_QUARANTINED = "molmesh_records_quarantined", Gauge;
    /// Objects that the store evicted or that expired.
    STORE_REMOVED = "molmesh_store_removed_total", Counter, reason: "ttl|cap|records";
    /// Failed operations of the store.
    STORE_ERRORS = "molmesh_store_errors_total", Counter, op: "operations of a store";
    /// Lookups of archive entries.
    ARCHIVE_REQUESTS = "molmesh_archive_requests_total", Counter, source: "local|cache|remote",
        result: "known|found|absent|unchanged|stale|corrupt|failed|too-large|no-memory|busy|unavailable";
    /// Time to fetch an entry from the remote archive, including all attempts and pauses.
    ARCHIVE_FETCH = "molmesh_archive_fetch_seconds", Histogram,
        result: "found|unchanged|absent|too-large|no-memory|busy|unavailable";
    /// 1 while the circuit breaker of a host of the remote archive is open, else 0.
    ARCHIVE_BREAKER = "molmesh_archive_breaker_open", Gauge, host: "hosts of `archive.url`";
    /// Bytes of cached archive entries on disk.
    ARCHIVE_KEPT = "molmesh_archive_cache_bytes", Gauge;
    /// Spans sent to the trace collector, by the result of their batch. Spans dropped from a full queue are logged
    /// instead.
    TRACE_SPANS = "molmesh_trace_spans_total", Counter, result: "exported|failed";
    /// Caught panics.
    PANICS = "molmesh_panics_total", Counter, component: "job|http";
    /// Always 1; the label is the version.
    BUILD_INFO = "molmesh_build_info", Gauge, version: "the version of this process";
    /// Processor time of all threads of the process.
    PROCESS_CPU = "process_cpu_seconds_total", Seconds;
    /// Resident memory of the process.
    PROCESS_RESIDENT = "process_resident_memory_bytes", Gauge;
    /// Virtual memory of the process.
    PROCESS_VIRTUAL = "process_virtual_memory_bytes", Gauge;
    /// Open file descriptors.
    PROCESS_FDS = "process_open_fds", Gauge;
    /// Maximum number of open file descriptors.
    PROCESS_MAX_FDS = "process_max_fds", Gauge;
    /// Threads of the process.
    PROCESS_THREADS = "process_threads", Gauge;
    /// Start time of the process, in seconds since 1970.
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
            let counts = matches!(metric.kind, MetricKind::Counter | MetricKind::Seconds);
            assert_eq!(name.ends_with("_total"), counts, "{name}");
            assert_eq!(metric.kind == MetricKind::Seconds, name.ends_with("_seconds_total"), "{name}");
            let known = ["molmesh_", "http_server_", "process_"].iter().any(|prefix| name.starts_with(prefix));
            assert!(known, "{name}");
            assert!(metric.help.ends_with('.') && metric.help.len() > 12, "{name}: {}", metric.help);
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
