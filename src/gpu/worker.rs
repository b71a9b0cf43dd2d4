//! A device's thread: it owns what runs jobs there, catches what goes wrong, and builds it anew.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::{Duration, Instant};

use super::error::GpuError;
use super::executor::{Executor, GpuJob};
use super::lane::{Entry, Run};
use super::queue::{Answer, Queues, shows_health};

/// Makes what runs jobs on one device: at the start, and again after a failure.
pub type Build = Box<dyn Fn() -> Result<Box<dyn Executor>, GpuError> + Send + Sync>;

/// Rebuilds without a finished job before a device is given up. Three: a driver that recovers does so at the first or
/// second attempt, and a job that kills devices must not keep one busy for ever.
pub const MOST_REBUILDS: usize = 3;

/// How long a device's thread waits.
#[derive(Debug, Clone, Copy)]
pub(super) struct Times {
    /// After a failed rebuild.
    pub(super) pause: Duration,
    /// For work, before the device lets go what it keeps for it.
    pub(super) rest: Duration,
}

/// Runs jobs on device `n` until the queues are closed or it is given up.
pub(super) fn work(queues: &Queues, n: usize, build: &Build, times: Times) {
    // Nothing outside the executor should panic; if it does, nobody may wait for this thread in vain.
    let ended = catch_unwind(AssertUnwindSafe(|| run(queues, n, build, times)));
    if let Err(payload) = ended {
        queues.down(n, &format!("its thread panicked: {}", words(&*payload)));
    }
}

fn run(queues: &Queues, n: usize, build: &Build, times: Times) {
    let mut executor = match built(build) {
        Ok(executor) => executor,
        Err(error) => return queues.down(n, &error.to_string()),
    };
    queues.up(n);
    while let Some(entries) = queues.next(n, times.rest) {
        if entries.is_empty() {
            executor.rest();
            queues.holds(n, executor.held_bytes());
            continue;
        }
        let begun = Instant::now();
        let answers = attempt(executor.as_mut(), &entries);
        let (time, held_bytes) = (begun.elapsed(), executor.held_bytes());
        let Some(why) = answers.iter().find_map(blame) else {
            queues.done(n, entries, answers, Run { time, held_bytes, lost: false, down: None });
            continue;
        };
        let given_up = |why: &str| format!("given up after {MOST_REBUILDS} rebuilds without a finished job: {why}");
        // A job that came to its end beside the failed one starts the count anew.
        let hopeless = queues.streak(n) >= MOST_REBUILDS && !answers.iter().any(shows_health);
        queues.done(n, entries, answers, Run { time, held_bytes, lost: true, down: hopeless.then(|| given_up(&why)) });
        discard(executor);
        if hopeless {
            return;
        }
        match rebuilt(queues, n, build, times.pause, why) {
            Ok(new) => executor = new,
            Err(why) => return queues.down(n, &given_up(&why)),
        }
    }
    discard(executor);
}

/// Builds until it works, with a pause that doubles: a driver that restarts takes its time. Fails with the last reason.
fn rebuilt(
    queues: &Queues,
    n: usize,
    build: &Build,
    pause: Duration,
    why: String,
) -> Result<Box<dyn Executor>, String> {
    let mut why = why;
    let mut pause = pause;
    while queues.rebuilding(n, MOST_REBUILDS) {
        match built(build) {
            Ok(executor) => return Ok(executor),
            Err(error) => why = error.to_string(),
        }
        if !queues.pause(n, pause) {
            return Err("the devices are being closed".to_owned());
        }
        pause *= 2;
    }
    Err(why)
}

fn built(build: &Build) -> Result<Box<dyn Executor>, GpuError> {
    catch_unwind(AssertUnwindSafe(build)).unwrap_or_else(|payload| Err(panicked(&*payload)))
}

/// Runs the jobs; one answer for each, whatever the executor does.
fn attempt(executor: &mut dyn Executor, entries: &[Entry]) -> Vec<Answer> {
    let jobs: Vec<GpuJob> = entries.iter().map(|entry| entry.job.clone()).collect();
    let all = |error: &GpuError| jobs.iter().map(|_| Err(error.clone())).collect();
    let run = || match entries {
        [Entry { job, share: Some(share), .. }] => vec![executor.part(job, share)],
        _ => executor.run(&jobs),
    };
    match catch_unwind(AssertUnwindSafe(run)) {
        Ok(answers) if answers.len() == jobs.len() => answers,
        Ok(answers) => all(&GpuError::Failed(format!("{} answers to {} jobs", answers.len(), jobs.len()))),
        Err(payload) => all(&panicked(&*payload)),
    }
}

/// What an answer holds against the device. Too little memory is no defect: the next job may be smaller.
fn blame(answer: &Answer) -> Option<String> {
    match answer {
        Err(GpuError::OutOfMemory { .. }) | Ok(_) => None,
        Err(error) => error.is_the_devices().then(|| error.to_string()),
    }
}

/// Drops what has failed. Its drivers may not like that either.
fn discard(executor: Box<dyn Executor>) {
    drop(catch_unwind(AssertUnwindSafe(|| drop(executor))));
}

fn panicked(payload: &(dyn Any + Send)) -> GpuError {
    GpuError::Failed(format!("it panicked: {}", words(payload)))
}

fn words(payload: &(dyn Any + Send)) -> &str {
    let text = payload.downcast_ref::<&str>().copied();
    text.or_else(|| payload.downcast_ref::<String>().map(String::as_str)).unwrap_or("no message")
}
