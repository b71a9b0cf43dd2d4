//! Objects from threads that block: an encoder writes, the runtime stores, and little is in memory between them.

use std::io;

use bytes::{Bytes, BytesMut};
use tokio::sync::{mpsc, oneshot};

use super::error::StoreError;
use super::handle::Store;
use super::name::Name;
use super::upload::{self, Upload};

/// Parts that wait for the runtime. With the one that is being filled and those on their way six are in memory at most.
const WAITING: usize = 1;

enum Message {
    Part(Bytes),
    Last(Bytes),
}

/// An object that is being written, from a thread that may block; see [`Store::writer`].
///
/// Nothing is visible before [`finish`](Self::finish), and nothing is left if the writer is dropped without it.
#[derive(Debug)]
pub struct Writer {
    filling: BytesMut,
    part: usize,
    to: Option<mpsc::Sender<Message>>,
    outcome: Option<oneshot::Receiver<Result<(), StoreError>>>,
}

impl Store {
    /// Begins an object whose bytes come from a thread that blocks. With `length` it must have exactly so many, and
    /// room is made for it before the first byte; otherwise room is made while it grows. Errors come with the writing.
    ///
    /// The writer's calls block: they must not be made on the async runtime.
    #[must_use]
    pub fn writer(&self, name: &Name, length: Option<u64>) -> Writer {
        let (to, from) = mpsc::channel(WAITING);
        let (done, outcome) = oneshot::channel();
        let (store, name) = (self.clone(), name.clone());
        self.0.runtime.spawn(async move {
            // Nobody listens to the outcome of what was given up.
            let _unheard = done.send(receive(&store, &name, length, from).await);
        });
        Writer { filling: BytesMut::new(), part: self.0.backend.part(), to: Some(to), outcome: Some(outcome) }
    }
}

impl Writer {
    /// Makes the object visible, as a whole. It is durable when this returns.
    ///
    /// # Errors
    /// [`StoreError`]; nothing is visible then.
    pub fn finish(mut self) -> Result<(), StoreError> {
        let last = Message::Last(self.filling.split().freeze());
        // If nobody takes it, the outcome says why.
        let _sent = self.to.take().map(|to| to.blocking_send(last));
        self.outcome()
    }

    /// How it ended. The runtime ends without a word where it is shut down.
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

    /// Does nothing: only [`Writer::finish`] makes anything visible.
    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Stores what comes, until the last part or until the writer is gone.
async fn receive(
    store: &Store,
    name: &Name,
    length: Option<u64>,
    mut parts: mpsc::Receiver<Message>,
) -> Result<(), StoreError> {
    let mut room = store.room_for(name, length.unwrap_or(0)).await?;
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
        if let Some(promised) = length.filter(|&promised| written > promised || last && written < promised) {
            break Err(StoreError::Length { promised, written });
        }
        if length.is_none()
            && let Err(error) = room.grow(bytes.len() as u64).await
        {
            break Err(error);
        }
        if last && upload.is_none() {
            // What fits into one part needs no upload, and may stay in memory.
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
