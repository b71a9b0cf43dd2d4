//! Writers for blocking threads. The runtime stores the bytes that an encoder writes, with little buffering in between.

use std::io;

use bytes::{Bytes, BytesMut};
use tokio::sync::{mpsc, oneshot};

use super::error::StoreError;
use super::handle::Store;
use super::name::Name;
use super::upload::{self, Upload};

/// Parts that wait for the runtime. With the one being filled and those being uploaded, at most six are in memory.
const WAITING: usize = 1;

enum Message {
    Part(Bytes),
    Last(Bytes),
}

/// Blocking writer of an object; see [`Store::writer`].
///
/// The object becomes visible with [`finish`](Self::finish). Dropping the writer earlier leaves nothing behind.
#[derive(Debug)]
pub struct Writer {
    filling: BytesMut,
    part: usize,
    to: Option<mpsc::Sender<Message>>,
    outcome: Option<oneshot::Receiver<Result<(), StoreError>>>,
}

impl Store {
    /// Starts an object that a blocking thread writes. With `length`, the object must have exactly this size, and space
    /// is reserved before the first byte. Otherwise, space is reserved as it grows. Errors are reported by the writer.
    ///
    /// The calls of the writer block, so they must not be made on the async runtime.
    #[must_use]
    pub fn writer(&self, name: &Name, length: Option<u64>) -> Writer {
        let (to, from) = mpsc::channel(WAITING);
        let (done, outcome) = oneshot::channel();
        let (store, name) = (self.clone(), name.clone());
        self.0.runtime.spawn(async move {
            // The receiver is gone if the writer was dropped.
            let _sent = done.send(receive(&store, &name, length, from).await);
        });
        Writer { filling: BytesMut::new(), part: self.0.backend.part(), to: Some(to), outcome: Some(outcome) }
    }
}

impl Writer {
    /// Makes the object visible. It is durable on return.
    ///
    /// # Errors
    /// Returns a [`StoreError`]. The object is not visible then.
    pub fn finish(mut self) -> Result<(), StoreError> {
        let last = Message::Last(self.filling.split().freeze());
        // A failed send means that the store failed; the outcome has the error.
        let _sent = self.to.take().map(|to| to.blocking_send(last));
        self.outcome()
    }

    /// Returns the result. A shut-down runtime drops the channel without one.
    fn outcome(&mut self) -> Result<(), StoreError> {
        let outcome = self.outcome.take().and_then(|outcome| outcome.blocking_recv().ok());
        outcome.unwrap_or(Err(StoreError::Abandoned))
    }
}

impl io::Write for Writer {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let Some(to) = &self.to else { return Err(StoreError::Abandoned.into()) };
        if self.filling.capacity() == 0 {
            self.filling.reserve(self.part);
        }
        let taken = bytes.len().min(self.part - self.filling.len());
        self.filling.extend_from_slice(&bytes[..taken]);
        if self.filling.len() == self.part {
            let part = Message::Part(std::mem::take(&mut self.filling).freeze());
            if to.blocking_send(part).is_err() {
                self.to = None;
                self.outcome()?;
                return Err(StoreError::Abandoned.into());
            }
        }
        Ok(taken)
    }

    /// Does nothing: only [`Writer::finish`] makes the object visible.
    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Stores parts until the last one, or until the writer is dropped.
async fn receive(
    store: &Store,
    name: &Name,
    length: Option<u64>,
    mut parts: mpsc::Receiver<Message>,
) -> Result<(), StoreError> {
    let mut reservation = store.reserve_for(name, length.unwrap_or(0)).await?;
    let backend = &store.0.backend;
    let mut written = 0;
    let mut upload: Option<Upload<'_>> = None;
    let outcome = loop {
        let (bytes, last) = match parts.recv().await {
            Some(Message::Part(bytes)) => (bytes, false),
            Some(Message::Last(bytes)) => (bytes, true),
            None => break Err(StoreError::Abandoned),
        };
        written += bytes.len() as u64;
        if let Some(declared) = length.filter(|&declared| written > declared || last && written < declared) {
            break Err(StoreError::Length { declared, written });
        }
        if length.is_none()
            && let Err(error) = reservation.grow(bytes.len() as u64).await
        {
            break Err(error);
        }
        if last && upload.is_none() {
            // An object of one part needs no multipart upload, and may be cached.
            let _lock = store.stripe(name).lock().await;
            upload::put(backend, name, bytes.clone(), false).await?;
            store.commit(name, written, Some(&bytes));
            return Ok(());
        }
        let pushed = match &mut upload {
            Some(upload) => upload.push(bytes).await,
            None => match Upload::begin(backend, name).await {
                Ok(begun) => upload.insert(begun).push(bytes).await,
                Err(error) => Err(error),
            },
        };
        if pushed.is_err() || last {
            break pushed;
        }
    };
    match (outcome, upload) {
        (Ok(()), Some(upload)) => {
            let _lock = store.stripe(name).lock().await;
            upload.finish().await?;
            store.commit(name, written, None);
            Ok(())
        }
        (outcome, upload) => {
            if let Some(upload) = upload {
                upload.abort().await;
            }
            outcome
        }
    }
}
