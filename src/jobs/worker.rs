//! Worker thread: takes a job, runs it, sends its outcome. A panic ends the job, not the worker.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use metrics::{counter, histogram};

use super::coalesced_job::QueuedTask;
use super::pool::WorkerContext;
use super::rank::Lane;
use super::{Failure, Finished, JobId, MemoryReservation, OnStart, Outcome, Settings, Task};
use crate::formats::Pieces;
use crate::pipeline::params::Request;
use crate::pipeline::{self, Choice, JobError, Product, ProgressSink, Report, StageClock, WorkScope};
use crate::structure::strict_validator::{self, Diagnostic, Level, MAX_UNREAD_BYTES};
use crate::structure::{ReadLimits, StructureError};
use crate::surface::{Column, Control, MemoryMeter as _, SurfaceError};
use crate::telemetry::{GRID_POINTS, JOBS_FALLBACK, JOBS_FINISHED, PANICS, STAGE_DURATION, TRIANGLES, TraceSpan};

/// A job that is queued again, in another lane.
struct Restarted;

/// Runs the jobs of a lane until the queue is closed and the lane is empty.
pub(super) fn work(shared: &WorkerContext, lane: Lane) {
    while let Some(entry) = shared.queue.pop(lane) {
        let (id, client) = (entry.id, entry.task.rank.client);
        let start = Instant::now();
        let Ok(outcome) = shared.threads.run(lane, || run(shared, entry)) else { continue };
        if let Some(meter) = &shared.settings.meter {
            meter(client, start.elapsed());
        }
        shared.publish_devices();
        // Successful jobs count in the duration estimate, and those that were cancelled, such as at a deadline.
        let counts = matches!(&outcome, Some(outcome) if outcome.as_ref().err().is_none_or(Failure::is_cancelled));
        shared.queue.done(id, outcome, counts.then(|| start.elapsed()));
    }
}

