//! Storage backend: a folder or S3. Classifies and counts errors.

use std::future::Future;
use std::io;
use std::path::{Path as FilePath, PathBuf};
use std::sync::{Arc, OnceLock};
use std::time::{Duration, SystemTime};

use bytes::Bytes;
use futures_util::TryStreamExt as _;
use metrics::counter;
use object_store::local::LocalFileSystem;
use object_store::path::Path;
use object_store::{GetOptions, GetRange, GetResult, ObjectMeta, ObjectStore, ObjectStoreExt as _, PutMode, Result};

use super::error::StoreError;
use super::lock::{create_folder, sync_folder};
use super::name::{Folder, Name};
use super::object::{Meta, Stored};
use super::quarantine::QUARANTINE;
use super::s3::{self, Bucket};
use super::secret::{self, Secret};
use super::stale;
use crate::config::StoreConfig;
use crate::sync::{spawn_blocking, timeout};
use crate::telemetry::STORE_ERRORS;

/// Size of a part of a large object on S3, bytes. S3 requires at least 5 MiB and accepts 10,000 parts: 80 GB.
const S3_PART: usize = 8 << 20;
/// Size of a write to a file, bytes: large enough to make waking a thread worthwhile.
const FILE_PART: usize = 1 << 20;
/// Folder of the objects of [`Backend::check`].
pub(super) const CHECK: &str = "check";

/// URL prefix of a folder.
const FOLDER_URL: &str = "file://";

/// Returns the folder of a store in `data_dir`.
fn folder_of(data_dir: &FilePath) -> PathBuf {
    data_dir.join("store")
}

/// Returns the target of the folder of a store in `data_dir`, if the folder is a symbolic link.
#[must_use]
pub fn link_of(data_dir: &FilePath) -> Option<PathBuf> {
    std::fs::read_link(folder_of(data_dir)).ok()
}

enum StorageKind {
    Local(PathBuf),
    S3(Bucket),
}

/// Folder or bucket that holds the objects.
pub(super) struct Backend {
    objects: Arc<dyn ObjectStore>,
    kind: StorageKind,
    /// Folder, or URL without credentials, for messages.
    location: String,
    /// Configuration key of the location.
    key: &'static str,
    /// Secret of the folder once it is known. A folder without it is another one, such as that below a lost mount.
    secret: OnceLock<Secret>,
    /// Time limit of an operation of a folder. The client of S3 has time limits of its own.
    limit: Duration,
}

impl Backend {
    /// Opens the configured store. The default is a folder in `data_dir`.
    pub(super) async fn open(config: &StoreConfig, data_dir: &FilePath) -> Result<Self, StoreError> {
        let limit = Duration::from_millis(config.timeout_ms);
        let shared = config.url.as_deref().and_then(|url| url.strip_prefix(FOLDER_URL));
        if let Some(url) = config.url.as_ref().filter(|_| shared.is_none()) {
            let failed = |reason| StoreError::Open { key: "store.url", location: url.clone(), reason };
            let (objects, bucket) = s3::connect(config, url).map_err(failed)?;
            let location = url.trim_end_matches('/').to_owned();
            return Ok(Self::new(objects, StorageKind::S3(bucket), "store.url", location, limit));
        }
        let root = shared.map_or_else(|| folder_of(data_dir), PathBuf::from);
        let key = if shared.is_some() { "store.url" } else { "server.data_dir" };
        if let Some(target) = link_of(data_dir).filter(|_| shared.is_none()) {
            let (store, target) = (root.display(), target.display());
            tracing::warn!(%store, %target, "the folder of the store is a symbolic link; objects are removed at its target");
        }
        let location = root.display().to_string();
        let folder = root.clone();
        let opened = spawn_blocking(move || {
            for name in Folder::ALL.map(Folder::as_str).into_iter().chain([CHECK, QUARANTINE]) {
                create_folder(&folder.join(name)).map_err(|e| e.to_string())?;
            }
            // An earlier process may have died between creating a folder and making it durable.
            for above in [Some(folder.as_path()), folder.parent()].into_iter().flatten() {
                sync_folder(above).map_err(|e| e.to_string())?;
            }
            LocalFileSystem::new_with_prefix(&folder).map(|files| files.with_fsync(true)).map_err(|e| e.to_string())
        });
        let opened = opened.await.unwrap_or_else(|e| Err(e.to_string()));
        let failed = |reason| StoreError::Open { key, location: location.clone(), reason };
        let objects = Arc::new(opened.map_err(failed)?);
        Ok(Self::new(objects, StorageKind::Local(root), key, location, limit))
    }

