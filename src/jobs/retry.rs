//! Retries of writes that the store rejects for now, for example while an object store restarts or a disk is full.

use std::fmt::Display;
use std::future::Future;
use std::time::Duration;

use tokio::time::Instant;

use super::JobId;
use crate::sync::sleep;

/// Pause before the second attempt; each further pause is twice as long.
pub(super) const FIRST_PAUSE: Duration = Duration::from_millis(250);
/// Upper limit of the pause, so that a store that works again is used soon.
pub(super) const MAX_PAUSE: Duration = Duration::from_secs(5);

/// Repeats `work` for job `id` until it succeeds, fails with a permanent error, or has been retried for `limit`.
pub(super) async fn retry<T, E: Display, F: Future<Output = Result<T, E>>>(
    id: &JobId,
    limit: Duration,
    is_temporary: impl Fn(&E) -> bool,
    mut work: impl FnMut() -> F,
) -> Result<T, E> {
    let end = Instant::now() + limit;
    let mut pause = FIRST_PAUSE;
    loop {
        let error = match work().await {
            Err(error) if is_temporary(&error) && Instant::now() + pause <= end => error,
            done => return done,
        };
        tracing::warn!(job_id = %id, %error, "the store rejected a write; retrying");
        sleep(pause).await;
        pause = (pause * 2).min(MAX_PAUSE);
    }
}
