//! Store: the same tests on a folder and on S3.

use crate::store_support;

use std::future::Future;
use std::io::Write as _;
use std::ops::Range;
use std::time::{Duration, Instant, SystemTime};

use bytes::Bytes;
use futures_util::{FutureExt as _, TryStreamExt as _};
use molmesh::config::{Secret, StoreConfig};
use molmesh::store::{Digest, Folder, Name, Store, StoreError, Usage};
use object_store::aws::AmazonS3Builder;
use object_store::path::Path;
use object_store::{ObjectStoreExt as _, PutPayload};
use store_support::{Service, TestStore, input, job, local, noise, result, s3, shared};

const HOUR: Duration = Duration::from_hours(1);
const MIB: usize = 1 << 20;

/// Runs each test on both backends.
macro_rules! on_both {
    ($($test:ident),+ $(,)?) => {
        mod folder {
            $(#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
            async fn $test() {
                super::$test(super::local()).await;
            })+
        }
        mod s3 {
            $(#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
            async fn $test() {
                super::$test(super::s3()).await;
            })+
        }
    };
}

on_both!(
    objects_are_stored_and_deleted,
    ranges_are_read_and_invalid_ranges_rejected,
    put_new_keeps_the_first_object,
    replacing_an_object_is_atomic,
    a_written_object_appears_when_finished,
    a_dropped_writer_leaves_nothing,
    least_recently_used_objects_are_evicted,
    objects_over_the_capacity_are_rejected,
    the_least_recently_used_objects_beyond_the_number_are_evicted,
    writers_evict_objects,
    objects_expire_by_folder_and_use_prolongs_their_life,
    pinned_objects_are_neither_evicted_nor_expired,
    small_results_are_cached_in_memory,
    memory_cache_is_bounded_and_drops_removed_objects,
    a_restart_finds_existing_objects,
    a_cancelled_put_still_finishes,
    the_check_leaves_nothing,
);

fn usage(bytes: usize, objects: u64) -> Usage {
    Usage { bytes: bytes as u64, objects }
}

async fn get(store: &Store, name: &Name) -> Option<Vec<u8>> {
    store.get(name).await.unwrap().map(|stored| stored.bytes.to_vec())
}

async fn put(store: &Store, name: &Name, bytes: usize) {
    store.put(name, noise(bytes, 1).into()).await.unwrap();
}

async fn has(store: &Store, name: &Name) -> bool {
    store.head(name).await.unwrap().is_some()
}

async fn part(store: &Store, name: &Name, range: Option<Range<u64>>) -> Option<(u64, Vec<u8>)> {
    let (meta, stream) = store.read(name, range).await.unwrap()?;
    let pieces: Vec<Bytes> = stream.try_collect().await.unwrap();
    Some((meta.size, pieces.concat()))
}

