//! Messages that end claims and locks.

use std::future::Future;
use std::sync::Arc;

use tokio::runtime::Handle;
use tokio::sync::watch;
use tokio::time::timeout;

use super::{NatsState, REQUEST};

/// Sender of messages that end claims and locks, with their number.
#[derive(Clone, Default)]
pub(super) struct Endings(Arc<watch::Sender<usize>>);

impl Endings {
    /// Sends a message in a task of its own. Does nothing after the end of the runtime.
    pub(super) fn send(&self, message: impl Future<Output = ()> + Send + 'static) {
        let Ok(runtime) = Handle::try_current() else { return };
        self.0.send_modify(|number| *number += 1);
        let unsent = Unsent(Arc::clone(&self.0));
        runtime.spawn(async move {
            message.await;
            drop(unsent);
        });
    }
}

/// Counts a message until it is sent, or its task ends otherwise.
struct Unsent(Arc<watch::Sender<usize>>);

impl Drop for Unsent {
    fn drop(&mut self) {
        self.0.send_modify(|number| *number -= 1);
    }
}

impl NatsState {
    /// Waits until the ends of claims and locks are sent, at most for the time of a request.
    pub(super) async fn flush(&self) {
        let sent = async {
            drop(self.endings.0.subscribe().wait_for(|number| *number == 0).await);
            drop(self.connection.flush().await);
        };
        drop(timeout(REQUEST, sent).await);
    }
}
