//! Conformance tests of brokers: the same for every implementation.

mod nats_lost;
mod nats_messages;
mod nats_only;
#[path = "nats_server.rs"]
pub(crate) mod server;

use std::collections::BTreeSet;
use std::future::Future;
use std::sync::Arc;
use std::time::{Duration, Instant};

use futures_util::StreamExt as _;
use tokio::runtime::Runtime;

use super::{Broker, Claim, ClaimEnd, Dispatch, DispatchError, JobEvent, JobProgress, MemoryBroker, NatsBroker};
use crate::config::BrokerConfig;
use crate::jobs::rank::DEFAULT_URGENCY;
use crate::jobs::record::JobId;
use crate::store::Digest;
use server::NatsServer;

/// Maximum time of a test on one broker.
const MAX_TEST: Duration = Duration::from_mins(2);
/// Maximum time of a step of a test.
const MAX_WAIT: Duration = Duration::from_secs(20);
/// Time in which a job that may be claimed is claimed.
const SOON: Duration = Duration::from_secs(5);
/// Lease of claims.
const LEASE: Duration = Duration::from_secs(2);
/// Maximum number of jobs.
const LIMIT: usize = 40;

impl Claim {
    /// Ends the claim of a job that has ended.
    pub(crate) async fn done(self) {
        self.end(ClaimEnd::Done).await;
    }
}

/// Broker that several nodes share.
enum Shared {
    Memory(MemoryBroker),
    Nats(NatsServer),
}

impl Shared {
    /// Connects a node.
    async fn node(&self) -> Arc<dyn Broker> {
        match self {
            Self::Memory(broker) => Arc::new(broker.clone()),
            Self::Nats(server) => Arc::new(nats(server).await),
        }
    }

    /// Runs `work` on a node that crashes afterwards, without a word to the broker. A broker within a process crashes
    /// with it, so there only the claims end.
    async fn crash<F: Future<Output = Claim>>(&self, work: impl FnOnce(Arc<dyn Broker>) -> F + Send + 'static) {
        match self {
            Self::Memory(broker) => drop(work(Arc::new(broker.clone())).await),
            Self::Nats(server) => {
                let server = server.address().to_owned();
                let crash = move || {
                    let runtime = Runtime::new().unwrap();
                    let broker = runtime.block_on(async { Arc::new(connect(&server).await) });
                    let claim = runtime.block_on(bounded(work(broker)));
                    // The claim is neither extended nor returned.
                    runtime.shutdown_background();
                    std::mem::forget(claim);
                };
                tokio::task::spawn_blocking(crash).await.unwrap();
            }
        }
    }
}

/// Connects to a server and waits until it answers.
async fn connect(address: &str) -> NatsBroker {
    let lease_ms = u64::try_from(LEASE.as_millis()).unwrap();
    let config = BrokerConfig { lease_ms, queue: LIMIT, ..BrokerConfig::default() };
    let broker = NatsBroker::connect(&config, address, "a").await.unwrap();
    until_down(&broker, MAX_WAIT, |why| why.is_none()).await;
    broker
}

