//! Interleavings of clients of one durable job, the workers that run it, and the writes of its record.

use std::collections::BTreeSet;
use std::sync::Arc;

use bytes::Bytes;
use futures_util::FutureExt as _;
use object_store::ObjectStoreExt as _;
use object_store::memory::InMemory;
use object_store::path::Path;
use serde_json::Value;
use shuttle::future::block_on;
use shuttle::rand::{Rng as _, thread_rng};

use super::super::coalesced_job::QueuedTask;
use super::super::queue::Queue;
use super::super::record::decode;
use super::super::{
    Budget, ContentKey, EndError, Failure, JobId, JobRecord, JobSpec, JobStore, JobView, Lane, MemoryBroker, OnStart,
    Pool, REPORT, Settings, Status, results,
};
use super::task;
use crate::config::JobsConfig;
use crate::store::interleavings::open_bytes;
use crate::store::{Digest, Name, Namespace, Store};
use crate::surface::{OutOfMemory, ReferenceBackend};
use crate::sync::thread::{self, JoinHandle};

/// Number of schedules of a test. Each has a hundred times the steps of a test of the queue.
const SCHEDULES: usize = 3000;
/// Idempotency key of every request.
const KEY: &str = "k";
/// Number of attempts after which a job fails.
const ATTEMPTS: u32 = 3;

/// Job store over objects in memory, and the queue of its workers.
#[derive(Clone)]
struct Fixture {
    jobs: JobStore,
    queue: Arc<Queue>,
    broker: MemoryBroker,
    store: Store,
    objects: Arc<InMemory>,
    /// Ends that clients have seen.
    ends: Arc<std::sync::Mutex<BTreeSet<String>>>,
}

impl Fixture {
    fn new() -> Self {
        let (store, objects) = block_on(open_bytes(1 << 20));
        let budget = Budget::new(1 << 30);
        let settings = Settings::for_test(2, budget);
        let pool = Arc::new(Pool::without_workers(settings, Arc::new(ReferenceBackend), "a test".to_owned()));
        let queue = Arc::clone(&pool.shared.queue);
        let config = JobsConfig { attempts: ATTEMPTS, ..JobsConfig::default() };
        let describe = |error: &EndError| Value::String(error.to_string());
        let broker = MemoryBroker::new(8);
        let shared = Arc::new(broker.clone());
        let jobs = JobStore::new(store.clone(), pool, shared, config, 1 << 20, [0; 32], describe);
        jobs.start_claiming();
        Self { jobs, queue, broker, store, objects, ends: Arc::default() }
    }

