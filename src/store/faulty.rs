//! Disk with injected faults, for tests.

use std::io;
use std::ops::Range;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use bytes::Bytes;
use futures_util::StreamExt as _;
use futures_util::stream::BoxStream;
use object_store::local::LocalFileSystem;
use object_store::path::Path;
use object_store::{
    CopyOptions, GetOptions, GetResult, GetResultPayload, ListResult, MultipartUpload, ObjectMeta, ObjectStore,
    PutMode, PutMultipartOptions, PutOptions, PutPayload, PutResult, Result, UploadPart,
};
use tempfile::TempDir;

use super::backend::Backend;
use super::{Folder, Store, StoreError};
use crate::config::StoreConfig;

/// Result of a write that must create an object.
#[derive(Debug, Default, Clone, Copy)]
pub(crate) enum Creation {
    /// Succeeds unless the object exists.
    #[default]
    Conditional,
    /// Replaces the object if it exists.
    Replacing,
    /// Fails as if the object existed.
    Refused,
}

/// Injected faults.
#[derive(Debug, Default)]
pub(crate) struct Faults {
    /// Writes fail.
    pub(crate) full: AtomicBool,
    /// A removal ends `full`.
    pub(crate) frees: AtomicBool,
    /// Removals fail.
    pub(crate) stuck: AtomicBool,
    /// Folder whose operations time out; true if reads do too.
    silent: Mutex<Option<(Folder, bool)>>,
    /// Time that each operation takes, ms.
    pub(crate) slow_ms: AtomicU64,
    /// Operations never end.
    pub(crate) hang: AtomicBool,
    /// Every operation with a multiple of this number fails; none if 0.
    pub(crate) error_every: AtomicUsize,
    operations: AtomicUsize,
    /// Number of operations that failed because of `error_every`.
    pub(crate) errors: AtomicUsize,
    /// Result of writes that must create an object.
    creation: Creation,
    /// Reads return half of the bytes.
    pub(crate) truncate: AtomicBool,
    /// Number of reads of job records.
    pub(crate) job_reads: AtomicUsize,
    /// Number of reads of inputs.
    pub(crate) input_reads: AtomicUsize,
    /// Number of writes of results.
    pub(crate) result_writes: AtomicUsize,
    /// Number of operations that wait because of `slow_ms`, and the largest one so far.
    waiting: AtomicUsize,
    pub(crate) most_waiting: AtomicUsize,
    /// Number of operations that timed out.
    pub(crate) timed_out: AtomicUsize,
}

pub(crate) fn error(kind: io::ErrorKind) -> object_store::Error {
    object_store::Error::Generic { store: "Faulty", source: Box::new(io::Error::from(kind)) }
}

impl Faults {
    /// Makes all operations on this folder time out, and no others.
    pub(crate) fn silence(&self, folder: Option<Folder>) {
        self.timed_out.store(0, Ordering::SeqCst);
        *self.silent.lock().unwrap() = folder.map(|folder| (folder, true));
    }

    /// Makes only writes to this folder time out.
    pub(crate) fn seal(&self, folder: Folder) {
        self.timed_out.store(0, Ordering::SeqCst);
        *self.silent.lock().unwrap() = Some((folder, false));
    }

    fn check_silence(&self, at: &Path, reading: bool) -> Result<()> {
        let silent = *self.silent.lock().unwrap();
        if silent.is_some_and(|(folder, all)| at.as_ref().starts_with(folder.as_str()) && (all || !reading)) {
            self.timed_out.fetch_add(1, Ordering::SeqCst);
            return Err(error(io::ErrorKind::TimedOut));
        }
        Ok(())
    }

    /// Delays an operation, or makes it hang or fail.
    async fn delay(&self) -> Result<()> {
        let period = self.error_every.load(Ordering::SeqCst);
        if period > 0 && (self.operations.fetch_add(1, Ordering::SeqCst) + 1).is_multiple_of(period) {
            self.errors.fetch_add(1, Ordering::SeqCst);
            return Err(error(io::ErrorKind::ConnectionReset));
        }
        if self.hang.load(Ordering::SeqCst) {
            std::future::pending::<()>().await;
        }
        let slow = Duration::from_millis(self.slow_ms.load(Ordering::SeqCst));
        if !slow.is_zero() {
            self.most_waiting.fetch_max(self.waiting.fetch_add(1, Ordering::SeqCst) + 1, Ordering::SeqCst);
            tokio::time::sleep(slow).await;
            self.waiting.fetch_sub(1, Ordering::SeqCst);
        }
        Ok(())
    }

    fn shorten(&self, bytes: Bytes) -> Bytes {
        if self.truncate.load(Ordering::SeqCst) { bytes.slice(..bytes.len() / 2) } else { bytes }
    }

    fn check_space(&self) -> Result<()> {
        if self.full.load(Ordering::Relaxed) { Err(error(io::ErrorKind::StorageFull)) } else { Ok(()) }
    }
}

/// Object store on a disk with injected faults.
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
        let faults = Arc::clone(&self.1);
        Box::pin(async move {
            faults.delay().await?;
            part.await?;
            faults.check_space()
        })
    }

    async fn complete(&mut self) -> Result<PutResult> {
        self.1.delay().await?;
        self.0.complete().await
    }

    async fn abort(&mut self) -> Result<()> {
        self.0.abort().await
    }
}

