//! Orderly stops of a process: its jobs are finished or return to the queue, and only a crash counts an attempt.

use std::sync::atomic::Ordering;
use std::time::Duration;

use super::{Fixture, MAX_WAIT, ended, is, until};
use crate::config::JobsConfig;
use crate::jobs::broker::{Broker as _, Dispatch};
use crate::jobs::runs::StoppedJobs;
use crate::jobs::{JobId, JobStore, Status};
use crate::store::Folder;

/// Time in which unfinished jobs return to the queue.
const RETURNING: Duration = Duration::from_secs(5);

/// Stops the jobs of a process after `drain`, which is too short for some of them.
pub(super) async fn stop(jobs: &JobStore, drain: Duration) -> StoppedJobs {
    let pool = &jobs.0.pool;
    jobs.stop_claiming();
    pool.leave();
    let finish = async {
        pool.finish().await;
        jobs.all_recorded().await;
    };
    if tokio::time::timeout(drain, finish).await.is_err() {
        jobs.return_jobs();
        pool.cancel();
        drop(tokio::time::timeout(RETURNING, jobs.all_recorded()).await);
    }
    jobs.stopped_jobs()
}

fn with_attempts(attempts: u32) -> JobsConfig {
    JobsConfig { attempts, ..JobsConfig::default() }
}

impl Fixture {
    /// Waits until the result of a job is being stored, which the store rejects.
    async fn until_storing(&self, id: &JobId) {
        self.until_timed_out(1).await;
        until("the record of the attempt", || async { self.on_record(id).await.status == Status::Running }).await;
    }

