//! Look-up of entries in the folder, the copies and the remote archive, and a cache of their digests.

use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use metrics::{counter, histogram};
use quick_cache::sync::Cache;
use tracing::Instrument as _;

use super::client::Answer;
use super::disk::{Disk, Found, Stored};
use super::error::FetchError;
use super::remote::Remote;
use crate::client_shares::{ClientShares, Place, ShareExceeded};
use crate::config::Config;
use crate::memory_budget::Budget;
use crate::single_flight::SingleFlight;
use crate::store::Digest;
use crate::structure::{Archive as Folder, EntryId, Stamp};
use crate::telemetry::{ARCHIVE_FETCH, ARCHIVE_REQUESTS, TraceSpan};

/// Number of entries whose digests are cached, in a few megabytes.
const CACHED_DIGESTS: usize = 16_384;

/// Source of an entry's bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Source {
    /// Local folder.
    Local,
    /// Copy of an earlier response of the remote archive.
    Cache,
    /// Remote archive.
    Remote,
}

/// File of an entry, compressed or not.
#[derive(Debug, Clone)]
pub struct Entry {
    /// Bytes as stored or received.
    pub bytes: Bytes,
    /// Digest of the bytes.
    pub digest: Digest,
    /// Source of the bytes.
    pub source: Source,
}

/// Cached facts about an entry.
#[derive(Debug, Clone)]
struct Known {
    digest: Digest,
    /// Stamp of the file in the folder; `None` for a copy of an entry that the folder does not have.
    stamp: Option<Stamp>,
    /// Time of the last check of the folder.
    checked: Instant,
    /// End of the freshness of a copy; `None` if it does not expire.
    fresh_until: Option<Instant>,
}

/// Entries by id. Clones share their state.
#[derive(Debug, Clone)]
pub struct Archive {
    shared: Arc<Shared>,
    /// Client whose share of `archive.concurrent` its fetches take; `None`: no share.
    client: Option<u64>,
}

#[derive(Debug)]
struct Shared {
    folder: Folder,
    disk: Disk,
    remote: Option<Remote>,
    shares: Arc<ClientShares>,
    timeout: Duration,
    fetches: SingleFlight<EntryId, Result<Entry, FetchError>>,
    known: Cache<EntryId, Known>,
    /// Entries that no remote archive has, each with the time until which it is not requested again.
    absent: Cache<EntryId, Instant>,
    check_interval: Duration,
    revalidate_after: Duration,
    retry_missing_after: Duration,
}

impl Archive {
    /// Creates the archive of a configuration. Running fetches are charged to `memory`. The first request starts all
    /// I/O.
    #[must_use]
    pub fn new(config: &Config, memory: Budget) -> Self {
        let (archive, inflated) = (&config.archive, config.limits.inflated_bytes);
        let shared = Shared {
            folder: Folder::new(config.archive_dir()).with_max_bytes(inflated),
            disk: Disk::new(config.archive_cache_dir(), archive.cache_bytes),
            remote: Remote::new(config, memory),
            shares: ClientShares::new(archive.concurrent, config.server.client_share),
            timeout: Duration::from_millis(archive.timeout_ms),
            fetches: SingleFlight::default(),
            known: Cache::new(CACHED_DIGESTS),
            absent: Cache::new(CACHED_DIGESTS),
            check_interval: Duration::from_millis(archive.local_check_interval_ms),
            revalidate_after: Duration::from_millis(archive.revalidate_after_ms),
            retry_missing_after: Duration::from_millis(archive.retry_missing_after_ms),
        };
        Self { shared: Arc::new(shared), client: None }
    }

    /// Returns the archive for a client, which may fetch its share of `archive.concurrent` entries at once.
    #[must_use]
    pub fn for_client(&self, client: u64) -> Self {
        Self { shared: Arc::clone(&self.shared), client: Some(client) }
    }

    /// Returns the bytes of an entry from the first source that has it. Waits at most `archive.timeout_ms`, half
    /// of it for a place in the share of the client. Must run on a tokio runtime with timers.
    ///
    /// # Errors
    /// Returns any [`FetchError`].
    pub async fn fetch(&self, id: &EntryId) -> Result<Entry, FetchError> {
        let start = tokio::time::Instant::now();
        let deadline = start + self.shared.timeout;
        let mut place = None;
        loop {
            match (self.run(id, &mut place, deadline).await, self.client) {
                // The share of this client, or of the first caller, is exceeded. Each caller waits for its own share,
                // so that no client waits for the requests of another one.
                (Err(FetchError::Share { .. }), Some(client)) if place.is_none() => {
                    // The other half of the time is for the fetch.
                    let taken = self.shared.shares.wait(client, start + self.shared.timeout / 2).await;
                    place = Some(taken.map_err(|ShareExceeded { limit }| FetchError::Share { id: id.clone(), limit })?);
                }
                // The fetch that this caller joined had no place either. Tries again.
                (Err(FetchError::Share { .. }), _) => {}
                (found, _) => return found,
            }
        }
    }

