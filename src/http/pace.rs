//! Minimum pace of response bodies: a client that reads too slowly for too long is disconnected.
//!
//! hyper polls a body ahead of the client and not again while the client reads nothing, so a body cannot measure its
//! own pace. Instead, [`Paced`] counts each slice until hyper has written and dropped it, and the task that runs the
//! exchange also waits for [`Pace::stalled`]: the connection for HTTP/1.1, the task of the stream for HTTP/2
//! ([`Streams`]).

use std::future::Future;
use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll, Waker, ready};
use std::time::Duration;

use axum::body::Body;
use axum::http::header::{CONTENT_LENGTH, CONTENT_TYPE};
use axum::http::{Response, Version};
use bytes::Bytes;
use hyper::body::{Body as HttpBody, Frame, SizeHint};
use hyper::rt::Executor;
use metrics::{Gauge, counter, gauge};
use tokio::sync::Notify;
use tokio::time::Instant;

use crate::memory_budget::Budget;
use crate::telemetry::{BODIES_OPEN, REJECTED};

/// Size of the pieces in which the progress of a client becomes visible, bytes: 16 seconds at 1 KiB/s.
const PIECE: usize = 16 << 10;
/// Maximum size of a piece, bytes. Larger ones are not faster.
const MAX_PIECE: usize = 256 << 10;
/// Fraction of what a client has read that may be a piece: at 1 KiB/s, a piece takes half of the time that
/// [`BYTES_PER_SECOND`] adds.
const PIECES_READ: u64 = 32;
/// Size of a slice over HTTP/2, bytes: one frame, so that the progress of many concurrent bodies is visible.
const STREAM_SLICE: usize = 16 << 10;
/// Send buffer of an HTTP/2 stream, bytes.
pub(super) const STREAM_BUFFER: usize = 64 << 10;
/// Size up to which a body is not watched over HTTP/1.1, bytes: the buffers of the system take it at once. Over HTTP/2
/// the client's window may keep any byte in this process.
const SMALL: u64 = 1 << 10;

tokio::task_local! {
    /// Pace of the HTTP/2 stream that this task serves.
    static STREAM: Arc<Pace>;
}

/// Bytes of a response body that a client must read within `server.write_timeout_ms`: half a kilobyte per second, so
/// that a connection of 8 KiB/s carries a dozen concurrent bodies.
pub(super) const MIN_BYTES: u64 = 16 << 10;

/// Number of bytes for which a client may pause one second longer.
const BYTES_PER_SECOND: u64 = 16 << 10;
/// Maximum time without progress, as a multiple of `server.write_timeout_ms`.
pub(super) const MAX_TIME_FACTOR: u32 = 4;

/// Pace at which one client reads its bodies.
#[derive(Debug)]
pub(super) struct Pace {
    /// Time in which the client must read [`MIN_BYTES`].
    within: Duration,
    state: Mutex<PaceState>,
}

#[derive(Debug)]
struct PaceState {
    /// Bytes that hyper holds and the client has not read.
    offered: u64,
    /// Bytes read since `since`, fewer than [`MIN_BYTES`].
    taken: u64,
    since: Instant,
    /// Bytes read in all.
    total: u64,
    /// Task that waits until everything is read.
    waker: Option<Waker>,
}

impl Pace {
    /// Creates the pace of a client that must read [`MIN_BYTES`] within this time.
    pub(super) fn new(within: Duration) -> Arc<Self> {
        let state = PaceState { offered: 0, taken: 0, since: Instant::now(), total: 0, waker: None };
        Arc::new(Self { within, state: Mutex::new(state) })
    }

    /// Returns the time for the next bytes of a client that has read `total` bytes. A slow client on a fast line fills
    /// the buffers of its system first, then pauses until it has read a part of these megabytes.
    fn allowed_time(&self, total: u64) -> Duration {
        let more = Duration::from_secs(total / BYTES_PER_SECOND);
        self.within.saturating_add(more).min(MAX_TIME_FACTOR * self.within)
    }

