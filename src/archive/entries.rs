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
use super::files::Files;
use super::remote::Remote;
use crate::client_shares::{ClientShares, ShareExceeded, SharePermit};
use crate::config::Config;
use crate::memory_budget::Budget;
use crate::readers::Readers;
use crate::single_flight::SingleFlight;
use crate::store::Digest;
use crate::structure::{EntryId, Stamp};
use crate::telemetry::{ARCHIVE_FETCH, ARCHIVE_REQUESTS, TraceSpan};

/// Number of entries whose digests are cached, in a few megabytes.
const CACHED_DIGESTS: usize = 16_384;

const NO_RESULT: FetchError = FetchError::Internal("its fetch ended without a result");

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
    /// Bytes as stored or received. They hold their part of the memory budget.
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
    shared: Arc<ArchiveState>,
    /// Client whose share limits its concurrent fetches; `None`: no share.
    client: Option<u64>,
}

#[derive(Debug)]
struct ArchiveState {
    files: Arc<Files>,
    remote: Option<Remote>,
    shares: Arc<ClientShares>,
    timeout: Duration,
    fetches: SingleFlight<EntryId, Result<Entry, FetchError>>,
    /// Digests that are being computed; `None` if the folder does not have the entry.
    digests: SingleFlight<EntryId, Result<Option<Digest>, FetchError>>,
    known: Cache<EntryId, Known>,
    /// Entries that no remote archive has, each with the time until which it is not requested again.
    absent: Cache<EntryId, Instant>,
    check_interval: Duration,
    revalidate_after: Duration,
    retry_missing_after: Duration,
}

impl Archive {
    /// Creates the archive of a configuration. Entries are charged to `memory` from before they are read until they are
    /// dropped. The first request starts all I/O.
    #[must_use]
    pub fn new(config: &Config, memory: Budget) -> Self {
        let archive = &config.archive;
        let files = Files::new(config, memory.clone());
        let shared = ArchiveState {
            remote: Remote::new(config, memory, files.readers.clone()),
            files: Arc::new(files),
            shares: ClientShares::new(archive.concurrent, config.server.client_share),
            timeout: Duration::from_millis(archive.timeout_ms),
            fetches: SingleFlight::default(),
            digests: SingleFlight::default(),
            known: Cache::new(CACHED_DIGESTS),
            absent: Cache::new(CACHED_DIGESTS),
            check_interval: Duration::from_millis(archive.local_check_interval_ms),
            revalidate_after: Duration::from_millis(archive.revalidate_after_ms),
            retry_missing_after: Duration::from_millis(archive.retry_missing_after_ms),
        };
        Self { shared: Arc::new(shared), client: None }
    }

    /// Returns the readers of structures outside of jobs, one per worker. Reading an entry takes one.
    #[must_use]
    pub fn readers(&self) -> Readers {
        self.shared.files.readers.clone()
    }

    /// Returns the archive for a client, which may fetch as many entries at once as its share.
    #[must_use]
    pub fn for_client(&self, client: u64) -> Self {
        Self { shared: Arc::clone(&self.shared), client: Some(client) }
    }

    /// Returns the bytes of an entry from the first source that has it. Waits at most a minute, half of it for a
    /// slot in the share of the client. Must run on a tokio runtime with timers.
    ///
    /// # Errors
    /// Returns any [`FetchError`].
    pub async fn fetch(&self, id: &EntryId) -> Result<Entry, FetchError> {
        let start = tokio::time::Instant::now();
        let deadline = start + self.shared.timeout;
        let mut slot = None;
        loop {
            match (self.run(id, &mut slot, deadline).await, self.client) {
                // The share of this client, or of the first caller, is exceeded. Each caller waits for its own share,
                // so that no client waits for the requests of another one.
                (Err(FetchError::Share { .. }), Some(client)) if slot.is_none() => {
                    // The other half of the time is for the fetch.
                    let taken = self.shared.shares.wait(client, start + self.shared.timeout / 2).await;
                    slot = Some(taken.map_err(|ShareExceeded { limit }| FetchError::Share { id: id.clone(), limit })?);
                }
                // The fetch that this caller joined had no slot either, so this caller tries again with its own slot.
                (Err(FetchError::Share { .. }), _) => {}
                (found, _) => return found,
            }
        }
    }

    /// Runs or joins the fetch of an entry. A new fetch takes `slot`, or fails if it needs one and there is none.
    async fn run(
        &self,
        id: &EntryId,
        slot: &mut Option<SharePermit>,
        deadline: tokio::time::Instant,
    ) -> Result<Entry, FetchError> {
        let (shared, wanted, client) = (Arc::clone(&self.shared), id.clone(), self.client);
        // The fetch outlives its first caller, but is traced under that caller's request.
        let mut fetch = self.shared.fetches.run(id, || {
            let (span, slot) = (TraceSpan::current(), slot.take());
            let find = async move { shared.find(&wanted, client, slot, deadline).await };
            let find = async move {
                match span {
                    Some(span) => span.run(find).await,
                    None => find.await,
                }
            };
            find.in_current_span()
        });
        fetch.recv().await.unwrap_or(Err(NO_RESULT))
    }

    /// Sends a HEAD request for one entry to every host of the remote archive, with a timeout of `limit` each. Returns
    /// the hosts with the status or the error; empty without a remote archive.
    pub async fn reach(&self, id: &EntryId, limit: Duration) -> Vec<(String, Result<u16, String>)> {
        match &self.shared.remote {
            Some(remote) => remote.reach(id, limit).await,
            None => Vec::new(),
        }
    }

