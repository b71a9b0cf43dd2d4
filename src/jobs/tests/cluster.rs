//! Job stores of several nodes over one store and one broker, within the process and on NATS.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use serde_json::Value;
use tempfile::TempDir;

use super::{MAX_WAIT, SAMPLE, ended, is, stops, task, until};
use crate::config::{JobsConfig, StoreConfig};
use crate::jobs::broker::tests::{bounded, nats, on_nats};
use crate::jobs::{
    Broker, Budget, EndError, JobId, JobSpec, JobStore, MemoryBroker, NatsBroker, Pool, Settings, Status,
};
use crate::store::{Folder, Name, Namespace, Store};
use crate::surface::ReferenceBackend;

/// Node of a cluster.
struct Node {
    jobs: JobStore,
    store: Store,
}

/// Starts a node over the shared folder `shared`. It does not claim jobs yet.
async fn node(shared: &Path, broker: Arc<dyn Broker>) -> Node {
    let url = Some(format!("file://{}", shared.display()));
    let store = Store::open_for(&StoreConfig { url, ..StoreConfig::default() }, shared, true).await.unwrap();
    let budget = Budget::new(1 << 30);
    let settings = Settings::for_test(1, budget);
    let pool = Arc::new(Pool::start(settings, Arc::new(ReferenceBackend), "a test".to_owned()).unwrap());
    let describe = |error: &EndError| Value::String(format!("{error:?}"));
    let secret = store.secret().await.unwrap();
    let jobs = JobStore::new(store.clone(), pool, broker, JobsConfig::default(), 1 << 30, secret, describe);
    Node { jobs, store }
}

impl Node {
    /// Accepts a job with a grid spacing.
    async fn accept(&self, resolution: &str, key: Option<&str>) -> JobId {
        let spec = JobSpec {
            task: task("a", resolution),
            file: Bytes::from_static(SAMPLE),
            map: None,
            parameters: vec![("resolution".to_owned(), resolution.to_owned())],
            idempotency_key: key.map(str::to_owned),
            batch: None,
        };
        self.jobs.accept(spec, None).await.unwrap().record.id
    }

    async fn watch(&self, id: &JobId) -> tokio::sync::watch::Receiver<crate::jobs::JobView> {
        self.jobs.watch(id, Namespace::default()).await.unwrap().unwrap()
    }
}

