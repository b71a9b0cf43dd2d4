//! Thread of a device: owns the executor, catches its failures and rebuilds it.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::time::Instant;

use super::device_queue::{DeviceThread, RunOutcome};
use super::error::GpuError;
use super::executor::Executor;
use super::job::{GpuJob, JobResult};
use super::queued_job::QueuedJob;
use super::scheduler::{Scheduler, proves_device_works};

/// Builds the executor of a device, at the start and after each failure.
pub type Build = Box<dyn Fn() -> Result<Box<dyn Executor>, GpuError> + Send + Sync>;

/// Maximum number of consecutive rebuilds without a finished job. Drivers that recover do so at the first or second
/// attempt, and a job that crashes devices must not keep one busy forever. Then the device cools down.
pub const MAX_REBUILDS: usize = 3;

/// Runs jobs on a device until the scheduler is closed or the thread is replaced. A device that goes down is used again
/// after its cool-down.
pub(super) fn work(scheduler: &Arc<Scheduler>, thread: DeviceThread, build: &Build) {
    // The first thread starts at once. A thread that replaces another one follows a hang.
    let mut starts = thread.generation == 0;
    while starts || scheduler.cool_down(thread) {
        starts = false;
        // Only the executor is expected to panic. Any other panic must not leave callers waiting.
        let ended = catch_unwind(AssertUnwindSafe(|| run(scheduler, thread, build)));
        if let Err(payload) = ended {
            scheduler.mark_down(thread, &format!("its thread panicked: {}", message(&*payload)));
        }
    }
    scheduler.end_thread(thread);
}

/// Builds the executor and runs jobs until the device is down, its thread replaced, or the scheduler closed.
fn run(scheduler: &Arc<Scheduler>, thread: DeviceThread, build: &Build) {
    scheduler.begin_build(thread);
    let mut executor = match try_build(scheduler, thread, build) {
        Ok(executor) => executor,
        Err(error) => return scheduler.mark_down(thread, &error.to_string()),
    };
    scheduler.mark_up(thread);
    if let Some(bytes) = scheduler.settings.readback_bytes {
        executor.reserve_memory(bytes);
        scheduler.set_held_bytes(thread, executor.held_bytes());
    }
    while let Some(batch) = scheduler.next_batch(thread, &executor.submission_counter()) {
        if batch.is_empty() {
            executor.release_idle_memory();
            scheduler.set_held_bytes(thread, executor.held_bytes());
            continue;
        }
        let start = Instant::now();
        let results = run_batch(executor.as_mut(), &batch);
        let (time, held_bytes) = (start.elapsed(), executor.held_bytes());
        let Some(why) = results.iter().find_map(device_failure) else {
            scheduler.finish_batch(thread, batch, results, RunOutcome { time, held_bytes, failed: false, down: None });
            continue;
        };
        let given_up = |why: &str| format!("down after {MAX_REBUILDS} rebuilds without a finished job: {why}");
        let give_up =
            scheduler.consecutive_rebuilds(thread) >= MAX_REBUILDS && !results.iter().any(proves_device_works);
        let down = give_up.then(|| given_up(&why));
        scheduler.finish_batch(thread, batch, results, RunOutcome { time, held_bytes, failed: true, down });
        discard(executor);
        if give_up {
            return;
        }
        match rebuild(scheduler, thread, build, why) {
            Ok(rebuilt) => executor = rebuilt,
            Err(why) => return scheduler.mark_down(thread, &given_up(&why)),
        }
    }
    discard(executor);
}

/// Rebuilds the executor. The pause between attempts doubles, because a driver takes time to restart. Fails with the
/// last reason.
fn rebuild(
    scheduler: &Arc<Scheduler>,
    thread: DeviceThread,
    build: &Build,
    mut why: String,
) -> Result<Box<dyn Executor>, String> {
    let mut pause = scheduler.settings.rebuild_pause;
    while scheduler.count_rebuild(thread, MAX_REBUILDS) {
        match try_build(scheduler, thread, build) {
            Ok(executor) => return Ok(executor),
            Err(error) => why = error.to_string(),
        }
        if !scheduler.pause(thread.device, pause) {
            return Err("the devices are being closed".to_owned());
        }
        pause *= 2;
    }
    Err(why)
}

fn try_build(scheduler: &Arc<Scheduler>, thread: DeviceThread, build: &Build) -> Result<Box<dyn Executor>, GpuError> {
    let built = catch_unwind(AssertUnwindSafe(build)).unwrap_or_else(|payload| Err(panicked(&*payload)));
    built.map(|mut executor| {
        let scheduler = Arc::clone(scheduler);
        executor.set_next_job(Box::new(move || scheduler.next_job(thread)));
        executor
    })
}

/// Runs a batch. Returns one result per job even if the executor panics or returns too few.
fn run_batch(executor: &mut dyn Executor, batch: &[QueuedJob]) -> Vec<JobResult> {
    let jobs: Vec<GpuJob> = batch.iter().map(|queued| queued.job.clone()).collect();
    let all = |error: &GpuError| jobs.iter().map(|_| Err(error.clone())).collect();
    let run = || match batch {
        [QueuedJob { job, partition: Some(partition), .. }] => vec![executor.run_partition(job, partition)],
        _ => executor.run(&jobs),
    };
    match catch_unwind(AssertUnwindSafe(run)) {
        Ok(results) if results.len() == jobs.len() => results,
        Ok(results) => all(&GpuError::Failed(format!("{} results for {} jobs", results.len(), jobs.len()))),
        Err(payload) => all(&panicked(&*payload)),
    }
}

/// Returns the reason to discard the executor, if there is one. After a lack of memory the executor stays, because the
/// next job may be smaller.
fn device_failure(result: &JobResult) -> Option<String> {
    match result {
        Err(GpuError::OutOfMemory(_)) | Ok(_) => None,
        Err(error) => error.is_device_failure().then(|| error.to_string()),
    }
}

/// Drops an executor, which may panic after a failure.
fn discard(executor: Box<dyn Executor>) {
    drop(catch_unwind(AssertUnwindSafe(|| drop(executor))));
}

fn panicked(payload: &(dyn Any + Send)) -> GpuError {
    GpuError::Failed(format!("it panicked: {}", message(payload)))
}

fn message(payload: &(dyn Any + Send)) -> &str {
    let text = payload.downcast_ref::<&str>().copied();
    text.or_else(|| payload.downcast_ref::<String>().map(String::as_str)).unwrap_or("no message")
}
