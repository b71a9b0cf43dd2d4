//! One worker: takes a job, runs it, answers. A panic ends the job, never the worker.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::time::{Duration, Instant};

use metrics::{counter, histogram};

use super::pool::Shared;
use super::queue::Entry;
use super::{Digest, Failure, Finished, Outcome};
use crate::pipeline::{self, Choice, JobError, JobLimits, Report};
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
        let ran = run(shared, entry);
        shared.publish_devices();
        shared.queue.done(id, ran.then(|| start.elapsed()));
    }
}

/// Runs one job and answers. False if it says nothing about how long jobs take.
fn run(shared: &Shared, entry: Entry) -> bool {
    let Entry { task, cancel, reply, accepted, .. } = entry;
    if cancel.is_cancelled() || reply.is_closed() || task.deadline <= Instant::now() {
        counter!(JOBS_FINISHED, "outcome" => "dismissed").increment(1);
        return false;
    }
    let waited = accepted.elapsed();
    let outcome = shared.budget.check().map_err(Failure::from).and_then(|()| {
        let choice = Choice { backend: shared.backend.as_ref(), reason: &shared.reason };
        let work = || {
            let digesting = Instant::now();
            let digest = task.digest.unwrap_or_else(|| Digest::of(&task.input));
            let digested = digesting.elapsed();
            let diagnostics = if task.strict { Some(check(shared, &task.input)?) } else { None };
            let limits = JobLimits { deadline: Some(task.deadline), ..shared.limits };
            let product = pipeline::run(&task.input, &task.job, &limits, &choice, &cancel, &())
                .map_err(|error| explained(shared, &task.input, error))?;
            Ok::<_, Failure>((digest, digested, diagnostics, product))
        };
        let (digest, digested, diagnostics, mut product) =
            catch_unwind(AssertUnwindSafe(work)).map_err(|payload| panicked(&*payload))??;
        product.report.add_timing("queue", ms(waited));
        product.report.add_timing("digest", ms(digested));
        count(&product.report);
        if let Some(why) = &product.report.fallback {
            counter!(JOBS_FALLBACK).increment(1);
            tracing::warn!(backend = product.report.backend, why, "another backend served a job");
        }
        let mut lease = shared.budget.lease();
        lease.force(bytes_of(&product.mesh));
        Ok(Finished { product, diagnostics, digest, waited, lease })
    });
    // The input is freed before the answer goes out: the receiver then sees the memory that is really held.
    drop(task);
    answer(reply, outcome.map(Arc::new))
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

fn answer(reply: tokio::sync::oneshot::Sender<Outcome>, outcome: Outcome) -> bool {
    let label = match &outcome {
        Ok(_) => "successful",
        Err(Failure::Job { error: JobError::Surface(SurfaceError::Cancelled), .. }) => "dismissed",
        Err(Failure::Panicked { .. }) => "panicked",
        Err(_) => "failed",
    };
    if let Err(failure) = &outcome {
        log_device(failure);
    }
    let ran = outcome.is_ok();
    counter!(JOBS_FINISHED, "outcome" => label).increment(1);
    if reply.send(outcome).is_err() {
        tracing::debug!(outcome = label, "nobody waits for the outcome");
    }
    ran
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
    Mesh::bytes_for(mesh.n_vertices() as u64, mesh.n_triangles() as u64) + 4 * optional as u64
}

fn ms(time: Duration) -> f64 {
    time.as_secs_f64() * 1e3
}
