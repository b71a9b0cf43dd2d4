//! Faults that no disk shows on demand: it is full, it does not let go. And that each error is sorted as it should be.

use std::io;
use std::ops::Range;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, SystemTime};

use bytes::Bytes;
use futures_util::StreamExt as _;
use futures_util::stream::BoxStream;
use object_store::local::LocalFileSystem;
use object_store::path::Path;
use object_store::{
    CopyOptions, GetOptions, GetResult, ListResult, MultipartUpload, ObjectMeta, ObjectStore, PutMultipartOptions,
    PutOptions, PutPayload, PutResult, Result, UploadPart,
};
use tempfile::TempDir;

use super::backend::Backend;
use super::{Folder, Name, Store, StoreError};
use crate::config::StoreConfig;

#[derive(Debug, Default)]
struct Faults {
    full: AtomicBool,
    stuck: AtomicBool,
}

fn error(kind: io::ErrorKind) -> object_store::Error {
    object_store::Error::Generic { store: "Faulty", source: Box::new(io::Error::from(kind)) }
}

impl Faults {
    fn room(&self) -> Result<()> {
        if self.full.load(Ordering::Relaxed) { Err(error(io::ErrorKind::StorageFull)) } else { Ok(()) }
    }
}

/// A folder on such a disk.
#[derive(Debug)]
struct Faulty {
    files: LocalFileSystem,
    faults: Arc<Faults>,
}

impl std::fmt::Display for Faulty {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Faulty")
    }
}

#[derive(Debug)]
struct FaultyUpload(Box<dyn MultipartUpload>, Arc<Faults>);

#[async_trait::async_trait]
impl MultipartUpload for FaultyUpload {
    fn put_part(&mut self, data: PutPayload) -> UploadPart {
        let part = self.0.put_part(data);
        let room = self.1.room();
        Box::pin(async move {
            part.await?;
            room
        })
    }

    async fn complete(&mut self) -> Result<PutResult> {
        self.0.complete().await
    }

    async fn abort(&mut self) -> Result<()> {
        self.0.abort().await
    }
}

#[async_trait::async_trait]
impl ObjectStore for Faulty {
    async fn put_opts(&self, at: &Path, payload: PutPayload, options: PutOptions) -> Result<PutResult> {
        self.faults.room()?;
        self.files.put_opts(at, payload, options).await
    }

    async fn put_multipart_opts(&self, at: &Path, options: PutMultipartOptions) -> Result<Box<dyn MultipartUpload>> {
        Ok(Box::new(FaultyUpload(self.files.put_multipart_opts(at, options).await?, Arc::clone(&self.faults))))
    }

    async fn get_opts(&self, at: &Path, options: GetOptions) -> Result<GetResult> {
        self.files.get_opts(at, options).await
    }

    async fn get_ranges(&self, at: &Path, ranges: &[Range<u64>]) -> Result<Vec<Bytes>> {
        self.files.get_ranges(at, ranges).await
    }

    fn delete_stream(&self, at: BoxStream<'static, Result<Path>>) -> BoxStream<'static, Result<Path>> {
        if self.faults.stuck.load(Ordering::Relaxed) {
            return at.map(|_| Err(error(io::ErrorKind::PermissionDenied))).boxed();
        }
        self.files.delete_stream(at)
    }

    fn list(&self, prefix: Option<&Path>) -> BoxStream<'static, Result<ObjectMeta>> {
        self.files.list(prefix)
    }

    async fn list_with_delimiter(&self, prefix: Option<&Path>) -> Result<ListResult> {
        self.files.list_with_delimiter(prefix).await
    }

    async fn copy_opts(&self, from: &Path, to: &Path, options: CopyOptions) -> Result<()> {
        self.files.copy_opts(from, to, options).await
    }
}

async fn faulty(max_bytes: u64) -> (TempDir, Arc<Faults>, Store) {
    let dir = tempfile::tempdir().unwrap();
    let config = StoreConfig { max_bytes, memory_object_bytes: 1, ..StoreConfig::default() };
    // Makes the folders.
    drop(Store::open(&config, dir.path()).await.unwrap());
    let (root, faults) = (dir.path().join("store"), Arc::new(Faults::default()));
    let files = LocalFileSystem::new_with_prefix(&root).unwrap();
    let objects = Arc::new(Faulty { files, faults: Arc::clone(&faults) });
    let store = Store::over(Backend::over(objects, root), &config).await.unwrap();
    (dir, faults, store)
}

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
async fn a_full_disk_is_named_and_nothing_is_lost() {
    let (dir, faults, store) = faulty(8 << 20).await;
    store.put(&name(1), body(1000)).await.unwrap();
    faults.full.store(true, Ordering::Relaxed);
    for refused in [store.put(&name(2), body(1000)).await, store.put_new(&name(2), body(9)).await.map(|_| ())] {
        let Err(StoreError::NoSpace { op: "put", place, .. }) = refused else { panic!("{refused:?}") };
        assert!(place.contains(&name(2).to_string()) && place.contains(store.place()), "{place}");
    }
    assert!(matches!(store.put(&name(1), body(1)).await, Err(StoreError::NoSpace { .. })));
    assert!(matches!(store.probe().await, Err(StoreError::NoSpace { op: "probe", .. })));
    for length in [None, Some(5 << 20)] {
        let mut writer = store.writer(&name(3), length);
        let write = move || {
            io::Write::write_all(&mut writer, &body(5 << 20))?;
            writer.finish().map_err(io::Error::from)
        };
        let refused = tokio::task::spawn_blocking(write).await.unwrap().unwrap_err();
        assert_eq!(refused.kind(), io::ErrorKind::StorageFull, "{refused}");
    }
    assert_eq!(store.get(&name(1)).await.unwrap().unwrap().bytes, body(1000));
    assert_eq!((store.usage(Folder::Results).bytes, files(&dir).len()), (1000, 1));
    // When there is room again, all of it is: no promise was forgotten.
    faults.full.store(false, Ordering::Relaxed);
    store.put(&name(4), body(8 << 20)).await.unwrap();
    assert_eq!((store.usage(Folder::Results).bytes, files(&dir).len()), (8 << 20, 1));
}

#[tokio::test]
async fn what_cannot_be_removed_stays_and_counts() {
    let (_dir, faults, store) = faulty(1000).await;
    store.put(&name(1), body(600)).await.unwrap();
    faults.stuck.store(true, Ordering::Relaxed);
    let far = SystemTime::now() + Duration::from_secs(1 << 30);
    let swept = store.sweep(far).await;
    assert_eq!((swept.expired, swept.bytes, swept.failed), (0, 0, 1));
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

#[test]
fn errors_are_sorted_by_what_is_to_be_done() {
    let of = |error: &object_store::Error| StoreError::sort("put", "here", error);
    for kind in [io::ErrorKind::StorageFull, io::ErrorKind::QuotaExceeded] {
        assert!(matches!(of(&error(kind)), StoreError::NoSpace { .. }), "{kind}");
    }
    for kind in [io::ErrorKind::PermissionDenied, io::ErrorKind::ReadOnlyFilesystem] {
        assert!(matches!(of(&error(kind)), StoreError::Denied { .. }), "{kind}");
    }
    assert!(matches!(of(&error(io::ErrorKind::TimedOut)), StoreError::Failed { .. }));
    // The system's own numbers: no space, not permitted, not allowed; and one that is none of these.
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