    /// Creates or joins the job.
    fn accept(&self) -> Client<'_> {
        let spec = JobSpec {
            task: task(1, true),
            map: None,
            file: Bytes::from(vec![1]),
            parameters: Vec::new(),
            idempotency_key: Some(KEY.to_owned()),
            batch: None,
        };
        let mut client = Client { fixture: self, ended: false };
        client.sees(&block_on(self.jobs.accept(spec, None)).unwrap());
        client
    }

    /// Returns the record of the ended job in the store, without a step of the scheduler.
    fn on_record(&self) -> Option<JobRecord> {
        let path = Path::from(Name::ended_job(id().as_str()).unwrap().to_string());
        let found = self.objects.get(&path).now_or_never().unwrap().ok()?;
        Some(decode::<JobRecord>(&found.bytes().now_or_never().unwrap().unwrap()).unwrap())
    }

    /// Returns the record of the open job in the store, without a step of the scheduler.
    fn open_record(&self) -> JobRecord {
        let path = Path::from(Name::job(id().as_str()).unwrap().to_string());
        let found = self.objects.get(&path).now_or_never().unwrap().unwrap();
        decode::<JobRecord>(&found.bytes().now_or_never().unwrap().unwrap()).unwrap()
    }

    /// Stores a result of the job.
    fn store_result(&self, entry: &QueuedTask) {
        let arithmetic = self.jobs.0.pool.file_arithmetics(&entry.task.request.options).remove(0);
        let key = ContentKey::new(&entry.task.digest, &entry.task.request, &arithmetic, Namespace::default());
        let report = results::report_file(b"{}".to_vec(), 0, Digest::of(b"")).unwrap();
        for (extension, bytes) in [("glb", Bytes::new()), (REPORT, report)] {
            block_on(self.store.put(&key.name(extension).unwrap(), bytes)).unwrap();
        }
    }

    /// Starts a worker. Each run fails for good, or for lack of memory, after which the job is tried again.
    fn worker(&self) -> JoinHandle<()> {
        let fixture = self.clone();
        thread::spawn(move || {
            while let Some(mut entry) = fixture.queue.pop(Lane::Batch) {
                let id = entry.id;
                if entry.cancel.is_cancelled() {
                    fixture.queue.done(id, None, None);
                    continue;
                }
                // Workers reserve memory between this check and the start.
                thread::yield_now();
                OnStart::run_all(std::mem::take(&mut entry.on_start));
                let memory = OutOfMemory::Budget { needed: 1, held: 1, limit: 1 };
                let failure = match thread_rng().gen_range(0..4) {
                    0 => Failure::Panicked { message: "scripted".to_owned() },
                    1 => {
                        // An earlier process may have stored the result of an attempt that it did not finish.
                        fixture.store_result(&entry);
                        Failure::Memory(memory)
                    }
                    _ => Failure::Memory(memory),
                };
                fixture.queue.done(id, Some(Err(failure)), None);
            }
        })
    }

    /// Waits for the end of all work and checks the final state. Returns its status.
    fn check(&self, workers: Vec<JoinHandle<()>>) -> Status {
        while !self.broker.is_empty() {
            thread::yield_now();
        }
        block_on(self.jobs.all_recorded());
        self.jobs.stop_claiming();
        self.queue.close();
        for worker in workers {
            worker.join().unwrap();
        }
        let end = self.on_record().expect("the end is on record");
        assert!(end.attempts <= ATTEMPTS);
        let mut client = Client { fixture: self, ended: false };
        client.sees(&block_on(self.jobs.view(&id(), Namespace::default())).unwrap().unwrap());
        // A job that has ended is not cancelled.
        let refused = block_on(self.jobs.dismiss(&id(), Namespace::default())).unwrap().unwrap();
        assert_eq!(refused.record, end);
        assert_eq!(self.on_record().unwrap(), end);
        end.status
    }
}

/// Client of the job.
struct Client<'a> {
    fixture: &'a Fixture,
    ended: bool,
}

impl Client<'_> {
    /// Checks a state of the job against the earlier ones and against its record.
    fn sees(&mut self, view: &JobView) {
        let is_final = view.record.status.is_final();
        assert!(is_final || !self.ended, "the job has left its end");
        self.ended = is_final;
        if !is_final {
            return;
        }
        let written = self.fixture.on_record();
        assert_eq!(written.as_ref(), Some(&view.record), "a visible end is not on record");
        let mut ends = self.fixture.ends.lock().unwrap();
        ends.insert(format!("{:?}", view.record));
        assert_eq!(ends.len(), 1, "the job has several ends");
    }

    /// Reads the state of the job.
    fn reads(&mut self) {
        if let Some(view) = block_on(self.fixture.jobs.view(&id(), Namespace::default())).unwrap() {
            self.sees(&view);
        }
    }

    /// Waits for the end of the job.
    fn waits(&mut self) {
        let mut watched = block_on(self.fixture.jobs.watch(&id(), Namespace::default())).unwrap().unwrap();
        let view = block_on(watched.wait_for(|view| view.record.status.is_final())).unwrap().clone();
        self.sees(&view);
    }

    /// Cancels the job unless it has ended.
    fn cancels(&mut self) {
        let view = block_on(self.fixture.jobs.dismiss(&id(), Namespace::default())).unwrap().unwrap();
        assert!(view.record.status.is_final(), "a request to cancel a job ends before the job");
        self.sees(&view);
    }

    /// Cancels the job in the wrong order: its end is visible before it is on record.
    fn cancels_without_record(&mut self) {
        let Some(job) = self.fixture.jobs.0.lock().jobs.get(&id()).cloned() else { return };
        if job.end(Status::Dismissed, |_| {}) {
            job.publish_end(job.record());
            job.stop();
            block_on(self.fixture.jobs.0.write_job(&job)).unwrap();
        }
    }
}

