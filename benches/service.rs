//! Overhead of the service for a synchronous upload of about 1,000 atoms: total time minus reading, meshing and
//! encoding.
//!
//! Uses a local socket; the overhead includes the time of the client. Run it with `cargo bench --bench service`.

#![expect(clippy::print_stdout, clippy::unwrap_used, reason = "a benchmark prints its figures and may panic")]

#[path = "../tests/http_support/mod.rs"]
mod http_support;

use std::sync::Arc;
use std::time::Instant;

use http_support::{SAMPLE, start};
use molmesh::surface::CpuBackend;

/// Returns the sample with a copy at a distance of 40 Å: 908 atoms.
fn doubled_sample() -> Vec<u8> {
    let text = std::str::from_utf8(SAMPLE).unwrap();
    let atoms = || text.lines().filter(|line| line.starts_with("ATOM"));
    let moved = atoms().map(|line| {
        let x: f64 = line[30..38].trim().parse().unwrap();
        format!("{}{:8.3}{}", &line[..30], x + 40.0, &line[38..])
    });
    atoms().map(str::to_owned).chain(moved).collect::<Vec<_>>().join("\n").into_bytes()
}

fn main() {
    let server = start(Arc::new(CpuBackend::new(None).unwrap()), |_| {});
    let structure = doubled_sample();
    let encode = || server.metric("molmesh_job_stage_duration_seconds_sum", &["stage=\"encode\""]) * 1e3;
    let mut overheads: Vec<f64> = (0..500)
        .map(|n| {
            // Identical uploads would be answered from the store.
            let body = [format!("REMARK 900 {n}\n").as_bytes(), &structure].concat();
            let before = encode();
            let start = Instant::now();
            let reply = server.post("/v1/meshes?resolution=1", &[], &body);
            let wall = start.elapsed().as_secs_f64() * 1e3;
            assert_eq!(reply.status, 200);
            let timing = reply.header("server-timing").unwrap();
            // Stages of the service. The metric has the time to write the file, to its last byte.
            let own = ["receive", "lookup", "load", "queue", "encode", "other", "total"];
            let stages = timing.split(", ").map(|stage| stage.split_once(";dur=").unwrap());
            let work: f64 =
                stages.filter(|(name, _)| !own.contains(name)).map(|(_, ms)| ms.parse::<f64>().unwrap()).sum();
            wall - work - (encode() - before)
        })
        .collect();
    overheads.sort_by(f64::total_cmp);
    let [half, most, nearly_all] = [50, 90, 99].map(|percent| overheads[overheads.len() * percent / 100]);
    println!("overhead of 500 uploads of 908 atoms, ms: {half:.3} p50, {most:.3} p90, {nearly_all:.3} p99");
}
