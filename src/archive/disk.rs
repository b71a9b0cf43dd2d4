//! Copies of entries on disk: two files each, `{middle}/{id}.body` and `{id}.json` with the length and digest of the
//! body. Files that do not match, after a crash or a disk error, are discarded. All functions block.

use std::collections::HashMap;
use std::fs::{self, File};
use std::io::{self, Read as _, Write as _};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, SystemTime};

use bytes::Bytes;
use metrics::gauge;
use serde::{Deserialize, Serialize};

use super::client::Origin;
use crate::memory_budget::MemoryReservation;
use crate::store::Digest;
use crate::structure::EntryId;
use crate::surface::OutOfMemory;
use crate::telemetry::ARCHIVE_KEPT;

/// Maximum size of the metadata, bytes; validators are short.
const METADATA_BYTES: u64 = 64 << 10;
/// Age after which a temporary file is assumed to be left over from a crashed process.
const STALE_TEMPORARY: Duration = Duration::from_hours(1);

/// Metadata of a copy, stored beside the body.
#[derive(Debug, Serialize, Deserialize)]
struct Metadata {
    bytes: u64,
    sha256: String,
    #[serde(flatten)]
    origin: Origin,
    /// Time of the last confirmation by the archive, ms of Unix time.
    checked_ms: u64,
}

/// Copy of an entry.
#[derive(Debug, Clone)]
pub(super) struct Stored {
    pub(super) bytes: Bytes,
    pub(super) digest: Digest,
    pub(super) origin: Origin,
    /// Time since the last confirmation by the archive; `None` if the clock was set back since.
    pub(super) age: Option<Duration>,
}

/// Result of a look-up.
#[derive(Debug)]
pub(super) enum Found {
    Nothing,
    /// The files did not match and were removed.
    Corrupt,
    Copy(Stored),
    /// No memory is available for the copy now.
    Refused(OutOfMemory),
}

/// Size and last use of a copy.
#[derive(Debug)]
struct IndexEntry {
    bytes: u64,
    used: SystemTime,
}

/// Index of the copies on disk, read once and then updated.
#[derive(Debug, Default)]
struct CopyIndex {
    entries: HashMap<EntryId, IndexEntry>,
    total: u64,
}

impl CopyIndex {
    fn put(&mut self, id: &EntryId, bytes: u64, used: SystemTime) {
        self.remove(id);
        self.entries.insert(id.clone(), IndexEntry { bytes, used });
        self.total += bytes;
    }

    fn remove(&mut self, id: &EntryId) {
        self.total -= self.entries.remove(id).map_or(0, |entry| entry.bytes);
    }

    /// Returns the least recently used copies to evict if the total exceeds `cap`. Evicts down to nine tenths of `cap`,
    /// so that not every insertion sorts.
    fn to_evict(&self, cap: u64) -> Vec<EntryId> {
        let mut over = self.total.saturating_sub(cap);
        if over > 0 {
            over = self.total - cap / 10 * 9;
        }
        let mut by_use: Vec<_> = self.entries.iter().map(|(id, entry)| (entry.used, id, entry.bytes)).collect();
        by_use.sort_unstable();
        let needed = by_use.into_iter().take_while(|(.., bytes)| {
            let more = over > 0;
            over = over.saturating_sub(*bytes);
            more
        });
        needed.map(|(_, id, _)| id.clone()).collect()
    }
}

/// Folder of copies.
#[derive(Debug)]
pub(super) struct Disk {
    dir: PathBuf,
    cap: u64,
    index: Mutex<Option<CopyIndex>>,
    n_temporary: AtomicU64,
}

impl Disk {
    /// Creates a store of at most `cap` bytes in `dir`. The first write creates the folder.
    pub(super) fn new(dir: PathBuf, cap: u64) -> Self {
        Self { dir, cap, index: Mutex::new(None), n_temporary: AtomicU64::new(0) }
    }

    fn path(&self, id: &EntryId, extension: &str) -> PathBuf {
        self.dir.join(id.middle()).join(format!("{id}.{extension}"))
    }

    /// Loads and verifies the copy of an entry. Its bytes hold `reservation`, which is charged first.
    pub(super) fn load(&self, id: &EntryId, reservation: MemoryReservation) -> io::Result<Found> {
        let metadata = match read(&self.path(id, "json"), METADATA_BYTES) {
            Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(Found::Nothing),
            metadata => metadata?,
        };
        let metadata = serde_json::from_slice::<Metadata>(&metadata).ok();
        if let Some(Err(error)) = metadata.as_ref().map(|metadata| reservation.grow(metadata.bytes.min(self.cap))) {
            return Ok(Found::Refused(error));
        }
        let Some(stored) = self.stored(id, metadata, reservation)? else {
            self.remove(id)?;
            return Ok(Found::Corrupt);
        };
        let now = SystemTime::now();
        // The modification time preserves the order of use across restarts.
        if let Err(error) = File::options().append(true).open(self.path(id, "body")).and_then(|f| f.set_modified(now)) {
            tracing::debug!(%id, %error, "the modification time of a copy cannot be set");
        }
        self.with_index(|index| index.put(id, stored.bytes.len() as u64, now));
        Ok(Found::Copy(stored))
    }

