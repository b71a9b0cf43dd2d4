//! Many jobs that share one run: their records, and their recovery.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use bytes::Bytes;

use super::{Fixture, MAX_WAIT, SAMPLE, ended, is, task};
use crate::config::JobsConfig;
use crate::jobs::broker::Broker as _;
use crate::jobs::coalesced_job::work_key;
use crate::jobs::durable_job::DurableJob;
use crate::jobs::{Budget, OnStart, Status};

/// Records an attempt of `n` jobs that share a run, with `writes` permits to write. Returns the time for which a worker
/// waits, and the largest number of concurrent operations of the store. `slow` is the time of an operation.
async fn record_attempts(n: usize, writes: usize, slow: Duration) -> (Duration, usize) {
    let fixture = Fixture::new(3, MAX_WAIT).await;
    let all = fixture.jobs.0.writes.available_permits();
    assert_eq!(fixture.jobs.0.writes.forget_permits(all - writes), all - writes);
    let mut jobs = Vec::new();
    for _ in 0..n {
        let id = fixture.store_record().await;
        jobs.push(Arc::new(DurableJob::new(fixture.on_record(&id).await)));
    }
    let on_start = jobs.iter().map(|job| fixture.jobs.on_start(job)).collect();
    fixture.faults.slow_ms.store(slow.as_millis().try_into().unwrap(), Ordering::SeqCst);
    let begun = Instant::now();
    tokio::task::spawn_blocking(|| OnStart::run_all(on_start)).await.unwrap();
    let time = begun.elapsed();
    fixture.faults.slow_ms.store(0, Ordering::SeqCst);
    for job in &jobs {
        assert_eq!(fixture.on_record(&job.id()).await.attempts, 1, "on record before the attempt starts");
    }
    (time, fixture.faults.most_waiting.load(Ordering::SeqCst))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn attempts_of_joined_jobs_are_recorded_concurrently() {
    const JOBS: u32 = 60;
    const WRITE: Duration = Duration::from_millis(40);
    let (one_by_one, most) = record_attempts(JOBS as usize, 1, WRITE).await;
    assert!(one_by_one > WRITE * JOBS && most == 1, "control: {one_by_one:?}, {most}");
    let (time, most) = record_attempts(JOBS as usize, 64, WRITE).await;
    assert!(time < one_by_one / 2, "{time:?}, one by one {one_by_one:?}");
    assert!((8..=64).contains(&most), "{most} concurrent writes");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn joined_jobs_are_recovered_within_the_memory_budget() {
    const JOBS: usize = 200;
    let input: Bytes = [SAMPLE, &b"REMARK 999 PADDING\n".repeat(5_000_000 / 19)].concat().into();
    let budget = Budget::new(8 * input.len() as u64);
    let fixture = Fixture::open_within(tempfile::tempdir().unwrap(), JobsConfig::default(), budget.clone()).await;
    let mut ids = Vec::new();
    for _ in 0..JOBS {
        ids.push(fixture.store_record_with(input.clone()).await);
    }
    // Without memory for the input, every job waits.
    let reservation = budget.reservation();
    reservation.grow(8 * input.len() as u64 - 1).unwrap();
    assert_eq!(fixture.jobs.reconcile().await.unwrap(), JOBS);
    tokio::time::sleep(Duration::from_millis(300)).await;
    assert_eq!(fixture.faults.input_reads.load(Ordering::SeqCst), 0, "memory is reserved before it is used");
    drop(reservation);
    let begun = Instant::now();
    let mut most = 0;
    while !fixture.broker.is_empty() {
        assert!(begun.elapsed() < MAX_WAIT, "the jobs do not end");
        most = most.max(budget.used());
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
    assert!(most <= 8 * input.len() as u64, "{most} bytes were held");
    for id in &ids {
        let record = fixture.on_record(id).await;
        // Those that are claimed after the first one has ended find its result.
        assert!(record.status == Status::Successful && record.attempts <= 1, "{record:?}");
    }
    let reads = fixture.faults.input_reads.load(Ordering::SeqCst);
    assert!((1..=2).contains(&reads), "the input was loaded {reads} times");
    assert_eq!(fixture.faults.result_writes.load(Ordering::SeqCst), 2, "mesh and report are stored once");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_recovered_job_whose_input_never_fits_fails() {
    let budget = Budget::new(SAMPLE.len() as u64 - 1);
    let fixture = Fixture::open_within(tempfile::tempdir().unwrap(), JobsConfig::default(), budget).await;
    let id = fixture.store_record().await;
    assert_eq!(fixture.jobs.reconcile().await.unwrap(), 1);
    let mut seen = fixture.watch(&id).await;
    ended(&mut seen).await;
    is(&seen, |record| record.status, &Status::Failed);
    let problem = seen.borrow().record.problem.clone().unwrap();
    assert!(problem.as_str().unwrap().contains("Memory"), "{problem}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_waits_for_memory_without_losing_attempts() {
    const BUDGET: u64 = 1 << 24;
    let budget = Budget::new(BUDGET);
    let config = JobsConfig { attempts: 2, ..JobsConfig::default() };
    let fixture = Fixture::open_within(tempfile::tempdir().unwrap(), config, budget.clone()).await;
    let others = budget.reservation();
    others.grow(BUDGET).unwrap();
    let id = fixture.accept_from("a").await.unwrap().record.id;
    let mut seen = fixture.watch(&id).await;
    // Four attempts fail in this time.
    tokio::time::sleep(Duration::from_secs(3)).await;
    is(&seen, |record| (record.status, record.attempts), &(Status::Accepted, 0));
    drop(others);
    ended(&mut seen).await;
    is(&seen, |record| (record.status, record.attempts), &(Status::Successful, 1));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_whose_result_is_stored_ends_while_another_one_has_the_lock_of_the_work() {
    let fixture = Fixture::new(1, MAX_WAIT).await;
    fixture.accept().await.unwrap();
    fixture.all_ended().await;
    let _lock = fixture.broker.lock(&work_key(&task("a", "2"))).await.expect("no job has the lock");
    assert_eq!(fixture.accept_from("b").await.unwrap().record.status, Status::Successful);
}
