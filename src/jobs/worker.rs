//! One worker: takes a job, runs it, answers. A panic ends the job, never the worker.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::time::{Duration, Instant};

use metrics::{counter, histogram};

use super::flight::Entry;
use super::pool::Shared;
use super::{Failure, Finished, Outcome};
use crate::pipeline::{self, Choice, JobError, Report};
use crate::structure::referee::{self, Diagnostic, Level};
use crate::structure::{ReadLimits, StructureError};
use crate::surface::{Column, Mesh, SurfaceError};
use crate::telemetry::{JOBS_FALLBACK, JOBS_FINISHED, PANICS, STAGE_DURATION, TRIANGLES, VOXELS};

/// Largest text of which the referee explains a refusal, bytes: it takes some 10 ms for so much, and 40 in the worst case.
const MAX_EXPLAINED: u64 = 512 << 10;

/// Runs jobs until the queue is closed and empty.
pub(super) fn work(shared: &Shared) {
    while let Some(entry) = shared.queue.pop() {
        let id = entry.id;
        let start = Instant::now();
        let outcome = run(shared, entry);
        shared.publish_devices();
        // Only a mesh says how long jobs take.
        let time = matches!(outcome, Some(Ok(_))).then(|| start.elapsed());
        shared.queue.done(id, outcome.as_ref(), time);
    }
}

/// Runs one job. None if nobody wants it any more.
fn run(shared: &Shared, entry: Entry) -> Option<Outcome> {
    let Entry { task, cancel, progress, claims, accepted, .. } = entry;
    if cancel.is_cancelled() {
        counter!(JOBS_FINISHED, "outcome" => "dismissed").increment(1);
        return None;
    }
    let waited = accepted.elapsed();
    let outcome = shared.budget.check().map_err(Failure::from).and_then(|()| {
        let choice = Choice { backend: shared.backend.as_ref(), reason: &shared.reason };
        let work = || {
            for claim in claims {
                claim();
            }
            let diagnostics = if task.strict { Some(check(shared, &task.input)?) } else { None };
            let product = pipeline::run(&task.input, &task.job, &shared.limits, &choice, &cancel, progress.as_ref())
                .map_err(|error| explained(shared, &task.input, error))?;
            Ok::<_, Failure>((diagnostics, product))
        };
        let (diagnostics, mut product) =
            catch_unwind(AssertUnwindSafe(work)).map_err(|payload| panicked(&*payload))??;
        product.report.add_timing("queue", ms(waited));
        count(&product.report);
        if let Some(why) = &product.report.fallback {
            counter!(JOBS_FALLBACK).increment(1);
            tracing::warn!(backend = product.report.backend, why, "another backend served a job");
        }
        let mut lease = shared.budget.lease();
        lease.force(bytes_of(&product.mesh));
        Ok(Finished { product, diagnostics, digest: task.digest, waited, lease })
    });
    // The input is freed before the answer goes out: the receiver then sees the memory that is really held.
    drop(task);
    let outcome = outcome.map(Arc::new);
    tell(&outcome);
    Some(outcome)
}

/// The strict check: the referee's findings, or a refusal if there are errors among them.
fn check(shared: &Shared, input: &[u8]) -> Result<Vec<Diagnostic>, Failure> {
    let diagnostics = referee::check(input, &shared.limits.read)
        .map_err(|error| Failure::Job { error: error.into(), diagnostics: Vec::new() })?;
    if diagnostics.iter().any(|d| d.level == Level::Error) {
        return Err(Failure::Check { diagnostics });
    }
    Ok(diagnostics)
}

/// A failure, with the referee's opinion of a file that our reader refused and that is small enough to ask about.
fn explained(shared: &Shared, input: &[u8], error: JobError) -> Failure {
    let unreadable =
        matches!(error, JobError::Structure(StructureError::Syntax { .. } | StructureError::NoAtoms { .. }));
    let limits = ReadLimits { max_inflated_bytes: MAX_EXPLAINED, ..shared.limits.read };
    // A file of which the referee cannot say anything either gets our refusal alone.
    let diagnostics = if unreadable { referee::check(input, &limits).unwrap_or_default() } else { Vec::new() };
    Failure::Job { error, diagnostics }
}

/// What drivers say of a failed device is for the log alone.
fn log_device(failure: &Failure) {
    if let Failure::Job { error: JobError::Surface(SurfaceError::Device { why }), .. } = failure {
        tracing::error!(why, "no device could run a job");
    }
}

/// Counts an outcome, and logs what is for the log.
fn tell(outcome: &Outcome) {
    let label = match outcome {
        Ok(_) => "successful",
        Err(Failure::Job { error: JobError::Surface(SurfaceError::Cancelled), .. }) => "dismissed",
        Err(Failure::Panicked { .. }) => "panicked",
        Err(_) => "failed",
    };
    if let Err(failure) = outcome {
        log_device(failure);
    }
    counter!(JOBS_FINISHED, "outcome" => label).increment(1);
}

fn panicked(payload: &(dyn Any + Send)) -> Failure {
    counter!(PANICS, "place" => "job").increment(1);
    let text = payload.downcast_ref::<&str>().copied().or_else(|| payload.downcast_ref::<String>().map(String::as_str));
    Failure::Panicked { message: text.unwrap_or("no message").to_owned() }
}

fn count(report: &Report) {
    counter!(TRIANGLES).increment(report.triangles);
    counter!(VOXELS).increment(report.samples);
    for (stage, ms) in &report.timings_ms {
        histogram!(STAGE_DURATION, "stage" => stage.clone()).record(ms.as_f64().unwrap_or_default() / 1e3);
    }
}

/// Bytes that a mesh holds.
fn bytes_of(mesh: &Mesh) -> u64 {
    let optional = mesh.atom_ids.as_ref().map_or(0, Column::len) + mesh.colors.as_ref().map_or(0, Column::len);
    mesh.bytes() + 4 * optional as u64
}

fn ms(time: Duration) -> f64 {
    time.as_secs_f64() * 1e3
}