    /// Returns the digest of an entry's bytes, without reading them if the digest is cached and fresh. A file of the
    /// folder is read part by part.
    ///
    /// # Errors
    /// Returns any [`FetchError`].
    pub async fn digest(&self, id: &EntryId) -> Result<Digest, FetchError> {
        if let Some(digest) = self.known(id).await {
            return Ok(digest);
        }
        let mut local = self.shared.digests.run(id, || {
            let (shared, wanted) = (Arc::clone(&self.shared), id.clone());
            async move { shared.local_digest(&wanted).await }.in_current_span()
        });
        match local.recv().await.unwrap_or(Err(NO_RESULT))? {
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
            let checked = Instant::now();
            let stamp = self.shared.files.stamp(id).await.ok()?;
            if stamp != known.stamp {
                return None;
            }
            self.shared.known.insert(id.clone(), Known { checked, ..known.clone() });
        }
        count(if known.stamp.is_some() { "local" } else { "cache" }, "known");
        Some(known.digest)
    }
}

impl ArchiveState {
    async fn find(
        &self,
        id: &EntryId,
        client: Option<u64>,
        slot: Option<SharePermit>,
        deadline: tokio::time::Instant,
    ) -> Result<Entry, FetchError> {
        let checked = Instant::now();
        if let Some((bytes, digest, stamp)) = self.local(id, deadline).await? {
            self.remember(id, Known { digest, stamp: Some(stamp), checked, fresh_until: None });
            return Ok(Entry { bytes, digest, source: Source::Local });
        }
        let stored = self.stored(id, deadline).await?;
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
        let slot = slot.map_or_else(|| client.map(|client| self.shares.take(client)).transpose(), |p| Ok(Some(p)));
        let _slot = slot.map_err(|ShareExceeded { limit }| FetchError::Share { id: id.clone(), limit })?;
        let answer = remote.fetch(id, stored.as_ref().map(|stored| &stored.origin), deadline).await;
        let result = match &answer {
            Ok(Answer::Unchanged) => "unchanged",
            Ok(_) => "found",
            Err(FetchError::NotFound { .. }) => "absent",
            Err(FetchError::TooLarge(_)) => "too-large",
            Err(FetchError::Memory { .. }) => "no-memory",
            Err(FetchError::Busy { .. }) => "busy",
            Err(_) => "unavailable",
        };
        count("remote", result);
        histogram!(ARCHIVE_FETCH, "result" => result).record(checked.elapsed().as_secs_f64());
        match (answer, stored) {
            (Ok(Answer::Body { bytes, digest, origin }), _) => {
                let ms = checked.elapsed().as_millis();
                tracing::info!(%id, url = origin.url, bytes = bytes.len(), ms, "fetched an entry");
                let kept = bytes.clone();
                self.on_disk(id, "stored", move |disk, id| disk.store(id, &kept, &digest, &origin)).await;
                let fresh_until = Some(checked + self.revalidate_after);
                self.remember(id, Known { digest, stamp: None, checked, fresh_until });
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
    async fn local(
        &self,
        id: &EntryId,
        deadline: tokio::time::Instant,
    ) -> Result<Option<(Bytes, Digest, Stamp)>, FetchError> {
        // The digest of an unchanged file is not computed again.
        let known = self.known.get(id).and_then(|known| Some((known.stamp?, known.digest)));
        let found = self.files.read(id, known, deadline).await;
        count_local(&found);
        found
    }

    /// Computes the digest of the entry in the folder, and remembers it.
    async fn local_digest(&self, id: &EntryId) -> Result<Option<Digest>, FetchError> {
        let checked = Instant::now();
        let found = self.files.digest(id).await;
        count_local(&found);
        Ok(found?.map(|(digest, stamp)| {
            self.remember(id, Known { digest, stamp: Some(stamp), checked, fresh_until: None });
            digest
        }))
    }

    /// Reads the copy on disk. Treats damaged and unreadable copies as missing.
    async fn stored(&self, id: &EntryId, deadline: tokio::time::Instant) -> Result<Option<Stored>, FetchError> {
        match self.files.copy(id, deadline).await? {
            Ok(Found::Copy(stored)) => return Ok(Some(stored)),
            Ok(Found::Refused(error)) => {
                count("cache", "no-memory");
                return Err(FetchError::Memory { id: id.clone(), error });
            }
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
        &self,
        id: &EntryId,
        what: &'static str,
        act: impl FnOnce(&Disk, &EntryId) -> std::io::Result<()> + Send + 'static,
    ) {
        let wanted = id.clone();
        if let Ok(Err(error)) = self.files.change(move |disk| act(disk, &wanted)).await {
            tracing::warn!(%id, %error, "a copy could not be {what}");
            count("cache", "failed");
        }
    }
}

fn count_local<T>(found: &Result<Option<T>, FetchError>) {
    match found {
        Ok(Some(_)) => count("local", "found"),
        Ok(None) => {}
        Err(FetchError::Memory { .. }) => count("local", "no-memory"),
        Err(FetchError::Busy { .. }) => count("local", "busy"),
        Err(_) => count("local", "failed"),
    }
}

fn count(source: &'static str, result: &'static str) {
    counter!(ARCHIVE_REQUESTS, "source" => source, "result" => result).increment(1);
}
