//! Durable jobs on a store that fails on command.

mod cluster;
mod joined;
mod records;
mod stops;

use std::fmt::Debug;
use std::future::Future;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant, SystemTime};

use bytes::Bytes;
use serde_json::Value;
use tempfile::TempDir;
use tokio::sync::watch;

use super::durable_job::DurableJob;
use super::rank::{Client, DEFAULT_URGENCY, Rank};
use super::record::{JobRecord, Requester, now_ms};
use super::{
    AcceptError, Budget, EndError, Input, JobId, JobSpec, JobStore, JobView, MemoryBroker, OnStart, Pool, Settings,
    Status, Task,
};
use crate::config::JobsConfig;
use crate::pipeline::params;
use crate::store::faulty::{Faults, faulty_in};
use crate::store::{Digest, Folder, Name, Namespace, Store, StoreError};
use crate::surface::ReferenceBackend;
use crate::telemetry::SpanParent;

const SAMPLE: &[u8] = include_bytes!("../../samples/4pti.pdb");
/// Maximum time of a step of a test.
const MAX_WAIT: Duration = Duration::from_mins(2);

/// Job store on a disk that fails on command.
struct Fixture {
    faults: Arc<Faults>,
    store: Store,
    jobs: JobStore,
    broker: MemoryBroker,
    dir: TempDir,
}

impl Fixture {
    async fn new(attempts: u32, retry_for: Duration) -> Self {
        let save_retry_ms = u64::try_from(retry_for.as_millis()).unwrap();
        let config = JobsConfig { attempts, save_retry_ms, ..JobsConfig::default() };
        Self::open(tempfile::tempdir().unwrap(), config).await
    }

    async fn open(dir: TempDir, config: JobsConfig) -> Self {
        Self::open_within(dir, config, Budget::new(1 << 30)).await
    }

    async fn open_within(dir: TempDir, config: JobsConfig, budget: Budget) -> Self {
        let (faults, store) = faulty_in(dir.path(), 1 << 30).await;
        let settings = Settings::for_test(1, budget);
        let pool = Arc::new(Pool::start(settings, Arc::new(ReferenceBackend), "a test".to_owned()).unwrap());
        let describe = |error: &EndError| Value::String(format!("{error:?}"));
        let broker = MemoryBroker::new(1000);
        let jobs = JobStore::new(store.clone(), pool, Arc::new(broker.clone()), config, 1 << 30, [0; 32], describe);
        jobs.start_claiming();
        Self { faults, store, jobs, broker, dir }
    }

    /// Waits until every job has ended.
    async fn all_ended(&self) {
        until("the end of all jobs", || async { self.broker.is_empty() }).await;
        self.jobs.all_recorded().await;
    }

    async fn accept(&self) -> Result<JobView, AcceptError> {
        self.accept_from("a").await
    }

    async fn accept_from(&self, client: &str) -> Result<JobView, AcceptError> {
        let (task, parameters) = (task(client, "2"), vec![("resolution".to_owned(), "2".to_owned())]);
        let file = Bytes::from_static(SAMPLE);
        let spec = JobSpec { task, file, map: None, parameters, idempotency_key: None, batch: None };
        self.jobs.accept(spec, None).await
    }

    /// Stores the record of a job that an earlier process accepted.
    async fn store_record(&self) -> JobId {
        self.store_record_with(Bytes::from_static(SAMPLE)).await
    }

    /// Stores the record of a job with its own input.
    async fn store_record_with(&self, input: Bytes) -> JobId {
        let digest = Digest::of(&input);
        let record = JobRecord {
            id: new_id(),
            namespace: Namespace::default(),
            input: digest,
            map: None,
            parameters: vec![("resolution".to_owned(), "2".to_owned())],
            format: "stl".to_owned(),
            client: 1,
            batch: None,
            urgency: DEFAULT_URGENCY,
            suits_gpu: false,
            status: Status::Accepted,
            requester: Requester::default(),
            attempts: 0,
            memory_waits: 0,
            created_ms: now_ms(),
            started_ms: None,
            finished_ms: None,
            result: None,
            problem: None,
        };
        self.store.put(&Name::job(record.id.as_str()).unwrap(), record.to_bytes()).await.unwrap();
        self.store.put_new(&Name::input(&digest), input).await.unwrap();
        record.id
    }

    /// Returns the stored record of a job.
    async fn on_record(&self, id: &JobId) -> JobRecord {
        self.jobs.0.read(id).await.unwrap().unwrap()
    }

