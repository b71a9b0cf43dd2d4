//! Many small jobs on one device: each in a submission of its own, and several sharing one.

use std::fmt::Write as _;
use std::sync::Arc;
use std::time::Instant;

use molmesh::gpu::bench::Opened;
use molmesh::gpu::{Executor, GpuJob, Prepared};
use molmesh::surface::{CancelToken, Control, SurfaceLimits, SurfaceParams};
use serde::Serialize;

use super::super::error::CliError;
use super::cases::ball;

/// Atoms of a job.
const ATOMS: usize = 600;
/// Different structures; jobs take them in turn.
const STRUCTURES: u64 = 32;
/// Jobs that one call is given.
const BATCHES: [usize; 4] = [1, 8, 32, 128];

/// Jobs of one size of batch.
#[derive(Debug, Clone, Serialize)]
pub(super) struct Rate {
    /// Jobs a call.
    batch: usize,
    jobs: usize,
    seconds: f64,
    jobs_per_second: f64,
    submissions: u64,
    triangles: usize,
    /// Host time of preparing a job, which other threads do while the device works, ms.
    prepare_ms: f64,
}

/// Runs `n` jobs for each size of batch.
pub(super) fn run(mut opened: Opened, n: usize) -> Result<Vec<Rate>, CliError> {
    let failed = |e: &dyn std::fmt::Display| CliError::Service(e.to_string());
    let start = Instant::now();
    let prepared: Vec<_> = (1..=STRUCTURES)
        .map(|seed| {
            let (params, limits) = (SurfaceParams::default(), SurfaceLimits::default());
            Prepared::new(&ball(ATOMS, seed), &params, &limits, &Control::default()).map(Arc::new)
        })
        .collect::<Result<_, _>>()
        .map_err(|e| failed(&e))?;
    let prepare_ms = start.elapsed().as_secs_f64() * 1e3 / STRUCTURES as f64;
    let job = |prepared: &Arc<Prepared>| GpuJob {
        prepared: prepared.clone(),
        cancel: CancelToken::default(),
        deadline: None,
    };
    let jobs: Vec<GpuJob> = prepared.iter().cycle().take(n).map(job).collect();
    let mut rates = Vec::new();
    for batch in BATCHES {
        let engine = &mut opened.engine;
        // Buffers are made, and shaders reach the device.
        for warm in jobs.chunks(batch).take(3) {
            engine.run(warm).into_iter().try_for_each(|result| result.map(drop)).map_err(|e| failed(&e))?;
        }
        engine.metered();
        let (mut triangles, start) = (0, Instant::now());
        for some in jobs.chunks(batch) {
            for result in engine.run(some) {
                triangles += result.map_err(|e| failed(&e))?.meshed.mesh.n_triangles();
            }
        }
        let seconds = start.elapsed().as_secs_f64();
        let submissions = engine.metered().submissions;
        rates.push(Rate {
            batch,
            jobs: n,
            seconds,
            jobs_per_second: n as f64 / seconds,
            submissions,
            triangles,
            prepare_ms,
        });
    }
    Ok(rates)
}

/// The same as text.
pub(super) fn table(rates: &[Rate]) -> String {
    let prepare = rates.first().map_or(0.0, |r| r.prepare_ms);
    let mut text =
        format!("jobs of {ATOMS} atoms at 0.5 Å, prepared beforehand ({prepare:.2} ms each on one thread)\n");
    // A string takes everything.
    _ = writeln!(
        text,
        "  {:>8}{:>8}{:>12}{:>10}{:>12}{:>16}",
        "a call", "jobs", "submissions", "s", "jobs/s", "triangles/job"
    );
    for r in rates {
        _ = writeln!(
            text,
            "  {:>8}{:>8}{:>12}{:>10.3}{:>12.0}{:>16}",
            r.batch,
            r.jobs,
            r.submissions,
            r.seconds,
            r.jobs_per_second,
            r.triangles / r.jobs.max(1)
        );
    }
    text
}
