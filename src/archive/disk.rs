//! Copies of entries on disk. Each is two files, `{middle}/{id}.body` and `{id}.json`, which says the body's length and
//! digest: whatever does not fit together, after a crash or a bad disk, is no copy. Everything here blocks.

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

use super::client::Validators;
use super::remote::Origin;
use crate::store::Digest;
use crate::structure::EntryId;
use crate::telemetry::ARCHIVE_KEPT;

/// Bytes of a description; validators are short.
const NOTE_BYTES: u64 = 64 << 10;
/// A staged file that is older was left by a process that died.
const ABANDONED: Duration = Duration::from_hours(1);

/// What is written beside a body.
#[derive(Debug, Serialize, Deserialize)]
struct Note {
    bytes: u64,
    sha256: String,
    url: String,
    etag: Option<String>,
    last_modified: Option<String>,
    /// When the archive last said that this is the entry, ms since 1970.
    checked_ms: u64,
}

/// A copy.
#[derive(Debug, Clone)]
pub(super) struct Stored {
    pub(super) bytes: Bytes,
    pub(super) digest: Digest,
    pub(super) origin: Origin,
    /// Time since the archive last said that this is the entry; none if the clock went backwards since.
    pub(super) age: Option<Duration>,
}

/// What there is of an entry.
#[derive(Debug)]
pub(super) enum Found {
    Nothing,
    /// Files that do not fit together; they are gone now.
    Corrupt,
    Copy(Stored),
}

#[derive(Debug)]
struct Slot {
    bytes: u64,
    used: SystemTime,
}

/// What is on disk: read once, then kept up to date.
#[derive(Debug, Default)]
struct Ledger {
    slots: HashMap<EntryId, Slot>,
    total: u64,
}

impl Ledger {
    fn put(&mut self, id: &EntryId, bytes: u64, used: SystemTime) {
        self.remove(id);
        self.slots.insert(id.clone(), Slot { bytes, used });
        self.total += bytes;
    }

    fn remove(&mut self, id: &EntryId) {
        self.total -= self.slots.remove(id).map_or(0, |slot| slot.bytes);
    }

    /// Those not used for longest, until nine tenths of `cap` are left: clearing up one by one would sort every time.
    fn surplus(&self, cap: u64) -> Vec<EntryId> {
        let mut over = self.total.saturating_sub(cap);
        if over > 0 {
            over = self.total - cap / 10 * 9;
        }
        let mut by_use: Vec<_> = self.slots.iter().map(|(id, slot)| (slot.used, id, slot.bytes)).collect();
        by_use.sort_unstable();
        let needed = by_use.into_iter().take_while(|(.., bytes)| {
            let more = over > 0;
            over = over.saturating_sub(*bytes);
            more
        });
        needed.map(|(_, id, _)| id.clone()).collect()
    }
}

/// The folder of copies.
#[derive(Debug)]
pub(super) struct Disk {
    dir: PathBuf,
    cap: u64,
    ledger: Mutex<Option<Ledger>>,
    staged: AtomicU64,
}

impl Disk {
    /// Copies in `dir`, which is made when the first is written, of `cap` bytes together.
    pub(super) fn new(dir: PathBuf, cap: u64) -> Self {
        Self { dir, cap, ledger: Mutex::new(None), staged: AtomicU64::new(0) }
    }

    fn path(&self, id: &EntryId, extension: &str) -> PathBuf {
        self.dir.join(id.middle()).join(format!("{id}.{extension}"))
    }

    /// The copy of an entry, if it is whole.
    pub(super) fn load(&self, id: &EntryId) -> io::Result<Found> {
        let note = match read(&self.path(id, "json"), NOTE_BYTES) {
            Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(Found::Nothing),
            note => note?,
        };
        let Some(stored) = self.stored(id, &note)? else {
            self.remove(id)?;
            return Ok(Found::Corrupt);
        };
        let now = SystemTime::now();
        // The order of use outlives the process where the file system lets it.
        if let Err(error) = File::options().append(true).open(self.path(id, "body")).and_then(|f| f.set_modified(now)) {
            tracing::debug!(%id, %error, "the use of a copy cannot be noted");
        }
        self.with_ledger(|ledger| ledger.put(id, stored.bytes.len() as u64, now));
        Ok(Found::Copy(stored))
    }

