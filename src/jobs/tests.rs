//! Promised jobs on a store that does not do its part.

use std::fmt::Debug;
use std::future::Future;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use bytes::Bytes;
use serde_json::Value;
use tempfile::TempDir;
use tokio::sync::watch;

use super::promise::Promise;
use super::rank::{Client, Rank, USUAL_URGENCY};
use super::{
    Budget, EndError, JobId, Ledger, LedgerSettings, Order, Pool, PromiseError, Record, Requester, Settings, Status,
    Task, View, now_ms,
};
use crate::formats::Format;
use crate::picture::Drawer;
use crate::pipeline::{JobLimits, params};
use crate::store::faulty::{Faults, faulty};
use crate::store::{Digest, Folder, Name, Store, StoreError};
use crate::surface::ReferenceBackend;
use crate::telemetry::{SpanParent, Tracer};

const SAMPLE: &[u8] = include_bytes!("../../samples/4pti.pdb");
const PATIENT: Duration = Duration::from_mins(2);

/// A ledger on a disk that fails on command.
struct House {
    faults: Arc<Faults>,
    store: Store,
    ledger: Ledger,
    _dir: TempDir,
}

impl House {
    async fn new(attempts: u32, patience: Duration) -> Self {
        let (dir, faults, store) = faulty(1 << 30).await;
        let settings = Settings {
            workers: 1,
            queue: 8,
            patience: Duration::from_secs(10),
            limits: JobLimits::default(),
            budget: Budget::new(1 << 30),
            drawer: Drawer::cpu("a test says so"),
            meter: None,
            tracer: Tracer::default(),
        };
        let pool = Arc::new(Pool::start(settings, Arc::new(ReferenceBackend), "a test says so".to_owned()).unwrap());
        let settings = LedgerSettings { allowed: PATIENT, attempts, output_bytes: 1 << 30, patience };
        let describe = |error: &EndError| Value::String(format!("{error:?}"));
        Self { faults, ledger: Ledger::new(store.clone(), pool, settings, [0; 32], describe), store, _dir: dir }
    }

    async fn promise(&self) -> Result<View, PromiseError> {
        let pairs = [("resolution", "2")].map(|(name, value)| (name.to_owned(), value.to_owned()));
        let request = params::parse(pairs.iter().map(|(name, value)| (name, value))).unwrap();
        let rank = Rank { client: Client::named("a"), batch: true, urgency: USUAL_URGENCY };
        let (input, digest) = (Bytes::from_static(SAMPLE), Digest::of(SAMPLE));
        let task = Task {
            input,
            digest,
            strict: false,
            job: request.job,
            rank,
            lease: None,
            parent: SpanParent::default(),
            id: None,
        };
        let order = Order { task, parameters: pairs.to_vec(), format: Format::Stl, idempotency: None };
        self.ledger.promise(order, None).await
    }

    /// A job that an earlier process promised.
    async fn inherit(&self) -> JobId {
        let record = Record {
            id: JobId::random().unwrap(),
            input: Digest::of(SAMPLE).to_string(),
            parameters: vec![("resolution".to_owned(), "2".to_owned())],
            format: "stl".to_owned(),
            client: 1,
            urgency: USUAL_URGENCY,
            status: Status::Accepted,
            requester: Requester::default(),
            attempts: 0,
            created_ms: now_ms(),
            started_ms: None,
            finished_ms: None,
            result: None,
            problem: None,
        };
        self.ledger.0.keep(&record).await.unwrap();
        self.store.put(&Name::input(&Digest::of(SAMPLE)), Bytes::from_static(SAMPLE)).await.unwrap();
        record.id
    }

    /// The job as the store has it.
    async fn on_record(&self, id: &JobId) -> Record {
        let stored = self.store.get(&Name::job(id.as_str()).unwrap()).await.unwrap().unwrap();
        serde_json::from_slice(&stored.bytes).unwrap()
    }

    async fn watch(&self, id: &JobId) -> watch::Receiver<View> {
        self.ledger.watch(id).await.unwrap().unwrap()
    }

    /// Waits until the store has not answered so often.
    async fn unanswered(&self, times: usize) {
        until("questions", || async { self.faults.unanswered.load(Ordering::SeqCst) >= times }).await;
    }
}

