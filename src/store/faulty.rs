//! Disk with injected faults, for tests.

use std::io;
use std::ops::Range;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};

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
use super::{Folder, Store};
use crate::config::StoreConfig;

/// Injected faults.
#[derive(Debug, Default)]
pub(crate) struct Faults {
    /// Writes fail.
    pub(crate) full: AtomicBool,
    /// A removal ends `full`.
    pub(crate) frees: AtomicBool,
    /// Removals fail.
    pub(crate) stuck: AtomicBool,
    /// Folder whose operations hang; true if reads hang too.
    silent: Mutex<Option<(Folder, bool)>>,
    /// Number of reads of job documents.
    pub(crate) job_reads: AtomicUsize,
    /// Number of operations that hang.
    pub(crate) unanswered: AtomicUsize,
}

pub(crate) fn error(kind: io::ErrorKind) -> object_store::Error {
    object_store::Error::Generic { store: "Faulty", source: Box::new(io::Error::from(kind)) }
}

impl Faults {
    /// Makes all operations on this folder hang, and no others.
    pub(crate) fn silence(&self, folder: Option<Folder>) {
        self.unanswered.store(0, Ordering::SeqCst);
        *self.silent.lock().unwrap() = folder.map(|folder| (folder, true));
    }

    /// Makes only writes to this folder hang.
    pub(crate) fn seal(&self, folder: Folder) {
        self.unanswered.store(0, Ordering::SeqCst);
        *self.silent.lock().unwrap() = Some((folder, false));
    }

    fn check_silence(&self, at: &Path, reading: bool) -> Result<()> {
        let silent = *self.silent.lock().unwrap();
        if silent.is_some_and(|(folder, all)| at.as_ref().starts_with(folder.as_str()) && (all || !reading)) {
            self.unanswered.fetch_add(1, Ordering::SeqCst);
            return Err(error(io::ErrorKind::TimedOut));
        }
        Ok(())
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
        let space = self.1.check_space();
        Box::pin(async move {
            part.await?;
            space
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
        self.faults.check_silence(at, false)?;
        self.faults.check_space()?;
        self.files.put_opts(at, payload, options).await
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
        self.files.get_opts(at, options).await
    }

    async fn get_ranges(&self, at: &Path, ranges: &[Range<u64>]) -> Result<Vec<Bytes>> {
        self.files.get_ranges(at, ranges).await
    }

    fn delete_stream(&self, at: BoxStream<'static, Result<Path>>) -> BoxStream<'static, Result<Path>> {
        if self.faults.stuck.load(Ordering::Relaxed) {
            return at.map(|_| Err(error(io::ErrorKind::PermissionDenied))).boxed();
        }
        if self.faults.frees.load(Ordering::Relaxed) {
            self.faults.full.store(false, Ordering::Relaxed);
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

/// Opens a store with injected faults in a temporary folder. `max_bytes` is its capacity.
pub(crate) async fn faulty(max_bytes: u64) -> (TempDir, Arc<Faults>, Store) {
    let dir = tempfile::tempdir().unwrap();
    let (faults, store) = faulty_in(dir.path(), max_bytes).await;
    (dir, faults, store)
}

/// Opens a store with injected faults in the data folder `dir`.
pub(crate) async fn faulty_in(dir: &std::path::Path, max_bytes: u64) -> (Arc<Faults>, Store) {
    let config = StoreConfig { max_bytes, memory_object_bytes: 1, ..StoreConfig::default() };
    // Creates the folders.
    drop(Store::open(&config, dir).await.unwrap());
    let (root, faults) = (dir.join("store"), Arc::new(Faults::default()));
    let files = LocalFileSystem::new_with_prefix(&root).unwrap();
    let objects = Arc::new(Faulty { files, faults: Arc::clone(&faults) });
    let store = Store::open_backend(Backend::over(objects, root), &config).await.unwrap();
    (faults, store)
}
