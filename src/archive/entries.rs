//! The order in which an entry is looked for, and what is remembered of what was found.

use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use metrics::{counter, histogram};
use quick_cache::sync::Cache;
use tracing::Instrument as _;

use super::client::Answer;
use super::disk::{Disk, Found, Stored};
use super::error::FetchError;
use super::memory::Memory;
use super::remote::{Origin, Remote};
use crate::config::Config;
use crate::single_flight::SingleFlight;
use crate::store::Digest;
use crate::structure::{Archive as Folder, EntryId, Stamp};
use crate::telemetry::{ARCHIVE_FETCH, ARCHIVE_REQUESTS, TraceSpan};

/// Entries whose digests are remembered: more than a day's visitors ask for, in a few megabytes.
const REMEMBERED: usize = 16_384;

/// Where the bytes of an entry came from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Source {
    /// The local folder.
    Local,
    /// A copy of what the remote archive sent before.
    Cache,
    /// The remote archive, just now.
    Remote,
}

/// An entry's file, compressed or not.
#[derive(Debug, Clone)]
pub struct Entry {
    /// The bytes as they are kept or were sent.
    pub bytes: Bytes,
    /// Their name.
    pub digest: Digest,
    /// Where they came from.
    pub source: Source,
}

/// What is remembered of an entry.
#[derive(Debug, Clone)]
struct Known {
    digest: Digest,
    /// Which file of the folder it is; none if it is a copy, and the folder has none.
    stamp: Option<Stamp>,
    /// When the folder was last looked at.
    looked: Instant,
    /// Until when a copy is fresh; none if it does not age.
    fresh_until: Option<Instant>,
}

/// Entries by id. Clones share everything.
#[derive(Debug, Clone)]
pub struct Archive {
    shared: Arc<Shared>,
}

#[derive(Debug)]
struct Shared {
    folder: Folder,
    disk: Disk,
    remote: Option<Remote>,
    fetches: SingleFlight<EntryId, Result<Entry, FetchError>>,
    known: Cache<EntryId, Known>,
    /// Entries that no remote archive has, and until when that is believed.
    absent: Cache<EntryId, Instant>,
    check: Duration,
    fresh: Duration,
    absent_for: Duration,
}

impl Archive {
    /// The archive of a configuration. What a remote archive sends is counted by `memory` until the fetch is over. Nothing is
    /// read and nobody is asked before the first entry is wanted.
    #[must_use]
    pub fn new(config: &Config, memory: Arc<dyn Memory>) -> Self {
        let (archive, inflated) = (&config.archive, config.limits.inflated_bytes);
        let shared = Shared {
            folder: Folder::new(config.archive_dir()).with_max_bytes(inflated),
            disk: Disk::new(config.archive_cache_dir(), archive.cache_bytes),
            remote: Remote::new(archive, inflated, memory),
            fetches: SingleFlight::default(),
            known: Cache::new(REMEMBERED),
            absent: Cache::new(REMEMBERED),
            check: archive.check(),
            fresh: archive.fresh(),
            absent_for: archive.absent(),
        };
        Self { shared: Arc::new(shared) }
    }

    /// An entry's bytes, from wherever they are nearest. Waits for the remote archive for `archive.timeout_ms` an
    /// address at most. Must run on a tokio runtime with timers.
    ///
    /// # Errors
    /// Any [`FetchError`].
    pub async fn fetch(&self, id: &EntryId) -> Result<Entry, FetchError> {
        let (shared, wanted) = (Arc::clone(&self.shared), id.clone());
        // The fetch outlives its first caller, but is traced under that caller's request.
        let mut fetch = self.shared.fetches.run(id, move || {
            let span = TraceSpan::current();
            let find = async move { shared.find(&wanted).await };
            let find = async move {
                match span {
                    Some(span) => span.run(find).await,
                    None => find.await,
                }
            };
            find.in_current_span()
        });
        fetch.recv().await.unwrap_or(Err(FetchError::Internal("its fetch ended without a result")))
    }

