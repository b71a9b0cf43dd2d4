//! Results that several callers share: the first caller starts the work, the others wait for its result.
//!
//! [`channel`] connects one run to its waiters. [`SingleFlight`] adds a map of the runs in progress by key.

use std::collections::HashMap;
use std::hash::Hash;
use std::sync::{Arc, PoisonError};

use tokio::sync::watch;

use crate::sync::{Handle, Mutex, MutexGuard};

/// Sending end of a shared result. Dropping it without a result ends every wait.
pub(crate) type ResultSender<T> = watch::Sender<Option<T>>;

/// Receiving end of a shared result.
#[derive(Debug, Clone)]
pub(crate) struct ResultReceiver<T>(watch::Receiver<Option<T>>);

/// Creates the two ends of a shared result.
pub(crate) fn channel<T>() -> (ResultSender<T>, ResultReceiver<T>) {
    let (sender, receiver) = watch::channel(None);
    (sender, ResultReceiver(receiver))
}

impl<T: Clone> ResultReceiver<T> {
    /// Creates a further receiver of a result.
    pub(crate) fn of(sender: &ResultSender<T>) -> Self {
        Self(sender.subscribe())
    }

    /// Waits for the result. `None` if the work ended without one. Cancel safe.
    pub(crate) async fn recv(&mut self) -> Option<T> {
        self.0.wait_for(Option::is_some).await.ok().and_then(|result| result.clone())
    }
}

type Running<K, T> = Mutex<HashMap<K, ResultReceiver<T>>>;

/// Tasks in progress by key, at most one for each key. A task runs to its end even if no caller waits for it any more.
#[derive(Debug)]
pub(crate) struct SingleFlight<K, T>(Arc<Running<K, T>>);

impl<K, T> Default for SingleFlight<K, T> {
    fn default() -> Self {
        Self(Arc::default())
    }
}

impl<K, T> SingleFlight<K, T>
where
    K: Clone + Eq + Hash + Send + 'static,
    T: Clone + Send + Sync + 'static,
{
    /// Returns the result of the task that runs for `key`, if one does.
    pub(crate) fn running(&self, key: &K) -> Option<ResultReceiver<T>> {
        lock(&self.0).get(key).cloned()
    }

    /// Returns the result of the task that runs for `key`; starts one with `start` if there is none.
    pub(crate) fn run<F>(&self, key: &K, start: impl FnOnce() -> F) -> ResultReceiver<T>
    where
        F: Future<Output = T> + Send + 'static,
    {
        let mut running = lock(&self.0);
        if let Some(receiver) = running.get(key) {
            return receiver.clone();
        }
        let (sender, receiver) = channel();
        running.insert(key.clone(), receiver.clone());
        // Spawned without the lock: a runtime that shuts down drops the task at once, and the task's entry takes the
        // lock.
        drop(running);
        let entry = RunningTask { running: Arc::clone(&self.0), key: key.clone() };
        let work = start();
        Handle::current().spawn(async move {
            let result = work.await;
            drop(entry);
            sender.send_replace(Some(result));
        });
        receiver
    }
}

fn lock<K, T>(running: &Running<K, T>) -> MutexGuard<'_, HashMap<K, ResultReceiver<T>>> {
    running.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Removes a task from the map when it ends, also by a panic.
struct RunningTask<K: Eq + Hash, T> {
    running: Arc<Running<K, T>>,
    key: K,
}

impl<K: Eq + Hash, T> Drop for RunningTask<K, T> {
    fn drop(&mut self) {
        lock(&self.running).remove(&self.key);
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};

    use tokio::sync::Notify;

    use super::*;

    #[tokio::test]
    async fn callers_share_one_run_and_the_next_run_is_new() {
        let (flights, runs, go) =
            (SingleFlight::<u8, usize>::default(), Arc::<AtomicUsize>::default(), Arc::new(Notify::new()));
        let run = |key| {
            let (runs, go) = (Arc::clone(&runs), Arc::clone(&go));
            flights.run(&key, || async move {
                go.notified().await;
                runs.fetch_add(1, Ordering::Relaxed) + 1
            })
        };
        let (mut first, mut second) = (run(1), run(1));
        assert!(flights.running(&1).is_some() && flights.running(&2).is_none());
        go.notify_one();
        assert_eq!((first.recv().await, second.recv().await), (Some(1), Some(1)));
        assert!(flights.running(&1).is_none());
        let mut third = run(1);
        go.notify_one();
        assert_eq!(third.recv().await, Some(2));
    }

    #[tokio::test]
    async fn a_panic_ends_every_wait_and_frees_the_key() {
        let flights = SingleFlight::<u8, u8>::default();
        let mut receiver = flights.run(&1, || async { std::panic::resume_unwind(Box::new(())) });
        assert_eq!(receiver.recv().await, None);
        assert!(flights.running(&1).is_none());
    }
}

#[cfg(test)]
#[cfg(feature = "shuttle")]
mod interleavings {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicUsize, Ordering};

    use shuttle::future::{block_on, yield_now};

    use super::SingleFlight;
    use crate::sync::thread;

    #[test]
    fn at_most_one_run_of_a_key_is_in_progress() {
        shuttle::check_random(
            || {
                let (flights, running) = (Arc::new(SingleFlight::<u8, u8>::default()), Arc::<AtomicUsize>::default());
                let callers: Vec<_> = (0..4)
                    .map(|n| {
                        let (flights, running) = (Arc::clone(&flights), Arc::clone(&running));
                        thread::spawn(move || {
                            let mut receiver = flights.run(&1, || async move {
                                assert_eq!(running.fetch_add(1, Ordering::SeqCst), 0, "two runs at once");
                                yield_now().await;
                                running.fetch_sub(1, Ordering::SeqCst);
                                n
                            });
                            // The last caller leaves.
                            n == 3 || block_on(receiver.recv()).is_some()
                        })
                    })
                    .collect();
                assert!(callers.into_iter().all(|caller| caller.join().unwrap()));
            },
            10_000,
        );
    }
}