/// Runs a test with two nodes: on a broker within the process, and on every installed version of NATS.
async fn with_all<F: Future<Output = ()>>(test: impl Fn(Node, Node) -> F) {
    let run = async |a: Arc<dyn Broker>, b: Arc<dyn Broker>| {
        let shared: TempDir = tempfile::tempdir().unwrap();
        Box::pin(test(node(shared.path(), a).await, node(shared.path(), b).await)).await;
    };
    let broker = MemoryBroker::new(1000);
    bounded(run(Arc::new(broker.clone()), Arc::new(broker))).await;
    on_nats(async |server| run(Arc::new(nats(server).await), Arc::new(nats(server).await)).await).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_runs_on_another_node_and_its_state_is_seen_on_both() {
    with_all(|a, b| async move {
        let id = a.accept("2", None).await;
        let mut seen = a.watch(&id).await;
        is(&seen, |record| record.status, &Status::Accepted);
        b.jobs.start_claiming();
        ended(&mut seen).await;
        is(&seen, |record| (record.status, record.attempts), &(Status::Successful, 1));
        let on_b = b.jobs.view(&id, Namespace::default()).await.unwrap().unwrap();
        assert_eq!(seen.borrow().record, on_b.record);
        assert_eq!(
            seen.borrow().version,
            on_b.version,
            "a client that reconnects to the other node gets no event twice"
        );
        assert_eq!(a.store.list(Folder::Results).await.unwrap().len(), 2);
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_running_job_is_cancelled_from_another_node() {
    with_all(|a, b| async move {
        b.jobs.start_claiming();
        // Takes seconds.
        let id = a.accept("0.2", None).await;
        let mut seen = a.watch(&id).await;
        let running = seen.wait_for(|view| view.record.status == Status::Running && view.stage.is_some());
        tokio::time::timeout(MAX_WAIT, running).await.expect("the job runs").unwrap();
        let dismissed = a.jobs.dismiss(&id, Namespace::default()).await.unwrap().unwrap();
        assert_eq!(dismissed.record.status, Status::Dismissed);
        tokio::time::timeout(Duration::from_secs(20), b.jobs.all_recorded()).await.expect("the worker stops");
        let on_b = b.jobs.view(&id, Namespace::default()).await.unwrap().unwrap();
        assert_eq!(on_b.record, dismissed.record);
        // The worker is free again.
        let next = a.accept("2", None).await;
        ended(&mut a.watch(&next).await).await;
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stopped_node_returns_its_job_to_another_one() {
    with_all(|a, b| async move {
        b.jobs.start_claiming();
        // Takes seconds.
        let id = a.accept("0.2", None).await;
        let read = async || a.jobs.0.read(&id).await.unwrap().unwrap();
        until("the attempt", || async { read().await.attempts == 1 }).await;
        let stopped = stops::stop(&b.jobs, Duration::ZERO).await;
        assert_eq!((stopped.returned, stopped.finished, stopped.unrecorded), (1, 0, 0));
        let record = read().await;
        assert_eq!((record.status, record.attempts), (Status::Accepted, 0), "{record:?}");
        a.jobs.start_claiming();
        until("the attempt of the other node", || async { read().await.attempts == 1 }).await;
        a.jobs.dismiss(&id, Namespace::default()).await.unwrap();
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn one_idempotency_key_makes_one_job_on_all_nodes() {
    with_all(|a, b| async move {
        let (one, other) = tokio::join!(a.accept("2", Some("key")), b.accept("2", Some("key")));
        assert_eq!(one, other);
        b.jobs.start_claiming();
        ended(&mut a.watch(&one).await).await;
        assert_eq!(b.accept("2.0", Some("key")).await, one);
        assert_eq!(a.store.list(Folder::Jobs).await.unwrap().len(), 1);
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn jobs_that_the_broker_has_lost_are_dispatched_again() {
    on_nats(async |server| {
        let shared = tempfile::tempdir().unwrap();
        let connect = async || Arc::new(nats(server).await);
        let (broker, other) = (connect().await, connect().await);
        let (a, b) = (node(shared.path(), broker.clone() as _).await, node(shared.path(), other.clone() as _).await);
        let mut ids = Vec::new();
        for resolution in ["2", "2.1", "2.2"] {
            ids.push(a.accept(resolution, None).await);
        }
        assert_eq!((a.jobs.reconcile().await.unwrap(), b.jobs.reconcile().await.unwrap()), (0, 0), "none is lost");
        server.stop(false);
        server.restart();
        let is_back = |broker: &NatsBroker| broker.down().is_none() && broker.queued() == 0;
        until("the broker", || async { is_back(&broker) && is_back(&other) }).await;
        assert_eq!((b.jobs.reconcile().await.unwrap(), a.jobs.reconcile().await.unwrap()), (3, 0));
        b.jobs.start_claiming();
        for id in &ids {
            let mut seen = a.watch(id).await;
            ended(&mut seen).await;
            is(&seen, |record| record.status, &Status::Successful);
        }
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_that_runs_twice_has_one_end() {
    for _ in 0..5 {
        let shared = tempfile::tempdir().unwrap();
        // Neither broker knows of the other, as after the expiry of a claim whose worker still runs.
        let brokers = [(); 2].map(|()| Arc::new(MemoryBroker::new(10)));
        let a = node(shared.path(), brokers[0].clone() as _).await;
        let b = node(shared.path(), brokers[1].clone() as _).await;
        let id = a.accept("2", None).await;
        assert_eq!(b.jobs.reconcile().await.unwrap(), 1);
        a.jobs.start_claiming();
        b.jobs.start_claiming();
        let (mut on_a, mut on_b) = (a.watch(&id).await, b.watch(&id).await);
        ended(&mut on_a).await;
        ended(&mut on_b).await;
        assert_eq!(on_a.borrow().record, on_b.borrow().record);
        until("both workers", || async { brokers.iter().all(|broker| broker.is_empty()) }).await;
        let records = a.store.list(Folder::Jobs).await.unwrap();
        assert_eq!(records.len(), 1, "{records:?}");
        assert_eq!(a.store.list(Folder::Results).await.unwrap().len(), 2);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_later_attempt_of_another_node_supersedes_an_earlier_one() {
    let shared = tempfile::tempdir().unwrap();
    let brokers = [(); 2].map(|()| Arc::new(MemoryBroker::new(10)));
    let a = node(shared.path(), brokers[0].clone() as _).await;
    let b = node(shared.path(), brokers[1].clone() as _).await;
    let id = a.accept("2", None).await;
    let mut record = b.jobs.0.read(&id).await.unwrap().unwrap();
    let job = a.jobs.insert_open(record.clone());
    assert!(!a.jobs.is_superseded(&job).await, "control: there is no other attempt");
    (record.attempts, record.status) = (2, Status::Running);
    let name = Name::job(id.as_str()).unwrap();
    b.store.put(&name, record.to_bytes()).await.unwrap();
    assert!(a.jobs.is_superseded(&job).await);
    job.adopt(record);
    assert!(!a.jobs.is_superseded(&job).await, "control: the same attempt");
    // A node of a later release.
    let owned = a.jobs.0.lock().own(&job).expect("no other run");
    let is_followed = || a.jobs.0.lock().jobs.contains_key(&id);
    assert!(!a.jobs.refresh(&job).await && is_followed(), "control: this release can read the record");
    b.store.put(&name, Bytes::from_static(br#"{"version":2}"#)).await.unwrap();
    assert!(a.jobs.is_superseded(&job).await);
    assert!(a.jobs.refresh(&job).await && !is_followed(), "the job is left to that node");
    tokio::time::timeout(MAX_WAIT, owned.stop.notified()).await.expect("the own run stops");
}