    /// Returns the size of a piece, a power of two that grows while an HTTP/1.1 client reads. Each stream of HTTP/2 has
    /// its own pace, so the pace of its connection stays at the minimum.
    pub(super) fn piece(&self) -> usize {
        let fraction = usize::try_from(self.state().total / PIECES_READ).unwrap_or(usize::MAX);
        1 << fraction.clamp(PIECE, MAX_PIECE).ilog2()
    }

    fn state(&self) -> MutexGuard<'_, PaceState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Counts a slice until its last reference is dropped.
    fn offer(self: &Arc<Self>, bytes: Bytes) -> Bytes {
        let mut state = self.state();
        if state.offered == 0 {
            (state.taken, state.since) = (0, Instant::now());
        }
        state.offered += bytes.len() as u64;
        drop(state);
        Bytes::from_owner(Slice { bytes, pace: Arc::clone(self) })
    }

    fn took(&self, bytes: u64) {
        let mut state = self.state();
        state.offered -= bytes;
        state.taken += bytes;
        state.total += bytes;
        if state.taken >= MIN_BYTES {
            (state.taken, state.since) = (0, Instant::now());
        }
        let waker = if state.offered == 0 { state.waker.take() } else { None };
        drop(state);
        if let Some(waker) = waker {
            waker.wake();
        }
    }

    fn poll_taken(&self, cx: &Context<'_>) -> Poll<()> {
        let mut state = self.state();
        if state.offered == 0 {
            return Poll::Ready(());
        }
        state.waker = Some(cx.waker().clone());
        Poll::Pending
    }

    /// Waits until everything that was offered is read.
    async fn taken(&self) {
        std::future::poll_fn(|cx| self.poll_taken(cx)).await;
    }

    /// Waits until the client was too slow for the whole time that it has.
    pub(super) async fn stalled(&self) {
        loop {
            let now = Instant::now();
            let due = {
                let state = self.state();
                // Without outstanding bytes the time starts now.
                let since = if state.offered == 0 { now } else { state.since };
                since + self.allowed_time(state.total)
            };
            if due <= now {
                return;
            }
            tokio::time::sleep_until(due).await;
        }
    }

    /// Watches the body of a response, with the pace of its HTTP/2 stream or else of `connection`. Event streams are
    /// exempt: they are as slow as their events and hold only one.
    pub(super) fn watch(answer: Response<Body>, connection: &Arc<Self>, version: Version) -> Response<Body> {
        let is_http2 = version == Version::HTTP_2;
        let limit = if is_http2 { 0 } else { SMALL };
        let stated = answer.headers().get(CONTENT_LENGTH).and_then(|length| length.to_str().ok()?.parse().ok());
        let is_small = stated.or(answer.body().size_hint().upper()).is_some_and(|bytes| bytes <= limit);
        let is_events =
            answer.headers().get(CONTENT_TYPE).is_some_and(|t| t.as_bytes().starts_with(b"text/event-stream"));
        if is_small || is_events {
            return answer;
        }
        let stream = if is_http2 { STREAM.try_with(Arc::clone).ok() } else { None };
        let stays = stream.is_some();
        let pace = stream.unwrap_or_else(|| Arc::clone(connection));
        answer.map(|body| {
            Body::new(Paced {
                body,
                rest: Bytes::new(),
                ended: false,
                stays,
                pace,
                _open: GaugeGuard::new(gauge!(BODIES_OPEN)),
            })
        })
    }
}

/// Counts and logs a disconnected client.
pub(super) fn cut_off() {
    counter!(REJECTED, "reason" => "write-timeout").increment(1);
    tracing::debug!("a client read a body too slowly");
}

/// Slice of a body that is being sent.
struct Slice {
    bytes: Bytes,
    pace: Arc<Pace>,
}

impl AsRef<[u8]> for Slice {
    fn as_ref(&self) -> &[u8] {
        &self.bytes
    }
}

impl Drop for Slice {
    fn drop(&mut self) {
        self.pace.took(self.bytes.len() as u64);
    }
}

/// Guard that adds 1 to a gauge until it is dropped.
pub(super) struct GaugeGuard(Gauge);

impl GaugeGuard {
    pub(super) fn new(gauge: Gauge) -> Self {
        gauge.increment(1.0);
        Self(gauge)
    }
}

