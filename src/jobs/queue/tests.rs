//! Refusal of jobs that would end too late, and the estimates that it depends on.

use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;

use super::Queue;
use crate::jobs::rank::{Lane, Rank};
use crate::jobs::{Failure, Refusal, Task};
use crate::pipeline::JobError;
use crate::surface::SurfaceError;

/// Creates a task that takes long, on a file of this content.
fn task(content: u8) -> Task {
    Task::for_test(Bytes::from(vec![content]), &[("resolution", "0.01")], Rank::default())
}

/// Returns the expected duration of the task.
fn expected(queue: &Queue) -> Duration {
    let task = task(0);
    Duration::from_secs_f64(queue.expected(crate::pipeline::estimate_work(task.input.atoms(), &task.request.options)))
}

#[test]
fn a_job_that_could_not_end_in_time_is_refused_at_once() {
    let queue = Arc::new(Queue::new(8, 1));
    let time = expected(&queue);
    assert!(time > Duration::from_secs(30), "{time:?}");
    // A free worker always tries: only jobs that run correct the estimate.
    let running = queue.push(task(1), time / 10, None).unwrap();
    assert_eq!(running.lane, Lane::Long);
    assert!(queue.pop(Lane::Long).is_some());
    // The running job has just begun, so the next one begins after about `time` and ends after twice that.
    let refused = queue.push(task(2), time.mul_f64(1.9), None).map(drop);
    let Err(Refusal::TooLate { wait, expected, .. }) = refused else { panic!("accepted") };
    assert!((0.95..=1.0).contains(&wait.div_duration_f64(time)), "{wait:?}");
    assert!((0.99..1.01).contains(&expected.div_duration_f64(time)), "{expected:?}");
    let waiting = queue.push(task(2), time.mul_f64(2.1), None).unwrap();
    // The identical job is the same one, which takes no longer for another request.
    assert!(queue.push(task(2), time / 10, None).unwrap().is_shared);
    drop((running, waiting));
}

/// Lets the running job have begun much earlier.
fn overrun(queue: &Queue) {
    let begun = Instant::now().checked_sub(100 * expected(queue));
    for job in queue.lock().jobs.iter_mut().filter(|job| job.begun.is_some()) {
        job.begun = Some(begun.unwrap());
    }
}

#[test]
fn a_job_is_refused_at_once_while_running_ones_take_longer_than_expected() {
    let queue = Arc::new(Queue::new(8, 3));
    let allowed = expected(&queue).mul_f64(1.5);
    let running = queue.push(task(1), allowed, None).unwrap();
    assert!(queue.pop(Lane::Long).is_some());
    let accepted = queue.push(task(2), allowed, None).unwrap();
    overrun(&queue);
    let refused = queue.push(task(3), allowed, None).map(drop);
    let Err(Refusal::TooLate { wait, expected, .. }) = refused else { panic!("accepted") };
    assert!(wait.is_zero() && expected > allowed, "a worker is free: {wait:?} {expected:?}");
    // The control: without other jobs, a job tries.
    drop(accepted);
    queue.done(running.job, None, None);
    assert!(queue.push(task(3), allowed, None).is_ok());
}

#[tokio::test]
async fn a_queued_request_gives_up_when_it_would_be_late_and_an_asynchronous_job_does_not() {
    let queue = Arc::new(Queue::new(8, 1));
    let _running = queue.push(task(1), Duration::from_hours(1), None).unwrap();
    assert!(queue.pop(Lane::Long).is_some());
    let mut waiting = queue.push(task(2), expected(&queue).mul_f64(2.1), None).unwrap();
    let pause = Duration::from_millis(100);
    assert!(tokio::time::timeout(pause, waiting.wait()).await.is_err(), "it would end in time");
    overrun(&queue);
    waiting.is_durable = true;
    assert!(tokio::time::timeout(pause, waiting.wait()).await.is_err(), "it waits until its deadline");
    waiting.is_durable = false;
    assert!(matches!(waiting.wait().await, Err(Failure::Waited { .. })));
}

#[test]
fn cancelled_jobs_tell_only_that_such_jobs_take_longer() {
    let queue = Arc::new(Queue::new(8, 1));
    let end = |seconds: f64| {
        let before = expected(&queue);
        let ticket = queue.push(task(1), Duration::from_hours(1), None).unwrap();
        let entry = queue.pop(Lane::Long).unwrap();
        let cancelled = Failure::Job { error: JobError::Surface(SurfaceError::Cancelled), diagnostics: Vec::new() };
        queue.done(entry.id, Some(Err(cancelled)), Some(Duration::from_secs_f64(seconds)));
        drop(ticket);
        expected(&queue).div_duration_f64(before)
    };
    let time = expected(&queue).as_secs_f64();
    assert!((end(0.5 * time) - 1.0).abs() < 1e-9, "it might have taken ten times as long");
    assert!(end(2.0 * time) > 1.1, "it takes at least twice as long");
}
