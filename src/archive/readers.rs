//! Permits to read structures outside of jobs, one per worker.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::{Instant, timeout_at};

use crate::reader_line::{ReaderLine, ReadingTime};

/// Permits, and the line of requests that wait for them. Clones share both.
#[derive(Debug, Clone)]
pub(super) struct Readers {
    pub(super) permits: Arc<Semaphore>,
    pub(super) line: Arc<ReaderLine>,
}

/// No reader was free in time. Holds the estimated time until one is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Busy(pub(super) Duration);

/// Permit, held during a read.
pub(super) struct Reading {
    _permit: OwnedSemaphorePermit,
    _time: ReadingTime,
}

impl Readers {
    pub(super) fn new(n: usize) -> Self {
        Self { permits: Arc::new(Semaphore::new(n)), line: ReaderLine::new(n) }
    }

    /// Waits for a permit, at most until `begin_by`. A request that would probably wait longer is refused at once.
    pub(super) async fn wait(&self, begin_by: Instant) -> Result<Reading, Busy> {
        let busy = || Busy(self.line.estimated_wait());
        let waiting = self.line.enter(begin_by.saturating_duration_since(Instant::now())).ok_or_else(busy)?;
        let permit = timeout_at(begin_by, Arc::clone(&self.permits).acquire_owned()).await;
        // The semaphore is never closed.
        let permit = permit.ok().and_then(Result::ok).ok_or_else(busy)?;
        Ok(Reading { _permit: permit, _time: waiting.begin() })
    }
}
