//! Memory of the whole process: it stays within the configured limit under load, in a process that cannot have more.
#![cfg(target_os = "linux")]

use crate::cli_support;
use crate::http_support;

use std::io::Write as _;
use std::time::{Duration, Instant};

use cli_support::{Folder, Service};
use http_support::send;

/// Limit of the service, MiB.
const BUDGET: u64 = 256;
/// Memory outside the budget: threads, the runtime, and requests that are refused, MiB.
const OVERHEAD: u64 = 96;

/// Returns a compressed PDB file of `n`³ atoms: 40 MB of text for n = 80.
fn upload(n: u32) -> Vec<u8> {
    let mut gzip = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    gzip.write_all(cli_support::block(n).as_bytes()).unwrap();
    gzip.finish().unwrap()
}

#[test]
fn a_burst_of_large_uploads_stays_within_the_memory_limit() {
    let folder = Folder::new();
    let budget = format!("limits.memory_bytes={BUDGET}MiB");
    let sets = [&budget, "limits.structure_cache_bytes=16MiB", "jobs.workers=4", "server.client_share=1"];
    let settings = [&["--devices", "cpu"][..], &sets.map(|set| ["--set", set]).concat()].concat();
    // The address space holds 1 GiB that the allocator reserves, and the stacks of all threads.
    let service = Service::start_limited(&folder, 4 << 30, &settings);
    let addr = service.addr.parse().unwrap();
    let (idle, body) = (service.memory("VmRSS"), upload(80));
    let targets = [
        "/v1/structures",
        "/v1/estimate?resolution=2",
        "/v1/report?resolution=2",
        "/v1/meshes?resolution=2",
        "/v1/meshes?resolution=2.5&format=png",
        "/v1/meshes?resolution=3&check=strict",
    ];
    let statuses: Vec<u16> = std::thread::scope(|scope| {
        let ask = |n: usize| {
            let (target, body) = (targets[n % targets.len()], &body);
            let separator = if target.contains('?') { '&' } else { '?' };
            // Different parameters, so that no two requests share a job.
            let target = match target {
                "/v1/structures" => target.to_owned(),
                _ => format!("{target}{separator}isovalue=1.{n:03}"),
            };
            scope.spawn(move || send(addr, "POST", &target, &[], body).status)
        };
        let clients: Vec<_> = (0..24).map(ask).collect();
        clients.into_iter().map(|client| client.join().unwrap()).collect()
    });
    assert!(statuses.iter().all(|status| [200, 201, 503].contains(status)), "{statuses:?}");
    // Both outcomes occur: the limit was reached, and not by the first request.
    assert!(statuses.contains(&503) && statuses.iter().any(|status| *status < 300), "{statuses:?}");
    let peak = service.memory("VmHWM");
    assert!(peak <= idle + BUDGET + OVERHEAD, "{peak} MiB at most, {idle} MiB idle: {statuses:?}");
    assert!(peak > idle + BUDGET / 2, "{peak} MiB at most, {idle} MiB idle: the load was too small");
    // Memory returns to the system.
    let end = Instant::now() + Duration::from_secs(30);
    while service.memory("VmRSS") > idle + OVERHEAD {
        assert!(Instant::now() < end, "{} MiB, {idle} MiB before", service.memory("VmRSS"));
        std::thread::sleep(Duration::from_millis(100));
    }
    assert_eq!(service.stop("TERM").0, Some(0));
}
