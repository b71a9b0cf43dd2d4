//! Interleavings of requests, workers and shutdown.

mod broker;
mod durable;

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use bytes::Bytes;
use shuttle::future::block_on;

use super::coalesced_job::QueuedTask;
use super::queue::Queue;
use super::rank::{Lane, Rank};
use super::{Failure, Refusal, Task, Ticket};
use crate::sync::thread::{self, JoinHandle};

/// Number of schedules of a test.
const SCHEDULES: usize = 10_000;

/// Creates a task; tasks of the same number are identical.
fn task(number: u8, batch: bool) -> Task {
    Task::for_test(Bytes::from(vec![number]), &[], Rank { batch, ..Rank::default() })
}

fn push(queue: &Arc<Queue>, number: u8, batch: bool) -> Result<Ticket, Refusal> {
    queue.push(task(number, batch), Duration::from_hours(1), None)
}

/// Waits for the end of a job. Returns true if it ran.
fn ran(mut ticket: Ticket) -> bool {
    ticket.outcome.take().is_some_and(|mut outcome| block_on(outcome.recv()).is_some())
}

/// Starts a worker of each lane, which counts its runs.
fn workers(queue: &Arc<Queue>, runs: &Arc<AtomicUsize>) -> Vec<JoinHandle<()>> {
    let worker = |lane| {
        let (queue, runs) = (Arc::clone(queue), Arc::clone(runs));
        thread::spawn(move || {
            while let Some(entry) = queue.pop(lane) {
                let QueuedTask { id, task, cancel, on_start, .. } = entry;
                thread::yield_now();
                if cancel.is_cancelled() && queue.restart(id, task, on_start).is_ok() {
                    continue;
                }
                runs.fetch_add(1, Ordering::SeqCst);
                let outcome = Err(Failure::Panicked { message: "scripted".to_owned() });
                queue.done(id, Some(outcome), None);
            }
        })
    };
    Lane::ALL.map(worker).into()
}

fn join(workers: Vec<JoinHandle<()>>) {
    for worker in workers {
        worker.join().unwrap();
    }
}

#[test]
fn every_waiting_request_gets_an_outcome_although_others_leave() {
    crate::sync::explore(
        || {
            let (queue, runs) = (Arc::new(Queue::new(8, 2)), Arc::default());
            let workers = workers(&queue, &runs);
            let requests: Vec<_> = (0..4)
                .map(|n| {
                    let queue = Arc::clone(&queue);
                    thread::spawn(move || {
                        let ticket = push(&queue, n % 2, false).unwrap();
                        // The last one disconnects.
                        n == 3 || ran(ticket)
                    })
                })
                .collect();
            assert!(requests.into_iter().all(|request| request.join().unwrap()));
            block_on(queue.idle());
            queue.close();
            join(workers);
            assert!((1..=4).contains(&runs.load(Ordering::SeqCst)));
        },
        SCHEDULES,
    );
}

#[test]
fn jobs_that_move_to_the_long_lane_end_although_others_leave_and_the_service_stops() {
    crate::sync::explore(
        || {
            let (queue, runs) = (Arc::new(Queue::new(8, 1)), Arc::default());
            let workers = workers(&queue, &runs);
            let mut requests: Vec<_> = (0..3)
                .map(|n| {
                    let queue = Arc::clone(&queue);
                    thread::spawn(move || push(&queue, n % 2, false).is_ok_and(|ticket| n == 2 || ran(ticket)))
                })
                .collect();
            let shared_queue = Arc::clone(&queue);
            requests.push(thread::spawn(move || {
                for _ in 0..4 {
                    shared_queue.make_room();
                    thread::yield_now();
                }
                true
            }));
            queue.close();
            requests.into_iter().for_each(|request| drop(request.join().unwrap()));
            block_on(queue.idle());
            join(workers);
        },
        SCHEDULES,
    );
}

#[test]
fn no_request_waits_for_ever_when_the_service_stops() {
    crate::sync::explore(
        || {
            let (queue, runs) = (Arc::new(Queue::new(8, 2)), Arc::default());
            let workers = workers(&queue, &runs);
            let requests: Vec<_> = (0..3)
                .map(|n| {
                    let queue = Arc::clone(&queue);
                    // A refusal ends the request as well.
                    thread::spawn(move || push(&queue, n, false).is_ok_and(ran))
                })
                .collect();
            queue.close();
            queue.cancel_all();
            let ran = requests.into_iter().map(|request| request.join().unwrap()).filter(|ran| *ran).count();
            join(workers);
            block_on(queue.idle());
            assert!(ran <= runs.load(Ordering::SeqCst));
        },
        SCHEDULES,
    );
}

#[test]
fn durable_jobs_run_or_are_left_to_the_next_process() {
    crate::sync::explore(
        || {
            let (queue, runs) = (Arc::new(Queue::new(8, 2)), Arc::default());
            let workers = workers(&queue, &runs);
            let requests: Vec<_> = (0..3)
                .map(|n| {
                    let queue = Arc::clone(&queue);
                    thread::spawn(move || ran(push(&queue, n, true).unwrap()))
                })
                .collect();
            queue.leave();
            let ran = requests.into_iter().map(|request| request.join().unwrap()).filter(|ran| *ran).count();
            block_on(queue.idle());
            queue.close();
            join(workers);
            assert_eq!(ran, runs.load(Ordering::SeqCst), "each job that ran has reported so");
        },
        SCHEDULES,
    );
}
