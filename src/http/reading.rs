//! Reading of structures outside of jobs, on blocking threads.

use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::task::JoinHandle;
use tokio::time::timeout_at;

use super::guard::Caller;
use super::state::App;
use crate::jobs::Failure;
use crate::readers::Busy;
use crate::surface::{CancelOnDrop, Control};

impl App {
    /// Runs `work`, which reads a structure, on a blocking thread, and charges its time to the caller. First waits for
    /// the share of the client and for a permit, for at most half of `jobs.deadline_ms`, which limits the whole call. A
    /// request that would probably wait longer, or be late, is refused at once. If the request ends early, the work is
    /// cancelled; permits, memory and `held` are released when it has stopped.
    pub(super) async fn read<T: Send + 'static>(
        self: &Arc<Self>,
        caller: &Caller,
        held: impl Send + 'static,
        work: impl FnOnce(&Control<'_>) -> T + Send + 'static,
    ) -> Result<T, Failure> {
        let limit = Duration::from_millis(self.config.jobs.deadline_ms);
        let now = Instant::now();
        let (begin_by, end) = (now + limit / 2, now + limit);
        let late = |_elapsed| Failure::Deadline { limit };
        let waited = |Busy { wait }| Failure::Waited { limit, wait };
        let permit = self.readers.wait(Some(caller.client.0), begin_by, end).await.map_err(waited)?;
        let stop = CancelOnDrop::default();
        let (cancel, reservation) = (stop.0.clone(), self.memory(caller.client).reservation());
        let (app, payer) = (Arc::clone(self), caller.clone());
        let reading = spawn_holding((held, permit), move || {
            let begun = Instant::now();
            let control = Control { cancel, deadline: Some(end), memory: Arc::new(reservation), ..Control::default() };
            let value = app.pool.run(|| work(&control));
            app.charge(&payer, begun.elapsed());
            value
        });
        let read = timeout_at(end.into(), reading).await.map_err(late)?;
        read.map_err(|error| Failure::Panicked { message: error.to_string() })
    }
}

/// Runs `work` on a blocking thread. The thread drops `held` after the work, even if the caller has stopped waiting.
fn spawn_holding<T: Send + 'static>(
    held: impl Send + 'static,
    work: impl FnOnce() -> T + Send + 'static,
) -> JoinHandle<T> {
    tokio::task::spawn_blocking(move || {
        let value = work();
        drop(held);
        value
    })
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc;

    use tokio::sync::Semaphore;

    use super::*;

    #[tokio::test(flavor = "multi_thread", worker_threads = 1)]
    async fn a_request_that_ends_early_releases_nothing_before_its_work_has_stopped() {
        let (go, wait) = mpsc::sync_channel::<()>(1);
        let permits = Arc::new(Semaphore::new(1));
        let held = Arc::clone(&permits).acquire_owned().await.unwrap();
        let reading = spawn_holding(held, move || wait.recv().is_ok());
        assert!(tokio::time::timeout(Duration::from_millis(50), reading).await.is_err(), "the request has left");
        assert_eq!(permits.available_permits(), 0);
        go.send(()).unwrap();
        drop(tokio::time::timeout(Duration::from_mins(1), permits.acquire()).await.unwrap().unwrap());
    }
}
