//! Digest of a body that another thread computes while the body arrives.

use bytes::Bytes;
use tokio::task::JoinHandle;

use super::problem::Problem;
use crate::jobs::MemoryReservation;
use crate::store::{Digest, Hasher};

/// Bytes that one task hashes: about 0.15 ms of work, ten times the cost of starting it.
const BATCH_BYTES: usize = 256 << 10;
/// Maximum number of pieces of a batch. Each may hold a buffer of the connection.
const BATCH_PIECES: usize = 64;
/// Size below which a piece is copied, so that it does not hold a much larger buffer.
const MIN_SHARED_BYTES: usize = 4 << 10;
/// Memory of two batches: one is hashed while the next one arrives.
const HELD_BYTES: u64 = 2 * BATCH_BYTES as u64;

/// SHA-256 of a body that arrives in pieces. Hashes full batches on blocking threads, one after the other, so no thread
/// waits for the client. The last batch is hashed by the caller.
#[derive(Debug, Default)]
pub(super) struct BodyHasher {
    /// Task that hashes the previous batch; `None` before the first full batch.
    running: Option<JoinHandle<Hasher>>,
    batch: Vec<Bytes>,
    batch_bytes: usize,
}

impl BodyHasher {
    /// Adds the next piece. If that fills the batch, waits until the previous batch is hashed. Charges the batches to
    /// `reservation` until [`digest`](Self::digest).
    pub(super) async fn update(&mut self, piece: &Bytes, reservation: &MemoryReservation) -> Result<(), Problem> {
        let is_small = piece.len() < MIN_SHARED_BYTES;
        self.batch.push(if is_small { Bytes::copy_from_slice(piece) } else { piece.clone() });
        self.batch_bytes += piece.len();
        if self.batch_bytes < BATCH_BYTES && self.batch.len() < BATCH_PIECES {
            return Ok(());
        }
        let mut hasher = if let Some(running) = self.running.take() {
            running.await.map_err(Problem::internal)?
        } else {
            reservation.grow(HELD_BYTES)?;
            Hasher::default()
        };
        let batch = std::mem::take(&mut self.batch);
        self.batch_bytes = 0;
        self.running = Some(tokio::task::spawn_blocking(move || {
            for piece in &batch {
                hasher.update(piece);
            }
            hasher
        }));
        Ok(())
    }

    /// Returns the digest of all pieces.
    pub(super) async fn digest(self, reservation: &MemoryReservation) -> Result<Digest, Problem> {
        let mut hasher = Hasher::default();
        if let Some(running) = self.running {
            hasher = running.await.map_err(Problem::internal)?;
            reservation.shrink(HELD_BYTES);
        }
        for piece in &self.batch {
            hasher.update(piece);
        }
        Ok(hasher.digest())
    }
}

#[cfg(test)]
#[allow(clippy::pedantic, clippy::unwrap_used, reason = "tests fail by panicking")]
mod tests {
    use super::*;
    use crate::jobs::Budget;

    #[tokio::test]
    async fn pieces_of_any_size_give_the_digest_of_the_body() {
        let body: Vec<u8> = (0..3_000_000_u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect();
        let body = Bytes::from(body);
        for size in [1000, 5000, 300_000, 3_000_000] {
            for n in [0, 1, 900, 250_000, 3_000_000] {
                let (budget, body) = (Budget::unlimited(), body.slice(..n));
                let (mut hasher, reservation) = (BodyHasher::default(), budget.reservation());
                for first in (0..n).step_by(size) {
                    hasher.update(&body.slice(first..n.min(first + size)), &reservation).await.unwrap();
                    assert!(hasher.batch.len() < BATCH_PIECES && hasher.batch_bytes < BATCH_BYTES);
                }
                assert_eq!(reservation.bytes() > 0, hasher.running.is_some());
                assert_eq!(
                    hasher.digest(&reservation).await.unwrap(),
                    Digest::of(&body),
                    "{n} bytes in pieces of {size}"
                );
                assert_eq!(reservation.bytes(), 0);
            }
        }
    }

    #[tokio::test]
    async fn batches_are_charged_before_they_are_held() {
        let (mut hasher, reservation) = (BodyHasher::default(), Budget::new(HELD_BYTES - 1).reservation());
        assert!(hasher.update(&Bytes::from(vec![0; BATCH_BYTES]), &reservation).await.is_err());
        let (mut hasher, reservation) = (BodyHasher::default(), Budget::new(HELD_BYTES).reservation());
        hasher.update(&Bytes::from(vec![0; BATCH_BYTES]), &reservation).await.unwrap();
    }
}