    /// Asks every host of the remote archive for the head of one entry, each for `limit` at most: the host, and the status of its
    /// answer or why there is none. Empty where there is no remote archive. No copy is made.
    pub async fn reach(&self, id: &EntryId, limit: Duration) -> Vec<(String, Result<u16, String>)> {
        match &self.shared.remote {
            Some(remote) => remote.reach(id, limit).await,
            None => Vec::new(),
        }
    }

    /// The digest of an entry's bytes, without reading them where they are known and fresh.
    ///
    /// # Errors
    /// Any [`FetchError`].
    pub async fn digest(&self, id: &EntryId) -> Result<Digest, FetchError> {
        match self.known(id).await {
            Some(digest) => Ok(digest),
            None => Ok(self.fetch(id).await?.digest),
        }
    }

    /// The digest of an entry's bytes if it is known and fresh: no file is read, nobody is asked.
    pub async fn known(&self, id: &EntryId) -> Option<Digest> {
        let known = self.shared.known.get(id)?;
        if known.fresh_until.is_some_and(|end| Instant::now() >= end) {
            return None;
        }
        if known.looked.elapsed() >= self.shared.check {
            let (shared, wanted) = (Arc::clone(&self.shared), id.clone());
            let looked = Instant::now();
            let stamp = blocking(move || shared.folder.stamp(&wanted)).await.ok()?.ok()?;
            if stamp != known.stamp {
                return None;
            }
            self.shared.known.insert(id.clone(), Known { looked, ..known.clone() });
        }
        count(if known.stamp.is_some() { "local" } else { "cache" }, "known");
        Some(known.digest)
    }
}

impl Shared {
    async fn find(self: &Arc<Self>, id: &EntryId) -> Result<Entry, FetchError> {
        let looked = Instant::now();
        if let Some((bytes, digest, stamp)) = self.local(id).await? {
            self.remember(id, Known { digest, stamp: Some(stamp), looked, fresh_until: None });
            return Ok(Entry { bytes, digest, source: Source::Local });
        }
        let stored = self.stored(id).await?;
        let is_fresh = |stored: &Stored| stored.age.is_some_and(|age| age < self.fresh);
        let (remote, stored) = match (&self.remote, stored) {
            // Nobody can be asked, so it is as fresh as it gets.
            (None, Some(stored)) => return Ok(self.copy(id, stored, looked, None)),
            (Some(_), Some(stored)) if is_fresh(&stored) => {
                let left = self.fresh.saturating_sub(stored.age.unwrap_or_default());
                return Ok(self.copy(id, stored, looked, Some(left)));
            }
            (None, None) => return Err(FetchError::NotFound { id: id.clone() }),
            (Some(remote), stored) => (remote, stored),
        };
        if self.absent.get(id).is_some_and(|until| looked < until) {
            count("cache", "absent");
            return Err(FetchError::NotFound { id: id.clone() });
        }
        let answer = remote.fetch(id, stored.as_ref().map(|stored| &stored.origin)).await;
        let result = match &answer {
            Ok(Answer::Unchanged) => "unchanged",
            Ok(_) => "found",
            Err(FetchError::NotFound { .. }) => "absent",
            Err(FetchError::TooLarge { .. }) => "too-large",
            Err(FetchError::Memory { .. }) => "no-memory",
            Err(_) => "unavailable",
        };
        count("remote", result);
        histogram!(ARCHIVE_FETCH, "result" => result).record(looked.elapsed().as_secs_f64());
        match (answer, stored) {
            (Ok(Answer::Body { bytes, digest, url, validators, share }), _) => {
                tracing::info!(%id, url, bytes = bytes.len(), ms = looked.elapsed().as_millis(), "fetched an entry");
                let (origin, kept) = (Origin { url, validators }, bytes.clone());
                self.on_disk(id, "kept", move |disk, id| disk.store(id, &kept, &digest, &origin)).await;
                self.remember(id, Known { digest, stamp: None, looked, fresh_until: Some(looked + self.fresh) });
                // From here on whoever asked counts it.
                drop(share);
                Ok(Entry { bytes, digest, source: Source::Remote })
            }
            (Ok(Answer::Unchanged), Some(stored)) => {
                let (n_bytes, digest, origin) = (stored.bytes.len() as u64, stored.digest, stored.origin.clone());
                self.on_disk(id, "noted", move |disk, id| disk.note(id, n_bytes, &digest, &origin)).await;
                Ok(self.copy(id, stored, looked, Some(self.fresh)))
            }
            (Ok(_), _) => Err(FetchError::Internal("the archive says that a copy is unchanged which there is not")),
            (Err(error @ FetchError::NotFound { .. }), _) => {
                self.on_disk(id, "removed", Disk::remove).await;
                self.known.remove(id);
                self.absent.insert(id.clone(), looked + self.absent_for);
                Err(error)
            }
            (Err(error @ FetchError::Unavailable { .. }), Some(stored)) => {
                let age_s = stored.age.map(|age| age.as_secs());
                tracing::warn!(%id, %error, age_s, "a stale copy stands in for the archive");
                count("cache", "stale");
                Ok(Entry { bytes: stored.bytes, digest: stored.digest, source: Source::Cache })
            }
            (Err(error), _) => Err(error),
        }
    }

