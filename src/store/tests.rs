//! Tests of disk faults and of the classification of errors.

use std::io;
use std::path::PathBuf;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant, SystemTime};

use bytes::Bytes;
use futures_util::TryStreamExt as _;
use futures_util::future::join_all;
use tempfile::TempDir;

use super::faulty::{Creation, error, faulty, open_creating, open_faulty};
use super::{Folder, Name, Store, StoreError};
use crate::config::StoreConfig;

fn name(number: u8) -> Name {
    Name::result(&format!("{number:064x}"), "glb").unwrap()
}

fn body(bytes: usize) -> Bytes {
    vec![7; bytes].into()
}

fn files(dir: &TempDir) -> Vec<PathBuf> {
    let files = std::fs::read_dir(dir.path().join("store/results")).unwrap();
    files.map(|file| file.unwrap().path()).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_full_disk_is_reported_and_stored_objects_remain() {
    let (dir, faults, store) = faulty(8 << 20).await;
    store.put(&name(1), body(1000)).await.unwrap();
    let pin = store.pin(&name(1));
    faults.full.store(true, Ordering::Relaxed);
    for refused in [store.put(&name(2), body(1000)).await, store.put_new(&name(2), body(9)).await.map(|_| ())] {
        let Err(StoreError::NoSpace { op: "put", location, .. }) = refused else { panic!("{refused:?}") };
        assert!(location.contains(&name(2).to_string()) && location.contains(store.location()), "{location}");
    }
    assert!(matches!(store.put(&name(1), body(1)).await, Err(StoreError::NoSpace { .. })));
    assert!(matches!(store.check().await, Err(StoreError::NoSpace { op: "check", .. })));
    let mut writer = store.writer(&name(3));
    let write = move || {
        let refused = io::Write::write_all(&mut writer, &body(5 << 20)).unwrap_err();
        assert_eq!(refused.kind(), io::ErrorKind::StorageFull, "{refused}");
        assert!(io::Write::write_all(&mut writer, &body(1)).is_err(), "a part is missing");
        assert!(matches!(writer.finish(), Err(StoreError::WriterFailed)));
    };
    tokio::task::spawn_blocking(write).await.unwrap();
    assert_eq!(store.get(&name(1)).await.unwrap().unwrap().bytes, body(1000));
    assert_eq!((store.usage(Folder::Results).bytes, files(&dir).len()), (1000, 1));
    drop(pin);
    // All reservations were released: the full capacity is available again.
    faults.full.store(false, Ordering::Relaxed);
    store.put(&name(4), body(8 << 20)).await.unwrap();
    assert_eq!((store.usage(Folder::Results).bytes, files(&dir).len()), (8 << 20, 1));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_store_without_conditional_writes_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    drop(Store::open(&StoreConfig::default(), dir.path()).await.unwrap());
    let open = async |creation| open_creating(creation, &dir.path().join("store")).await.map(drop);
    open(Creation::Conditional).await.unwrap();
    for creation in [Creation::Replacing, Creation::Refused] {
        let refused = open(creation).await.unwrap_err().to_string();
        assert!(refused.contains("must support conditional writes"), "{creation:?}: {refused}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn nodes_that_open_an_empty_store_at_once_share_its_secret() {
    let dir = tempfile::tempdir().unwrap();
    let open = async |folder: &str| {
        let url = Some(format!("file://{}", dir.path().join(folder).display()));
        let config = StoreConfig { url, ..StoreConfig::default() };
        Store::open_for(&config, dir.path(), true).await.unwrap().secret().await.unwrap()
    };
    let secrets = join_all((0..8).map(|_| open("one"))).await;
    assert!(secrets.iter().all(|secret| *secret == secrets[0]), "{secrets:?}");
    // The control.
    assert_ne!(open("other").await, secrets[0]);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_full_disk_evicts_twice_the_size_and_tries_once_more() {
    let (_dir, faults, store) = faulty(8 << 20).await;
    for number in 1..=5 {
        store.put(&name(number), body(1000)).await.unwrap();
    }
    faults.frees.store(true, Ordering::Relaxed);
    faults.full.store(true, Ordering::Relaxed);
    store.put(&name(6), body(800)).await.unwrap();
    let mut left = Vec::new();
    for number in 1..=6 {
        left.push(store.head(&name(number)).await.unwrap().is_some());
    }
    assert_eq!(left, [false, false, true, true, true, true]);
    // A second failure is reported.
    faults.frees.store(false, Ordering::Relaxed);
    faults.full.store(true, Ordering::Relaxed);
    let refused = store.put(&name(7), body(800)).await;
    assert!(matches!(refused, Err(StoreError::NoSpace { .. })), "{refused:?}");
    assert_eq!(store.usage(Folder::Results).objects, 2);
}

#[tokio::test(flavor = "multi_thread")]
async fn cached_results_keep_no_buffer_of_their_writer() {
    let dir = tempfile::tempdir().unwrap();
    let store = Store::open(&StoreConfig::default(), dir.path()).await.unwrap();
    for (number, is_cached) in [(1, true), (3, false)] {
        let mut writer = store.writer(&name(number)).cached(is_cached);
        let write = move || io::Write::write_all(&mut writer, &body(1000)).map(|()| writer.finish());
        tokio::task::spawn_blocking(write).await.unwrap().unwrap().unwrap();
    }
    assert!(store.0.memory.get(&name(3)).is_none());
    let mut part = vec![7; 1 << 20];
    part.truncate(1000);
    store.put(&name(2), part.into()).await.unwrap();
    for number in [1, 2] {
        let cached = store.0.memory.get(&name(number)).expect("a small result is cached").bytes;
        store.0.memory.remove(&name(number));
        let buffer = cached.try_into_mut().expect("the only reference");
        assert_eq!(buffer, body(1000));
        assert!(buffer.capacity() < 2000, "{} bytes are kept", buffer.capacity());
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn removed_results_are_forgotten() {
    let dir = tempfile::tempdir().unwrap();
    let store = Store::open(&StoreConfig::default(), dir.path()).await.unwrap();
    for number in 1..=3 {
        store.put(&name(number), body(10)).await.unwrap();
        store.set_intact(&name(number)).await.unwrap();
    }
    assert_eq!(store.0.intact.len(), 3);
    store.delete(&name(1)).await.unwrap();
    assert_eq!(store.0.intact.len(), 2);
    store.sweep(store.now() + Duration::from_hours(1000)).await;
    assert_eq!(store.0.intact.len(), 0);
}

#[tokio::test]
async fn the_last_use_survives_a_restart() {
    let dir = tempfile::tempdir().unwrap();
    let open = async || Store::open(&StoreConfig::default(), dir.path()).await.unwrap();
    let file = |number| dir.path().join("store").join(name(number).to_string());
    let set = |number, at| std::fs::File::open(file(number)).unwrap().set_modified(at).unwrap();
    let of = |number| std::fs::metadata(file(number)).unwrap().modified().unwrap();
    let now = SystemTime::now();
    let hours = |n| now - Duration::from_hours(n);
    let store = open().await;
    for number in 1..=3 {
        store.put(&name(number), body(10)).await.unwrap();
    }
    set(1, hours(20));
    set(2, hours(20));
    set(3, now - Duration::from_mins(30));
    let store = open().await;
    for number in [1, 3] {
        assert!(store.get(&name(number)).await.unwrap().is_some());
    }
    store.sweep(now).await;
    assert!(of(1) >= now - Duration::from_secs(1), "the use is saved");
    assert!(of(2) < hours(19), "an object that is not used keeps its time");
    assert!(of(3) < now - Duration::from_mins(29), "at most one save an hour");
    // The day since the write of the first object has passed, not the day since its use.
    let store = open().await;
    assert_eq!(store.sweep(now + Duration::from_hours(5)).await.expired, 1);
    assert!(store.head(&name(1)).await.unwrap().is_some() && store.head(&name(2)).await.unwrap().is_none());
}

#[tokio::test]
async fn a_peek_is_no_use() {
    let dir = tempfile::tempdir().unwrap();
    let open = async || Store::open(&StoreConfig::default(), dir.path()).await.unwrap();
    let (record, now) = (Name::ended_job("1").unwrap(), SystemTime::now());
    open().await.put(&record, body(10)).await.unwrap();
    let file = dir.path().join("store").join(record.to_string());
    std::fs::File::open(&file).unwrap().set_modified(now - Duration::from_hours(20)).unwrap();
    let store = open().await;
    let is_used = async || {
        store.sweep(now).await;
        std::fs::metadata(&file).unwrap().modified().unwrap() > now - Duration::from_hours(19)
    };
    assert_eq!(store.peek(&record).await.unwrap(), Some(body(10)));
    assert!(!is_used().await);
    assert!(store.get(&record).await.unwrap().is_some() && is_used().await);
    assert_eq!(store.peek(&Name::ended_job("2").unwrap()).await.unwrap(), None);
}

#[tokio::test]
async fn objects_that_cannot_be_removed_still_count() {
    let (dir, faults, store) = faulty(1000).await;
    store.put(&name(1), body(600)).await.unwrap();
    faults.stuck.store(true, Ordering::Relaxed);
    let far = SystemTime::now() + Duration::from_secs(1 << 30);
    let log = std::sync::Mutex::new(std::fs::File::create(dir.path().join("log")).unwrap());
    let logging = tracing::subscriber::set_default(tracing_subscriber::fmt().with_writer(log).finish());
    let swept = store.sweep(far).await;
    drop(logging);
    assert_eq!((swept.expired, swept.bytes, swept.failed), (0, 0, 1));
    let log = std::fs::read_to_string(dir.path().join("log")).unwrap();
    assert!(log.contains("an object could not be removed") && log.contains('…'), "{log}");
    assert!(!log.contains(&name(1).to_string()), "{log}");
    assert!(matches!(store.delete(&name(1)).await, Err(StoreError::Denied { op: "delete", .. })));
    let refused = store.put(&name(2), body(600)).await;
    assert!(matches!(refused, Err(StoreError::Full { bytes: 600, .. })), "{refused:?}");
    assert_eq!(store.get(&name(1)).await.unwrap().unwrap().bytes, body(600));
    assert_eq!(store.usage(Folder::Results).bytes, 600);
    faults.stuck.store(false, Ordering::Relaxed);
    store.put(&name(2), body(600)).await.unwrap();
    assert_eq!((store.get(&name(1)).await.unwrap(), store.usage(Folder::Results).bytes), (None, 600));
    assert_eq!(store.sweep(far).await.expired, 1);
}

/// Applies every operation to the object 1, which exists, and returns their errors. Writes the objects 2 to 4.
async fn operate(store: &Store) -> Vec<StoreError> {
    let mut errors = Vec::new();
    let read = async || store.read(&name(1), None).await?.unwrap().1.try_collect::<Vec<_>>().await;
    errors.extend(read().await.err());
    errors.extend(store.get(&name(1)).await.err());
    errors.extend(store.head(&name(1)).await.err());
    errors.extend(store.put(&name(2), body(1000)).await.err());
    errors.extend(store.put_new(&name(3), body(1000)).await.err());
    errors.extend(store.check().await.err());
    let mut writer = store.writer(&name(4));
    let write = move || match io::Write::write_all(&mut writer, &body(3 << 20)) {
        Ok(()) => writer.finish().err(),
        Err(error) => Some(error.downcast::<StoreError>().unwrap()),
    };
    errors.extend(tokio::task::spawn_blocking(write).await.unwrap());
    errors.extend(store.delete(&name(1)).await.err());
    errors
}

#[tokio::test(flavor = "multi_thread")]
async fn slow_operations_succeed_and_hanging_ones_fail_in_time() {
    let dir = tempfile::tempdir().unwrap();
    let config = StoreConfig { timeout_ms: 500, memory_object_bytes: 1, ..StoreConfig::default() };
    let (faults, store) = open_faulty(dir.path(), config).await;
    store.put(&name(1), body(1000)).await.unwrap();
    faults.hang.store(true, Ordering::SeqCst);
    let begun = Instant::now();
    let errors = operate(&store).await;
    assert_eq!(errors.len(), 8, "every operation fails: {errors:?}");
    for error in errors {
        assert!(error.is_temporary() && error.to_string().contains("store.timeout_ms"), "{error}");
    }
    assert!(begun.elapsed() < Duration::from_secs(40), "{:?}", begun.elapsed());
    let whole = [dir.path().join("store").join(name(1).to_string())];
    while files(&dir) != whole {
        assert!(begun.elapsed() < Duration::from_secs(40), "half-written: {:?}", files(&dir));
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    // Nothing stays locked or reserved.
    faults.hang.store(false, Ordering::SeqCst);
    faults.slow_ms.store(20, Ordering::SeqCst);
    assert!(operate(&store).await.is_empty());
    assert_eq!((store.usage(Folder::Results).objects, files(&dir).len()), (3, 3));
}

#[tokio::test(flavor = "multi_thread")]
async fn truncated_reads_are_errors_and_not_cached() {
    let dir = tempfile::tempdir().unwrap();
    let (faults, store) = open_faulty(dir.path(), StoreConfig::default()).await;
    std::fs::write(dir.path().join("store").join(name(1).to_string()), body(1000)).unwrap();
    faults.truncate.store(true, Ordering::SeqCst);
    let refused = store.get(&name(1)).await;
    assert!(matches!(refused, Err(StoreError::Failed { op: "read", .. })), "{refused:?}");
    let refused = store.read(&name(1), None).await.unwrap().unwrap().1.try_collect::<Vec<_>>().await;
    assert!(matches!(refused, Err(StoreError::Failed { op: "read", .. })), "{refused:?}");
    faults.truncate.store(false, Ordering::SeqCst);
    assert_eq!(store.get(&name(1)).await.unwrap().unwrap().bytes, body(1000));
}

#[tokio::test(flavor = "multi_thread")]
async fn occasional_errors_lose_and_damage_nothing() {
    let (dir, faults, store) = faulty(1 << 30).await;
    faults.error_every.store(100, Ordering::SeqCst);
    let mut kept = 0;
    for number in 0..400_u64 {
        let name = Name::result(&format!("{number:064x}"), "glb").unwrap();
        kept += u64::from(store.put(&name, body(100)).await.is_ok());
        // One of two attempts succeeds.
        let first = store.get(&name).await;
        let read = if first.is_err() { store.get(&name).await } else { first };
        assert!(read.unwrap().is_none_or(|stored| stored.bytes == body(100)), "{number}");
    }
    let errors = faults.errors.load(Ordering::SeqCst);
    assert!(errors >= 8 && (390..400).contains(&kept), "{errors} errors, {kept} objects");
    assert_eq!((store.usage(Folder::Results).objects, files(&dir).len() as u64), (kept, kept));
}

#[tokio::test]
async fn a_jump_of_the_clock_neither_expires_nor_prolongs_objects() {
    for days in [1, -1] {
        let dir = tempfile::tempdir().unwrap();
        let config = StoreConfig { result_ttl_ms: 4 * 3_600_000, ..StoreConfig::default() };
        let (_faults, store) = open_faulty(dir.path(), config).await;
        store.put(&name(1), body(10)).await.unwrap();
        store.0.clock.jump.store(days, Ordering::Relaxed);
        store.put(&name(2), body(10)).await.unwrap();
        assert_eq!(store.sweep(store.now()).await.expired, 0);
        // Files have the time of the system, which the next process compares with.
        let hour = Duration::from_hours(1);
        store.touch(&name(2), store.now() + 2 * hour);
        assert_eq!(store.sweep(store.now() + 2 * hour).await.expired, 0);
        let file = std::fs::metadata(dir.path().join("store").join(name(2).to_string())).unwrap();
        let ahead = store.0.clock.system() + 2 * hour;
        let error = file.modified().unwrap().duration_since(ahead).unwrap_or_else(|e| e.duration());
        assert!(error < Duration::from_mins(10), "{error:?}");
        assert_eq!(store.sweep(store.now() + 5 * hour).await.expired, 1);
        assert!(store.head(&name(1)).await.unwrap().is_none() && store.head(&name(2)).await.unwrap().is_some());
    }
}

#[test]
fn errors_are_classified() {
    let of = |error: &object_store::Error| StoreError::classify("put", "here", error);
    for kind in [io::ErrorKind::StorageFull, io::ErrorKind::QuotaExceeded] {
        assert!(matches!(of(&error(kind)), StoreError::NoSpace { .. }), "{kind}");
    }
    for kind in [io::ErrorKind::PermissionDenied, io::ErrorKind::ReadOnlyFilesystem] {
        assert!(matches!(of(&error(kind)), StoreError::Denied { .. }), "{kind}");
    }
    assert!(matches!(of(&error(io::ErrorKind::TimedOut)), StoreError::Failed { .. }));
    // System error numbers: ENOSPC, EPERM, EACCES, and another one.
    let code = |code| object_store::Error::Generic { store: "x", source: Box::new(io::Error::from_raw_os_error(code)) };
    assert!(matches!(of(&code(28)), StoreError::NoSpace { .. }));
    assert!([1, 13].into_iter().all(|number| matches!(of(&code(number)), StoreError::Denied { .. })));
    assert!(matches!(of(&code(5)), StoreError::Failed { .. }));
    let source = || "no".into();
    let forbidden = object_store::Error::PermissionDenied { path: "a".to_owned(), source: source() };
    assert!(matches!(of(&forbidden), StoreError::Denied { .. }));
    let other = object_store::Error::Precondition { path: "a".to_owned(), source: source() };
    assert!(matches!(of(&other), StoreError::Failed { .. }));
    assert!(of(&forbidden).to_string().contains("here"));
}
