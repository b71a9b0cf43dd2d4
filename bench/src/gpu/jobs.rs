//! Throughput of small jobs on one device, alone and in batches.

use std::time::Instant;

use molmesh::gpu::{Engine, Executor as _, GpuJob};
use molmesh::surface::SurfaceParams;
use serde::Serialize;
use serde_json::{Value, json};

use super::prepare;
use crate::error::{Error, Result};
use crate::{print, structures};

/// Atoms per job.
const ATOMS: usize = 600;
/// Number of different structures, used in turn.
const STRUCTURES: u64 = 32;
/// Jobs per call of the engine.
const BATCHES: [usize; 4] = [1, 8, 32, 128];

/// Throughput at one batch size.
#[derive(Debug, Serialize)]
struct BatchRate {
    batch: usize,
    jobs: usize,
    seconds: f64,
    jobs_per_second: f64,
    triangles: usize,
}

/// Runs `n` jobs at each batch size.
pub(super) fn run(engine: &mut Engine, n: usize) -> Result<Value> {
    let start = Instant::now();
    let prepared: Vec<GpuJob> = (1..=STRUCTURES)
        .map(|seed| prepare(&structures::ball(ATOMS, seed)?, &SurfaceParams::default()))
        .collect::<Result<_>>()?;
    let prepare_ms = start.elapsed().as_secs_f64() * 1e3 / STRUCTURES as f64;
    print(&format!("jobs of {ATOMS} atoms at 0.5 Å, prepared in advance ({prepare_ms:.2} ms each on one thread)\n"))?;
    print("     batch    jobs         s      jobs/s   triangles/job\n")?;
    let jobs: Vec<GpuJob> = prepared.iter().cycle().take(n).cloned().collect();
    let mut rates = Vec::new();
    for batch in BATCHES {
        let mut run = |jobs: &[GpuJob]| -> Result<usize> {
            let results = engine.run(jobs).into_iter();
            results.map(|job| job.map(|job| job.meshed.mesh.n_triangles()).map_err(Error::failed)).sum()
        };
        // The first calls allocate buffers.
        jobs.chunks(batch).take(3).try_for_each(|jobs| run(jobs).map(drop))?;
        let start = Instant::now();
        let triangles = jobs.chunks(batch).map(run).sum::<Result<usize>>()?;
        let seconds = start.elapsed().as_secs_f64();
        let jobs_per_second = n as f64 / seconds;
        print(&format!("{batch:>10}{n:>8}{seconds:>10.3}{jobs_per_second:>12.0}{:>16}\n", triangles / n))?;
        rates.push(BatchRate { batch, jobs: n, seconds, jobs_per_second, triangles });
    }
    Ok(json!({ "prepare_ms": prepare_ms, "jobs": rates }))
}