    fn stored(
        &self,
        id: &EntryId,
        metadata: Option<Metadata>,
        reservation: MemoryReservation,
    ) -> io::Result<Option<Stored>> {
        let Some(metadata) = metadata else { return Ok(None) };
        let Ok(digest) = metadata.sha256.parse::<Digest>() else { return Ok(None) };
        let body = match read(&self.path(id, "body"), metadata.bytes.min(self.cap)) {
            Err(e) if [io::ErrorKind::NotFound, io::ErrorKind::FileTooLarge].contains(&e.kind()) => return Ok(None),
            body => body?,
        };
        if body.len() as u64 != metadata.bytes || Digest::of(&body) != digest {
            return Ok(None);
        }
        let checked = SystemTime::UNIX_EPOCH + Duration::from_millis(metadata.checked_ms);
        let age = SystemTime::now().duration_since(checked).ok();
        Ok(Some(Stored { bytes: reservation.attach(body), digest, origin: metadata.origin, age }))
    }

    /// Stores an entry and evicts others if necessary. An entry larger than the capacity is not stored.
    pub(super) fn store(&self, id: &EntryId, bytes: &[u8], digest: &Digest, origin: &Origin) -> io::Result<()> {
        let n_bytes = bytes.len() as u64;
        if n_bytes > self.cap {
            return self.remove(id);
        }
        self.write(&self.path(id, "body"), bytes)?;
        self.confirm(id, n_bytes, digest, origin)?;
        let evicted = self.with_index(|index| {
            index.put(id, n_bytes, SystemTime::now());
            index.to_evict(self.cap)
        });
        evicted.iter().try_for_each(|other| self.remove(other))
    }

    /// Writes the metadata of a copy that the archive has just sent or confirmed.
    pub(super) fn confirm(&self, id: &EntryId, bytes: u64, digest: &Digest, origin: &Origin) -> io::Result<()> {
        let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
        let metadata = Metadata {
            bytes,
            sha256: digest.to_string(),
            origin: origin.clone(),
            checked_ms: u64::try_from(now.as_millis()).unwrap_or(u64::MAX),
        };
        self.write(&self.path(id, "json"), serde_json::to_string(&metadata)?.as_bytes())
    }

    /// Removes a copy.
    pub(super) fn remove(&self, id: &EntryId) -> io::Result<()> {
        self.with_index(|index| index.remove(id));
        // Metadata first: a body without metadata is ignored.
        for extension in ["json", "body"] {
            match fs::remove_file(self.path(id, extension)) {
                Err(e) if e.kind() != io::ErrorKind::NotFound => return Err(e),
                _ => {}
            }
        }
        Ok(())
    }

    /// Writes a file atomically. Without fsync: damage by a power failure is detected on reading.
    fn write(&self, path: &Path, bytes: &[u8]) -> io::Result<()> {
        let folder = path.parent().unwrap_or(&self.dir);
        fs::create_dir_all(folder)?;
        let n = self.n_temporary.fetch_add(1, Ordering::Relaxed);
        let temporary = folder.join(format!(".{}-{n}.tmp", std::process::id()));
        let written = File::create(&temporary).and_then(|mut file| file.write_all(bytes));
        let renamed = written.and_then(|()| fs::rename(&temporary, path));
        if renamed.is_err() {
            // A later process removes the file if this fails.
            drop(fs::remove_file(&temporary));
        }
        renamed
    }

    fn with_index<T>(&self, act: impl FnOnce(&mut CopyIndex) -> T) -> T {
        let mut index = self.index.lock().unwrap_or_else(PoisonError::into_inner);
        let index = index.get_or_insert_with(|| scan(&self.dir));
        let result = act(index);
        gauge!(ARCHIVE_KEPT).set(index.total as f64);
        result
    }
}

/// Reads a file of at most `limit` bytes.
fn read(path: &Path, limit: u64) -> io::Result<Vec<u8>> {
    let file = File::open(path)?;
    let length = file.metadata()?.len();
    let mut bytes = Vec::with_capacity(usize::try_from(length.min(limit)).unwrap_or(0));
    file.take(limit.saturating_add(1)).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > limit { Err(io::ErrorKind::FileTooLarge.into()) } else { Ok(bytes) }
}

/// Indexes the copies of earlier processes and removes their temporary files. Skips unreadable files.
fn scan(dir: &Path) -> CopyIndex {
    let mut index = CopyIndex::default();
    let folders = fs::read_dir(dir).into_iter().flatten().flatten();
    for file in folders.filter_map(|folder| fs::read_dir(folder.path()).ok()).flatten().flatten() {
        let (path, Ok(data)) = (file.path(), file.metadata()) else { continue };
        let used = data.modified().unwrap_or(SystemTime::UNIX_EPOCH);
        let stem = path.file_stem().and_then(|stem| stem.to_str()).unwrap_or_default();
        match path.extension().and_then(|extension| extension.to_str()) {
            Some("body") => {
                if let Some(id) = stem.parse::<EntryId>().ok().filter(|id| id.as_str() == stem) {
                    index.put(&id, data.len(), used);
                }
            }
            Some("tmp") if used.elapsed().is_ok_and(|age| age > STALE_TEMPORARY) => {
                if let Err(error) = fs::remove_file(&path) {
                    tracing::debug!(%error, "a stale temporary file cannot be removed");
                }
            }
            _ => {}
        }
    }
    index
}
