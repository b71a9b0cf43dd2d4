//! Locks, channels, threads and tasks of the concurrent modules: those of `std` and Tokio, or, with the feature
//! `shuttle`, those of Shuttle, whose scheduler explores their interleavings in the tests named `interleavings`.

#[cfg(feature = "shuttle")]
pub use {
    shuttle::sync::{Condvar, Mutex, MutexGuard, mpsc},
    shuttle::thread,
};
#[cfg(not(feature = "shuttle"))]
pub use {
    std::sync::{Condvar, Mutex, MutexGuard, mpsc},
    std::thread,
    tokio::runtime::Handle,
    tokio::task::spawn_blocking,
    tokio::time::{sleep, timeout},
};

/// Counterpart of Tokio's handle: the scheduler of Shuttle runs all tasks.
#[cfg(feature = "shuttle")]
#[derive(Debug, Clone)]
pub struct Handle;

#[cfg(feature = "shuttle")]
impl Handle {
    /// Returns the handle.
    #[must_use]
    pub fn current() -> Self {
        Self
    }

    /// Starts a task, which runs to its end even if the returned handle is dropped.
    #[expect(clippy::unused_self, reason = "has the signature of Tokio's handle")]
    pub fn spawn<T: Send + 'static>(
        &self,
        task: impl Future<Output = T> + Send + 'static,
    ) -> shuttle::future::JoinHandle<T> {
        shuttle::future::spawn(task)
    }

    /// Runs a task on the current thread.
    #[expect(clippy::unused_self, reason = "has the signature of Tokio's handle")]
    pub fn block_on<T>(&self, task: impl Future<Output = T>) -> T {
        shuttle::future::block_on(task)
    }
}

/// Runs `work` at once: threads outside of the scheduler would be invisible to it.
///
/// # Errors
/// None; the signature is that of Tokio.
#[cfg(feature = "shuttle")]
#[expect(clippy::unused_async, reason = "has the signature of Tokio's function")]
pub async fn spawn_blocking<T>(work: impl FnOnce() -> T) -> std::io::Result<T> {
    Ok(work())
}

/// Lets other tasks run: the scheduler has no clock.
#[cfg(feature = "shuttle")]
pub async fn sleep(_: std::time::Duration) {
    shuttle::future::yield_now().await;
}

/// Runs `work` without a limit: the scheduler has no clock.
///
/// # Errors
/// None; the signature is that of Tokio.
#[cfg(feature = "shuttle")]
pub async fn timeout<T>(_: std::time::Duration, work: impl Future<Output = T>) -> Result<T, std::convert::Infallible> {
    Ok(work.await)
}

/// Runs a model under `schedules` random schedules.
#[cfg(feature = "shuttle")]
pub fn explore(model: impl Fn() + Send + Sync + 'static, schedules: usize) {
    let mut config = shuttle::Config::new();
    // The stack of a thread, bytes. Nested futures of unoptimized code need more than the default.
    config.stack_size = 1 << 20;
    shuttle::Runner::new(shuttle::scheduler::RandomScheduler::new(schedules), config).run(model);
}