    /// Runs or joins the fetch of an entry. A new fetch takes `place`, or fails if it needs one and there is none.
    async fn run(
        &self,
        id: &EntryId,
        place: &mut Option<Place>,
        deadline: tokio::time::Instant,
    ) -> Result<Entry, FetchError> {
        let (shared, wanted, client) = (Arc::clone(&self.shared), id.clone(), self.client);
        // The fetch outlives its first caller, but is traced under that caller's request.
        let mut fetch = self.shared.fetches.run(id, || {
            let (span, place) = (TraceSpan::current(), place.take());
            let find = async move { shared.find(&wanted, client, place, deadline).await };
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

    /// Sends a HEAD request for one entry to every host of the remote archive, with a timeout of `limit` each. Returns
    /// the hosts with the status or the error; empty without a remote archive.
    pub async fn reach(&self, id: &EntryId, limit: Duration) -> Vec<(String, Result<u16, String>)> {
        match &self.shared.remote {
            Some(remote) => remote.reach(id, limit).await,
            None => Vec::new(),
        }
    }

    /// Returns the digest of an entry's bytes, without reading them if the digest is cached and fresh.
    ///
    /// # Errors
    /// Returns any [`FetchError`].
    pub async fn digest(&self, id: &EntryId) -> Result<Digest, FetchError> {
        match self.known(id).await {
            Some(digest) => Ok(digest),
            None => Ok(self.fetch(id).await?.digest),
        }
    }

    /// Returns the digest of an entry's bytes if it is cached and fresh. Reads no file and sends no request.
    pub async fn known(&self, id: &EntryId) -> Option<Digest> {
        let known = self.shared.known.get(id)?;
        if known.fresh_until.is_some_and(|end| Instant::now() >= end) {
            return None;
        }
        if known.checked.elapsed() >= self.shared.check_interval {
            let (shared, wanted) = (Arc::clone(&self.shared), id.clone());
            let checked = Instant::now();
            let stamp = blocking(move || shared.folder.stamp(&wanted)).await.ok()?.ok()?;
            if stamp != known.stamp {
                return None;
            }
            self.shared.known.insert(id.clone(), Known { checked, ..known.clone() });
        }
        count(if known.stamp.is_some() { "local" } else { "cache" }, "known");
        Some(known.digest)
    }
}

impl Shared {
    async fn find(
        self: &Arc<Self>,
        id: &EntryId,
        client: Option<u64>,
        place: Option<Place>,
        deadline: tokio::time::Instant,
    ) -> Result<Entry, FetchError> {
        let checked = Instant::now();
        if let Some((bytes, digest, stamp)) = self.local(id).await? {
            self.remember(id, Known { digest, stamp: Some(stamp), checked, fresh_until: None });
            return Ok(Entry { bytes, digest, source: Source::Local });
        }
        let stored = self.stored(id).await?;
        let is_fresh = |stored: &Stored| stored.age.is_some_and(|age| age < self.revalidate_after);
        let (remote, stored) = match (&self.remote, stored) {
            // Without a remote archive a copy does not expire.
            (None, Some(stored)) => return Ok(self.copy(id, stored, checked, None)),
            (Some(_), Some(stored)) if is_fresh(&stored) => {
                let left = self.revalidate_after.saturating_sub(stored.age.unwrap_or_default());
                return Ok(self.copy(id, stored, checked, Some(left)));
            }
            (None, None) => return Err(FetchError::NotFound { id: id.clone() }),
            (Some(remote), stored) => (remote, stored),
        };
        if self.absent.get(id).is_some_and(|until| checked < until) {
            count("cache", "absent");
            return Err(FetchError::NotFound { id: id.clone() });
        }
        let place = place.map_or_else(|| client.map(|client| self.shares.take(client)).transpose(), |p| Ok(Some(p)));
        let _place = place.map_err(|ShareExceeded { limit }| FetchError::Share { id: id.clone(), limit })?;
        let answer = remote.fetch(id, stored.as_ref().map(|stored| &stored.origin), deadline).await;
        let result = match &answer {
            Ok(Answer::Unchanged) => "unchanged",
            Ok(_) => "found",
            Err(FetchError::NotFound { .. }) => "absent",
            Err(FetchError::TooLarge { .. }) => "too-large",
            Err(FetchError::Memory { .. }) => "no-memory",
            Err(_) => "unavailable",
        };
        count("remote", result);
        histogram!(ARCHIVE_FETCH, "result" => result).record(checked.elapsed().as_secs_f64());
        match (answer, stored) {
            (Ok(Answer::Body { bytes, digest, origin, lease }), _) => {
                let ms = checked.elapsed().as_millis();
                tracing::info!(%id, url = origin.url, bytes = bytes.len(), ms, "fetched an entry");
                let kept = bytes.clone();
                self.on_disk(id, "stored", move |disk, id| disk.store(id, &kept, &digest, &origin)).await;
                self.remember(
                    id,
                    Known { digest, stamp: None, checked, fresh_until: Some(checked + self.revalidate_after) },
                );
                // From here on the caller accounts for the memory.
                drop(lease);
                Ok(Entry { bytes, digest, source: Source::Remote })
            }
            (Ok(Answer::Unchanged), Some(stored)) => {
                let (n_bytes, digest, origin) = (stored.bytes.len() as u64, stored.digest, stored.origin.clone());
                self.on_disk(id, "confirmed", move |disk, id| disk.confirm(id, n_bytes, &digest, &origin)).await;
                Ok(self.copy(id, stored, checked, Some(self.revalidate_after)))
            }
            (Ok(_), _) => Err(FetchError::Internal("the archive answered `304 Not Modified` without a copy")),
            (Err(error @ FetchError::NotFound { .. }), _) => {
                self.on_disk(id, "removed", Disk::remove).await;
                self.known.remove(id);
                self.absent.insert(id.clone(), checked + self.retry_missing_after);
                Err(error)
            }
            (Err(error @ FetchError::Unavailable { .. }), Some(stored)) => {
                let age_s = stored.age.map(|age| age.as_secs());
                tracing::warn!(%id, %error, age_s, "a stale copy is used because the archive is unavailable");
                count("cache", "stale");
                Ok(Entry { bytes: stored.bytes, digest: stored.digest, source: Source::Cache })
            }
            (Err(error), _) => Err(error),
        }
    }

    /// Reads the entry from the folder.
    async fn local(self: &Arc<Self>, id: &EntryId) -> Result<Option<(Bytes, Digest, Stamp)>, FetchError> {
        let (shared, wanted) = (Arc::clone(self), id.clone());
        let found = blocking(move || {
            let found = shared.folder.fetch(&wanted)?;
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

    /// Reads the copy on disk. Treats damaged and unreadable copies as missing.
    async fn stored(self: &Arc<Self>, id: &EntryId) -> Result<Option<Stored>, FetchError> {
        let (shared, wanted) = (Arc::clone(self), id.clone());
        match blocking(move || shared.disk.load(&wanted)).await? {
            Ok(Found::Copy(stored)) => return Ok(Some(stored)),
            Ok(Found::Nothing) => {}
            Ok(Found::Corrupt) => {
                tracing::warn!(%id, "a damaged copy on disk was removed");
                count("cache", "corrupt");
            }
            Err(error) => {
                tracing::warn!(%id, %error, "a copy on disk cannot be read");
                count("cache", "failed");
            }
        }
        Ok(None)
    }

    /// Turns a copy into an entry that is fresh for `left`.
    fn copy(&self, id: &EntryId, stored: Stored, checked: Instant, left: Option<Duration>) -> Entry {
        count("cache", "found");
        let Stored { bytes, digest, .. } = stored;
        self.remember(id, Known { digest, stamp: None, checked, fresh_until: left.map(|left| checked + left) });
        Entry { bytes, digest, source: Source::Cache }
    }

    fn remember(&self, id: &EntryId, known: Known) {
        self.absent.remove(id);
        self.known.insert(id.clone(), known);
    }

    /// Changes a copy on disk. A failure is only logged, since the entry itself is still usable.
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

/// Runs blocking `work` on its own thread.
async fn blocking<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> Result<T, FetchError> {
    let ended = tokio::task::spawn_blocking(work).await;
    ended.map_err(|_panicked_or_stopped| FetchError::Internal("reading ended without a result"))
}

fn count(source: &'static str, result: &'static str) {
    counter!(ARCHIVE_REQUESTS, "source" => source, "result" => result).increment(1);
}