/// Waits until the reason for which a broker is down is the expected one.
async fn until_down(broker: &dyn Broker, limit: Duration, mut is_expected: impl FnMut(Option<&str>) -> bool) {
    let begun = Instant::now();
    loop {
        let why = broker.down();
        if is_expected(why.as_deref()) {
            return;
        }
        assert!(begun.elapsed() < limit, "{why:?} after {limit:?}");
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}

pub(crate) async fn nats(server: &NatsServer) -> NatsBroker {
    connect(server.address()).await
}

/// Runs a test, which fails if it waits too long.
pub(crate) async fn bounded<F: Future>(test: F) -> F::Output {
    tokio::time::timeout(MAX_TEST, test).await.expect("the test ends")
}

/// Runs a test on every broker: within the process, and on every installed version of NATS.
async fn with_all<F: Future<Output = ()>>(test: impl Fn(Arc<Shared>) -> F) {
    let run = async |shared: Shared| {
        // Lives until a failure of the test is known, so that the server explains itself.
        let shared = Arc::new(shared);
        bounded(test(Arc::clone(&shared))).await;
    };
    run(Shared::Memory(MemoryBroker::new(LIMIT))).await;
    for program in server::programs() {
        println!("{}", program.display());
        run(Shared::Nats(NatsServer::start(&program))).await;
    }
}

/// Runs a test on every installed version of NATS.
pub(crate) async fn on_nats(test: impl AsyncFn(&mut NatsServer)) {
    for program in server::programs() {
        println!("{}", program.display());
        let mut server = NatsServer::start(&program);
        bounded(test(&mut server)).await;
    }
}

fn job(urgency: u8) -> Dispatch {
    Dispatch { id: JobId::random(&[0; 32], 0).unwrap(), urgency, suits_gpu: false }
}

/// Claims a job that must be available.
async fn claim(broker: &Arc<dyn Broker>) -> Claim {
    tokio::time::timeout(SOON, broker.claim(false)).await.expect("a job is available")
}

/// Checks that no job is available for `time`.
async fn none_within(broker: &Arc<dyn Broker>, time: Duration) {
    if let Ok(claim) = tokio::time::timeout(time, broker.claim(false)).await {
        panic!("claimed {claim:?}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn jobs_follow_the_level_of_their_urgency_then_the_order_of_dispatch() {
    with_all(|shared| async move {
        let broker = shared.node().await;
        let jobs = [(DEFAULT_URGENCY, 3), (7, 6), (2, 0), (4, 4), (5, 7), (0, 1), (DEFAULT_URGENCY, 5), (1, 2)];
        let mut expected = Vec::new();
        for (urgency, place) in jobs {
            let job = job(urgency);
            assert_eq!(broker.dispatch(&job).await, Ok(true));
            expected.push((place, job.id));
        }
        expected.sort();
        for (_, id) in expected {
            let claimed = claim(&broker).await;
            assert_eq!(claimed.id, id);
            claimed.done().await;
        }
        none_within(&broker, Duration::from_millis(300)).await;
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_that_is_more_urgent_precedes_earlier_ones() {
    with_all(|shared| async move {
        let broker = shared.node().await;
        for _ in 0..10 {
            assert_eq!(broker.dispatch(&job(DEFAULT_URGENCY)).await, Ok(true));
        }
        // After them, the next claim does not ask the queues in turn.
        for _ in 0..4 {
            claim(&broker).await.done().await;
        }
        let urgent = job(0);
        for job in [&job(7), &urgent] {
            assert_eq!(broker.dispatch(job).await, Ok(true));
        }
        let claimed = claim(&broker).await;
        assert_eq!(claimed.id, urgent.id);
        claimed.done().await;
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn no_job_waits_for_ever_behind_more_urgent_ones() {
    with_all(|shared| async move {
        let broker = shared.node().await;
        for _ in 0..30 {
            assert_eq!(broker.dispatch(&job(0)).await, Ok(true));
        }
        let last = Dispatch { suits_gpu: true, ..job(7) };
        assert_eq!(broker.dispatch(&last).await, Ok(true));
        let mut jobs_before = 0;
        loop {
            let claimed = claim(&broker).await;
            let is_last = claimed.id == last.id;
            claimed.done().await;
            if is_last {
                break;
            }
            jobs_before += 1;
        }
        assert!((3..8).contains(&jobs_before), "{jobs_before} jobs came first");
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn workers_first_claim_jobs_that_suit_them() {
    for (prefers_gpu, expected) in [(false, [4, 0, 2, 1, 3]), (true, [4, 1, 3, 0, 2])] {
        with_all(move |shared| async move {
            let broker = shared.node().await;
            let jobs = [(false, 3), (true, 3), (false, 3), (true, 3), (false, 0)]
                .map(|(suits_gpu, urgency)| Dispatch { suits_gpu, ..job(urgency) });
            for job in &jobs {
                assert_eq!(broker.dispatch(job).await, Ok(true));
            }
            for number in expected {
                let claimed = tokio::time::timeout(SOON, broker.claim(prefers_gpu)).await.expect("a job is available");
                assert_eq!(claimed.id, jobs[number].id, "{number}");
                claimed.done().await;
            }
        })
        .await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_is_queued_once_until_it_is_done() {
    with_all(|shared| async move {
        let (a, b) = (shared.node().await, shared.node().await);
        let job = job(DEFAULT_URGENCY);
        assert_eq!(a.dispatch(&job).await, Ok(true));
        assert_eq!((b.dispatch(&job).await, a.dispatch(&job).await), (Ok(false), Ok(false)), "it is queued");
        let claimed = claim(&b).await;
        assert_eq!(a.dispatch(&job).await, Ok(false), "it is claimed");
        none_within(&a, Duration::from_millis(300)).await;
        claimed.done().await;
        assert_eq!(a.dispatch(&job).await, Ok(true), "it is done");
        claim(&b).await.done().await;
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_full_queue_rejects_jobs() {
    with_all(|shared| async move {
        let broker = shared.node().await;
        for _ in 0..LIMIT {
            assert_eq!(broker.dispatch(&job(DEFAULT_URGENCY)).await, Ok(true));
        }
        let more = job(DEFAULT_URGENCY);
        assert_eq!(broker.dispatch(&more).await, Err(DispatchError::Full));
        let begun = Instant::now();
        while broker.queued() < LIMIT {
            assert!(begun.elapsed() < SOON, "{} jobs are counted", broker.queued());
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
        claim(&broker).await.done().await;
        assert_eq!(broker.dispatch(&more).await, Ok(true), "there is a free slot");
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_returned_job_is_claimed_again_after_its_delay() {
    with_all(|shared| async move {
        let broker = shared.node().await;
        let job = job(DEFAULT_URGENCY);
        assert_eq!(broker.dispatch(&job).await, Ok(true));
        drop(claim(&broker).await);
        let claimed = claim(&broker).await;
        assert_eq!(claimed.id, job.id);
        claimed.end(ClaimEnd::Release(Duration::from_millis(700))).await;
        none_within(&broker, Duration::from_millis(300)).await;
        let claimed = claim(&broker).await;
        assert_eq!(claimed.id, job.id);
        claimed.done().await;
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_of_a_crashed_node_is_claimed_again() {
    with_all(|shared| async move {
        let broker = shared.node().await;
        let job = job(DEFAULT_URGENCY);
        assert_eq!(broker.dispatch(&job).await, Ok(true));
        let begun = Instant::now();
        shared.crash(|broker| async move { broker.claim(false).await }).await;
        let claimed = tokio::time::timeout(LEASE + SOON, broker.claim(false)).await.expect("the lease expires");
        println!("claimed again after {:?}", begun.elapsed());
        assert_eq!(claimed.id, job.id);
        // A claim of a running node lasts longer than a lease.
        none_within(&broker, LEASE * 2).await;
        claimed.done().await;
        none_within(&broker, LEASE + SOON / 5).await;
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn nodes_share_the_jobs() {
    with_all(|shared| async move {
        let nodes = [shared.node().await, shared.node().await, shared.node().await];
        let work = |broker: Arc<dyn Broker>| async move {
            let mut claimed = Vec::new();
            while let Ok(claim) = tokio::time::timeout(Duration::from_secs(2), broker.claim(false)).await {
                claimed.push(claim.id.clone());
                tokio::time::sleep(Duration::from_millis(10)).await;
                claim.done().await;
            }
            claimed
        };
        // The nodes wait before there are jobs.
        let workers = nodes.clone().map(|node| tokio::spawn(work(node)));
        tokio::time::sleep(Duration::from_millis(200)).await;
        let mut expected = BTreeSet::new();
        for _ in 0..30 {
            let job = job(DEFAULT_URGENCY);
            assert_eq!(nodes[0].dispatch(&job).await, Ok(true));
            expected.insert(job.id);
        }
        let mut all = Vec::new();
        for worker in workers {
            let claimed = worker.await.unwrap();
            assert!(claimed.len() >= 3, "a node claimed only {}", claimed.len());
            all.extend(claimed);
        }
        assert_eq!(all.len(), expected.len(), "no job is claimed twice");
        assert_eq!(all.into_iter().collect::<BTreeSet<_>>(), expected);
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn followers_get_the_events_of_their_job() {
    with_all(|shared| async move {
        let (a, b) = (shared.node().await, shared.node().await);
        let (job, other) = (job(3), job(3));
        let mut events = b.events(&job.id).await;
        // A subscription takes effect after a round trip.
        tokio::time::sleep(Duration::from_millis(100)).await;
        let progress = JobProgress { attempts: 2, started_ms: Some(7), stage: "field".into(), fraction: 0.25 };
        let running = JobEvent::Running(progress);
        a.publish(&other.id, JobEvent::Ended);
        a.publish(&job.id, running.clone());
        let mut next = async || tokio::time::timeout(SOON, events.next()).await.expect("an event");
        assert_eq!(next().await, Some(running));
        a.publish(&job.id, JobEvent::Ended);
        assert_eq!(next().await, Some(JobEvent::Ended));
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn work_is_locked_by_one_run_at_a_time() {
    with_all(|shared| async move {
        let (a, b) = (shared.node().await, shared.node().await);
        let [work, other] = [b"work", b"else"].map(|name| Digest::of(name));
        let lock = a.lock(&work).await.expect("the work is free");
        // The lock of a running node lasts longer than a lease.
        tokio::time::sleep(LEASE * 3 / 2).await;
        assert!(a.lock(&work).await.is_none() && b.lock(&work).await.is_none());
        assert!(b.lock(&other).await.is_some());
        drop(lock);
        let begun = Instant::now();
        while b.lock(&work).await.is_none() {
            assert!(begun.elapsed() < LEASE / 2, "the lock is not released");
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    })
    .await;
}
