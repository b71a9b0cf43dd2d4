//! Reloading of the key file: periodically, and on SIGHUP.

use std::sync::Arc;
use std::time::Duration;

use metrics::gauge;

use super::signal::Signal;
use crate::access::Access;
use crate::telemetry::QUOTA_CLIENTS;

/// Interval between two checks of the key file, so that a withdrawn key is rejected a few seconds later.
const INTERVAL: Duration = Duration::from_secs(2);

/// Publishes the number of clients with a quota.
#[expect(clippy::cast_precision_loss, reason = "gauges are floats, counts of clients are small")]
pub(super) fn publish_clients(access: &Access) {
    gauge!(QUOTA_CLIENTS).set(access.meter.clients() as f64);
}

/// Reloads the key file when it changes and on SIGHUP. Without keys it does nothing, and SIGHUP keeps its default
/// action. Listens for the signal from the call on, not from the first poll.
pub(super) fn run(access: Arc<Access>) -> impl Future<Output = ()> + Send + 'static {
    let hangup = access.has_keys().then(Signal::hangup);
    async move {
        if let Some(hangup) = hangup {
            reload(&access, hangup).await;
        }
    }
}

async fn reload(access: &Arc<Access>, mut hangup: Signal) {
    loop {
        let requested = tokio::select! {
            () = hangup.next() => true,
            () = tokio::time::sleep(INTERVAL) => false,
        };
        let access = Arc::clone(access);
        match tokio::task::spawn_blocking(move || access.refresh(requested)).await {
            Ok(Ok(None)) => {}
            Ok(Ok(Some(keys))) => tracing::info!(keys, "reloaded the keys"),
            Ok(Err(error)) => tracing::error!(%error, "cannot reload the keys; the earlier ones stay valid"),
            Err(error) => tracing::error!(%error, "reloading the keys panicked"),
        }
    }
}
