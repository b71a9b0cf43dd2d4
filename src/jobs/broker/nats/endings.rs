//! Messages that end claims and locks.

use std::future::Future;
use std::sync::Arc;

use tokio::runtime::Handle;
use tokio::sync::watch;

use super::NatsState;

/// Sender of messages that end claims and locks, with their number.
#[derive(Clone, Default)]
pub(super) struct Endings(Arc<watch::Sender<usize>>);

impl Endings {
    /// Sends a message in a task of its own. Does nothing after the end of the runtime.
    pub(super) fn send(&self, message: impl Future<Output = ()> + Send + 'static) {
        let Ok(runtime) = Handle::try_current() else { return };
        self.0.send_modify(|number| *number += 1);
        let number = Arc::clone(&self.0);
        runtime.spawn(async move {
            message.await;
            number.send_modify(|number| *number -= 1);
        });
    }
}

impl NatsState {
    /// Waits until the ends of claims and locks are sent.
    pub(super) async fn flush(&self) {
        drop(self.endings.0.subscribe().wait_for(|number| *number == 0).await);
        drop(self.connection.flush().await);
    }
}
