//! Tests that count messages to the server.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use async_nats::Subscriber;
use futures_util::StreamExt as _;

use super::super::order::QUEUES;
use super::super::{Broker, Dispatch};
use super::server::NatsServer;
use super::{SOON, claim, job, nats, on_nats};
use crate::jobs::rank::DEFAULT_URGENCY;

/// Number of jobs of a test.
const JOBS: usize = 32;
/// Time after which a message has reached all subscribers.
const ARRIVAL: Duration = Duration::from_millis(300);

/// Subscribes to the messages of all programs.
async fn observe(server: &NatsServer, subject: &str) -> Subscriber {
    let connection = async_nats::connect(server.address()).await.unwrap();
    let messages = connection.subscribe(subject.to_owned()).await.unwrap();
    tokio::time::sleep(ARRIVAL).await;
    messages
}

/// Counts the messages that have arrived or arrive soon.
async fn count(messages: &mut Subscriber) -> usize {
    let mut n = 0;
    while let Ok(Some(_)) = tokio::time::timeout(ARRIVAL, messages.next()).await {
        n += 1;
    }
    n
}

/// Queues a job without an announcement.
async fn put(connection: &async_nats::Client, queue: &str, job: &Dispatch) {
    let subject = format!("molmesh.jobs.{queue}.{}", job.id.as_str());
    connection.request(subject, "".into()).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_busy_node_asks_each_empty_queue_once_a_second() {
    on_nats(async |server| {
        let node: Arc<dyn Broker> = Arc::new(nats(server).await);
        let mut requests = observe(server, "$JS.API.CONSUMER.MSG.NEXT.>").await;
        for _ in 0..JOBS {
            assert_eq!(node.dispatch(&job(DEFAULT_URGENCY)).await, Ok(true));
        }
        let begun = Instant::now();
        for _ in 0..JOBS {
            claim(&node).await.done().await;
        }
        let seconds = usize::try_from(begun.elapsed().as_secs()).unwrap();
        let (asked, limit) = (count(&mut requests).await, JOBS + (QUEUES.len() - 1) * (1 + seconds));
        assert!((JOBS..=limit).contains(&asked), "{asked} requests for {JOBS} jobs in {seconds} s");
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_busy_node_does_not_overlook_urgent_jobs_of_other_nodes() {
    on_nats(async |server| {
        let [node, other] = [nats(server).await, nats(server).await].map(|node| Arc::new(node) as Arc<dyn Broker>);
        for _ in 0..10 {
            assert_eq!(other.dispatch(&job(DEFAULT_URGENCY)).await, Ok(true));
        }
        // After them, the node knows empty queues, and the next claim does not ask the queues in turn.
        for _ in 0..4 {
            claim(&node).await.done().await;
        }
        let urgent = job(0);
        assert_eq!(other.dispatch(&urgent).await, Ok(true));
        tokio::time::sleep(ARRIVAL).await;
        let claimed = claim(&node).await;
        assert_eq!(claimed.id, urgent.id);
        claimed.done().await;
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_has_at_most_four_announcements_however_many_nodes_there_are() {
    on_nats(async |server| {
        let nodes = [nats(server).await, nats(server).await, nats(server).await, nats(server).await].map(Arc::new);
        let mut announcements = observe(server, "molmesh.new.*").await;
        let begun = Arc::new(AtomicUsize::new(0));
        let workers = nodes.clone().map(|node| {
            let begun = Arc::clone(&begun);
            tokio::spawn(async move {
                while begun.fetch_add(1, Ordering::Relaxed) < JOBS {
                    let claim = node.claim(false).await;
                    tokio::time::sleep(Duration::from_millis(5)).await;
                    claim.done().await;
                }
            })
        });
        // All nodes wait for jobs.
        tokio::time::sleep(ARRIVAL).await;
        let dispatch = |job: Dispatch| async {
            let job = job;
            assert_eq!(nodes[0].dispatch(&job).await, Ok(true));
        };
        let jobs = (0..JOBS).map(|_| job(DEFAULT_URGENCY));
        futures_util::stream::iter(jobs).for_each_concurrent(None, dispatch).await;
        for worker in workers {
            worker.await.unwrap();
        }
        let n = count(&mut announcements).await;
        assert!((2 * JOBS..=4 * JOBS).contains(&n), "{n} announcements of {JOBS} jobs");
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_idle_node_finds_a_job_that_was_not_announced_beside_jobs_of_others() {
    on_nats(async |server| {
        let node: Arc<dyn Broker> = Arc::new(nats(server).await);
        let connection = async_nats::connect(server.address()).await.unwrap();
        let waiting = tokio::spawn(async move { node.claim(false).await });
        tokio::time::sleep(ARRIVAL).await;
        let (job, begun) = (job(7), Instant::now());
        put(&connection, "low-cpu", &job).await;
        while !waiting.is_finished() {
            assert!(begun.elapsed() < SOON, "the node does not look for jobs");
            // A job that another node claims.
            connection.publish("molmesh.new.cpu", "normal-gpu".into()).await.unwrap();
            tokio::time::sleep(ARRIVAL).await;
        }
        let claimed = waiting.await.unwrap();
        assert_eq!(claimed.id, job.id);
        claimed.done().await;
    })
    .await;
}
