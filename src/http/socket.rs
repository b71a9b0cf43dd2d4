//! TCP stream with a write timeout and a lingering close. A client that reads nothing is disconnected, and a connection
//! that is closed while the client still sends stays open for reading, so that the client receives the response.
//!
//! Data is handed to the system in small pieces, and only when it has sent almost all data before, so that the progress
//! of writes follows the client.

use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, Interest, ReadBuf};
use tokio::net::TcpStream;
use tokio::time::{Instant, Sleep};

use super::pace::Pace;

/// Time for which a closed connection still reads.
const LINGER: Duration = Duration::from_secs(2);
/// Maximum number of bytes that a closed connection still reads.
const LINGER_BYTES: u64 = 64 << 20;

/// TCP stream with a write timeout and a lingering close.
pub(super) struct Guarded<H: Send + 'static> {
    stream: Option<TcpStream>,
    /// Permit of the connection, held until the socket is closed.
    hold: Option<H>,
    timeout: Duration,
    pace: Arc<Pace>,
    /// Size of the pieces that are written, bytes.
    piece: usize,
    stalled: Option<Pin<Box<Sleep>>>,
    peer_ended: bool,
}

impl<H: Send + 'static> Guarded<H> {
    /// Wraps `stream`, whose pieces have the size that `pace` gives; `hold` is dropped when the socket is closed.
    pub(super) fn new(stream: TcpStream, hold: H, timeout: Duration, pace: Arc<Pace>) -> Self {
        Self { stream: Some(stream), hold: Some(hold), timeout, pace, piece: 0, stalled: None, peer_ended: false }
    }

    fn stream(&mut self) -> io::Result<Pin<&mut TcpStream>> {
        self.stream.as_mut().map(Pin::new).ok_or_else(|| io::ErrorKind::NotConnected.into())
    }

    /// Waits until less than half a piece is unsent. Writes alone do not: the system fills its last packet first, up to
    /// 64 KiB, and a slow client takes a minute for these.
    fn poll_sent(&mut self, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        let piece = self.pace.piece();
        let grows = std::mem::replace(&mut self.piece, piece) < piece;
        let stream = self.stream()?.get_mut();
        if grows {
            limit_unsent(stream, piece)?;
        }
        loop {
            ready!(stream.poll_write_ready(cx))?;
            match stream.try_io(Interest::WRITABLE, || accepts_data(stream)) {
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                done => return Poll::Ready(done),
            }
        }
    }

    /// Starts the timeout when a write is pending, stops it when the write proceeds.
    fn watch<T>(&mut self, cx: &mut Context<'_>, polled: Poll<io::Result<T>>) -> Poll<io::Result<T>> {
        if polled.is_ready() {
            self.stalled = None;
            return polled;
        }
        let timeout = self.timeout;
        let sleep = self.stalled.get_or_insert_with(|| Box::pin(tokio::time::sleep_until(Instant::now() + timeout)));
        ready!(sleep.as_mut().poll(cx));
        Poll::Ready(Err(io::Error::new(io::ErrorKind::TimedOut, "the client reads nothing")))
    }
}

impl<H: Send + Unpin + 'static> AsyncRead for Guarded<H> {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        let before = buf.filled().len();
        let polled = self.stream()?.poll_read(cx, buf);
        if matches!(polled, Poll::Ready(Ok(()))) && buf.filled().len() == before && buf.remaining() > 0 {
            self.peer_ended = true;
        }
        polled
    }
}

impl<H: Send + Unpin + 'static> AsyncWrite for Guarded<H> {
    fn poll_write(self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        self.poll_write_vectored(cx, &[io::IoSlice::new(buf)])
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bufs: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let polled = match self.poll_sent(cx) {
            Poll::Ready(Ok(())) => match leading(bufs, self.piece) {
                Leading::Whole(bufs) => self.stream()?.poll_write_vectored(cx, bufs),
                Leading::Part(buf) => self.stream()?.poll_write(cx, buf),
            },
            Poll::Ready(Err(error)) => Poll::Ready(Err(error)),
            Poll::Pending => Poll::Pending,
        };
        self.watch(cx, polled)
    }

    fn is_write_vectored(&self) -> bool {
        true
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        let polled = self.stream()?.poll_flush(cx);
        self.watch(cx, polled)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.stream()?.poll_shutdown(cx)
    }
}

impl<H: Send + 'static> Drop for Guarded<H> {
    fn drop(&mut self) {
        let (Some(stream), hold) = (self.stream.take(), self.hold.take()) else { return };
        let Ok(runtime) = tokio::runtime::Handle::try_current() else { return };
        if !self.peer_ended {
            runtime.spawn(linger(stream, hold));
        }
    }
}

/// Limits the unsent data of the system.
#[cfg(target_os = "linux")]
fn limit_unsent(stream: &TcpStream, bytes: usize) -> io::Result<()> {
    socket2::SockRef::from(stream).set_tcp_notsent_lowat(u32::try_from(bytes).unwrap_or(u32::MAX))
}

#[cfg(not(target_os = "linux"))]
fn limit_unsent(_stream: &TcpStream, _bytes: usize) -> io::Result<()> {
    Ok(())
}

/// Fails with `WouldBlock` if too much data is unsent.
#[cfg(target_os = "linux")]
fn accepts_data(stream: &TcpStream) -> io::Result<()> {
    use rustix::event::{PollFd, PollFlags, Timespec, poll};
    let mut sockets = [PollFd::new(stream, PollFlags::OUT)];
    let ready = poll(&mut sockets, Some(&Timespec { tv_sec: 0, tv_nsec: 0 }))?;
    if ready > 0 { Ok(()) } else { Err(io::ErrorKind::WouldBlock.into()) }
}

#[cfg(not(target_os = "linux"))]
fn accepts_data(_stream: &TcpStream) -> io::Result<()> {
    Ok(())
}

/// Data of one write.
enum Leading<'a> {
    Whole(&'a [io::IoSlice<'a>]),
    Part(&'a [u8]),
}

/// Returns at most `piece` bytes from the start of `bufs`.
fn leading<'a>(bufs: &'a [io::IoSlice<'a>], piece: usize) -> Leading<'a> {
    let mut length = 0;
    let fits = |buf: &&io::IoSlice<'_>| {
        length += buf.len();
        length <= piece
    };
    let count = bufs.iter().take_while(fits).count();
    let whole = &bufs[..count];
    match bufs.get(count) {
        Some(next) if whole.iter().all(|buf| buf.is_empty()) => Leading::Part(&next[..piece]),
        _ => Leading::Whole(whole),
    }
}

/// Closes a socket without losing the response. Closing with unread bytes would send a reset, which discards what the
/// client has not read yet, so this shuts down the sending side and discards input for a while.
async fn linger<H>(mut stream: TcpStream, hold: H) {
    use tokio::io::AsyncWriteExt as _;
    let swallow = async {
        stream.shutdown().await?;
        let (mut sink, mut reader) = (tokio::io::sink(), stream.take(LINGER_BYTES));
        tokio::io::copy(&mut reader, &mut sink).await
    };
    if let Ok(Err(error)) = tokio::time::timeout(LINGER, swallow).await {
        tracing::trace!(%error, "a client left before its connection was closed");
    }
    drop(hold);
}
