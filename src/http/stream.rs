//! Streaming of mesh files: the writer runs on a blocking thread and sends pieces to the body through a bounded
//! channel, so that memory use stays small and a slow client slows the writer down.

use std::io::{self, Write};
use std::sync::Arc;
use std::time::Instant;

use axum::body::Body;
use bytes::{BufMut as _, Bytes, BytesMut};
use futures_util::stream;
use metrics::histogram;
use tokio::sync::{mpsc, oneshot};

use super::errors::{file_too_large, format_problem};
use super::problem::Problem;
use super::state::Delivery;
use crate::formats::Format;
use crate::jobs::{Budget, Finished};
use crate::telemetry::{STAGE_DURATION, TraceSpan};

/// Size of a piece, bytes: large enough for few wake-ups, small enough for the CPU cache.
const PIECE: usize = 256 << 10;
/// Number of buffered pieces per client.
const PIECES: usize = 4;

/// Message of the writer.
enum WriterMessage {
    Data(Bytes),
    /// The file is complete. If the channel closes without it, the writer has failed.
    End,
}

/// Starts the writer. Returns the length of the file if it is known, and the body.
pub(super) async fn start(
    finished: Arc<Finished>,
    format: Format,
    limit: u64,
    budget: Budget,
    delivery: Delivery,
) -> Result<(Option<u64>, Body), Problem> {
    let (head, answer) = oneshot::channel();
    let (sender, receiver) = mpsc::channel(PIECES);
    let pieces = Pieces { sender, buffer: BytesMut::new(), budget };
    let (log, span) = (tracing::Span::current(), TraceSpan::current());
    tokio::task::spawn_blocking(move || {
        log.in_scope(|| write(&finished, format, limit, head, pieces, span.as_ref()));
        drop(delivery);
    });
    // The writer has panicked; the panic hook has logged it.
    let length = answer.await.map_err(|_dropped| Problem::internal("the writer failed"))??;
    let body = stream::unfold(Some(receiver), |pieces| async move {
        let mut pieces = pieces?;
        match pieces.recv().await {
            Some(WriterMessage::Data(data)) => Some((Ok(data), Some(pieces))),
            Some(WriterMessage::End) => None,
            None => Some((Err(io::Error::other("the mesh could not be written to its end")), None)),
        }
    });
    Ok((length, Body::from_stream(body)))
}

/// Plans the file, sends its length, writes it.
fn write(
    finished: &Finished,
    format: Format,
    limit: u64,
    head: oneshot::Sender<Result<Option<u64>, Problem>>,
    mut writer: Pieces,
    span: Option<&TraceSpan>,
) {
    let start = Instant::now();
    let product = &finished.product;
    let resolution = product.report.resolution;
    let file = match product.file(format) {
        Ok(file) if file.bytes_bound() > limit => Err(file_too_large(file.bytes_bound(), limit, resolution)),
        Ok(file) => Ok(file),
        Err(error) => Err(format_problem(&error, resolution)),
    };
    let (length, file) = match file {
        Ok(file) => (Ok(file.bytes()), Some(file)),
        Err(problem) => (Err(problem), None),
    };
    // Without a receiver the client has left.
    let gone = head.send(length).is_err();
    let Some(file) = file.filter(|_| !gone) else { return };
    let written = file.write(&mut writer).and_then(|()| {
        // Recorded before the last piece is sent, with which the span of the request ends.
        let time = start.elapsed();
        histogram!(STAGE_DURATION, "stage" => "encode").record(time.as_secs_f64());
        if let Some(span) = span {
            span.part("encode", start, time);
        }
        writer.finish()
    });
    match written {
        Ok(()) => {}
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => tracing::debug!("the client left"),
        // The body fails without `WriterMessage::End`, which aborts the connection: a truncated mesh must not look
        // complete.
        Err(error) => tracing::error!(%error, format = format.name(), "writing a mesh failed"),
    }
}

/// Writer that collects pieces. Blocks while the client is slow.
struct Pieces {
    sender: mpsc::Sender<WriterMessage>,
    buffer: BytesMut,
    /// Charged with each piece until it is sent.
    budget: Budget,
}

impl Pieces {
    fn send(&self, piece: WriterMessage) -> io::Result<()> {
        self.sender.blocking_send(piece).map_err(|_gone| io::ErrorKind::BrokenPipe.into())
    }

    fn send_buffer(&mut self) -> io::Result<()> {
        let data = std::mem::take(&mut self.buffer).freeze();
        let reservation = self.budget.reservation();
        reservation.force(data.len() as u64);
        self.send(WriterMessage::Data(reservation.attach(data)))
    }

    fn finish(&mut self) -> io::Result<()> {
        if !self.buffer.is_empty() {
            self.send_buffer()?;
        }
        // A receiver that knows the length may hang up after the last byte.
        self.send(WriterMessage::End).or(Ok(()))
    }
}

impl Write for Pieces {
    fn write(&mut self, data: &[u8]) -> io::Result<usize> {
        if self.buffer.capacity() == 0 {
            self.buffer.reserve(PIECE);
        }
        let n = data.len().min(self.buffer.capacity() - self.buffer.len());
        self.buffer.put_slice(&data[..n]);
        if self.buffer.len() == self.buffer.capacity() {
            self.send_buffer()?;
        }
        Ok(n)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}