    /// Starts another process over the same data. Results cannot be stored.
    async fn restart(self, config: JobsConfig) -> Self {
        let next = Self::open(self.dir, config).await;
        next.faults.seal(Folder::Results);
        assert_eq!(next.jobs.reconcile().await.unwrap(), 1);
        next
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_result_is_stored_within_the_drain() {
    let fixture = Fixture::new(1, MAX_WAIT).await;
    fixture.faults.seal(Folder::Results);
    let id = fixture.accept().await.unwrap().record.id;
    fixture.until_storing(&id).await;
    let works_again = async {
        tokio::time::sleep(Duration::from_secs(2)).await;
        fixture.faults.silence(None);
    };
    let (stopped, ()) = tokio::join!(stop(&fixture.jobs, MAX_WAIT), works_again);
    assert_eq!(stopped, StoppedJobs { finished: 1, ..StoppedJobs::default() });
    let record = fixture.on_record(&id).await;
    assert_eq!((record.status, record.attempts), (Status::Successful, 1));
    assert_eq!(fixture.store.usage(Folder::Results).objects, 2);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_unfinished_job_returns_to_the_queue_at_once() {
    let fixture = Fixture::new(1, MAX_WAIT).await;
    fixture.faults.seal(Folder::Results);
    let id = fixture.accept().await.unwrap().record.id;
    fixture.until_storing(&id).await;
    assert_eq!(fixture.on_record(&id).await.attempts, 1);
    let stopped = stop(&fixture.jobs, Duration::from_millis(100)).await;
    assert_eq!(stopped, StoppedJobs { returned: 1, ..StoppedJobs::default() });
    let record = fixture.on_record(&id).await;
    assert_eq!((record.status, record.attempts, record.started_ms), (Status::Accepted, 0, None));
    let claim = tokio::time::timeout(RETURNING, fixture.broker.claim(false)).await.expect("the claim is released");
    assert_eq!(claim.id, id);
    let next = fixture.restart(with_attempts(1)).await;
    next.faults.silence(None);
    let mut seen = next.watch(&id).await;
    ended(&mut seen).await;
    is(&seen, |record| (record.status, record.attempts), &(Status::Successful, 1));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn stops_do_not_count_as_attempts() {
    let mut fixture = Fixture::new(2, MAX_WAIT).await;
    fixture.faults.seal(Folder::Results);
    let id = fixture.accept().await.unwrap().record.id;
    for _ in 0..4 {
        fixture.until_storing(&id).await;
        assert_eq!(stop(&fixture.jobs, Duration::ZERO).await.returned, 1);
        fixture = fixture.restart(with_attempts(2)).await;
    }
    fixture.faults.silence(None);
    let mut seen = fixture.watch(&id).await;
    ended(&mut seen).await;
    is(&seen, |record| (record.status, record.attempts), &(Status::Successful, 1));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn crashes_count_as_attempts() {
    let mut fixture = Fixture::new(2, MAX_WAIT).await;
    fixture.faults.seal(Folder::Results);
    let id = fixture.accept().await.unwrap().record.id;
    for attempts in 1..=2 {
        fixture.until_storing(&id).await;
        assert_eq!(fixture.on_record(&id).await.attempts, attempts);
        // The process writes nothing any more.
        fixture.faults.hang.store(true, Ordering::SeqCst);
        fixture = fixture.restart(with_attempts(2)).await;
    }
    fixture.faults.silence(None);
    let mut seen = fixture.watch(&id).await;
    ended(&mut seen).await;
    is(&seen, |record| (record.status, record.attempts), &(Status::Failed, 2));
    assert!(seen.borrow().record.problem.as_ref().unwrap().as_str().unwrap().starts_with("Poison"));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stored_result_ends_a_job_whose_attempts_are_exhausted() {
    let fixture = Fixture::new(1, MAX_WAIT).await;
    fixture.faults.seal(Folder::Results);
    let id = fixture.accept().await.unwrap().record.id;
    fixture.until_storing(&id).await;
    fixture.faults.seal(Folder::Jobs);
    fixture.until_timed_out(1).await;
    // The result is stored, but the process ends before the record of the end.
    assert_eq!(fixture.store.usage(Folder::Results).objects, 2);
    let stopped = stop(&fixture.jobs, Duration::ZERO).await;
    assert_eq!(stopped, StoppedJobs { unrecorded: 1, ..StoppedJobs::default() });
    fixture.faults.hang.store(true, Ordering::SeqCst);
    let next = fixture.restart(with_attempts(1)).await;
    let mut seen = next.watch(&id).await;
    ended(&mut seen).await;
    is(&seen, |record| (record.status, record.attempts), &(Status::Successful, 1));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_that_waits_for_the_store_returns_to_the_queue() {
    let fixture = Fixture::new(1, MAX_WAIT).await;
    fixture.store_record().await;
    fixture.faults.silence(Some(Folder::Inputs));
    assert_eq!(fixture.jobs.reconcile().await.unwrap(), 1);
    // The pauses between the attempts to read the input grow.
    fixture.until_timed_out(3).await;
    assert_eq!(stop(&fixture.jobs, Duration::ZERO).await.returned, 1);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_claim_whose_record_is_not_read_is_released() {
    let fixture = Fixture::new(1, MAX_WAIT).await;
    let id = fixture.store_record().await;
    let dispatch = Dispatch::of(&fixture.on_record(&id).await);
    fixture.faults.silence(Some(Folder::Jobs));
    assert_eq!(fixture.broker.dispatch(&dispatch).await, Ok(true));
    fixture.until_timed_out(1).await;
    assert_eq!(stop(&fixture.jobs, Duration::ZERO).await.returned, 1);
    let claim = tokio::time::timeout(RETURNING, fixture.broker.claim(false)).await.expect("the claim is released");
    assert_eq!(claim.id, id);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn no_attempt_begins_after_the_return() {
    let fixture = Fixture::new(1, MAX_WAIT).await;
    let id = fixture.store_record().await;
    let job = fixture.jobs.insert_open(fixture.on_record(&id).await);
    fixture.jobs.return_jobs();
    // A worker has taken the job and is about to start.
    fixture.jobs.begin(&job).await;
    for record in [job.record(), fixture.on_record(&id).await] {
        assert_eq!((record.status, record.attempts), (Status::Accepted, 0), "{record:?}");
    }
}
