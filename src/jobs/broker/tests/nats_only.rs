//! Tests of what only a broker with a server has.

use std::sync::Arc;
use std::time::{Duration, Instant};

use futures_util::StreamExt as _;

use super::super::{Broker, ClaimEnd, Dispatch, NatsBroker, check_broker};
use super::{MAX_WAIT, SOON, claim, job, nats, none_within, on_nats, until_down};
use crate::config::BrokerConfig;
use crate::jobs::rank::DEFAULT_URGENCY;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn jobs_are_dispatched_and_claimed_concurrently() {
    // With `MOLMESH_DISPATCHES=20000` and `--no-capture` it prints the rates of a long run.
    let n: usize = std::env::var("MOLMESH_DISPATCHES").map_or(1000, |n| n.parse().unwrap());
    on_nats(async |server| {
        let config = BrokerConfig { queue: n, ..BrokerConfig::default() };
        let connect = async || Arc::new(NatsBroker::connect(&config, server.address(), "a").await.unwrap());
        let nodes = [connect().await, connect().await, connect().await];
        for node in &nodes {
            until_down(&**node, MAX_WAIT, |why| why.is_none()).await;
        }
        let jobs: Vec<_> = (0..n).map(|_| job(DEFAULT_URGENCY)).collect();
        let mut times = Vec::new();
        for job in &jobs[..n / 10] {
            let begun = Instant::now();
            assert_eq!(nodes[0].dispatch(job).await, Ok(true));
            times.push(begun.elapsed());
        }
        times.sort_unstable();
        let begun = Instant::now();
        let dispatch = |job: Dispatch| async {
            let job = job;
            assert_eq!(nodes[0].dispatch(&job).await, Ok(true));
        };
        futures_util::stream::iter(jobs[n / 10..].iter().cloned()).for_each_concurrent(64, dispatch).await;
        let rate = (n - n / 10) as f64 / begun.elapsed().as_secs_f64();
        let claimed = Arc::new(std::sync::atomic::AtomicUsize::new(0));
        let begun = Instant::now();
        let workers = nodes.map(|node| {
            let claimed = Arc::clone(&claimed);
            tokio::spawn(async move {
                while claimed.fetch_add(1, std::sync::atomic::Ordering::Relaxed) < n {
                    let claim = node.claim(false).await;
                    // The job itself takes no time.
                    tokio::spawn(claim.done());
                }
            })
        });
        for worker in workers {
            worker.await.unwrap();
        }
        let claims = n as f64 / begun.elapsed().as_secs_f64();
        println!(
            "dispatch p50 {:?}, p99 {:?}; {rate:.0} dispatches per s from one node; {claims:.0} claims per s by three",
            times[times.len() / 2],
            times[times.len() * 99 / 100]
        );
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_node_with_another_store_gets_no_jobs() {
    on_nats(async |server| {
        let broker: Arc<dyn Broker> = Arc::new(nats(server).await);
        assert_eq!(broker.dispatch(&job(DEFAULT_URGENCY)).await, Ok(true));
        let other = NatsBroker::connect(&BrokerConfig::default(), server.address(), "b").await.unwrap();
        until_down(&other, SOON, |why| why.is_some_and(|why| why.contains("another store"))).await;
        none_within(&(Arc::new(other) as _), SOON / 2).await;
        // Control: a node with the same store gets the job.
        let same: Arc<dyn Broker> = Arc::new(nats(server).await);
        let claimed = claim(&same).await;
        claimed.done().await;
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stream_that_cannot_be_created_is_reported() {
    on_nats(async |server| {
        let config = BrokerConfig { replicas: 3, ..BrokerConfig::default() };
        let broker = NatsBroker::connect(&config, server.address(), "a").await.unwrap();
        until_down(&broker, SOON, |why| why.is_some_and(|why| why.contains("replicas"))).await;
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_broker_that_comes_back_is_used_again() {
    on_nats(async |server| {
        let broker: Arc<dyn Broker> = Arc::new(nats(server).await);
        let queued = job(DEFAULT_URGENCY);
        let config = BrokerConfig::default();
        assert_eq!(broker.dispatch(&queued).await, Ok(true));
        for keeps_data in [true, false] {
            server.stop(keeps_data);
            until_down(&*broker, SOON, |why| why.is_some()).await;
            assert!(check_broker(&config, server.address()).await.is_err());
            server.restart();
            until_down(&*broker, SOON, |why| why.is_none()).await;
            assert_eq!(check_broker(&config, server.address()).await, Ok(()));
            // Without its data the broker has lost the job.
            assert_eq!(broker.dispatch(&queued).await, Ok(!keeps_data));
            let claimed = claim(&broker).await;
            assert_eq!(claimed.id, queued.id);
            claimed.end(ClaimEnd::Release(Duration::ZERO)).await;
        }
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn new_jobs_go_to_idle_workers_that_they_suit() {
    on_nats(async |server| {
        let [gpu, cpu] = [nats(server).await, nats(server).await].map(Arc::new);
        // An idle worker that a job suits precedes the others, unless its thread has to wait.
        let mut suited = 0;
        for n in 0..20 {
            let job = Dispatch { suits_gpu: n % 2 == 1, ..job(DEFAULT_URGENCY) };
            let claim = |broker: &Arc<NatsBroker>, prefers_gpu| {
                let broker = Arc::clone(broker);
                Box::pin(async move { broker.claim(prefers_gpu).await })
            };
            let claims = async {
                tokio::select! {
                    claimed = claim(&gpu, true) => (claimed, true),
                    claimed = claim(&cpu, false) => (claimed, false),
                }
            };
            let dispatch = async {
                // Both look for jobs.
                tokio::time::sleep(Duration::from_millis(300)).await;
                assert_eq!(cpu.dispatch(&job).await, Ok(true));
            };
            let ((claimed, on_gpu), ()) = tokio::join!(claims, dispatch);
            assert_eq!(claimed.id, job.id);
            suited += usize::from(on_gpu == job.suits_gpu);
            claimed.done().await;
        }
        assert!(suited > 15, "{suited} of 20 jobs went to the worker that they suit");
        // A worker takes what does not suit it if no other one is idle.
        let claim = tokio::spawn(async move { cpu.claim(false).await });
        tokio::time::sleep(Duration::from_millis(300)).await;
        let other = Dispatch { suits_gpu: true, ..job(DEFAULT_URGENCY) };
        assert_eq!(gpu.dispatch(&other).await, Ok(true));
        let claimed = tokio::time::timeout(SOON, claim).await.expect("the job is claimed").unwrap();
        assert_eq!(claimed.id, other.id);
        claimed.done().await;
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn idle_nodes_share_jobs_that_are_dispatched_at_once() {
    on_nats(async |server| {
        let nodes = [nats(server).await, nats(server).await].map(Arc::new);
        let mut late = 0;
        for _ in 0..20 {
            let claims = nodes.clone().map(|node| tokio::spawn(async move { node.claim(false).await }));
            // Both look for jobs.
            tokio::time::sleep(Duration::from_millis(300)).await;
            let begun = Instant::now();
            for _ in 0..2 {
                assert_eq!(nodes[0].dispatch(&job(DEFAULT_URGENCY)).await, Ok(true));
            }
            for claim in claims {
                tokio::time::timeout(SOON, claim).await.expect("a job for each node").unwrap().done().await;
            }
            // A node without an announcement finds its job at an interval of a second.
            late += usize::from(begun.elapsed() > Duration::from_millis(400));
        }
        assert!(late < 5, "{late} of 20 times, a node missed the announcement");
    })
    .await;
}