/// Returns the id of the job.
fn id() -> JobId {
    JobId::from_key(&[0; 32], Namespace::default(), task(1, true).rank.client.0, KEY)
}

/// Explores schedules of clients that create, read and sometimes cancel one job while two workers run it. Returns the
/// names of all ends.
fn explore(cancel: fn(&mut Client<'_>)) -> BTreeSet<&'static str> {
    let ends = Arc::<std::sync::Mutex<BTreeSet<_>>>::default();
    let of_model = Arc::clone(&ends);
    let model = move || {
        let fixture = Fixture::new();
        let workers = vec![fixture.worker(), fixture.worker()];
        let start = |work: fn(&Fixture, fn(&mut Client<'_>))| {
            let fixture = fixture.clone();
            thread::spawn(move || work(&fixture, cancel))
        };
        let clients = [
            start(|fixture, _| fixture.accept().waits()),
            start(|fixture, cancel| {
                let mut client = fixture.accept();
                // A job that is cancelled early rarely reaches another attempt.
                if thread_rng().gen_range(0..2) == 0 {
                    cancel(&mut client);
                }
                client.reads();
            }),
            start(|fixture, _| {
                let mut client = Client { fixture, ended: false };
                (0..3).for_each(|_| client.reads());
            }),
        ];
        for client in clients {
            client.join().unwrap();
        }
        let end = fixture.check(workers);
        of_model.lock().unwrap().insert(end.name());
    };
    crate::sync::explore(model, SCHEDULES);
    let ends = ends.lock().unwrap();
    ends.clone()
}

#[test]
fn a_job_has_one_end_which_is_visible_once_it_is_on_record() {
    let ends = explore(|client| client.cancels());
    assert_eq!(ends, BTreeSet::from(["dismissed", "failed", "successful"]), "the schedules reach every end");
}

#[test]
#[should_panic(expected = "a visible end is not on record")]
fn an_end_that_is_visible_before_it_is_on_record_is_detected() {
    drop(explore(|client| client.cancels_without_record()));
}

/// Explores schedules of a stop while two workers run a job. Returns the names of all states after it.
fn explore_stops(stop: fn(&JobStore)) -> BTreeSet<&'static str> {
    let states = Arc::<std::sync::Mutex<BTreeSet<_>>>::default();
    let of_model = Arc::clone(&states);
    let model = move || {
        let fixture = Fixture::new();
        let workers = [fixture.worker(), fixture.worker()];
        drop(fixture.accept());
        // The job may run meanwhile.
        (0..thread_rng().gen_range(0..300)).for_each(|_| thread::yield_now());
        fixture.jobs.stop_claiming();
        stop(&fixture.jobs);
        block_on(fixture.jobs.all_recorded());
        for worker in workers {
            worker.join().unwrap();
        }
        let record = fixture.on_record().unwrap_or_else(|| fixture.open_record());
        let is_counted = !record.status.is_final() && record.attempts > 0;
        assert!(!is_counted, "a stop counts an attempt: {record:?}");
        of_model.lock().unwrap().insert(record.status.name());
    };
    crate::sync::explore(model, SCHEDULES);
    let states = states.lock().unwrap();
    states.clone()
}

#[test]
fn a_stop_counts_no_attempt() {
    let states = explore_stops(|jobs| {
        jobs.return_jobs();
        jobs.0.pool.cancel();
    });
    assert!(states.contains("accepted"), "no schedule returns the job: {states:?}");
}

#[test]
#[should_panic(expected = "a stop counts an attempt")]
fn an_attempt_that_begins_after_the_return_is_detected() {
    drop(explore_stops(|jobs| {
        jobs.return_jobs();
        jobs.0.pool.cancel();
        block_on(jobs.all_recorded());
        let Some(job) = jobs.0.lock().jobs.get(&id()).cloned() else { return };
        // A worker that does not check whether jobs return.
        if job.begin(|| true) {
            block_on(jobs.0.write_job(&job)).unwrap();
        }
    }));
}