#[async_trait::async_trait]
impl ObjectStore for Faulty {
    async fn put_opts(&self, at: &Path, payload: PutPayload, options: PutOptions) -> Result<PutResult> {
        self.faults.check_silence(at, false)?;
        self.faults.check_space()?;
        self.faults.delay().await?;
        if at.as_ref().starts_with(Folder::Results.as_str()) {
            self.faults.result_writes.fetch_add(1, Ordering::SeqCst);
        }
        match self.faults.creation {
            Creation::Replacing => self.files.put_opts(at, payload, PutMode::Overwrite.into()).await,
            Creation::Refused if options.mode == PutMode::Create => {
                let (path, source) = (at.to_string(), Box::new(io::Error::from(io::ErrorKind::AlreadyExists)));
                Err(object_store::Error::AlreadyExists { path, source })
            }
            Creation::Conditional | Creation::Refused => self.files.put_opts(at, payload, options).await,
        }
    }

    async fn put_multipart_opts(&self, at: &Path, options: PutMultipartOptions) -> Result<Box<dyn MultipartUpload>> {
        self.faults.check_silence(at, false)?;
        Ok(Box::new(FaultyUpload(self.files.put_multipart_opts(at, options).await?, Arc::clone(&self.faults))))
    }

    async fn get_opts(&self, at: &Path, options: GetOptions) -> Result<GetResult> {
        self.faults.check_silence(at, true)?;
        if !options.head && at.as_ref().starts_with(Folder::Jobs.as_str()) {
            self.faults.job_reads.fetch_add(1, Ordering::SeqCst);
        }
        if !options.head && at.as_ref().starts_with(Folder::Inputs.as_str()) {
            self.faults.input_reads.fetch_add(1, Ordering::SeqCst);
        }
        self.faults.delay().await?;
        let read = self.files.get_opts(at, options).await?;
        if !self.faults.truncate.load(Ordering::SeqCst) || read.range.is_empty() {
            return Ok(read);
        }
        let (meta, range, attributes, extensions) =
            (read.meta.clone(), read.range.clone(), read.attributes.clone(), read.extensions.clone());
        let bytes = self.faults.shorten(read.bytes().await?);
        let payload = GetResultPayload::Stream(futures_util::stream::iter([Ok(bytes)]).boxed());
        Ok(GetResult { payload, meta, range, attributes, extensions })
    }

    async fn get_ranges(&self, at: &Path, ranges: &[Range<u64>]) -> Result<Vec<Bytes>> {
        self.faults.delay().await?;
        let parts = self.files.get_ranges(at, ranges).await?;
        Ok(parts.into_iter().map(|bytes| self.faults.shorten(bytes)).collect())
    }

    fn delete_stream(&self, at: BoxStream<'static, Result<Path>>) -> BoxStream<'static, Result<Path>> {
        if self.faults.stuck.load(Ordering::Relaxed) {
            return at.map(|_| Err(error(io::ErrorKind::PermissionDenied))).boxed();
        }
        if self.faults.frees.load(Ordering::Relaxed) {
            self.faults.full.store(false, Ordering::Relaxed);
        }
        let faults = Arc::clone(&self.faults);
        let delayed = at.then(move |at| {
            let faults = Arc::clone(&faults);
            async move {
                faults.delay().await?;
                at
            }
        });
        self.files.delete_stream(delayed.boxed())
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

/// Opens a store with injected faults in a temporary folder. `max_bytes` is its capacity.
pub(crate) async fn faulty(max_bytes: u64) -> (TempDir, Arc<Faults>, Store) {
    let dir = tempfile::tempdir().unwrap();
    let (faults, store) = faulty_in(dir.path(), max_bytes).await;
    (dir, faults, store)
}

/// Opens a store with injected faults in the data folder `dir`.
pub(crate) async fn faulty_in(dir: &std::path::Path, max_bytes: u64) -> (Arc<Faults>, Store) {
    open_faulty(dir, StoreConfig { max_bytes, memory_object_bytes: 1, ..StoreConfig::default() }).await
}

/// Opens a store with injected faults and its own configuration in the data folder `dir`.
pub(crate) async fn open_faulty(dir: &std::path::Path, config: StoreConfig) -> (Arc<Faults>, Store) {
    // Creates the folders.
    drop(Store::open(&config, dir).await.unwrap());
    let (root, faults) = (dir.join("store"), Arc::new(Faults::default()));
    let files = LocalFileSystem::new_with_prefix(&root).unwrap();
    let objects = Arc::new(Faulty { files, faults: Arc::clone(&faults) });
    let store = Store::open_backend(Backend::over(objects, root, &config), &config, false).await.unwrap();
    (faults, store)
}

/// Returns the objects of the folder `dir`, which are created in this way.
pub(crate) fn objects_created(creation: Creation, dir: &std::path::Path) -> Arc<dyn ObjectStore> {
    let files = LocalFileSystem::new_with_prefix(dir).unwrap();
    Arc::new(Faulty { files, faults: Arc::new(Faults { creation, ..Faults::default() }) })
}

/// Opens a store in the folder `dir` whose objects are created in this way.
pub(crate) async fn open_creating(creation: Creation, dir: &std::path::Path) -> Result<Store, StoreError> {
    let (config, objects) = (StoreConfig::default(), objects_created(creation, dir));
    Store::open_backend(Backend::over(objects, dir.to_owned(), &config), &config, false).await
}