/// Waits until `holds` returns true.
async fn until<F: Future<Output = bool>>(what: &str, mut holds: impl FnMut() -> F) {
    let begun = Instant::now();
    while !holds().await {
        assert!(begun.elapsed() < Duration::from_secs(30), "timed out waiting for {what}");
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}

/// Runs blocking `work`.
async fn blocking<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> T {
    tokio::task::spawn_blocking(work).await.unwrap()
}

#[test]
fn names_cannot_leave_their_folder() {
    let key = "0123456789abcdef".repeat(4);
    assert_eq!(Name::job("0a1f").unwrap().to_string(), "jobs/0a1f.json");
    assert_eq!(Name::result(&key, "report.json").unwrap().to_string(), format!("results/{key}.report.json"));
    assert_eq!(Name::input(&Digest::of(b"abc")).to_string(), format!("inputs/{}", Digest::of(b"abc")));
    assert_eq!(Name::result(&key, "glb").unwrap().folder(), Folder::Results);
    assert_eq!(Name::ended_job("0a1f").unwrap().to_string(), "jobs/0a1f.ended.json");
    for bad in ["", "..", "../a", "a/b", "a-b", "a\\b", "a.b", "A", "g", "a\0", "a%2f", "é", "a#1", &"a".repeat(65)] {
        assert!(Name::job(bad).is_err(), "{bad:?}");
    }
    for bad in ["", ".", "..", "glb.", ".glb", "a..b", "../x", "g/b", "GLB", "glb#1", "a b", "é", &"a".repeat(17)] {
        assert!(Name::result(&key, bad).is_err(), "{bad:?}");
    }
    for bad in ["", "../../etc/passwd", &key[1..], &key.to_uppercase(), &format!("{}/{}", &key[..31], &key[32..])] {
        assert!(Name::result(bad, "glb").is_err(), "{bad:?}");
    }
}

async fn objects_are_stored_and_deleted(place: TestStore) {
    let store = place.open().await;
    let names = [result(1), result(2), input(1), job(1)];
    for (seed, name) in (1..).zip(&names) {
        assert_eq!((get(&store, name).await, store.head(name).await.unwrap()), (None, None));
        store.put(name, noise(1000, seed).into()).await.unwrap();
        assert_eq!(get(&store, name).await, Some(noise(1000, seed)));
    }
    let listed = store.list(Folder::Results).await.unwrap();
    assert_eq!(
        listed.iter().map(|(name, meta)| (name.clone(), meta.size)).collect::<Vec<_>>(),
        [(result(1), 1000), (result(2), 1000)]
    );
    let age = SystemTime::now().duration_since(listed[0].1.modified).unwrap_or_default();
    assert!(age < HOUR, "{age:?}");
    assert_eq!(Folder::ALL.map(|f| store.usage(f)), [usage(1000, 1), usage(1000, 1), usage(2000, 2)]);
    store.put(&result(1), noise(10, 9).into()).await.unwrap();
    assert_eq!(get(&store, &result(1)).await, Some(noise(10, 9)));
    assert_eq!(store.usage(Folder::Results), usage(1010, 2));
    for name in &names {
        store.delete(name).await.unwrap();
        assert_eq!((get(&store, name).await, store.head(name).await.unwrap()), (None, None));
        store.delete(name).await.unwrap();
    }
    assert_eq!(Folder::ALL.map(|f| store.usage(f)), [usage(0, 0); 3]);
    assert_eq!(store.list(Folder::Results).await.unwrap(), []);
}

async fn ranges_are_read_and_invalid_ranges_rejected(place: TestStore) {
    let store = place.open().await;
    // One result is too large for the memory cache, one fits; all objects have several chunks on disk.
    for (name, length) in [(result(1), 5 * MIB), (result(2), MIB), (input(1), MIB)] {
        let bytes = noise(length, 3);
        store.put(&name, bytes.clone().into()).await.unwrap();
        let size = length as u64;
        for range in [0..1, 0..size, 7..size - 7, size - 1..size, 300_000..600_000] {
            let expected = &bytes[usize::try_from(range.start).unwrap()..usize::try_from(range.end).unwrap()];
            let (whole, read) = part(&store, &name, Some(range.clone())).await.unwrap();
            assert!(whole == size && read == expected, "{range:?} of {name}");
        }
        assert!(part(&store, &name, Some(size - 3..u64::MAX)).await.unwrap().1 == bytes[length - 3..]);
        assert!(part(&store, &name, None).await.unwrap() == (size, bytes));
        let inverted = Range { start: 9, end: 3 };
        for bad in [size..size + 1, 5..5, inverted] {
            let refused = store.read(&name, Some(bad.clone())).await.map(|_| ());
            assert!(matches!(refused, Err(StoreError::Range { size: s, .. }) if s == size), "{bad:?}: {refused:?}");
        }
    }
    store.put(&input(2), Bytes::new()).await.unwrap();
    assert_eq!(part(&store, &input(2), None).await, Some((0, Vec::new())));
    assert_eq!(part(&store, &input(3), None).await, None);
    assert_eq!(part(&store, &input(3), Some(0..1)).await, None);
    // An object that is being read is not removed by a sweep; deleting one ends its streams with an error.
    if place.is_local() {
        let old = SystemTime::now() + Duration::from_hours(24 * 365);
        store.put(&input(4), noise(MIB, 4).into()).await.unwrap();
        let (_, stream) = store.read(&input(4), None).await.unwrap().unwrap();
        store.sweep(old).await;
        assert!(stream.try_collect::<Vec<_>>().await.unwrap().concat() == noise(MIB, 4));
        let (_, stream) = store.read(&input(4), None).await.unwrap().unwrap();
        store.delete(&input(4)).await.unwrap();
        assert!(matches!(stream.try_collect::<Vec<_>>().await, Err(StoreError::Failed { .. })));
        store.put(&input(4), noise(MIB, 4).into()).await.unwrap();
        assert_eq!(store.sweep(old).await.expired, 1, "control: no reader");
    }
}

async fn put_new_keeps_the_first_object(place: TestStore) {
    let store = place.open().await;
    for name in [result(1), input(1), job(1)] {
        assert!(store.put_new(&name, noise(10, 1).into()).await.unwrap());
        assert!(!store.put_new(&name, noise(20, 2).into()).await.unwrap());
        assert_eq!(get(&store, &name).await, Some(noise(10, 1)), "{name}");
        // Of concurrent calls exactly one succeeds, and its bytes are stored.
        store.delete(&name).await.unwrap();
        let calls = (0..8).map(|seed| store.put_new(&name, noise(30, seed).into()));
        let won = futures_util::future::join_all(calls).await.into_iter().map(Result::unwrap).collect::<Vec<_>>();
        assert_eq!(won.iter().filter(|&&won| won).count(), 1, "{name}: {won:?}");
        let seed = won.iter().position(|&won| won).unwrap() as u64;
        assert_eq!(get(&store, &name).await, Some(noise(30, seed)));
    }
    assert_eq!(Folder::ALL.map(|f| store.usage(f)), [usage(30, 1); 3]);
}

async fn replacing_an_object_is_atomic(place: TestStore) {
    let store = place.open().await;
    let bodies = [noise(MIB, 1), noise(2 * MIB, 2)];
    store.put(&job(1), bodies[0].clone().into()).await.unwrap();
    let writer = tokio::spawn({
        let (store, bodies) = (store.clone(), bodies.clone());
        async move {
            for body in bodies.iter().cycle() {
                store.put(&job(1), body.clone().into()).await.unwrap();
            }
        }
    });
    let mut seen = [0; 2];
    // The writer goes on until readers have met each object, on a busy machine too.
    while seen.iter().sum::<i32>() < 8 || seen.contains(&0) {
        let read = get(&store, &job(1)).await.unwrap();
        let which = bodies.iter().position(|body| *body == read);
        seen[which.unwrap_or_else(|| panic!("{} bytes that were never written", read.len()))] += 1;
    }
    writer.abort();
    assert!(writer.await.unwrap_err().is_cancelled());
}

async fn a_written_object_appears_when_finished(place: TestStore) {
    let store = place.open().await;
    let bytes = noise(if place.is_local() { 8 * MIB } else { 60 * MIB } + 17, 5);
    for name in [result(1), result(2)] {
        let (step, stepped) = std::sync::mpsc::sync_channel::<()>(0);
        let (sender, written) = tokio::sync::oneshot::channel();
        let mut writer = store.writer(&name);
        let body = bytes.clone();
        let thread = std::thread::spawn(move || {
            for piece in body.chunks(100_000) {
                writer.write_all(piece).unwrap();
            }
            sender.send(()).unwrap();
            stepped.recv().unwrap();
            writer.finish().unwrap();
        });
        // Polling finds nothing while the writer is running.
        let done = tokio::spawn(written);
        while !done.is_finished() {
            assert!(!has(&store, &name).await && store.get(&name).await.unwrap().is_none());
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
        // All but the last parts are stored under a temporary name by now.
        assert!(store.list(Folder::Results).await.unwrap().iter().all(|(listed, _)| *listed != name));
        assert!(!has(&store, &name).await && part(&store, &name, None).await.is_none());
        assert_eq!(place.unfinished().len(), 1);
        step.send(()).unwrap();
        blocking(move || thread.join().unwrap()).await;
        assert!(part(&store, &name, None).await.unwrap().1 == bytes);
        assert_eq!(place.unfinished(), Vec::<String>::new());
    }
    assert_eq!(store.usage(Folder::Results), usage(2 * bytes.len(), 2));
    // An object that fits into one part.
    let mut writer = store.writer(&result(3));
    blocking(move || writer.write_all(b"solid").map(|()| writer.finish())).await.unwrap().unwrap();
    assert_eq!(get(&store, &result(3)).await, Some(b"solid".to_vec()));
    let empty = store.writer(&result(4));
    blocking(move || empty.finish()).await.unwrap();
    assert_eq!(get(&store, &result(4)).await, Some(Vec::new()));
}

async fn a_dropped_writer_leaves_nothing(place: TestStore) {
    let store = place.open().await;
    let size = if place.is_local() { 8 * MIB } else { 60 * MIB };
    put(&store, &result(3), 5).await;
    for (name, panics) in [(result(1), false), (result(2), true), (result(3), false)] {
        let mut writer = store.writer(&name);
        let (step, stepped) = std::sync::mpsc::sync_channel::<()>(0);
        let thread = std::thread::spawn(move || {
            writer.write_all(&noise(size, 1)).unwrap();
            stepped.recv().unwrap();
            assert!(!panics, "the encoder fails on purpose");
        });
        until("the upload", async || !place.unfinished().is_empty()).await;
        step.send(()).unwrap();
        assert_eq!(blocking(move || thread.join()).await.is_err(), panics);
        until("the end of the upload", async || place.unfinished().is_empty()).await;
    }
    assert!(!has(&store, &result(1)).await && !has(&store, &result(2)).await);
    // The previous object remains.
    assert_eq!(get(&store, &result(3)).await, Some(noise(5, 1)));
    assert_eq!(store.usage(Folder::Results), usage(5, 1));
}

async fn least_recently_used_objects_are_evicted(mut place: TestStore) {
    place.config.max_bytes = 1000;
    let store = place.open().await;
    for i in 1..=4 {
        put(&store, &result(i), 250).await;
    }
    // Job records do not count.
    put(&store, &job(1), 5000).await;
    assert_eq!(store.usage(Folder::Results), usage(1000, 4));
    // 1 and 2 are used in two ways, so 3 is the least recently used.
    assert!(get(&store, &result(1)).await.is_some());
    store.touch(&result(2), SystemTime::now());
    put(&store, &input(1), 250).await;
    assert!(!has(&store, &result(3)).await);
    // Next are 4, then 1 and 2.
    put(&store, &result(5), 10).await;
    assert!(!has(&store, &result(4)).await);
    put(&store, &result(6), 700).await;
    for (name, there) in
        [(result(1), false), (result(2), false), (input(1), true), (result(5), true), (result(6), true)]
    {
        assert_eq!(has(&store, &name).await, there, "{name}");
    }
    assert_eq!((store.usage(Folder::Results), store.usage(Folder::Inputs)), (usage(710, 2), usage(250, 1)));
    assert!(has(&store, &job(1)).await);
    // Replacing an object frees its previous size.
    put(&store, &result(6), 900).await;
    assert_eq!((store.usage(Folder::Results), store.usage(Folder::Inputs)), (usage(900, 1), usage(0, 0)));
    put(&store, &result(7), 100).await;
    // A lowered capacity is enforced by the next sweep.
    place.config.max_bytes = 999;
    let store = place.open().await;
    let swept = store.sweep(SystemTime::now()).await;
    assert_eq!((swept.evicted, swept.expired, store.usage(Folder::Results).objects), (1, 0, 1));
}

async fn objects_over_the_capacity_are_rejected(mut place: TestStore) {
    place.config.max_bytes = 1000;
    let store = place.open().await;
    put(&store, &result(1), 600).await;
    for refused in [
        store.put(&result(2), noise(1001, 1).into()).await,
        store.put_new(&input(2), noise(1001, 1).into()).await.map(|_| ()),
        blocking({
            let mut writer = store.writer(&result(2));
            move || {
                writer.write_all(&noise(1001, 1)).unwrap();
                writer.finish().map(drop)
            }
        })
        .await,
    ] {
        let refused = refused.unwrap_err();
        assert!(matches!(refused, StoreError::TooLarge(_)), "{refused}");
        assert_eq!(refused.to_string(), "the file needs 1001 bytes in the store, the limit is 1000 (store.max_bytes)");
    }
    // A rejected object evicts nothing. An object of exactly the capacity is stored.
    assert!(has(&store, &result(1)).await && !has(&store, &result(2)).await);
    put(&store, &result(2), 1000).await;
    assert_eq!(store.usage(Folder::Results), usage(1000, 1));
}

async fn writers_evict_objects(mut place: TestStore) {
    place.config.max_bytes = 20 * MIB as u64;
    let store = place.open().await;
    for i in 1..=4 {
        put(&store, &result(i), 5 * MIB).await;
    }
    let mut writer = store.writer(&result(5));
    blocking(move || writer.write_all(&noise(9 * MIB, 1)).map(|()| writer.finish())).await.unwrap().unwrap();
    assert!(!has(&store, &result(1)).await && !has(&store, &result(2)).await && has(&store, &result(3)).await);
    assert_eq!(store.usage(Folder::Results), usage(19 * MIB, 3));
    // The reservation grows up to the capacity.
    let mut writer = store.writer(&result(6));
    let refused = blocking(move || writer.write_all(&noise(64 * MIB, 1))).await.unwrap_err();
    assert_eq!(refused.kind(), std::io::ErrorKind::FileTooLarge);
    assert!(matches!(refused.downcast::<StoreError>().unwrap(), StoreError::TooLarge(_)));
    until("the end of the upload", async || place.unfinished().is_empty()).await;
    assert!(!has(&store, &result(6)).await);
    // Its reservation is released.
    put(&store, &result(7), 20 * MIB).await;
    assert_eq!(store.usage(Folder::Results), usage(20 * MIB, 1));
}

async fn objects_expire_by_folder_and_use_prolongs_their_life(mut place: TestStore) {
    let hours = |n: u64| n * 3_600_000;
    (place.config.result_ttl_ms, place.config.input_ttl_ms) = (hours(2), hours(4));
    let store = place.open().await;
    let now = SystemTime::now();
    for name in [result(1), result(2), input(1), job(1)] {
        put(&store, &name, 100).await;
    }
    store.touch(&result(2), now + 2 * HOUR);
    let names = [result(1), result(2), input(1), job(1)];
    let there = async || {
        let mut there = Vec::new();
        for name in &names {
            there.push(has(&store, name).await);
        }
        there
    };
    // One minute of tolerance for slow machines. The clock may be set back.
    for early in [now - HOUR, now, now + 2 * HOUR - HOUR / 60] {
        assert_eq!(store.sweep(early).await.expired, 0);
    }
    assert_eq!(there().await, [true, true, true, true]);
    // Job records expire with the results.
    let swept = store.sweep(now + 2 * HOUR + HOUR / 60).await;
    assert_eq!((swept.expired, swept.evicted, swept.bytes, swept.failed), (2, 0, 200, 0));
    assert_eq!(there().await, [false, true, true, false]);
    // An earlier use does not shorten the life of an object.
    store.touch(&result(2), now);
    assert_eq!(store.sweep(now + 3 * HOUR).await.expired, 0);
    assert_eq!(store.sweep(now + 5 * HOUR).await.expired, 2);
    assert_eq!(there().await, [false; 4]);
    assert_eq!(Folder::ALL.map(|f| store.usage(f)), [usage(0, 0); 3]);
}

async fn the_least_recently_used_objects_beyond_the_number_are_evicted(mut place: TestStore) {
    place.config.max_objects = 3;
    let store = place.open().await;
    for name in [result(1), input(1), result(2), job(1), job(2)] {
        put(&store, &name, 10).await;
    }
    assert!(get(&store, &result(1)).await.is_some());
    put(&store, &result(3), 10).await;
    let there = async |names: &[Name]| {
        let mut there = Vec::new();
        for name in names {
            there.push(has(&store, name).await);
        }
        there
    };
    let all = [input(1), result(1), result(2), result(3), job(1), job(2)];
    assert_eq!(there(&all).await, [false, true, true, true, true, true], "records of jobs have caps of their own");
    let mut writer = store.writer(&result(4));
    blocking(move || writer.write_all(&noise(10, 1)).map(|()| writer.finish())).await.unwrap().unwrap();
    assert_eq!(there(&all).await, [false, true, false, true, true, true]);
    drop(store);
    place.config.max_objects = 1;
    let swept = place.open().await.sweep(SystemTime::now()).await;
    assert_eq!((swept.expired, swept.evicted), (0, 2));
}

async fn pinned_objects_are_neither_evicted_nor_expired(mut place: TestStore) {
    place.config.max_bytes = 1000;
    let store = place.open().await;
    let far = SystemTime::now() + 10_000 * HOUR;
    // Pins are counted, and may precede their object.
    let pins = [store.pin(&result(1)), store.pin(&result(1)), store.pin(&job(1))];
    for name in [result(1), result(2), job(1)] {
        put(&store, &name, 500).await;
    }
    assert_eq!(store.sweep(far).await.expired, 1);
    assert!(has(&store, &result(1)).await && !has(&store, &result(2)).await && has(&store, &job(1)).await);
    let [first, second, _third] = pins;
    drop(first);
    let refused = store.put(&result(3), noise(600, 1).into()).await;
    assert!(matches!(refused, Err(StoreError::Full { bytes: 600, held: 500, max_bytes: 1000 })), "{refused:?}");
    put(&store, &result(3), 500).await;
    // The unpinned object is evicted, although it is more recent.
    put(&store, &result(4), 500).await;
    assert!(has(&store, &result(1)).await && !has(&store, &result(3)).await);
    drop(second);
    put(&store, &result(5), 500).await;
    assert!(!has(&store, &result(1)).await);
    // Pinned objects can be deleted.
    store.delete(&job(1)).await.unwrap();
    assert!(!has(&store, &job(1)).await);
}

async fn small_results_are_cached_in_memory(mut place: TestStore) {
    place.config.memory_object_bytes = 1000;
    let store = place.open().await;
    for name in [result(1), result(2), input(1)] {
        put(&store, &name, 1000).await;
    }
    put(&store, &result(3), 1001).await;
    let store = place.open().await;
    assert_eq!(store.memory_held(), 0);
    // The first read is from disk.
    assert_eq!(get(&store, &result(1)).await, Some(noise(1000, 1)));
    assert!(store.memory_held() >= 1000);
    for name in [result(3), input(1)] {
        assert!(get(&store, &name).await.is_some());
    }
    for name in [result(1), result(2), result(3), input(1)] {
        place.remove_directly(&name);
    }
    // Further reads are from memory.
    let cached = store.get(&result(1)).now_or_never().expect("an immediate result").unwrap().unwrap();
    assert_eq!((cached.bytes.to_vec(), cached.meta.size), (noise(1000, 1), 1000));
    assert_eq!(part(&store, &result(1), Some(10..20)).await, Some((1000, noise(1000, 1)[10..20].to_vec())));
    // Large objects, inputs and objects that were not read are missing, and the index is corrected.
    for name in [result(2), result(3), input(1)] {
        assert_eq!(get(&store, &name).await, None, "{name}");
    }
    assert_eq!((store.usage(Folder::Results), store.usage(Folder::Inputs)), (usage(1000, 1), usage(0, 0)));
}

async fn memory_cache_is_bounded_and_drops_removed_objects(mut place: TestStore) {
    (place.config.memory_bytes, place.config.memory_object_bytes) = (20_000, 5000);
    let store = place.open().await;
    for i in 0..20 {
        put(&store, &result(i), 3000).await;
        assert!(store.memory_held() <= 20_000, "{}", store.memory_held());
    }
    assert!(store.memory_held() > 10_000, "{}", store.memory_held());
    for i in 0..20 {
        assert_eq!(get(&store, &result(i)).await, Some(noise(3000, 1)));
        assert!(store.memory_held() <= 20_000);
    }
    // Replaced objects give the new bytes; deleted and expired ones none.
    store.put(&result(19), noise(10, 7).into()).await.unwrap();
    assert_eq!(get(&store, &result(19)).await, Some(noise(10, 7)));
    let mut writer = store.writer(&result(19));
    blocking(move || writer.write_all(&noise(9 * MIB, 8)).map(|()| writer.finish())).await.unwrap().unwrap();
    assert_eq!(get(&store, &result(19)).await, Some(noise(9 * MIB, 8)));
    store.delete(&result(19)).await.unwrap();
    assert_eq!(get(&store, &result(19)).await, None);
    store.sweep(SystemTime::now() + 10_000 * HOUR).await;
    assert_eq!(store.memory_held(), 0);
    for i in 0..20 {
        assert_eq!(get(&store, &result(i)).await, None);
    }
}

async fn a_restart_finds_existing_objects(mut place: TestStore) {
    let store = place.open().await;
    for (i, name) in [result(1), result(2), result(3), input(1), job(1)].iter().enumerate() {
        put(&store, name, 100 + i).await;
    }
    let before = Folder::ALL.map(|f| store.usage(f));
    drop(store);
    if place.is_local() {
        // The second object is the oldest. Foreign files are neither counted nor removed.
        let old = std::fs::File::options().write(true).open(place.root().join(result(2).to_string())).unwrap();
        old.set_modified(SystemTime::now() - HOUR).unwrap();
        std::fs::write(place.root().join("results/notes.txt"), "notes").unwrap();
    }
    let store = place.open().await;
    assert_eq!(Folder::ALL.map(|f| store.usage(f)), before);
    assert_eq!(get(&store, &result(3)).await, Some(noise(102, 1)));
    // Objects of other processes are counted when they are first read.
    let other = place.open().await;
    put(&other, &input(2), 50).await;
    assert_eq!(get(&store, &input(2)).await, Some(noise(50, 1)));
    assert_eq!(store.usage(Folder::Inputs), usage(103 + 50, 2));
    place.config.max_bytes = 101 + 102 + 103 + 50 + 50;
    let store = place.open().await;
    let swept = store.sweep(SystemTime::now()).await;
    assert_eq!((swept.expired, swept.evicted), (0, 1));
    if place.is_local() {
        assert!(!has(&store, &result(2)).await && has(&store, &result(1)).await);
        assert_eq!(std::fs::read_to_string(place.root().join("results/notes.txt")).unwrap(), "notes");
    }
}

async fn a_cancelled_put_still_finishes(place: TestStore) {
    let store = place.open().await;
    for i in 0..8 {
        // Polled once and dropped, as when a client disconnects.
        let _dropped = store.put(&input(i), noise(1000, i).into()).now_or_never();
    }
    until("all objects", async || store.usage(Folder::Inputs) == usage(8000, 8)).await;
    for i in 0..8 {
        assert_eq!(get(&store, &input(i)).await, Some(noise(1000, i)));
    }
    let _dropped = store.delete(&input(0)).now_or_never();
    until("the deletion", async || store.usage(Folder::Inputs) == usage(7000, 7)).await;
    assert!(!has(&store, &input(0)).await);
}

async fn the_check_leaves_nothing(place: TestStore) {
    let store = place.open().await;
    store.check().await.unwrap();
    assert_eq!(Folder::ALL.map(|f| store.usage(f)), [usage(0, 0); 3]);
    assert_eq!(place.unfinished(), Vec::<String>::new());
    if place.is_local() {
        assert_eq!(std::fs::read_dir(place.root().join("check")).unwrap().count(), 0);
        std::fs::remove_dir_all(place.root()).unwrap();
        std::fs::write(place.root(), "in the way").unwrap();
        let message = store.check().await.unwrap_err().to_string();
        assert!(message.contains("check") && message.contains(store.location()), "{message}");
        assert!(store.put(&result(1), Bytes::from_static(b"x")).await.is_err());
        assert_eq!(store.usage(Folder::Results), usage(0, 0));
    }
}

#[tokio::test]
async fn staged_files_of_crashed_processes_are_removed() {
    let place = local();
    let store = place.open().await;
    put(&store, &result(1), 10).await;
    let (old, young) = (place.root().join("results/a.glb#1"), place.root().join(format!("{}#12", result(2))));
    let foreign = place.root().join("results/a#b");
    for path in [&old, &young, &foreign] {
        std::fs::write(path, "half").unwrap();
    }
    for path in [&old, &foreign] {
        let file = std::fs::File::options().write(true).open(path).unwrap();
        file.set_modified(SystemTime::now() - 2 * HOUR).unwrap();
    }
    assert_eq!(place.open().await.usage(Folder::Results), usage(10, 1));
    assert_eq!([&old, &young, &foreign].map(|p| p.exists()), [false, true, true]);
    // A later sweep removes files that were too recent at the start, but not every sweep searches.
    let now = SystemTime::now();
    assert_eq!(store.sweep(now + HOUR / 2).await.stale, 0);
    assert_eq!(store.sweep(now + 2 * HOUR).await.stale, 1);
    assert_eq!([&old, &young, &foreign].map(|p| p.exists()), [false, false, true]);
    assert!(has(&store, &result(1)).await);
}

#[tokio::test]
async fn uploads_of_crashed_processes_are_removed() {
    let place = s3();
    let store = place.open().await;
    let config = &place.config;
    let prefix = config.url.as_ref().unwrap().strip_prefix("s3://meshes/").unwrap();
    let bucket = AmazonS3Builder::new()
        .with_bucket_name("meshes")
        .with_endpoint(config.endpoint.as_ref().unwrap())
        .with_region("us-east-1")
        .with_allow_http(true)
        .with_access_key_id("any")
        .with_secret_access_key("any")
        .build()
        .unwrap();
    // One upload of this store, one of a foreign file, and one with a similar prefix.
    let elsewhere = format!("{prefix}-other/{}", result(1));
    for path in [format!("{prefix}/{}", result(1)), format!("{prefix}/results/notes.txt"), elsewhere.clone()] {
        let mut upload = bucket.put_multipart(&Path::from(path)).await.unwrap();
        upload.put_part(PutPayload::from_static(b"half")).await.unwrap();
    }
    assert_eq!(place.unfinished().len(), 2);
    drop(store);
    let _store = place.open().await;
    assert_eq!(place.unfinished(), [format!("{prefix}/results/notes.txt")]);
    let other = shared().send("GET", "/meshes?uploads");
    assert!(other.contains(&elsewhere), "{other}");
}

async fn refusal(config: &StoreConfig, data_dir: &std::path::Path) -> (&'static str, String) {
    let refused = Store::open(config, data_dir).await;
    let Err(StoreError::Open { key, location, reason }) = refused else { panic!("{refused:?}") };
    let message = StoreError::Open { key, location, reason }.to_string();
    assert!(message.contains(key), "{message}");
    (key, message)
}

#[tokio::test]
async fn errors_name_an_unusable_folder() {
    let dir = tempfile::tempdir().unwrap();
    let config = StoreConfig::default();
    // A file where the folder should be, at three depths.
    for (data_dir, file) in [("a", "a"), ("b", "b/store"), ("c", "c/store/results")] {
        let (data_dir, file) = (dir.path().join(data_dir), dir.path().join(file));
        std::fs::create_dir_all(file.parent().unwrap()).unwrap();
        std::fs::write(&file, "in the way").unwrap();
        let (key, message) = refusal(&config, &data_dir).await;
        assert_eq!(key, "server.data_dir");
        assert!(message.contains(&data_dir.join("store").display().to_string()), "{message}");
        std::fs::remove_file(&file).unwrap();
        Store::open(&config, &data_dir).await.unwrap();
    }
    // A read-only folder. The superuser can write there, so /sys is used instead.
    let closed = dir.path().join("closed");
    Store::open(&config, &closed).await.unwrap();
    let mut mode = std::fs::metadata(&closed).unwrap().permissions();
    mode.set_readonly(true);
    for folder in ["", "store", "store/check"] {
        std::fs::set_permissions(closed.join(folder), mode.clone()).unwrap();
    }
    let superuser = std::fs::write(closed.join("store/check/x"), "").is_ok();
    let closed = if superuser { std::path::PathBuf::from("/sys") } else { closed };
    let (_, message) = refusal(&config, &closed).await;
    assert!(message.contains(&closed.display().to_string()), "{message}");
}

#[tokio::test(flavor = "multi_thread")]
async fn errors_name_an_unusable_bucket_but_no_secret() {
    let service = Service::start(&["--guarded"]);
    let dir = tempfile::tempdir().unwrap();
    let good = service.config("here");
    // Control: the store opens with valid settings.
    let store = Store::open(&good, dir.path()).await.unwrap();
    store.put(&input(1), noise(9 * MIB, 1).into()).await.unwrap();
    assert_eq!(get(&store, &input(1)).await, Some(noise(9 * MIB, 1)));
    let secret = Secret::new("c2VjcmV0");
    for bad in [
        StoreConfig { url: Some("s3://nowhere".to_owned()), ..good.clone() },
        StoreConfig { secret_access_key: Some(secret.clone()), ..good.clone() },
        StoreConfig { access_key_id: Some("unknown".to_owned()), secret_access_key: Some(secret), ..good.clone() },
        StoreConfig { url: Some("http://meshes".to_owned()), ..good.clone() },
        StoreConfig { allow_http: false, ..good.clone() },
        StoreConfig { endpoint: Some("http://127.0.0.1:1".to_owned()), ..good.clone() },
    ] {
        let begun = Instant::now();
        let (key, message) = refusal(&bad, dir.path()).await;
        assert!(begun.elapsed() < Duration::from_secs(20), "{:?}: {message}", begun.elapsed());
        assert_eq!(key, "store.url");
        assert!(message.contains(bad.url.as_ref().unwrap()), "{message}");
        for shown in [message, format!("{bad:?}"), serde_json::to_string(&bad).unwrap()] {
            let secret = bad.secret_access_key.as_ref().unwrap().reveal();
            assert!(!shown.contains(secret), "{shown}");
        }
    }
    // No folder was created.
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 0);
    // If the service stops, operations fail and the usage is unchanged.
    drop(service);
    assert!(store.check().await.is_err());
    assert!(store.put(&input(2), Bytes::from_static(b"x")).await.is_err());
    assert_eq!(store.usage(Folder::Inputs), usage(9 * MIB, 1));
}

#[test]
fn metrics_report_stored_and_removed_objects() {
    let recorder = metrics_exporter_prometheus::PrometheusBuilder::new().build_recorder();
    // The recorder is local to this thread.
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    let value = |line: &str| {
        let text = recorder.handle().render();
        text.lines().find_map(|l| l.strip_prefix(line)?.trim().parse::<u64>().ok()).unwrap_or_default()
    };
    let requests =
        |tier: &str, found: &str| value(&format!("molmesh_cache_requests_total{{tier=\"{tier}\",result=\"{found}\"}}"));
    metrics::with_local_recorder(&recorder, || {
        runtime.block_on(async {
            let mut place = local();
            (place.config.memory_object_bytes, place.config.max_bytes) = (100, 1000);
            let store = place.open().await;
            assert_eq!(value("molmesh_store_bytes{folder=\"results\"}"), 0);
            for (name, bytes) in [(result(1), 100), (result(2), 101), (input(1), 50), (job(1), 7)] {
                put(&store, &name, bytes).await;
            }
            let held = ["results", "inputs", "jobs"].map(|folder| {
                (
                    value(&format!("molmesh_store_bytes{{folder=\"{folder}\"}}")),
                    value(&format!("molmesh_store_objects{{folder=\"{folder}\"}}")),
                )
            });
            assert_eq!(held, [(201, 2), (50, 1), (7, 1)]);
            // From memory, from disk, and missing. Inputs are not counted.
            for name in [result(1), result(2), result(3), input(1)] {
                let _found = get(&store, &name).await;
            }
            assert_eq!([requests("memory", "hit"), requests("memory", "miss")], [1, 2]);
            assert_eq!([requests("store", "hit"), requests("store", "miss")], [1, 1]);
            put(&store, &result(4), 1000).await;
            assert_eq!(value("molmesh_store_removed_total{reason=\"cap\"}"), 3);
            store.sweep(SystemTime::now() + 10_000 * HOUR).await;
            assert_eq!(value("molmesh_store_removed_total{reason=\"ttl\"}"), 2);
            assert_eq!(value("molmesh_store_objects{folder=\"results\"}"), 0);
            assert_eq!(value("molmesh_store_errors_total{op=\"check\"}"), 0);
            std::fs::remove_dir_all(place.root()).unwrap();
            std::fs::write(place.root(), "in the way").unwrap();
            assert!(store.check().await.is_err());
            assert_eq!(value("molmesh_store_errors_total{op=\"check\"}"), 1);
        });
    });
}

#[test]
fn errors_do_not_quote_secrets() {
    let load = |text: &str| {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), text).unwrap();
        molmesh::config::load(Some(file.path()), [], &[])
    };
    let message = load("[store]\nsecret_access_key = 8675309").unwrap_err().to_string();
    assert!(message.contains("store.secret_access_key") && !message.contains("8675309"), "{message}");
    // Control: other values are quoted.
    assert!(load("[store]\naccess_key_id = 8675309").unwrap_err().to_string().contains("8675309"));
    let config = load("[store]\nsecret_access_key = \"8675309\"\nallow_http = true").unwrap().config;
    assert_eq!(config.store.secret_access_key.as_ref().map(Secret::reveal), Some("8675309"));
    assert!(!format!("{config:?}").contains("8675309") && config.store.allow_http);
    let flag = |value: &str| molmesh::config::load(None, [], &[("store.allow_http".to_owned(), value.to_owned())]);
    assert!(flag("true").unwrap().config.store.allow_http && !flag("false").unwrap().config.store.allow_http);
    assert!(flag("maybe").unwrap_err().to_string().contains("true or false"));
}