    /// The entry in the folder.
    async fn local(self: &Arc<Self>, id: &EntryId) -> Result<Option<(Bytes, Digest, Stamp)>, FetchError> {
        let (shared, wanted) = (Arc::clone(self), id.clone());
        let found = blocking(move || {
            let found = shared.folder.fetch_stamped(&wanted)?;
            Ok(found.map(|(bytes, stamp)| {
                let digest = Digest::of(&bytes);
                (Bytes::from(bytes), digest, stamp)
            }))
        });
        let found = found.await?;
        match &found {
            Ok(Some(_)) => count("local", "found"),
            Ok(None) => {}
            Err(_) => count("local", "failed"),
        }
        found.map_err(|error| FetchError::Local(Arc::new(error)))
    }

    /// The copy on disk, if there is one that is whole and can be read.
    async fn stored(self: &Arc<Self>, id: &EntryId) -> Result<Option<Stored>, FetchError> {
        let (shared, wanted) = (Arc::clone(self), id.clone());
        match blocking(move || shared.disk.load(&wanted)).await? {
            Ok(Found::Copy(stored)) => return Ok(Some(stored)),
            Ok(Found::Nothing) => {}
            Ok(Found::Corrupt) => {
                tracing::warn!(%id, "a copy on disk was damaged and is dropped");
                count("cache", "corrupt");
            }
            Err(error) => {
                tracing::warn!(%id, %error, "a copy on disk cannot be read");
                count("cache", "failed");
            }
        }
        Ok(None)
    }

    /// A copy as an entry, fresh for as long as `left`.
    fn copy(&self, id: &EntryId, stored: Stored, looked: Instant, left: Option<Duration>) -> Entry {
        count("cache", "found");
        let Stored { bytes, digest, .. } = stored;
        self.remember(id, Known { digest, stamp: None, looked, fresh_until: left.map(|left| looked + left) });
        Entry { bytes, digest, source: Source::Cache }
    }

    fn remember(&self, id: &EntryId, known: Known) {
        self.absent.remove(id);
        self.known.insert(id.clone(), known);
    }

    /// Changes a copy on disk. An entry that cannot be kept can still be used.
    async fn on_disk(
        self: &Arc<Self>,
        id: &EntryId,
        what: &'static str,
        act: impl FnOnce(&Disk, &EntryId) -> std::io::Result<()> + Send + 'static,
    ) {
        let (shared, wanted) = (Arc::clone(self), id.clone());
        if let Ok(Err(error)) = blocking(move || act(&shared.disk, &wanted)).await {
            tracing::warn!(%id, %error, "a copy could not be {what}");
            count("cache", "failed");
        }
    }
}

/// Runs `work` where it may block.
async fn blocking<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> Result<T, FetchError> {
    let ended = tokio::task::spawn_blocking(work).await;
    ended.map_err(|_panicked_or_stopped| FetchError::Internal("reading ended without a result"))
}

fn count(source: &'static str, result: &'static str) {
    counter!(ARCHIVE_REQUESTS, "source" => source, "result" => result).increment(1);
}
