//! Interleavings of nodes that dispatch, claim, return and finish jobs of one broker.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use shuttle::future::block_on;
use shuttle::rand::{Rng as _, thread_rng};
use tokio::sync::watch;

use super::SCHEDULES;
use crate::jobs::broker::{Broker, Claim, ClaimEnd, Dispatch, MemoryBroker};
use crate::jobs::record::JobId;
use crate::store::Digest;
use crate::sync::thread;

/// Number of jobs.
const JOBS: u64 = 3;

/// Runs and ends of each job.
type RunCounts = std::sync::Mutex<BTreeMap<JobId, (u32, u32)>>;

/// Changes the counts of a job and returns them. Assertions follow outside the lock: a poisoned one would hide them.
fn change(counts: &RunCounts, id: &JobId, change: impl FnOnce(&mut (u32, u32))) -> (u32, u32) {
    let mut counts = counts.lock().unwrap();
    let count = counts.entry(id.clone()).or_default();
    change(count);
    *count
}

/// Runs a claimed job, which ends or returns to the queue. `returns_early` returns it before its run has ended.
fn run(broker: &MemoryBroker, claim: Claim, counts: &RunCounts, returns_early: bool) {
    let id = claim.id.clone();
    let (runs, _) = change(counts, &id, |(runs, _)| *runs += 1);
    assert_eq!(runs, 1, "two workers run a job");
    if returns_early {
        block_on(claim.end(ClaimEnd::Release(Duration::ZERO)));
        thread::yield_now();
        change(counts, &id, |(runs, _)| *runs -= 1);
        return;
    }
    let lock = block_on(broker.lock(&Digest::of(id.as_str().as_bytes())));
    assert!(lock.is_some(), "two workers do the same work");
    thread::yield_now();
    drop(lock);
    let ends = thread_rng().gen_range(0..3) > 0;
    change(counts, &id, |(runs, ended)| {
        *runs -= 1;
        *ended += u32::from(ends);
    });
    if ends {
        block_on(claim.done());
    } else {
        block_on(claim.end(ClaimEnd::Release(Duration::ZERO)));
    }
}

/// Explores schedules of two nodes that dispatch the same jobs, and two workers.
fn explore(returns_early: bool) {
    let model = move || {
        let (broker, counts) = (MemoryBroker::new(8), Arc::<RunCounts>::default());
        let job = |n: u64| JobId::from_key(&[0; 32], crate::store::Namespace::default(), n, "k");
        let jobs: Vec<_> = (0..JOBS).map(|n| Dispatch { id: job(n), urgency: 3, suits_gpu: n % 2 == 0 }).collect();
        let node = || {
            let (broker, jobs) = (broker.clone(), jobs.clone());
            thread::spawn(move || {
                jobs.iter().filter(|job| block_on(broker.dispatch(job)).unwrap()).map(|job| job.id.clone()).collect()
            })
        };
        let nodes: Vec<thread::JoinHandle<Vec<JobId>>> = vec![node(), node()];
        let stop = watch::Sender::new(false);
        let worker = || {
            let (broker, counts, mut stop) = (broker.clone(), Arc::clone(&counts), stop.subscribe());
            thread::spawn(move || {
                loop {
                    let next = async {
                        tokio::select! {
                            claim = broker.claim(false) => Some(claim),
                            _ = stop.wait_for(|stops| *stops) => None,
                        }
                    };
                    let Some(claim) = block_on(next) else { return };
                    run(&broker, claim, &counts, returns_early);
                }
            })
        };
        let workers = [worker(), worker()];
        let mut dispatched: Vec<JobId> = nodes.into_iter().flat_map(|node| node.join().unwrap()).collect();
        while !broker.is_empty() {
            thread::yield_now();
        }
        stop.send_replace(true);
        for worker in workers {
            worker.join().unwrap();
        }
        dispatched.sort();
        let counts = counts.lock().unwrap().clone();
        for id in &dispatched {
            let times = dispatched.iter().filter(|other| *other == id).count();
            // A job that has ended may be dispatched again by a node that does not know it.
            assert_eq!(counts[id], (0, u32::try_from(times).unwrap()), "a dispatched job ends once");
        }
        assert_eq!(counts.len() as u64, JOBS);
    };
    crate::sync::explore(model, SCHEDULES);
}

#[test]
fn every_dispatched_job_ends_once_and_runs_on_one_worker_at_a_time() {
    explore(false);
}

#[test]
#[should_panic(expected = "two workers run a job")]
fn a_job_that_is_returned_before_its_run_has_ended_is_detected() {
    explore(true);
}