async fn until<F: Future<Output = bool>>(what: &str, mut holds: impl FnMut() -> F) {
    let begun = Instant::now();
    while !holds().await {
        assert!(begun.elapsed() < PATIENT, "{what} did not come");
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}

#[track_caller]
fn is<T: PartialEq + Debug>(seen: &watch::Receiver<View>, of: impl Fn(&Record) -> T, expected: &T) {
    let record = seen.borrow().record.clone();
    assert_eq!(&of(&record), expected, "{record:?}");
}

async fn ended(seen: &mut watch::Receiver<View>) {
    let end = seen.wait_for(|view| view.record.status.is_final());
    tokio::time::timeout(PATIENT, end).await.expect("the job ends").unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_store_that_is_silent_gives_no_job_up() {
    let house = House::new(1, PATIENT).await;
    let id = house.inherit().await;
    house.faults.silence(Some(Folder::Inputs));
    assert_eq!(house.ledger.recover().await.unwrap(), 1);
    let mut seen = house.watch(&id).await;
    // More than there are attempts: being asked for the input is none.
    house.unanswered(3).await;
    is(&seen, |record| (record.status, record.attempts), &(Status::Accepted, 0));
    house.faults.silence(None);
    ended(&mut seen).await;
    is(&seen, |record| (record.status, record.attempts), &(Status::Successful, 1));
    assert_eq!(house.store.usage(Folder::Results).objects, 2);
    // A store that says that there is no input is another matter.
    let id = house.inherit().await;
    house.store.delete(&Name::input(&Digest::of(SAMPLE))).await.unwrap();
    assert_eq!(house.ledger.recover().await.unwrap(), 1);
    let mut seen = house.watch(&id).await;
    ended(&mut seen).await;
    is(&seen, |record| record.status, &Status::Failed);
    assert!(seen.borrow().record.problem.as_ref().unwrap().as_str().unwrap().starts_with("Lost"));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_result_is_held_until_the_store_takes_it() {
    let house = House::new(1, PATIENT).await;
    house.faults.seal(Folder::Results);
    let id = house.promise().await.unwrap().record.id;
    let mut seen = house.watch(&id).await;
    house.unanswered(3).await;
    is(&seen, |record| record.status, &Status::Running);
    house.faults.silence(None);
    ended(&mut seen).await;
    is(&seen, |record| (record.status, record.attempts), &(Status::Successful, 1));
    until("the record", || async { house.on_record(&id).await.status == Status::Successful }).await;
    assert_eq!(house.store.usage(Folder::Results).objects, 2);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_result_that_the_store_never_takes_is_made_as_often_as_may_be() {
    let house = House::new(3, Duration::ZERO).await;
    house.faults.seal(Folder::Results);
    let id = house.promise().await.unwrap().record.id;
    let mut seen = house.watch(&id).await;
    ended(&mut seen).await;
    is(&seen, |record| (record.status, record.attempts), &(Status::Failed, 3));
    let problem = seen.borrow().record.problem.clone().unwrap();
    assert!(problem.as_str().unwrap().starts_with("Save"), "why it failed, not how often: {problem}");
    assert_eq!(house.faults.unanswered.load(Ordering::SeqCst), 3, "once for each mesh");
    until("the record", || async { house.on_record(&id).await.status == Status::Failed }).await;
    // What is too large will not fit later either, and is made once.
    let mut house = House::new(3, PATIENT).await;
    house.ledger = Ledger::new(
        house.store.clone(),
        Arc::clone(&house.ledger.0.pool),
        LedgerSettings { output_bytes: 100, ..house.ledger.0.settings },
        [0; 32],
        house.ledger.0.describe,
    );
    let id = house.promise().await.unwrap().record.id;
    let mut seen = house.watch(&id).await;
    ended(&mut seen).await;
    is(&seen, |record| (record.status, record.attempts), &(Status::Failed, 1));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_ending_is_written_down_when_the_store_answers_again() {
    let house = House::new(1, PATIENT).await;
    house.faults.seal(Folder::Results);
    let id = house.promise().await.unwrap().record.id;
    let mut seen = house.watch(&id).await;
    house.unanswered(1).await;
    house.faults.silence(Some(Folder::Jobs));
    ended(&mut seen).await;
    is(&seen, |record| record.status, &Status::Successful);
    house.unanswered(2).await;
    house.faults.silence(None);
    until("the record", || async { house.on_record(&id).await.status == Status::Successful }).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn nothing_is_promised_that_is_not_on_record() {
    let house = House::new(1, PATIENT).await;
    for folder in Folder::ALL {
        house.faults.silence(Some(folder));
        let refused = house.promise().await;
        assert!(matches!(refused, Err(PromiseError::Store(StoreError::Failed { .. }))), "{refused:?}");
    }
    house.faults.silence(None);
    assert_eq!((house.store.usage(Folder::Jobs).objects, house.ledger.recover().await.unwrap()), (0, 0));
    house.promise().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_that_was_dismissed_does_not_begin() {
    let house = House::new(1, PATIENT).await;
    let id = house.inherit().await;
    let promise = Arc::new(Promise::new(house.on_record(&id).await));
    let claim = house.ledger.claim(&promise, None);
    assert!(promise.end(Status::Dismissed, |_| {}));
    house.ledger.0.keep_up(&promise).await.unwrap();
    // The worker had it in hand already.
    tokio::task::spawn_blocking(claim).await.unwrap();
    for record in [promise.record(), house.on_record(&id).await] {
        assert_eq!((record.status, record.attempts), (Status::Dismissed, 0), "{record:?}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_is_on_record_last_is_what_was_so_last() {
    let house = House::new(1, PATIENT).await;
    let id = house.inherit().await;
    let promise = Arc::new(Promise::new(house.on_record(&id).await));
    assert!(promise.begin());
    // Somebody else is writing the record when the worker wants to write that it begins.
    let turn = promise.writing.lock().await;
    let (ledger, begun) = (house.ledger.clone(), Arc::clone(&promise));
    let mut writes = tokio::spawn(async move { ledger.0.keep_up(&begun).await.unwrap() });
    let waits = tokio::time::timeout(Duration::from_millis(200), &mut writes).await.is_err();
    assert!(waits, "two wrote at once");
    assert!(promise.end(Status::Dismissed, |_| {}));
    drop(turn);
    writes.await.unwrap();
    assert_eq!(house.on_record(&id).await.status, Status::Dismissed);
}