    fn stored(&self, id: &EntryId, note: &[u8]) -> io::Result<Option<Stored>> {
        let Ok(note) = serde_json::from_slice::<Note>(note) else { return Ok(None) };
        let Ok(digest) = note.sha256.parse::<Digest>() else { return Ok(None) };
        let body = match read(&self.path(id, "body"), note.bytes.min(self.cap)) {
            Err(e) if [io::ErrorKind::NotFound, io::ErrorKind::FileTooLarge].contains(&e.kind()) => return Ok(None),
            body => body?,
        };
        if body.len() as u64 != note.bytes || Digest::of(&body) != digest {
            return Ok(None);
        }
        let checked = SystemTime::UNIX_EPOCH + Duration::from_millis(note.checked_ms);
        let validators = Validators { etag: note.etag, last_modified: note.last_modified };
        let (bytes, origin) = (Bytes::from(body), Origin { url: note.url, validators });
        Ok(Some(Stored { bytes, digest, origin, age: SystemTime::now().duration_since(checked).ok() }))
    }

    /// Keeps an entry, and drops others where there is no room. One that is larger than all the room is not kept.
    pub(super) fn store(&self, id: &EntryId, bytes: &[u8], digest: &Digest, origin: &Origin) -> io::Result<()> {
        let n_bytes = bytes.len() as u64;
        if n_bytes > self.cap {
            return self.remove(id);
        }
        self.write(&self.path(id, "body"), bytes)?;
        self.note(id, n_bytes, digest, origin)?;
        let surplus = self.with_ledger(|ledger| {
            ledger.put(id, n_bytes, SystemTime::now());
            ledger.surplus(self.cap)
        });
        surplus.iter().try_for_each(|other| self.remove(other))
    }

    /// Notes that the archive has just said that a copy is still the entry.
    pub(super) fn note(&self, id: &EntryId, bytes: u64, digest: &Digest, origin: &Origin) -> io::Result<()> {
        let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
        let Validators { etag, last_modified } = origin.validators.clone();
        let note = Note {
            bytes,
            sha256: digest.to_string(),
            url: origin.url.clone(),
            etag,
            last_modified,
            checked_ms: u64::try_from(now.as_millis()).unwrap_or(u64::MAX),
        };
        self.write(&self.path(id, "json"), serde_json::to_string(&note)?.as_bytes())
    }

    /// Drops a copy.
    pub(super) fn remove(&self, id: &EntryId) -> io::Result<()> {
        self.with_ledger(|ledger| ledger.remove(id));
        // The note first: a body without one is nothing.
        for extension in ["json", "body"] {
            match fs::remove_file(self.path(id, extension)) {
                Err(e) if e.kind() != io::ErrorKind::NotFound => return Err(e),
                _ => {}
            }
        }
        Ok(())
    }

    /// Writes a file whole or not at all. No fsync: what a power cut leaves is noticed when it is read.
    fn write(&self, path: &Path, bytes: &[u8]) -> io::Result<()> {
        let folder = path.parent().unwrap_or(&self.dir);
        fs::create_dir_all(folder)?;
        let n = self.staged.fetch_add(1, Ordering::Relaxed);
        let staged = folder.join(format!(".{}-{n}.tmp", std::process::id()));
        let written = File::create(&staged).and_then(|mut file| file.write_all(bytes));
        let renamed = written.and_then(|()| fs::rename(&staged, path));
        if renamed.is_err() {
            // What cannot be removed either is removed by a later process.
            drop(fs::remove_file(&staged));
        }
        renamed
    }

    fn with_ledger<T>(&self, act: impl FnOnce(&mut Ledger) -> T) -> T {
        let mut ledger = self.ledger.lock().unwrap_or_else(PoisonError::into_inner);
        let ledger = ledger.get_or_insert_with(|| take_stock(&self.dir));
        let result = act(ledger);
        gauge!(ARCHIVE_KEPT).set(ledger.total as f64);
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

/// What earlier processes left, and away with what they left half done. What cannot be read is not there.
fn take_stock(dir: &Path) -> Ledger {
    let mut ledger = Ledger::default();
    let folders = fs::read_dir(dir).into_iter().flatten().flatten();
    for file in folders.filter_map(|folder| fs::read_dir(folder.path()).ok()).flatten().flatten() {
        let (path, Ok(data)) = (file.path(), file.metadata()) else { continue };
        let used = data.modified().unwrap_or(SystemTime::UNIX_EPOCH);
        let stem = path.file_stem().and_then(|stem| stem.to_str()).unwrap_or_default();
        match path.extension().and_then(|extension| extension.to_str()) {
            Some("body") => {
                if let Some(id) = stem.parse::<EntryId>().ok().filter(|id| id.as_str() == stem) {
                    ledger.put(&id, data.len(), used);
                }
            }
            Some("tmp") if used.elapsed().is_ok_and(|age| age > ABANDONED) => {
                if let Err(error) = fs::remove_file(&path) {
                    tracing::debug!(%error, "a file that was left behind cannot be removed");
                }
            }
            _ => {}
        }
    }
    ledger
}