    async fn watch(&self, id: &JobId) -> watch::Receiver<JobView> {
        self.jobs.watch(id, Namespace::default()).await.unwrap().unwrap()
    }

    /// Waits until `times` operations of the store have timed out.
    async fn until_timed_out(&self, times: usize) {
        until("the timeouts of the store", || async { self.faults.timed_out.load(Ordering::SeqCst) >= times }).await;
    }
}

impl Task {
    /// Returns a task for tests.
    pub(super) fn for_test(file: Bytes, parameters: &[(&str, &str)], rank: Rank) -> Self {
        Self {
            digest: Digest::of(&file),
            input: Input::File(file),
            namespace: Namespace::default(),
            request: params::parse(parameters.iter().copied()).unwrap(),
            rank,
            reservation: None,
            parent: SpanParent::default(),
            id: None,
        }
    }
}

/// Returns a task of a client.
fn task(client: &str, resolution: &str) -> Task {
    let rank = Rank { client: Client::named(client), batch: true, ..Rank::default() };
    Task::for_test(Bytes::from_static(SAMPLE), &[("resolution", resolution), ("format", "stl")], rank)
}

fn new_id() -> JobId {
    JobId::random(&[0; 32], Client::named("a").0).unwrap()
}

async fn until<F: Future<Output = bool>>(what: &str, mut holds: impl FnMut() -> F) {
    let begun = Instant::now();
    while !holds().await {
        assert!(begun.elapsed() < MAX_WAIT, "{what} did not come");
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}

#[track_caller]
fn is<T: PartialEq + Debug>(seen: &watch::Receiver<JobView>, of: impl Fn(&JobRecord) -> T, expected: &T) {
    let record = seen.borrow().record.clone();
    assert_eq!(&of(&record), expected, "{record:?}");
}

async fn ended(seen: &mut watch::Receiver<JobView>) {
    let end = seen.wait_for(|view| view.record.status.is_final());
    tokio::time::timeout(MAX_WAIT, end).await.expect("the job ends").unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_failing_store_ends_no_job() {
    let fixture = Fixture::new(1, MAX_WAIT).await;
    let id = fixture.store_record().await;
    fixture.faults.silence(Some(Folder::Inputs));
    assert_eq!(fixture.jobs.reconcile().await.unwrap(), 1);
    let mut seen = fixture.watch(&id).await;
    // More failures than attempts: a failed read of the input is not an attempt.
    fixture.until_timed_out(3).await;
    is(&seen, |record| (record.status, record.attempts), &(Status::Accepted, 0));
    fixture.faults.silence(None);
    ended(&mut seen).await;
    is(&seen, |record| (record.status, record.attempts), &(Status::Successful, 1));
    assert_eq!(fixture.store.usage(Folder::Results).objects, 2);
    // A store that answers that the input does not exist is different.
    let other = Bytes::from_static(b"another input");
    let id = fixture.store_record_with(other.clone()).await;
    fixture.store.delete(&Name::input(&Digest::of(&other))).await.unwrap();
    assert_eq!(fixture.jobs.reconcile().await.unwrap(), 1);
    let mut seen = fixture.watch(&id).await;
    ended(&mut seen).await;
    is(&seen, |record| record.status, &Status::Failed);
    assert!(seen.borrow().record.problem.as_ref().unwrap().as_str().unwrap().starts_with("Lost"));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_result_is_held_until_it_is_stored() {
    let fixture = Fixture::new(1, MAX_WAIT).await;
    fixture.faults.seal(Folder::Results);
    let id = fixture.accept().await.unwrap().record.id;
    let mut seen = fixture.watch(&id).await;
    fixture.until_timed_out(3).await;
    is(&seen, |record| record.status, &Status::Running);
    fixture.faults.silence(None);
    ended(&mut seen).await;
    is(&seen, |record| (record.status, record.attempts), &(Status::Successful, 1));
    until("the record", || async { fixture.on_record(&id).await.status == Status::Successful }).await;
    assert_eq!(fixture.store.usage(Folder::Results).objects, 2);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_result_that_is_never_stored_is_computed_for_every_attempt() {
    let fixture = Fixture::new(3, Duration::ZERO).await;
    fixture.faults.seal(Folder::Results);
    let id = fixture.accept().await.unwrap().record.id;
    let mut seen = fixture.watch(&id).await;
    ended(&mut seen).await;
    is(&seen, |record| (record.status, record.attempts), &(Status::Failed, 3));
    let problem = seen.borrow().record.problem.clone().unwrap();
    assert!(problem.as_str().unwrap().starts_with("Save"), "the cause, not the number of attempts: {problem}");
    assert_eq!(fixture.faults.timed_out.load(Ordering::SeqCst), 3, "once for each mesh");
    until("the record", || async { fixture.on_record(&id).await.status == Status::Failed }).await;
    // A result that is too large is not retried.
    let mut fixture = Fixture::new(3, MAX_WAIT).await;
    fixture.jobs = JobStore::new(
        fixture.store.clone(),
        Arc::clone(&fixture.jobs.0.pool),
        Arc::new(MemoryBroker::new(8)),
        fixture.jobs.0.config.clone(),
        100,
        [0; 32],
        fixture.jobs.0.describe,
    );
    fixture.jobs.start_claiming();
    let id = fixture.accept().await.unwrap().record.id;
    let mut seen = fixture.watch(&id).await;
    ended(&mut seen).await;
    is(&seen, |record| (record.status, record.attempts), &(Status::Failed, 1));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_end_of_a_job_is_recorded_once_the_store_works_again() {
    let fixture = Fixture::new(1, MAX_WAIT).await;
    fixture.faults.seal(Folder::Results);
    let id = fixture.accept().await.unwrap().record.id;
    let mut seen = fixture.watch(&id).await;
    fixture.until_timed_out(1).await;
    fixture.faults.silence(Some(Folder::Jobs));
    fixture.until_timed_out(2).await;
    // The end is not visible before it is on record.
    is(&seen, |record| record.status, &Status::Running);
    // Until then nothing removes the result.
    let expire = async || fixture.store.sweep(SystemTime::now() + Duration::from_hours(10_000)).await;
    expire().await;
    assert_eq!(fixture.store.usage(Folder::Results).objects, 2);
    fixture.faults.silence(None);
    ended(&mut seen).await;
    is(&seen, |record| record.status, &Status::Successful);
    assert_eq!(fixture.on_record(&id).await, seen.borrow().record);
    fixture.all_ended().await;
    expire().await;
    assert_eq!(fixture.store.usage(Folder::Results).objects, 0, "control: an unused result expires");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn no_job_is_accepted_without_a_record() {
    let fixture = Fixture::new(1, MAX_WAIT).await;
    for folder in Folder::ALL {
        fixture.faults.silence(Some(folder));
        let refused = fixture.accept().await;
        assert!(matches!(refused, Err(AcceptError::Store(StoreError::Failed { .. }))), "{refused:?}");
    }
    fixture.faults.silence(None);
    assert_eq!((fixture.store.usage(Folder::Jobs).objects, fixture.jobs.reconcile().await.unwrap()), (0, 0));
    fixture.accept().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_dismissed_job_does_not_start() {
    let fixture = Fixture::new(1, MAX_WAIT).await;
    let id = fixture.store_record().await;
    let job = Arc::new(DurableJob::new(fixture.on_record(&id).await));
    let on_start = fixture.jobs.on_start(&job);
    assert!(job.end(Status::Dismissed, |_| {}));
    fixture.jobs.0.write_job(&job).await.unwrap();
    // The worker has already taken the job.
    tokio::task::spawn_blocking(move || OnStart::run_all(vec![on_start])).await.unwrap();
    for record in [job.record(), fixture.on_record(&id).await] {
        assert_eq!((record.status, record.attempts), (Status::Dismissed, 0), "{record:?}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_last_record_has_the_latest_state() {
    let fixture = Fixture::new(1, MAX_WAIT).await;
    let id = fixture.store_record().await;
    let job = Arc::new(DurableJob::new(fixture.on_record(&id).await));
    assert!(job.begin(|| true));
    // Another task writes the record when the worker wants to record the start.
    let turn = job.writing.lock().await;
    let (jobs, begun) = (fixture.jobs.clone(), Arc::clone(&job));
    let mut writes = tokio::spawn(async move { jobs.0.write_job(&begun).await.unwrap() });
    let waits = tokio::time::timeout(Duration::from_millis(200), &mut writes).await.is_err();
    assert!(waits, "two concurrent writers");
    assert!(job.end(Status::Dismissed, |_| {}));
    drop(turn);
    writes.await.unwrap();
    assert_eq!(fixture.on_record(&id).await.status, Status::Dismissed);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn records_that_cannot_be_read_go_into_quarantine() {
    let fixture = Fixture::new(1, MAX_WAIT).await;
    let good = fixture.store_record().await;
    let whole = fixture.on_record(&good).await.to_bytes();
    let mut flipped = whole.to_vec();
    flipped[whole.len() / 3] ^= 1;
    let bad = [Bytes::new(), whole.slice(..whole.len() / 2), Bytes::from(flipped)];
    let names: Vec<_> = bad.iter().map(|_| Name::job(new_id().as_str()).unwrap()).collect();
    for (name, bytes) in names.iter().zip(&bad) {
        fixture.store.put(name, bytes.clone()).await.unwrap();
    }
    // One is read by a request, the others by the recovery.
    let id = |name: &Name| name.to_string()[5..37].parse::<JobId>().unwrap();
    let refused = fixture.jobs.view(&id(&names[0]), Namespace::default()).await;
    assert!(matches!(refused, Err(StoreError::Quarantined { .. })), "{refused:?}");
    assert_eq!(fixture.store.quarantined().await.unwrap(), 1);
    assert_eq!(fixture.jobs.reconcile().await.unwrap(), 1);
    ended(&mut fixture.watch(&good).await).await;
    assert_eq!(fixture.store.quarantined().await.unwrap(), 3);
    let folder = fixture.dir.path().join("store/quarantine");
    for (name, bytes) in names.iter().zip(&bad) {
        let refused = fixture.jobs.dismiss(&id(name), Namespace::default()).await;
        assert!(matches!(refused, Err(StoreError::Quarantined { .. })), "{refused:?}");
        let file = folder.join(format!("{}.json", id(name).as_str()));
        assert_eq!(&std::fs::read(&file).unwrap(), bytes, "kept as it was");
        std::fs::remove_file(file).unwrap();
    }
    assert_eq!(fixture.store.quarantined().await.unwrap(), 0);
    assert_eq!(fixture.jobs.view(&id(&names[0]), Namespace::default()).await.unwrap(), None);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn recovered_inputs_are_pinned() {
    let fixture = Fixture::new(1, MAX_WAIT).await;
    let id = fixture.store_record().await;
    // The job cannot start, so only the recovery protects its input.
    fixture.faults.silence(Some(Folder::Inputs));
    assert_eq!(fixture.jobs.reconcile().await.unwrap(), 1);
    fixture.store.sweep(SystemTime::now() + Duration::from_hours(10_000)).await;
    fixture.faults.silence(None);
    let mut seen = fixture.watch(&id).await;
    ended(&mut seen).await;
    is(&seen, |record| record.status, &Status::Successful);
}

#[tokio::test]
async fn versions_of_states_continue_after_a_restart() {
    let fixture = Fixture::new(1, MAX_WAIT).await;
    let id = fixture.store_record().await;
    let job = DurableJob::new(fixture.on_record(&id).await);
    let mut versions = vec![job.view().version];
    for _ in 0..5 {
        assert!(job.begin(|| true));
        versions.push(job.view().version);
    }
    tokio::time::sleep(Duration::from_millis(50)).await;
    let next = DurableJob::new(job.record());
    versions.push(next.view().version);
    assert!(next.end(Status::Failed, |_| {}));
    next.publish_end(next.record());
    versions.push(next.view().version);
    assert!(versions.is_sorted_by(|a, b| a < b), "{versions:?}");
    assert_eq!(DurableJob::new(next.record()).view().version, *versions.last().unwrap(), "no event follows the last");
}

#[tokio::test(flavor = "multi_thread")]
async fn tiles_do_not_change_the_estimated_duration_of_jobs() {
    let fixture = Fixture::new(1, Duration::ZERO).await;
    let pool = &fixture.jobs.0.pool;
    let run = async |pairs: &[(&str, &str)]| {
        let request = params::parse(pairs.iter().copied()).unwrap();
        let mut ticket = pool.submit(Task { request, ..task("a", "2") }, MAX_WAIT, None).unwrap();
        assert!(ticket.wait().await.is_ok());
        pool.seconds(1.0)
    };
    let before = pool.seconds(1.0);
    assert!((run(&[("resolution", "2"), ("tile", "0/0/0/0")]).await - before).abs() < f64::EPSILON);
    assert!((run(&[("resolution", "2")]).await - before).abs() > f64::EPSILON, "the control");
}
