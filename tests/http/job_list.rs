//! Lists of jobs: pages, states, and the jobs that a caller may see.

use crate::access_support::Keys;
use crate::http_support;

use std::collections::BTreeSet;
use std::sync::Arc;

use http_support::{Fake, Mode, Reply, Running, SAMPLE, sample, send, start, wait_for};
use serde_json::Value;

const ASYNC: (&str, &str) = ("prefer", "respond-async");

/// Starts a job and returns its address.
fn submit(server: &Running, headers: &[(&str, &str)], body: &[u8]) -> String {
    let reply = server.post("/v1/meshes", &[headers, &[ASYNC]].concat(), body);
    assert_eq!(reply.status, 202, "{}", reply.text());
    reply.header("location").unwrap().to_owned()
}

fn list(server: &Running, path: &str, headers: &[(&str, &str)]) -> Reply {
    send(server.addr, "GET", path, headers, b"")
}

/// Returns the addresses of the jobs of a page.
fn addresses(page: &Value) -> Vec<String> {
    let jobs = page["jobs"].as_array().unwrap().iter();
    jobs.map(|job| format!("/v1/jobs/{}", job["jobID"].as_str().unwrap())).collect()
}

/// Returns the address of the next page.
fn next(page: &Value) -> Option<String> {
    let link = page["links"].as_array().unwrap().iter().find(|link| link["rel"] == "next")?;
    Some(link["href"].as_str().unwrap().to_owned())
}

/// Returns the addresses of all jobs of a list, in order.
fn all(server: &Running, path: &str, headers: &[(&str, &str)]) -> Vec<String> {
    let (mut found, mut page) = (Vec::new(), Some(path.to_owned()));
    while let Some(path) = page {
        let reply = list(server, &path, headers);
        assert_eq!((reply.status, reply.header("cache-control")), (200, Some("no-store")), "{}", reply.text());
        found.extend(addresses(&reply.json()));
        page = next(&reply.json());
    }
    found
}

#[test]
fn pages_have_each_job_once_while_jobs_are_added() {
    let server = start(Fake::new(Mode::Octahedra), |_| {});
    let first: BTreeSet<String> = (0..7).map(|n| submit(&server, &[], &sample(n))).collect();
    for job in &first {
        assert_eq!(server.get(&format!("{job}?wait=20")).json()["status"], "successful");
    }
    let (mut found, mut page, mut n) = (Vec::new(), Some("/v1/jobs?limit=2".to_owned()), 7);
    while let Some(path) = page {
        let reply = server.get(&path).json();
        assert_eq!(reply["links"][0]["href"], path);
        let jobs = addresses(&reply);
        assert!(jobs.len() <= 2 && (jobs.len() == 2 || next(&reply).is_none()), "{reply}");
        for (job, address) in reply["jobs"].as_array().unwrap().iter().zip(&jobs) {
            assert!(!first.contains(address) || *job == server.get(address).json(), "{job}");
        }
        found.extend(jobs);
        submit(&server, &[], &sample(n));
        n += 1;
        page = next(&reply);
    }
    let distinct: BTreeSet<String> = found.iter().cloned().collect();
    assert_eq!(distinct.len(), found.len(), "a job is on two pages");
    assert!(distinct.is_superset(&first), "a job is on no page");
    assert_eq!(all(&server, "/v1/jobs", &[]).len(), n);
    for (query, parameter) in [("after=next", "after"), ("limit=1001", "limit"), ("state=done", "state"), ("x=1", "x")]
    {
        let problem = server.get(&format!("/v1/jobs?{query}")).problem(400, "bad-parameter");
        assert_eq!(problem["parameter"], parameter);
    }
}

#[test]
fn lists_are_filtered_by_state() {
    let backend = Fake::new(Mode::Octahedra);
    let server = start(Arc::clone(&backend) as _, |c| c.jobs.workers = 1);
    let ended = |job: String| {
        server.get(&format!("{job}?wait=20"));
        job
    };
    let successful = ended(submit(&server, &[], SAMPLE));
    let failed = ended(submit(&server, &[], b"HEADER\nnothing"));
    backend.set(Mode::Held);
    let running = submit(&server, &[], &sample(1));
    wait_for("the job runs", || server.get(&running).json()["status"] == "running");
    let [accepted, dismissed] = [2, 3].map(|n| submit(&server, &[], &sample(n)));
    assert_eq!(send(server.addr, "DELETE", &dismissed, &[], b"").status, 200);
    let jobs = [
        ("accepted", accepted),
        ("running", running),
        ("successful", successful),
        ("failed", failed),
        ("dismissed", dismissed),
    ];
    for (state, job) in &jobs {
        assert_eq!(all(&server, &format!("/v1/jobs?state={state}&limit=1"), &[]), std::slice::from_ref(job), "{state}");
    }
    assert_eq!(all(&server, "/v1/jobs", &[]).len(), jobs.len());
    backend.set(Mode::Octahedra);
}

#[test]
fn a_key_sees_the_jobs_of_its_group_after_a_restart() {
    let keys = Keys::new(&[("a", "read,mesh", ""), ("b", "read,mesh", ""), ("second", "read,mesh", "group = \"a\"")]);
    let folder = tempfile::tempdir().unwrap();
    let begin = || {
        start(Fake::new(Mode::Octahedra), |c| {
            folder.path().clone_into(&mut c.server.data_dir);
            c.access.keys_file = Some(keys.path());
        })
    };
    let of = |server: &Running, id: &str| all(server, "/v1/jobs?limit=2", &[("x-api-key", keys.text(id))]);
    let server = begin();
    let mut own = Vec::new();
    for (n, id) in ["a", "second", "a", "b", "a"].into_iter().enumerate() {
        let key = [("x-api-key", keys.text(id))];
        let job = submit(&server, &key, &sample(n));
        list(&server, &format!("{job}?wait=20"), &key);
        own.extend((id != "b").then_some(job));
    }
    own.sort();
    assert!(server.join());
    // The second list knows the namespaces from the first one.
    let server = begin();
    for _ in 0..2 {
        assert_eq!(of(&server, "b").len(), 1);
        assert_eq!([of(&server, "a"), of(&server, "second")], [own.clone(), own.clone()]);
    }
    list(&server, "/v1/jobs", &[]).problem(401, "key-required");
}

#[test]
fn without_keys_a_client_sees_the_jobs_of_its_address() {
    let server = start(Fake::new(Mode::Octahedra), |c| c.server.trusted_proxies = Some("127.0.0.1".parse().unwrap()));
    let clients = ["198.51.100.1", "198.51.100.2"].map(|address| [("x-forwarded-for", address)]);
    let jobs = [0, 1].map(|n| submit(&server, &clients[n], &sample(n)));
    for (client, job) in clients.iter().zip(&jobs) {
        assert_eq!(all(&server, "/v1/jobs", client), std::slice::from_ref(job));
    }
    list(&server, "/v1/jobs", &[]).problem(403, "client-unknown");
    // The proxy is not known to this service.
    let server = start(Fake::new(Mode::Octahedra), |c| c.access.cors_origins = Some("*".parse().unwrap()));
    let job = submit(&server, &clients[0], SAMPLE);
    for headers in [clients[1], [("via", "1.1 proxy")], [("origin", "https://other.example")]] {
        list(&server, "/v1/jobs", &headers).problem(403, "client-unknown");
    }
    assert_eq!(all(&server, "/v1/jobs", &[]), [job]);
}
