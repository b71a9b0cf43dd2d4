//! Interleavings of writers, readers, pins, eviction and removal.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::SystemTime;

use bytes::Bytes;
use futures_util::stream::BoxStream;
use object_store::memory::InMemory;
use object_store::path::Path;
use object_store::{
    CopyOptions, GetOptions, GetResult, ListResult, MultipartUpload, ObjectMeta, ObjectStore, PutMultipartOptions,
    PutOptions, PutPayload, PutResult, Result,
};
use shuttle::future::{block_on, yield_now};

use super::backend::Backend;
use super::{Folder, Name, Store, StoreError};
use crate::config::StoreConfig;
use crate::sync::thread;

/// Number of schedules of a test.
const SCHEDULES: usize = 10_000;
/// Size of an object, bytes.
const SIZE: usize = 10;

/// Objects in memory; other tasks may run before and after each operation.
#[derive(Debug)]
struct Yielding(Arc<InMemory>);

impl std::fmt::Display for Yielding {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Yielding")
    }
}

#[async_trait::async_trait]
impl ObjectStore for Yielding {
    async fn put_opts(&self, at: &Path, payload: PutPayload, options: PutOptions) -> Result<PutResult> {
        yield_now().await;
        let put = self.0.put_opts(at, payload, options).await;
        yield_now().await;
        put
    }

    async fn put_multipart_opts(&self, at: &Path, options: PutMultipartOptions) -> Result<Box<dyn MultipartUpload>> {
        self.0.put_multipart_opts(at, options).await
    }

    async fn get_opts(&self, at: &Path, options: GetOptions) -> Result<GetResult> {
        yield_now().await;
        let got = self.0.get_opts(at, options).await;
        yield_now().await;
        got
    }

    fn delete_stream(&self, at: BoxStream<'static, Result<Path>>) -> BoxStream<'static, Result<Path>> {
        self.0.delete_stream(at)
    }

    fn list(&self, prefix: Option<&Path>) -> BoxStream<'static, Result<ObjectMeta>> {
        self.0.list(prefix)
    }

    async fn list_with_delimiter(&self, prefix: Option<&Path>) -> Result<ListResult> {
        self.0.list_with_delimiter(prefix).await
    }

    async fn copy_opts(&self, from: &Path, to: &Path, options: CopyOptions) -> Result<()> {
        self.0.copy_opts(from, to, options).await
    }
}

fn name(number: u8) -> Name {
    Name::result(&format!("{number:064x}"), "glb").unwrap()
}

async fn put(store: &Store, number: u8) -> std::result::Result<(), StoreError> {
    store.put(&name(number), Bytes::from(vec![number; SIZE])).await
}

/// Opens a store of `objects` objects of [`SIZE`] bytes. Caches nothing.
async fn open(objects: u64) -> Store {
    open_bytes(objects * SIZE as u64).await.0
}

/// Opens an empty store of `max_bytes`, and returns its objects as well. Caches nothing.
pub(crate) async fn open_bytes(max_bytes: u64) -> (Store, Arc<InMemory>) {
    let config = StoreConfig { max_bytes, memory_object_bytes: 1, ..StoreConfig::default() };
    let objects = Arc::new(InMemory::new());
    let backend = Backend::over(Arc::new(Yielding(Arc::clone(&objects))), PathBuf::from("/nonexistent"), &config);
    (Store::open_backend(backend, &config, false).await.unwrap(), objects)
}

/// Checks that the index agrees with the objects, and that no reservation is left.
async fn check(store: &Store, capacity: u64) {
    let listed = store.list(Folder::Results).await.unwrap();
    let usage = store.usage(Folder::Results);
    assert_eq!((usage.objects, usage.bytes), (listed.len() as u64, (listed.len() * SIZE) as u64));
    assert!(usage.objects <= capacity);
    for (name, _) in listed {
        store.delete(&name).await.unwrap();
    }
    for number in 0..u8::try_from(capacity).unwrap() {
        put(store, number).await.unwrap();
    }
    assert_eq!(store.usage(Folder::Results).objects, capacity);
}

#[test]
fn pinned_objects_stay_and_the_index_agrees_with_the_objects() {
    crate::sync::explore(
        || {
            let store = block_on(open(2));
            let start = |work: fn(Store)| {
                let store = store.clone();
                thread::spawn(move || work(store))
            };
            let threads = [
                start(|store| {
                    let pin = store.pin(&name(1));
                    block_on(put(&store, 1)).unwrap();
                    let found = block_on(store.get(&name(1))).unwrap();
                    assert_eq!(found.unwrap().bytes[..], [1; SIZE], "a pinned object was removed");
                    drop(pin);
                }),
                start(|store| {
                    (2..5).for_each(|number| block_on(put(&store, number)).unwrap());
                    block_on(store.delete(&name(3))).unwrap();
                }),
                start(|store| {
                    block_on(store.sweep(SystemTime::now()));
                    // Absent or whole.
                    let found = block_on(store.get(&name(2))).unwrap();
                    assert!(found.is_none_or(|stored| stored.bytes[..] == [2; SIZE]));
                }),
            ];
            for thread in threads {
                thread.join().unwrap();
            }
            block_on(check(&store, 2));
        },
        SCHEDULES,
    );
}

#[test]
fn a_store_full_of_pinned_objects_refuses_and_recovers() {
    crate::sync::explore(
        || {
            let store = block_on(open(1));
            let pin = store.pin(&name(1));
            block_on(put(&store, 1)).unwrap();
            let writer = thread::spawn({
                let store = store.clone();
                move || match block_on(put(&store, 2)) {
                    Ok(()) => true,
                    Err(StoreError::Full { .. }) => false,
                    Err(error) => panic!("{error}"),
                }
            });
            drop(pin);
            let written = writer.join().unwrap();
            assert_eq!(block_on(store.get(&name(2))).unwrap().is_some(), written);
            assert_ne!(block_on(store.get(&name(1))).unwrap().is_some(), written);
            block_on(check(&store, 1));
        },
        SCHEDULES,
    );
}
