//! What the store does not take now is offered again for a while: services that keep things restart, and disks are cleared.

use std::fmt::Display;
use std::future::Future;
use std::time::Duration;

use tokio::time::Instant;

use super::JobId;

/// Pause before the second attempt; it doubles with every further one.
pub(super) const FIRST: Duration = Duration::from_millis(250);
/// Longest pause: a store that answers again is not left waiting for long.
pub(super) const LONGEST: Duration = Duration::from_secs(5);

/// Does what `work` says for job `id` until it goes well, until it fails for good, or until `patience` is over.
///
/// # Errors
/// The last one.
pub(super) async fn insist<T, E: Display, F: Future<Output = Result<T, E>>>(
    id: &JobId,
    patience: Duration,
    may_pass: impl Fn(&E) -> bool,
    mut work: impl FnMut() -> F,
) -> Result<T, E> {
    let end = Instant::now() + patience;
    let mut pause = FIRST;
    loop {
        let error = match work().await {
            Err(error) if may_pass(&error) && Instant::now() + pause <= end => error,
            done => return done,
        };
        tracing::warn!(job_id = %id, %error, "a job waits for the store to take something");
        tokio::time::sleep(pause).await;
        pause = (pause * 2).min(LONGEST);
    }
}