impl Drop for GaugeGuard {
    fn drop(&mut self) {
        self.0.decrement(1.0);
    }
}

/// Body in slices that are counted until they are sent.
struct Paced {
    body: Body,
    /// Rest of the current frame.
    rest: Bytes,
    /// The inner body has ended.
    ended: bool,
    /// Delays the end until everything is read: hyper ends the task of an HTTP/2 stream with its body, and the rest of
    /// the buffer could not be freed afterwards.
    stays: bool,
    pace: Arc<Pace>,
    _open: GaugeGuard,
}

impl HttpBody for Paced {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        while self.rest.is_empty() && !self.ended {
            match ready!(Pin::new(&mut self.body).poll_frame(cx)) {
                Some(Ok(frame)) => match frame.into_data() {
                    Ok(data) => self.rest = data,
                    Err(trailers) => return Poll::Ready(Some(Ok(trailers))),
                },
                Some(Err(error)) => return Poll::Ready(Some(Err(error))),
                None => self.ended = true,
            }
            self.ended = self.ended || self.body.is_end_stream();
        }
        if self.rest.is_empty() {
            if self.stays {
                ready!(self.pace.poll_taken(cx));
            }
            return Poll::Ready(None);
        }
        let length = self.rest.len().min(if self.stays { STREAM_SLICE } else { self.pace.piece() / 2 });
        let slice = self.rest.split_to(length);
        Poll::Ready(Some(Ok(Frame::data(self.pace.offer(slice)))))
    }

    fn is_end_stream(&self) -> bool {
        let ended = self.rest.is_empty() && (self.ended || self.body.is_end_stream());
        ended && (!self.stays || self.pace.state().offered == 0)
    }

    fn size_hint(&self) -> SizeHint {
        let (rest, hint) = (self.rest.len() as u64, self.body.size_hint());
        let mut all = SizeHint::new();
        all.set_lower(hint.lower() + rest);
        if let Some(upper) = hint.upper() {
            all.set_upper(upper + rest);
        }
        all
    }
}

/// Executor for the streams of an HTTP/2 connection, which ends a stream if its client is too slow. Such a stream is
/// reset and its buffers are freed; if the reset cannot be sent either, `broken` is notified. The send buffer of each
/// stream is charged to `budget`.
#[derive(Clone)]
pub(super) struct Streams {
    /// Time in which a client must read [`MIN_BYTES`].
    within: Duration,
    broken: Arc<Notify>,
    budget: Budget,
}

impl Streams {
    pub(super) fn new(within: Duration, broken: &Arc<Notify>, budget: Budget) -> Self {
        Self { within, broken: Arc::clone(broken), budget }
    }
}

impl<F> Executor<F> for Streams
where
    F: Future + Send + 'static,
    F::Output: Send,
{
    fn execute(&self, stream: F) {
        let (pace, broken) = (Pace::new(self.within), Arc::clone(&self.broken));
        let buffers = self.budget.buffers(STREAM_BUFFER as u64);
        tokio::spawn(async move {
            let stalled = tokio::select! {
                _ = STREAM.scope(Arc::clone(&pace), stream) => false,
                () = pace.stalled() => true,
            };
            if stalled {
                cut_off();
                if tokio::time::timeout(pace.within, pace.taken()).await.is_err() {
                    broken.notify_one();
                }
            }
            drop(buffers);
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::OutOfMemory;

    #[tokio::test]
    async fn streams_are_charged_to_the_memory_budget() {
        let (budget, done) = (Budget::new(STREAM_BUFFER as u64), Arc::new(Notify::new()));
        let streams = Streams::new(Duration::from_secs(30), &Arc::default(), budget.clone());
        for _ in 0..2 {
            let done = Arc::clone(&done);
            streams.execute(async move { done.notified().await });
        }
        let Err(OutOfMemory::Budget { held, .. }) = budget.check() else { panic!("within the limit") };
        assert_eq!(held, 2 * STREAM_BUFFER as u64);
        done.notify_waiters();
        while budget.check().is_err() {
            done.notify_one();
            tokio::task::yield_now().await;
        }
    }
}