    fn new(
        objects: Arc<dyn ObjectStore>,
        kind: StorageKind,
        key: &'static str,
        location: String,
        limit: Duration,
    ) -> Self {
        Self { objects, kind, location, key, secret: OnceLock::new(), limit }
    }

    /// Creates a backend over a folder with injected behaviour, for tests.
    #[cfg(test)]
    pub(super) fn over(objects: Arc<dyn ObjectStore>, root: PathBuf, config: &StoreConfig) -> Self {
        let (location, limit) = (root.display().to_string(), Duration::from_millis(config.timeout_ms));
        Self::new(objects, StorageKind::Local(root), "server.data_dir", location, limit)
    }

    /// Returns the location, for messages.
    pub(super) fn location(&self) -> &str {
        &self.location
    }

    /// Converts an error to [`StoreError::Open`], with the configuration key of the location.
    pub(super) fn open_error(&self, error: &StoreError) -> StoreError {
        StoreError::Open { key: self.key, location: self.location.clone(), reason: error.to_string() }
    }

    pub(super) fn is_local(&self) -> bool {
        matches!(self.kind, StorageKind::Local(_))
    }

    /// Returns the size of a part of a large object, bytes.
    pub(super) fn part_size(&self) -> usize {
        if self.is_local() { FILE_PART } else { S3_PART }
    }

    pub(super) fn objects(&self) -> &Arc<dyn ObjectStore> {
        &self.objects
    }

    /// Runs an operation, in a folder for at most `store.timeout_ms`. A hanging one keeps its thread until the system
    /// answers.
    pub(super) async fn timed<T>(&self, work: impl Future<Output = Result<T>>) -> Result<T> {
        if !self.is_local() {
            return work.await;
        }
        let late = || format!("no answer within {} ms (store.timeout_ms)", self.limit.as_millis());
        let late = |_elapsed| Err(from_io(io::Error::new(io::ErrorKind::TimedOut, late())));
        timeout(self.limit, work).await.unwrap_or_else(late)
    }

