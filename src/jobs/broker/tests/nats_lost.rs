//! Tests of streams and consumers that an operator deletes.

use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::task::JoinHandle;

use super::super::{Broker, Claim, Dispatch};
use super::server::NatsServer;
use super::{SOON, claim, job, nats, none_within, on_nats, until_down};
use crate::jobs::rank::DEFAULT_URGENCY;
use crate::store::Digest;

/// Deletes the consumer for the jobs of [`dispatched`].
const DELETE_CONSUMER: &str = "CONSUMER.DELETE.molmesh-jobs.normal-cpu";
/// Deletes another consumer.
const DELETE_OTHER: &str = "CONSUMER.DELETE.molmesh-jobs.low-gpu";
/// Deletes the stream of jobs.
const DELETE_STREAM: &str = "STREAM.DELETE.molmesh-jobs";
/// Deletes the stream of locks.
const DELETE_LOCKS: &str = "STREAM.DELETE.molmesh-work";
/// Maximum time until a job is claimed from a consumer that was lost. Old servers do not answer a claim from a consumer
/// that does not exist.
const MAX_CLAIM: Duration = SOON.saturating_mul(2);

async fn nodes(server: &NatsServer) -> [Arc<dyn Broker>; 2] {
    [Arc::new(nats(server).await), Arc::new(nats(server).await)]
}

async fn dispatched(broker: &dyn Broker) -> Dispatch {
    let job = job(DEFAULT_URGENCY);
    assert_eq!(broker.dispatch(&job).await, Ok(true));
    job
}

/// Starts a claim, and returns it when the node waits for a job.
async fn start_claim(broker: &Arc<dyn Broker>) -> JoinHandle<Claim> {
    let broker = Arc::clone(broker);
    let claim = tokio::spawn(async move { broker.claim(false).await });
    tokio::time::sleep(Duration::from_millis(300)).await;
    claim
}

/// Checks that a claim gets a job.
async fn assert_claims(claim: JoinHandle<Claim>, job: &Dispatch) {
    let claimed = tokio::time::timeout(MAX_CLAIM, claim).await.expect("the job is claimed").unwrap();
    assert_eq!(claimed.id, job.id);
    claimed.done().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn lost_consumers_are_created_again() {
    on_nats(async |server| {
        let [a, b] = nodes(server).await;
        assert!(server.jetstream("STREAM.INFO.molmesh-jobs").contains("\"consumer_count\":6"));
        for lost in [&[DELETE_CONSUMER] as &[_], &[DELETE_OTHER, DELETE_CONSUMER]] {
            // A job that is dispatched afterwards.
            let claim = start_claim(&b).await;
            for request in lost {
                server.jetstream(request);
            }
            let job = dispatched(&*a).await;
            assert_claims(claim, &job).await;
            // A job that was dispatched before.
            let job = dispatched(&*b).await;
            for request in lost {
                server.jetstream(request);
            }
            assert_claims(start_claim(&a).await, &job).await;
            let begun = Instant::now();
            while !server.jetstream("STREAM.INFO.molmesh-jobs").contains("\"consumer_count\":6") {
                assert!(begun.elapsed() < SOON);
                tokio::time::sleep(Duration::from_millis(20)).await;
            }
        }
        assert_eq!((a.losses(), b.losses()), (0, 0), "no job was lost");
        for node in [&a, &b] {
            until_down(&**node, SOON, |why| why.is_none()).await;
            none_within(node, Duration::from_millis(300)).await;
        }
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_lost_stream_is_created_again_and_its_jobs_can_be_dispatched_again() {
    on_nats(async |server| {
        let [a, b] = nodes(server).await;
        let lost = dispatched(&*a).await;
        assert_eq!((a.down(), a.losses(), b.losses()), (None, 0, 0));
        server.jetstream(DELETE_STREAM);
        until_down(&*a, SOON, |why| why.is_some()).await;
        for node in [&a, &b] {
            until_down(&**node, SOON, |why| why.is_none() && node.losses() > 0).await;
        }
        assert_eq!((a.losses(), b.losses()), (1, 1));
        assert_eq!(a.dispatch(&lost).await, Ok(true));
        let claimed = claim(&b).await;
        assert_eq!(claimed.id, lost.id);
        claimed.done().await;
        // A stream that is lost while a node waits for a job.
        let claim = start_claim(&b).await;
        server.jetstream(DELETE_STREAM);
        until_down(&*a, SOON, |why| why.is_none() && a.losses() == 2).await;
        let job = dispatched(&*a).await;
        assert_claims(claim, &job).await;
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_lost_stream_of_locks_is_created_again() {
    on_nats(async |server| {
        let [a, b] = nodes(server).await;
        let work = Digest::of(b"work");
        // Without the stream, both nodes do the work.
        let is_exclusive = async || {
            let _lock = a.lock(&work).await.expect("the work is free");
            b.lock(&work).await.is_none()
        };
        assert!(is_exclusive().await);
        server.jetstream(DELETE_LOCKS);
        let begun = Instant::now();
        while !is_exclusive().await {
            assert!(begun.elapsed() < SOON, "the stream is still missing");
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
        assert_eq!((a.losses(), b.losses()), (0, 0), "no job was lost");
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn failed_claims_are_reported_while_they_last() {
    on_nats(async |server| {
        let broker: Arc<dyn Broker> = Arc::new(nats(server).await);
        let mut is_reported = false;
        // A check of the streams may create the consumer before it is asked.
        for _ in 0..5 {
            let claim = start_claim(&broker).await;
            assert_eq!(broker.down(), None);
            server.jetstream(DELETE_CONSUMER);
            let job = dispatched(&*broker).await;
            let fails = |why: Option<&str>| why.is_some_and(|why| why.contains("no job can be claimed"));
            until_down(&*broker, MAX_CLAIM, |why| {
                is_reported |= fails(why);
                is_reported || claim.is_finished()
            })
            .await;
            assert_claims(claim, &job).await;
            until_down(&*broker, SOON, |why| why.is_none()).await;
            if is_reported {
                break;
            }
        }
        assert!(is_reported);
    })
    .await;
}
