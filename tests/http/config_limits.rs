//! Every limit of the configuration has a metric and a test, and is documented.

use crate::http_support;

use std::collections::BTreeSet;
use std::path::Path;
use std::process::Command;

use http_support::{Fake, Mode, start};
use molmesh::telemetry::{METRICS, REJECTED};
use serde_json::Value;

/// Key; metric or reason in `molmesh_requests_rejected_total` that counts hits of the limit (empty if nothing is
/// rejected or lost); test that reaches the limit.
type Row = (&'static str, &'static str, &'static str);

const ROWS: &[Row] = &[
    ("server.connections", "too-many-connections", "http/limits::excess_connections_are_rejected_with_503"),
    ("server.client_share", "share-exceeded", "http/shares::a_client_cannot_take_all_connections"),
    ("server.termination_notice_ms", "", "http/stop::the_notice_is_limited_and_optional"),
    ("server.drain_timeout_ms", "", "http/lifecycle::a_drain_has_a_deadline"),
    ("limits.body_bytes", "body-too-large", "http/limits::bodies_are_limited_with_and_without_a_declared_length"),
    ("limits.inflated_bytes", "inflated-too-large", "http/limits::compression_bombs_stop_at_the_inflated_limit"),
    ("limits.atoms", "too-many-atoms", "http/limits::atoms_are_limited"),
    ("limits.grid_points", "grid-too-large", "http/limits::grids_and_meshes_are_limited_and_suggested_spacings_fit"),
    (
        "limits.candidate_pairs",
        "too-many-candidates",
        "http/limits::grids_and_meshes_are_limited_and_suggested_spacings_fit",
    ),
    ("limits.mesh_bytes", "mesh-too-large", "http/limits::grids_and_meshes_are_limited_and_suggested_spacings_fit"),
    ("limits.memory_bytes", "memory-full", "cli/memory::a_burst_of_large_uploads_stays_within_the_memory_limit"),
    (
        "limits.structure_cache_bytes",
        "molmesh_structure_cache_requests_total",
        "src/jobs/structures::the_limit_is_respected_and_the_least_recently_used_structure_is_evicted",
    ),
    ("limits.scratch_bytes", "molmesh_scratch_bytes", "http/tilesets::a_tileset_larger_than_the_cache_is_on_disk"),
    ("jobs.workers", "molmesh_queue_depth", "http/limits::a_full_queue_rejects_with_retry_after"),
    ("jobs.queue", "queue-full", "http/limits::a_full_queue_rejects_with_retry_after"),
    ("jobs.deadline_ms", "deadline", "http/limits::the_deadline_includes_queueing_and_stops_the_job"),
    (
        "jobs.batch_deadline_ms",
        "molmesh_jobs_finished_total",
        "http/openapi_statuses::the_server_returns_every_documented_status_and_no_other",
    ),
    (
        "jobs.attempts",
        "molmesh_jobs_finished_total",
        "http/jobs_durable::a_job_that_repeatedly_crashes_the_process_fails",
    ),
    (
        "jobs.records_per_client",
        "too-many-jobs",
        "src/jobs/tests/records::records_are_limited_in_total_and_for_each_client",
    ),
    (
        "broker.replicas",
        "molmesh_broker_up",
        "src/jobs/broker/tests/nats_only::a_stream_that_cannot_be_created_is_reported",
    ),
    (
        "broker.lease_ms",
        "molmesh_broker_redeliveries_total",
        "http/cluster::a_job_of_a_killed_worker_runs_again_on_another_one",
    ),
    ("broker.queue", "queue-full", "http/limits::a_full_broker_rejects_jobs_with_retry_after"),
    (
        "devices.readback_bytes",
        "molmesh_device_memory_bytes",
        "gpu/meshes::a_device_with_reserved_memory_allocates_no_readback_buffer",
    ),
    ("archive.cache_bytes", "molmesh_archive_cache_bytes", "http/archive_http::least_recently_used_copies_are_evicted"),
    (
        "store.timeout_ms",
        "molmesh_store_errors_total",
        "cli/doctor::a_store_that_does_not_respond_fails_in_bounded_time",
    ),
    ("store.max_bytes", "store-full", "http/store::objects_over_the_capacity_are_rejected"),
    (
        "store.result_ttl_ms",
        "molmesh_store_removed_total",
        "http/store::objects_expire_by_folder_and_use_prolongs_their_life",
    ),
    (
        "store.input_ttl_ms",
        "molmesh_store_removed_total",
        "http/store::objects_expire_by_folder_and_use_prolongs_their_life",
    ),
    ("access.address_requests", "quota-exceeded", "http/access::addresses_have_quotas_also_behind_trusted_proxies"),
    ("access.address_work_s", "quota-exceeded", "http/access::addresses_have_quotas_of_time"),
    ("telemetry.sample_ratio", "molmesh_trace_spans_total", "telemetry/traces::a_fraction_of_the_traces_is_recorded"),
];

fn read(path: &str) -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(path);
    std::fs::read_to_string(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// Returns the keys and defaults of all numbers in the schema.
fn numbers() -> Vec<(String, Value)> {
    let schema = molmesh::config::schema();
    let mut found = Vec::new();
    for (section, of_section) in schema["properties"].as_object().unwrap() {
        for (key, of_key) in of_section["properties"].as_object().unwrap() {
            if of_key.get("minimum").is_some() {
                found.push((format!("{section}.{key}"), of_key["default"].clone()));
            }
        }
    }
    found
}

/// Returns the names of all metrics, and the reasons of rejections: the problem types that a running service explains,
/// and the other values of the label.
fn counted() -> BTreeSet<String> {
    let server = start(Fake::new(Mode::Octahedra), |_| {});
    let problems = server.get("/problems").json();
    let slugs = problems.as_array().unwrap().iter().map(|problem| problem["type"].as_str().unwrap());
    let mut counted: BTreeSet<String> = slugs.map(|kind| kind.rsplit('/').next().unwrap().to_owned()).collect();
    for metric in METRICS {
        counted.insert(metric.name.to_owned());
        if metric.name == REJECTED {
            counted.extend(metric.labels[0].values.split('`').skip(1).step_by(2).map(str::to_owned));
        }
    }
    counted
}

/// Returns the tests of this program.
fn tests() -> BTreeSet<String> {
    let listed = Command::new(std::env::current_exe().unwrap()).args(["--list", "--format", "terse"]).output().unwrap();
    let listed = String::from_utf8(listed.stdout).unwrap();
    listed.lines().filter_map(|line| Some(format!("http/{}", line.strip_suffix(": test")?))).collect()
}

/// Returns the errors in a list of rows.
fn faults(rows: &[Row], counted: &BTreeSet<String>, tests: &BTreeSet<String>) -> Vec<String> {
    let mut faults = Vec::new();
    let listed: BTreeSet<String> = rows.iter().map(|(key, ..)| (*key).to_owned()).collect();
    let known: BTreeSet<String> = numbers().into_iter().map(|(key, _)| key).collect();
    faults.extend(listed.symmetric_difference(&known).map(|key| format!("{key} is only in one of list and schema")));
    for (key, reason, test) in rows {
        if !reason.is_empty() && !counted.contains(*reason) {
            faults.push(format!("{key}: no metric or reason {reason}"));
        }
        let (file, name) = test.split_once("::").unwrap();
        // Tests of other programs are looked up in their files.
        let is_known = if file.starts_with("http/") {
            // A test of several stores has a name for each.
            let (module, end) = (format!("{file}::"), format!("::{name}"));
            tests.iter().any(|test| test.starts_with(&module) && test.ends_with(&end))
        } else {
            let folder = if file.starts_with("src/") { "" } else { "tests/" };
            read(&format!("{folder}{file}.rs")).contains(&format!("fn {name}("))
        };
        if !is_known {
            faults.push(format!("{key}: no test {test}"));
        }
    }
    faults
}

#[test]
fn every_limit_has_a_metric_and_a_test() {
    let (counted, tests) = (counted(), tests());
    assert_eq!(faults(ROWS, &counted, &tests), Vec::<String>::new());
    // Control: a missing key, an unknown key, an unknown metric and unknown tests.
    assert!(faults(&ROWS[1..], &counted, &tests)[0].contains("server.connections"));
    for bad in [
        ("server.atoms", "deadline", "http/limits::atoms_are_limited"),
        ("limits.atoms", "molmesh_nothing", "http/limits::atoms_are_limited"),
        ("limits.atoms", "too-many-atoms", "http/limits::nothing"),
        ("limits.atoms", "too-many-atoms", "cli/memory::nothing"),
    ] {
        assert_eq!(faults(&[ROWS, &[bad]].concat(), &counted, &tests).len(), 1, "{bad:?}");
    }
}

/// Returns the differences between a documentation page and the list.
fn differences(page: &str) -> Vec<String> {
    let mut rows: Vec<(String, String, String)> = Vec::new();
    for line in page.lines().filter(|line| line.starts_with("| `")) {
        let cells: Vec<&str> = line.trim_matches('|').split(" | ").map(|cell| cell.trim_matches([' ', '`'])).collect();
        if let [key, default, .., counted] = cells[..]
            && key.contains('.')
        {
            rows.push((key.to_owned(), default.to_owned(), counted.replace('`', "")));
        }
    }
    let mut faults = Vec::new();
    for (key, default) in numbers() {
        let default = match (default.as_u64(), default.as_str()) {
            (Some(n), _) => formatted(&key, n),
            (None, Some(text)) => text.to_owned(),
            (None, None) => default.to_string(),
        };
        let counted = ROWS.iter().find(|row| row.0 == key).map(|row| row.1).unwrap_or_default();
        let counted = if counted.is_empty() { "–" } else { counted };
        let of_key: Vec<_> = rows.iter().filter(|row| row.0 == key).collect();
        match of_key[..] {
            [(_, documented, by)] if *documented == default && by == counted => {}
            _ => faults.push(format!("expected `{key}` | {default} | … | `{counted}`, found {of_key:?}")),
        }
    }
    let known: BTreeSet<String> = numbers().into_iter().map(|(key, _)| key).collect();
    faults.extend(rows.iter().filter(|row| !known.contains(&row.0)).map(|row| format!("{} is not a limit", row.0)));
    faults
}

/// Formats a number as in the documentation.
fn formatted(key: &str, n: u64) -> String {
    if key.ends_with("_bytes") {
        let (shift, suffix) = [(30, "GiB"), (20, "MiB"), (10, "KiB")].into_iter().find(|(s, _)| n >= 1 << s).unwrap();
        assert_eq!(n >> shift << shift, n, "{key}");
        return format!("{} {suffix}", n >> shift);
    }
    let digits = n.to_string();
    let grouped: Vec<&str> = digits.as_bytes().rchunks(3).rev().map(|c| std::str::from_utf8(c).unwrap()).collect();
    let unit = if key.ends_with("_ms") { " ms" } else { "" };
    format!("{}{unit}", grouped.join(","))
}

#[test]
fn the_documented_limits_match_the_configuration() {
    let page = read("docs/operate/limits.md");
    assert_eq!(differences(&page), Vec::<String>::new());
    // Control: a different default, a missing row.
    assert_eq!(differences(&page.replace("| 1,024 |", "| 1,025 |")).len(), 1);
    let fewer = page.lines().filter(|line| !line.contains("`jobs.queue`")).collect::<Vec<_>>().join("\n");
    assert_eq!(differences(&fewer).len(), 1);
}