    /// Runs a blocking operation in the folder, for at most `store.timeout_ms`. `None` on S3.
    async fn in_folder<T: Send + 'static>(
        &self,
        op: &'static str,
        at: &str,
        work: impl FnOnce(&FilePath) -> io::Result<T> + Send + 'static,
    ) -> Option<Result<T, StoreError>> {
        let StorageKind::Local(root) = &self.kind else { return None };
        let root = root.clone();
        let done = spawn_blocking(move || work(&root));
        let done = async { done.await.unwrap_or_else(|e| Err(e.into())).map_err(from_io) };
        Some(self.timed(done).await.map_err(|error| self.fail(op, at, &error)))
    }

    /// Classifies and counts an error. `at` is a path relative to the root of the store.
    pub(super) fn fail(&self, op: &'static str, at: &str, error: &(dyn std::error::Error + 'static)) -> StoreError {
        counter!(STORE_ERRORS, "op" => op).increment(1);
        StoreError::classify(op, &format!("{}/{at}", self.location), error)
    }

    /// Returns a function that classifies and counts an error of the object `name`.
    pub(super) fn fail_at<'a>(
        &'a self,
        op: &'static str,
        name: &'a Name,
    ) -> impl Fn(object_store::Error) -> StoreError + 'a {
        move |error| self.fail(op, &name.to_string(), &error)
    }

    /// Writes an object. With `new`, returns false and changes nothing if the object exists.
    pub(super) async fn put(&self, name: &Name, bytes: Bytes, new: bool) -> Result<bool, StoreError> {
        self.check_folder().await?;
        let mode = if new { PutMode::Create } else { PutMode::Overwrite };
        match self.timed(self.objects.put_opts(&name.path(), bytes.into(), mode.into())).await {
            Ok(_) => Ok(true),
            Err(object_store::Error::AlreadyExists { .. }) if new => Ok(false),
            Err(e) => Err(self.fail_at("put", name)(e)),
        }
    }

    /// Starts reading an object, or a range within it.
    pub(super) async fn get(
        &self,
        name: &Name,
        range: Option<std::ops::Range<u64>>,
    ) -> Result<Option<GetResult>, StoreError> {
        let options = GetOptions { range: range.map(GetRange::Bounded), ..GetOptions::default() };
        let read = found(self.timed(self.objects.get_opts(&name.path(), options)).await);
        self.or_missing(read.map_err(self.fail_at("get", name))?).await
    }

    /// Returns what was found. Fails if nothing was found because the folder of the store is missing.
    async fn or_missing<T>(&self, found: Option<T>) -> Result<Option<T>, StoreError> {
        if found.is_none() {
            self.check_folder().await?;
        }
        Ok(found)
    }

    /// Reads all bytes of an object.
    pub(super) async fn get_whole(&self, name: &Name) -> Result<Option<Stored>, StoreError> {
        let Some(read) = self.get(name, None).await? else { return Ok(None) };
        let meta = Meta::from(&read.meta);
        let bytes = self.timed(read.bytes()).await.map_err(self.fail_at("get", name))?;
        self.check_length(name, &bytes, meta.size)?;
        Ok(Some(Stored { bytes, meta }))
    }

    /// Reads a range of an object. Keeps no file open.
    pub(super) async fn piece(&self, name: &Name, range: std::ops::Range<u64>) -> Result<Bytes, StoreError> {
        let length = range.end - range.start;
        let (path, ranges) = (name.path(), [range]);
        let read = self.timed(self.objects.get_ranges(&path, &ranges)).await;
        let bytes = read.map_err(self.fail_at("read", name))?.into_iter().next().unwrap_or_default();
        self.check_length(name, &bytes, length)?;
        Ok(bytes)
    }

    /// Rejects a read that returned fewer bytes than expected.
    fn check_length(&self, name: &Name, bytes: &Bytes, expected: u64) -> Result<(), StoreError> {
        if bytes.len() as u64 == expected {
            return Ok(());
        }
        let short = format!("read {} of {expected} bytes", bytes.len());
        Err(self.fail("read", &name.to_string(), &io::Error::other(short)))
    }

    pub(super) async fn head(&self, name: &Name) -> Result<Option<Meta>, StoreError> {
        let found = found(self.timed(self.objects.head(&name.path())).await).map_err(self.fail_at("head", name))?;
        Ok(self.or_missing(found).await?.as_ref().map(Meta::from))
    }

    /// Removes an object. Succeeds if it does not exist.
    pub(super) async fn delete(&self, name: &Name) -> Result<(), StoreError> {
        found(self.timed(self.objects.delete(&name.path())).await).map_err(self.fail_at("delete", name)).map(|_| ())
    }

    /// Lists the objects of a folder in name order. Ignores files with other names.
    pub(super) async fn list(&self, folder: Folder) -> Result<Vec<(Name, Meta)>, StoreError> {
        self.check_folder().await?;
        let listed = self.objects.list(Some(&Path::from(folder.as_str())));
        let parsed = |meta: ObjectMeta| Some((Name::from_path(meta.location.as_ref())?, Meta::from(&meta)));
        let fail = |e| self.fail("list", folder.as_str(), &e);
        let mut names: Vec<_> =
            listed.try_filter_map(|meta| std::future::ready(Ok(parsed(meta)))).try_collect().await.map_err(fail)?;
        names.sort_by(|(a, _), (b, _)| a.cmp(b));
        Ok(names)
    }

    /// Reads the secret of the store, or creates it.
    pub(super) async fn secret(&self) -> Result<Secret, StoreError> {
        let outcome = match self.in_folder("secret", "secret", secret::in_folder).await {
            Some(outcome) => outcome,
            None => secret::in_bucket(self.objects.as_ref()).await.map_err(|e| self.fail("secret", "secret", &e)),
        };
        if let Ok(secret) = &outcome {
            self.secret.get_or_init(|| *secret);
        }
        outcome.map_err(|error| self.open_error(&error))
    }

    /// Checks that the folder of the store is still there: a write would create it again, and its objects would be lost
    /// when the right folder returns.
    pub(super) async fn check_folder(&self) -> Result<(), StoreError> {
        let Some(secret) = self.secret.get().copied() else { return Ok(()) };
        let found = self.in_folder("folder", "", move |root| secret::is_in_folder(root, &secret)).await;
        found.unwrap_or(Ok(()))
    }

    /// Returns the free bytes of the disk, 0 if unknown; `None` on S3.
    pub(super) async fn free_bytes(&self) -> Option<u64> {
        Some(self.in_folder("free", "", |root| Ok(free_bytes(root))).await?.unwrap_or(0))
    }

    /// Sets the modification times of objects to their last uses, which the next process reads. S3 has no such
    /// operation.
    pub(super) async fn save_uses(&self, uses: Vec<(Name, SystemTime)>) -> Result<(), StoreError> {
        let save = move |root: &FilePath| {
            for (name, used) in uses {
                match std::fs::File::open(root.join(name.to_string())).and_then(|file| file.set_modified(used)) {
                    Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
                    _ => {}
                }
            }
            Ok(())
        };
        self.in_folder("use", "", save).await.unwrap_or(Ok(()))
    }

    /// Removes leftovers of crashed processes: staged files, unfinished uploads, checks. Returns their number.
    pub(super) async fn clear_stale(&self, now: SystemTime) -> Result<u64, StoreError> {
        let fail = |e: object_store::Error| self.fail("clear", CHECK, &e);
        let listed = self.timed(self.objects.list(Some(&Path::from(CHECK))).try_collect());
        let checks: Vec<_> = listed.await.map_err(fail)?;
        let mut removed = 0;
        for check in checks.into_iter().filter(|check| stale::is_stale(check.last_modified.into(), now)) {
            found(self.timed(self.objects.delete(&check.location)).await).map_err(fail)?;
            removed += 1;
        }
        let unfinished = match &self.kind {
            StorageKind::Local(_) => self.in_folder("clear", "", move |root| stale::clear_files(root, now)).await,
            StorageKind::S3(bucket) => {
                Some(bucket.clear_uploads(now).await.map_err(|e| self.fail("clear", "", e.as_ref())))
            }
        };
        unfinished.unwrap_or(Ok(0)).map(|unfinished| removed + unfinished)
    }
}

#[cfg(target_os = "linux")]
fn free_bytes(folder: &FilePath) -> u64 {
    rustix::fs::statvfs(folder).map_or(0, |disk| disk.f_bavail.saturating_mul(disk.f_frsize))
}

#[cfg(not(target_os = "linux"))]
fn free_bytes(_: &FilePath) -> u64 {
    0
}

fn from_io(error: io::Error) -> object_store::Error {
    object_store::Error::Generic { store: "folder", source: Box::new(error) }
}

/// Converts a "not found" error to `None`.
fn found<T>(answer: Result<T>) -> Result<Option<T>> {
    match answer {
        Ok(found) => Ok(Some(found)),
        Err(object_store::Error::NotFound { .. }) => Ok(None),
        Err(e) => Err(e),
    }
}
