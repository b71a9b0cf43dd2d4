//! Tests that count messages to the server.

use std::sync::Arc;
use std::time::{Duration, Instant};

use async_nats::Subscriber;
use futures_util::StreamExt as _;

use super::super::Broker;
use super::super::order::QUEUES;
use super::server::NatsServer;
use super::{claim, job, nats, on_nats};
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
