//! Number of job records, and faults while they are read and written.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use bytes::Bytes;

use super::{Fixture, MAX_WAIT, ended, new_id, until};
use crate::config::JobsConfig;
use crate::jobs::broker::{Broker as _, Dispatch};
use crate::jobs::durable_job::DurableJob;
use crate::jobs::job_map::MAX_ENDED;
use crate::jobs::record::{JobRecord, now_ms};
use crate::jobs::{AcceptError, JobId, Status};
use crate::store::{Folder, Name, Namespace, StoreError};

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn records_are_limited_in_total_and_for_each_client() {
    let config = JobsConfig { records: 3, records_per_client: 2, ..JobsConfig::default() };
    let fixture = Fixture::open(tempfile::tempdir().unwrap(), config).await;
    // Results cannot be stored, so the jobs stay open.
    fixture.faults.seal(Folder::Results);
    let mut open = Vec::new();
    for client in ["a", "a", "b"] {
        open.push(fixture.accept_from(client).await.unwrap().record.id);
    }
    let key = Some("jobs.records_per_client");
    for (client, limit, key) in [("a", 2, key), ("b", 3, None), ("c", 3, None)] {
        let refused = fixture.accept_from(client).await;
        let Err(AcceptError::Store(StoreError::TooManyRecords(error))) = refused else { panic!("{refused:?}") };
        assert_eq!((error.max, error.key()), (limit, key), "the request would join the work of the others");
    }
    fixture.faults.silence(None);
    fixture.all_ended().await;
    // In the order of their use.
    for id in &open {
        assert_eq!(fixture.on_record(id).await.status, Status::Successful);
    }
    // The result exists. The oldest ended job of the client is removed, then the oldest of all.
    for (client, oldest) in [("a", &open[0]), ("c", &open[1])] {
        let new = fixture.accept_from(client).await.unwrap().record;
        assert_eq!(new.status, Status::Successful);
        assert_eq!(fixture.jobs.view(oldest, Namespace::default()).await.unwrap(), None, "{client}");
        assert!(fixture.jobs.view(&new.id, Namespace::default()).await.unwrap().is_some());
        assert_eq!(fixture.store.usage(Folder::Jobs).objects, 3);
    }
    assert!(fixture.jobs.view(&open[2], Namespace::default()).await.unwrap().is_some());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn few_ended_jobs_stay_in_memory() {
    let fixture = Fixture::new(1, MAX_WAIT).await;
    let open = fixture.store_record().await;
    let record = fixture.on_record(&open).await;
    let insert = |record: JobRecord| {
        let id = record.id.clone();
        fixture.jobs.0.lock().insert(&Arc::new(DurableJob::new(record)));
        id
    };
    insert(record.clone());
    let ended = |n: u64| JobRecord { id: new_id(), status: Status::Successful, finished_ms: Some(n), ..record.clone() };
    let ids: Vec<JobId> = (0..3 * MAX_ENDED as u64).map(|n| insert(ended(n))).collect();
    let jobs = &fixture.jobs.0.lock().jobs;
    let n = jobs.len();
    assert!((MAX_ENDED..=MAX_ENDED + MAX_ENDED / 10 + 1).contains(&n), "{n}");
    assert!(jobs.contains_key(&open), "open jobs stay");
    assert!(ids[ids.len() - MAX_ENDED + 1..].iter().all(|id| jobs.contains_key(id)), "the last ones to end stay");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_start_reads_the_records_of_open_jobs_only() {
    const ENDED: usize = 20_000;
    let config = JobsConfig { records_per_client: ENDED, ..JobsConfig::default() };
    let fixture = Fixture::open(tempfile::tempdir().unwrap(), config.clone()).await;
    let open = [fixture.store_record().await, fixture.store_record().await];
    // A process that dies between the two steps of ending a job leaves both documents.
    let half_ended = fixture.store_record().await;
    let folder = fixture.dir.path().join("store/jobs");
    let write = |id: &JobId| std::fs::write(folder.join(format!("{}.ended.json", id.as_str())), b"{}").unwrap();
    write(&half_ended);
    (1..ENDED).for_each(|_| write(&new_id()));
    let fixture = Fixture::open(fixture.dir, config).await;
    assert_eq!(fixture.jobs.reconcile().await.unwrap(), open.len());
    // Workers may read the records of their claims again meanwhile.
    let reads = fixture.faults.job_reads.load(Ordering::SeqCst);
    assert!((open.len()..=10 * open.len()).contains(&reads), "{reads} records were read");
    assert!(!folder.join(format!("{}.json", half_ended.as_str())).exists());
    for id in &open {
        ended(&mut fixture.watch(id).await).await;
    }
    fixture.all_ended().await;
    let count = || fixture.store.usage(Folder::Jobs).objects;
    assert_eq!(count(), ENDED as u64 + 2);
    // The names alone identify the client: its ended records are removed down to the cap.
    fixture.accept().await.unwrap();
    assert_eq!(count(), ENDED as u64);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn jobs_of_other_releases_are_left_alone() {
    let fixture = Fixture::new(1, MAX_WAIT).await;
    let own = fixture.store_record().await;
    let [later_version, later_parameter, absent] = [(); 3].map(|()| new_id());
    let record = JobRecord {
        id: later_parameter.clone(),
        parameters: vec![("later".to_owned(), "1".to_owned())],
        ..fixture.on_record(&own).await
    };
    let stored = [(&later_version, Bytes::from_static(br#"{"version":2}"#)), (&later_parameter, record.to_bytes())];
    let name = |id: &JobId| Name::job(id.as_str()).unwrap();
    for (id, bytes) in &stored {
        fixture.store.put(&name(id), bytes.clone()).await.unwrap();
    }
    // Nodes of the other release have dispatched the jobs. There is one worker, which claims them in order.
    let dispatches =
        [&later_version, &later_parameter, &absent].map(|id| Dispatch { id: id.clone(), ..Dispatch::of(&record) });
    for dispatch in &dispatches {
        assert!(fixture.broker.dispatch(dispatch).await.unwrap());
    }
    until("the last claim", || async { !fixture.broker.holds(&absent) }).await;
    for dispatch in &dispatches[..2] {
        assert!(fixture.broker.holds(&dispatch.id), "the claim was given back");
    }
    assert!(!fixture.jobs.has_read_records(), "control: the records were not read yet");
    assert_eq!(fixture.jobs.reconcile().await.unwrap(), 1, "only the own job is dispatched");
    assert!(fixture.jobs.has_read_records());
    ended(&mut fixture.watch(&own).await).await;
    assert_eq!((fixture.jobs.other_release_count(), fixture.store.quarantined().await.unwrap()), (2, 0));
    for (id, bytes) in &stored {
        assert_eq!(&fixture.store.get(&name(id)).await.unwrap().unwrap().bytes, bytes, "the record is unchanged");
    }
    let space = Namespace::default();
    for refused in [fixture.jobs.view(&later_version, space).await, fixture.jobs.dismiss(&later_version, space).await] {
        assert!(matches!(refused, Err(StoreError::OtherRelease { .. })), "{refused:?}");
    }
    let view = fixture.jobs.view(&later_parameter, space).await.unwrap().unwrap();
    assert_eq!((view.record.status, view.record.attempts), (Status::Accepted, 0));
    let dismissed = fixture.jobs.dismiss(&later_parameter, space).await.unwrap().unwrap();
    assert_eq!((dismissed.record.status, fixture.jobs.other_release_count()), (Status::Dismissed, 1));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_record_of_an_ended_job_prevents_another_one() {
    let fixture = Fixture::new(1, MAX_WAIT).await;
    let id = fixture.store_record().await;
    let open = fixture.on_record(&id).await;
    let ended = JobRecord { status: Status::Dismissed, finished_ms: Some(now_ms()), ..open.clone() };
    assert!(!fixture.jobs.0.write_new(&open).await.unwrap(), "the job is open");
    fixture.jobs.0.write_end(ended.clone()).await.unwrap();
    assert!(!fixture.jobs.0.write_new(&open).await.unwrap(), "the job has ended");
    assert_eq!((fixture.on_record(&id).await, fixture.jobs.reconcile().await.unwrap()), (ended, 0));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn occasional_errors_of_the_store_end_no_job() {
    let fixture = Fixture::new(3, MAX_WAIT).await;
    fixture.faults.error_every.store(10, Ordering::SeqCst);
    let mut accepted = Vec::new();
    for client in 0..30 {
        match fixture.accept_from(&client.to_string()).await {
            Ok(view) => accepted.push(view.record.id),
            Err(AcceptError::Store(StoreError::Failed { .. })) => {}
            Err(error) => panic!("{error:?}"),
        }
    }
    fixture.all_ended().await;
    assert!(accepted.len() < 30 && accepted.len() >= 5, "{} jobs are accepted", accepted.len());
    fixture.faults.error_every.store(0, Ordering::SeqCst);
    for id in &accepted {
        assert_eq!(fixture.on_record(id).await.status, Status::Successful);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_truncated_read_of_a_record_is_no_damage() {
    let fixture = Fixture::new(1, MAX_WAIT).await;
    let id = fixture.store_record().await;
    fixture.faults.truncate.store(true, Ordering::SeqCst);
    let refused = fixture.jobs.0.read(&id).await;
    assert!(matches!(refused, Err(StoreError::Failed { .. })), "{refused:?}");
    fixture.faults.truncate.store(false, Ordering::SeqCst);
    assert_eq!((fixture.on_record(&id).await.id, fixture.store.quarantined().await.unwrap()), (id, 0));
}