/// Runs one job. Returns no outcome if all clients left before its start.
fn run(shared: &WorkerContext, entry: QueuedTask) -> Result<Option<Outcome>, Restarted> {
    let QueuedTask { id: entry_id, task, cancel, progress, on_start, accepted, span } = entry;
    let log = span.as_parent().log_span(task.id.as_ref().map(JobId::as_str));
    let _entered = log.enter();
    let id = task.id.clone();
    if cancel.is_cancelled() {
        // It may have had to give its worker away before the threads of the worker were ready.
        if shared.queue.restart(entry_id, task, on_start).is_ok() {
            return Err(Restarted);
        }
        counter!(JOBS_FINISHED, "outcome" => "dismissed").increment(1);
        end_span(&span, id, "dismissed", None);
        return Ok(None);
    }
    let waited = accepted.elapsed();
    span.part("queue", accepted, waited);
    let outcome = shared.settings.budget.check().map_err(Failure::from).and_then(|()| {
        let budget = shared.settings.budget.for_client(task.rank.client.0);
        let (reservation, drawing) = (Arc::new(budget.reservation()), budget.reservation());
        // The memory for drawing is known in advance: reserved now, jobs do not fail at their end for lack of it.
        // Reading notes the file and the map.
        drawing.also_held(input_bytes(&task));
        drawing.grow(task.request.options.picture.map_or(0, |picture| picture.bytes()))?;
        reservation.also_held(drawing.bytes());
        let control = Control {
            cancel: cancel.clone(),
            memory: Arc::<MemoryReservation>::clone(&reservation),
            ..Control::default()
        };
        let choice = shared.choice(&task.input, &task.request.options);
        let work = || {
            OnStart::run_all(on_start);
            let file = task.input.file();
            let (diagnostics, checked) = if task.request.strict {
                let begun = Instant::now();
                let found = check(shared, &task, &control);
                progress.ended("check", begun, begun.elapsed());
                (Some(found?), Some(begun.elapsed()))
            } else {
                (None, None)
            };
            let mut product = product(shared, &task, &choice, &control, progress.as_ref())
                .map_err(|error| explained(shared, file, error, &control))?;
            if let Some(picture) = &task.request.options.picture {
                pipeline::draw(&mut product, picture, &shared.settings.renderer, &control, progress.as_ref())?;
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
        let (backend, reason) = (product.report.backend, &product.report.backend_reason);
        tracing::debug!(backend, reason, timings_ms = ?product.report.timings_ms, "a job succeeded");
        if let Some(why) = &product.report.fallback {
            counter!(JOBS_FALLBACK).increment(1);
            tracing::warn!(backend = product.report.backend, why, "a job fell back to another backend");
        }
        if let Some((renderer, why)) =
            product.report.picture.as_ref().and_then(|p| Some((p.renderer, p.fallback.as_ref()?)))
        {
            counter!(JOBS_FALLBACK).increment(1);
            tracing::warn!(renderer, why, "a picture fell back to another renderer");
        }
        drop(drawing);
        reservation.set(bytes_of(&product));
        Ok(Finished { product, diagnostics, reservation })
    });
    let was_cancelled = outcome.as_ref().err().is_some_and(Failure::is_cancelled);
    let restarted = if was_cancelled { shared.queue.restart(entry_id, task, Vec::new()) } else { Err(task) };
    let Err(task) = restarted else { return Err(Restarted) };
    // Frees the input before the outcome is sent, so that the receiver sees the true memory use.
    drop(task);
    let outcome = outcome.map(Arc::new);
    for (stage, begun, time) in progress.stages() {
        span.part(stage, begun, time);
    }
    end_span(&span, id, count_outcome(&outcome), Some(&outcome));
    Ok(Some(outcome))
}

/// Computes the mesh of a task, on its structure or on a tileset that is kept in memory.
fn product(
    shared: &WorkerContext,
    task: &Task,
    choice: &Choice<'_>,
    control: &Control<'_>,
    progress: &dyn ProgressSink,
) -> Result<Product, JobError> {
    let Task { namespace, digest, input, request: Request { options, .. }, .. } = task;
    let Settings { structures, limits, .. } = &shared.settings;
    if options.tile.is_some() && !options.selection.instances {
        let clock = StageClock::new(progress);
        let (tileset, colors) =
            structures.tileset((*namespace, *digest), input, options, &limits.read, control, &clock)?;
        let scope = WorkScope::new(&clock, control);
        return tileset.product(options, colors.as_deref(), choice, &limits.surface, &scope);
    }
    let read = |control: &Control<'_>| structures.get((*namespace, *digest), input, &limits.read, control);
    pipeline::run_with(read, options, limits, choice, control, progress, None)
}

/// Sets attributes and status of the span of a job, and ends it.
fn end_span(span: &TraceSpan, id: Option<JobId>, label: &'static str, outcome: Option<&Outcome>) {
    span.set("molmesh.job.outcome", label);
    if let Some(id) = id {
        span.set("molmesh.job.id", id.to_string());
    }
    match outcome {
        Some(Ok(finished)) => {
            let report = &finished.product.report;
            span.set("molmesh.backend", report.backend);
            span.set("molmesh.device", report.device.clone());
            span.set("molmesh.atoms", report.atoms.cast_signed());
            span.set("molmesh.grid_points", report.grid_points.cast_signed());
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

/// Runs the strict validator. Fails if it finds errors.
fn check(shared: &WorkerContext, task: &Task, control: &Control<'_>) -> Result<Vec<Diagnostic>, Failure> {
    let missing = || Failure::Panicked { message: "a strict task has no file".to_owned() };
    let file = task.input.file().ok_or_else(missing)?;
    // The job notes its file when it reads it.
    let memory = shared.settings.budget.for_client(task.rank.client.0).reservation();
    memory.also_held(control.memory.budget().map_or(0, |[_, held]| held).saturating_add(input_bytes(task)));
    let control = control.with_memory(&Arc::new(memory));
    let diagnostics = strict_validator::check(file, &shared.settings.limits.read, &control).map_err(JobError::from)?;
    if diagnostics.iter().any(|d| d.level == Level::Error) {
        return Err(Failure::Check { diagnostics });
    }
    Ok(diagnostics)
}

/// Adds the findings of the strict validator to the failure of a small file that cannot be read.
fn explained(shared: &WorkerContext, file: Option<&Bytes>, error: JobError, control: &Control<'_>) -> Failure {
    let unreadable =
        matches!(error, JobError::Structure(StructureError::Syntax { .. } | StructureError::NoAtoms { .. }));
    let Some(file) = file.filter(|_| unreadable) else { return error.into() };
    let limits = ReadLimits { max_inflated_bytes: MAX_UNREAD_BYTES, ..shared.settings.limits.read };
    // If the strict validator fails as well, there are no findings.
    Failure::Job { error, diagnostics: strict_validator::check(file, &limits, control).unwrap_or_default() }
}

/// Counts and logs an outcome. Returns its label.
fn count_outcome(outcome: &Outcome) -> &'static str {
    let label = match outcome {
        Ok(_) => "successful",
        Err(failure) if failure.is_cancelled() => "dismissed",
        Err(Failure::Panicked { .. }) => "panicked",
        Err(_) => "failed",
    };
    // Clients do not get the driver's message about a failed device.
    if let Err(Failure::Job { error: JobError::Surface(SurfaceError::Device { why }), .. }) = outcome {
        tracing::error!(why, "no device could run a job");
    }
    counter!(JOBS_FINISHED, "outcome" => label).increment(1);
    label
}

fn panicked(payload: &(dyn Any + Send)) -> Failure {
    counter!(PANICS, "component" => "job").increment(1);
    let text = payload.downcast_ref::<&str>().copied().or_else(|| payload.downcast_ref::<String>().map(String::as_str));
    Failure::Panicked { message: text.unwrap_or("no message").to_owned() }
}

fn count(report: &Report) {
    counter!(TRIANGLES).increment(report.triangles);
    counter!(GRID_POINTS).increment(report.grid_points);
    for (stage, ms) in &report.timings_ms {
        histogram!(STAGE_DURATION, "stage" => stage.clone()).record(ms.as_f64().unwrap_or_default() / 1e3);
    }
}

/// Returns the size of the file and the map of a task, bytes.
fn input_bytes(task: &Task) -> u64 {
    let map = task.request.options.map.as_ref().map_or(0, |map| map.as_ref().len());
    (task.input.file().map_or(0, Bytes::len) + map) as u64
}

/// Memory use of a product, bytes.
fn bytes_of(Product { mesh, pieces, picture, .. }: &Product) -> u64 {
    let drawn = picture.as_ref().map_or(0, Vec::len) as u64 + pieces.as_ref().map_or(0, Pieces::bytes);
    let optional = mesh.atom_ids.as_ref().map_or(0, Column::len) + mesh.colors.as_ref().map_or(0, Column::len);
    mesh.bytes() + 4 * optional as u64 + drawn
}

fn ms(time: Duration) -> f64 {
    time.as_secs_f64() * 1e3
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicBool, Ordering};

    use super::*;
    use crate::jobs::{Budget, Pool, Rank};
    use crate::surface::ReferenceBackend;

    fn task(resolution: &str) -> Task {
        let file = Bytes::from_static(include_bytes!("../../samples/4pti.pdb"));
        Task::for_test(file, &[("resolution", resolution)], Rank::default())
    }

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn a_job_that_gives_its_worker_away_before_it_begins_runs_later() {
        let settings = Settings::for_test(1, Budget::new(1 << 30));
        let pool = Pool::without_workers(settings, Arc::new(ReferenceBackend), "a test".to_owned());
        let (shared, started) = (&pool.shared, Arc::new(AtomicBool::new(false)));
        let start = {
            let started = Arc::clone(&started);
            OnStart::new(async move { started.store(true, Ordering::SeqCst) })
        };
        let mut ticket = pool.submit(task("2"), Duration::from_mins(1), Some(start)).unwrap();
        let entry = shared.queue.pop(Lane::Short).unwrap();
        let other = pool.submit(task("3"), Duration::from_mins(1), None).unwrap();
        // The system starts the threads of the worker late.
        while !entry.cancel.is_cancelled() {
            std::thread::sleep(Duration::from_millis(5));
            shared.queue.make_room();
        }
        let run = |entry| tokio::task::block_in_place(|| super::run(shared, entry));
        assert!(run(entry).is_err() && !started.load(Ordering::SeqCst));
        let entry = shared.queue.pop(Lane::Long).unwrap();
        let id = entry.id;
        let Ok(Some(outcome)) = run(entry) else { panic!("the job did not run") };
        assert!(started.load(Ordering::SeqCst));
        shared.queue.done(id, Some(outcome), None);
        assert!(ticket.wait().await.is_ok());
        // Control: nobody waits for a job that was cancelled because its client left.
        let entry = shared.queue.pop(Lane::Short).unwrap();
        drop(other);
        assert!(matches!(run(entry), Ok(None)));
    }
}
