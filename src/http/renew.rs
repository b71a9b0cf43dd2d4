//! Keys that change while the service runs: their file is looked at from time to time, and read when somebody says so.

use std::sync::Arc;
use std::time::Duration;

use metrics::gauge;

use crate::access::Access;
use crate::telemetry::QUOTA_CLIENTS;

/// How often the file of keys is looked at: a key that is withdrawn is of no use a few seconds later.
const LOOK: Duration = Duration::from_secs(2);

/// Tells metrics how many clients there are.
#[expect(clippy::cast_precision_loss, reason = "gauges are floats, counts of clients are small")]
pub(super) fn tell(access: &Access) {
    gauge!(QUOTA_CLIENTS).set(access.meter().clients() as f64);
}

/// Reads the file of keys again whenever it has changed, and on SIGHUP. Without keys, does nothing: SIGHUP then means what
/// it means to other programs. The signal is listened for from the call on, not from the first poll.
pub(super) fn keys(access: Arc<Access>) -> impl Future<Output = ()> + Send + 'static {
    let hangup = access.has_keys().then(Hangup::listen);
    async move {
        if let Some(hangup) = hangup {
            renew(&access, hangup).await;
        }
    }
}

async fn renew(access: &Arc<Access>, mut hangup: Hangup) {
    loop {
        let told = tokio::select! {
            () = hangup.next() => true,
            () = tokio::time::sleep(LOOK) => false,
        };
        let access = Arc::clone(access);
        match tokio::task::spawn_blocking(move || access.refresh(told)).await {
            Ok(Ok(None)) => {}
            Ok(Ok(Some(keys))) => tracing::info!(keys, "the keys were read again"),
            Ok(Err(error)) => tracing::error!(%error, "the keys stay as they were"),
            Err(error) => tracing::error!(%error, "the keys cannot be read"),
        }
    }
}

/// SIGHUP, where there is one.
struct Hangup {
    #[cfg(unix)]
    signal: Option<tokio::signal::unix::Signal>,
}

impl Hangup {
    #[cfg(unix)]
    fn listen() -> Self {
        let signal = tokio::signal::unix::signal(tokio::signal::unix::SignalKind::hangup());
        Self { signal: signal.inspect_err(|error| tracing::warn!(%error, "cannot listen for SIGHUP")).ok() }
    }

    #[cfg(not(unix))]
    fn listen() -> Self {
        Self {}
    }

    #[cfg(unix)]
    async fn next(&mut self) {
        match &mut self.signal {
            Some(signal) => drop(signal.recv().await),
            None => std::future::pending().await,
        }
    }

    #[cfg(not(unix))]
    async fn next(&mut self) {
        std::future::pending().await
    }
}
