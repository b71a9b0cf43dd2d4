//! One worker: takes a job, runs it, answers. A panic ends the job, never the worker.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::time::{Duration, Instant};

use metrics::{counter, histogram};

use super::flight::Entry;
use super::pool::Shared;
use super::{Failure, Finished, JobId, Outcome};
use crate::pipeline::{self, Choice, JobError, Product, ProgressSink as _, Report};
use crate::structure::referee::{self, Diagnostic, Level};
use crate::structure::{ReadLimits, StructureError};
use crate::surface::{Column, SurfaceError};
use crate::telemetry::{JOBS_FALLBACK, JOBS_FINISHED, PANICS, STAGE_DURATION, TRIANGLES, TraceSpan, VOXELS};

/// Largest text of which the referee explains a refusal, bytes: it takes some 10 ms for so much, and 40 in the worst case.
const MAX_EXPLAINED: u64 = 512 << 10;

/// Runs jobs until the queue is closed and empty.
pub(super) fn work(shared: &Shared) {
    while let Some(entry) = shared.queue.pop() {
        let (id, client) = (entry.id, entry.task.rank.client);
        let start = Instant::now();
        let outcome = run(shared, entry);
        if let Some(meter) = &shared.meter {
            meter.spent(client, start.elapsed());
        }
        shared.publish_devices();
        // Only a mesh says how long jobs take.
        let time = matches!(outcome, Some(Ok(_))).then(|| start.elapsed());
        shared.queue.done(id, outcome.as_ref(), time);
    }
}

/// Runs one job. None if nobody wants it any more.
fn run(shared: &Shared, entry: Entry) -> Option<Outcome> {
    let Entry { task, cancel, progress, claims, accepted, span, .. } = entry;
    let log = span.as_parent().log_span(task.id.as_ref().map(JobId::as_str));
    let _entered = log.enter();
    let trace = Trace { span, job: task.id.clone() };
    if cancel.is_cancelled() {
        counter!(JOBS_FINISHED, "outcome" => "dismissed").increment(1);
        trace.close("dismissed", None);
        return None;
    }
    let waited = accepted.elapsed();
    trace.span.part("queue", accepted, waited);
    let outcome = shared.budget.check().map_err(Failure::from).and_then(|()| {
        // Drawing's memory is known before anything is done for it.
        let mut drawing = shared.budget.lease();
        drawing.grow(task.job.picture.map_or(0, |picture| picture.bytes()))?;
        let choice = Choice { backend: shared.backend.as_ref(), reason: &shared.reason };
        let work = || {
            for claim in claims {
                claim();
            }
            let (diagnostics, checked) = if task.strict {
                let begun = Instant::now();
                let found = check(shared, &task.input);
                progress.ended("check", begun, begun.elapsed());
                (Some(found?), Some(begun.elapsed()))
            } else {
                (None, None)
            };
            let mut product =
                pipeline::run(&task.input, &task.job, &shared.limits, &choice, &cancel, progress.as_ref(), None)
                    .map_err(|error| explained(shared, &task.input, error))?;
            if let Some(picture) = &task.job.picture {
                pipeline::draw(&mut product, picture, &shared.drawer, &cancel, progress.as_ref())
                    .map_err(|error| Failure::Job { error, diagnostics: Vec::new() })?;
            }
            if let Some(time) = checked {
                product.report.add_timing("check", ms(time));
            }
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
        if let Some((renderer, why)) =
            product.report.picture.as_ref().and_then(|p| Some((p.renderer, p.fallback.as_ref()?)))
        {
            counter!(JOBS_FALLBACK).increment(1);
            tracing::warn!(renderer, why, "another renderer drew a picture");
        }
        let mut lease = shared.budget.lease();
        lease.force(bytes_of(&product));
        Ok(Finished { product, diagnostics, digest: task.digest, waited, lease })
    });
    // The input is freed before the answer goes out: the receiver then sees the memory that is really held.
    drop(task);
    let outcome = outcome.map(Arc::new);
    for (stage, begun, time) in progress.stages() {
        trace.span.part(stage, begun, time);
    }
    trace.close(tell(&outcome), Some(&outcome));
    Some(outcome)
}

/// The span of a job.
struct Trace {
    span: TraceSpan,
    job: Option<JobId>,
}

impl Trace {
    /// Sets the attributes and the status, and ends the span.
    fn close(&self, label: &'static str, outcome: Option<&Outcome>) {
        let span = &self.span;
        span.set("molmesh.job.outcome", label);
        if let Some(id) = &self.job {
            span.set("molmesh.job.id", id.to_string());
        }
        match outcome {
            Some(Ok(finished)) => {
                let report = &finished.product.report;
                span.set("molmesh.backend", report.backend);
                span.set("molmesh.device", report.device.clone());
                span.set("molmesh.atoms", report.atoms.cast_signed());
                span.set("molmesh.samples", report.samples.cast_signed());
                span.set("molmesh.triangles", report.triangles.cast_signed());
                if let Some(picture) = &report.picture {
                    span.set("molmesh.renderer", picture.renderer);
                }
            }
            Some(Err(failure)) => span.fail(failure.to_string()),
            None => {}
        }
        span.end();
    }
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

/// Counts an outcome, and logs what is for the log. What it is called comes back.
fn tell(outcome: &Outcome) -> &'static str {
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
    label
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

/// Bytes that a product holds.
fn bytes_of(Product { mesh, picture, .. }: &Product) -> u64 {
    let drawn = picture.as_ref().map_or(0, Vec::len) as u64;
    let optional = mesh.atom_ids.as_ref().map_or(0, Column::len) + mesh.colors.as_ref().map_or(0, Column::len);
    mesh.bytes() + 4 * optional as u64 + drawn
}

fn ms(time: Duration) -> f64 {
    time.as_secs_f64() * 1e3
}
