//! Refusal of jobs that would end too late, and the estimates that it depends on.

use std::sync::Arc;
use std::time::Duration;

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
    Duration::from_secs_f64(queue.expected(crate::pipeline::estimate_work(task.input.atoms(), &task.job)))
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
    let Err(Refusal::TooLate { wait, allowed }) = refused else { panic!("accepted") };
    assert!((0.95..=1.0).contains(&wait.div_duration_f64(time)), "{wait:?}");
    assert!((0.94..0.96).contains(&allowed.div_duration_f64(time)), "half of the time is kept for the wait");
    let waiting = queue.push(task(2), time.mul_f64(2.1), None).unwrap();
    // The identical job is the same one, which takes no longer for another request.
    assert!(queue.push(task(2), time / 10, None).unwrap().is_shared);
    drop((running, waiting));
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
