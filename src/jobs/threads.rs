//! Threads of jobs. Each job has a Rayon pool of its own: a pool does not interrupt its tasks, so the short work of one
//! client would wait for the long work of another. The operating system divides the processors among the pools.

use std::sync::{Mutex, MutexGuard, PoisonError};

use rayon::{ThreadPool, ThreadPoolBuilder};

use super::rank::Lane;

/// Number of idle pools of a lane that are kept.
const KEPT: usize = 2;

impl Lane {
    /// Returns the nice value of the threads. HTTP threads have 0. Each step lowers the weight of a thread by a fifth.
    /// Idle processors are not affected.
    fn nice(self) -> i32 {
        match self {
            Self::Short => 5,
            Self::Long => 10,
            Self::Batch => 15,
        }
    }
}

/// Rayon pools by lane.
pub(super) struct ThreadPools {
    /// Number of threads of a pool.
    threads: usize,
    idle: [Mutex<Vec<ThreadPool>>; Lane::ALL.len()],
}

impl ThreadPools {
    /// Creates no pool yet. With `workers` jobs of a lane, their pools have at most four threads per processor.
    pub(super) fn new(workers: usize) -> Self {
        let all = rayon::current_num_threads();
        let threads = (4 * all).div_ceil(workers.max(1)).clamp(1, all);
        Self { threads, idle: Lane::ALL.map(|_| Mutex::default()) }
    }

    fn idle(&self, lane: Lane) -> MutexGuard<'_, Vec<ThreadPool>> {
        self.idle[lane as usize].lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Runs `work` on a pool of its own.
    pub(super) fn run<T: Send>(&self, lane: Lane, work: impl FnOnce() -> T + Send) -> T {
        let kept = self.idle(lane).pop();
        // Without threads of its own, the work shares those of the process.
        let Some(pool) = kept.or_else(|| self.create(lane)) else { return work() };
        let span = tracing::Span::current();
        let value = pool.install(|| span.in_scope(work));
        let mut idle = self.idle(lane);
        if idle.len() < KEPT {
            idle.push(pool);
        }
        value
    }

    /// Creates a pool. `None` if the system has no threads left.
    fn create(&self, lane: Lane) -> Option<ThreadPool> {
        let name = move |n| format!("{lane:?}-{n}").to_lowercase();
        let builder = ThreadPoolBuilder::new().num_threads(self.threads).thread_name(name);
        match builder.start_handler(move |_| set_nice(lane.nice())).build() {
            Ok(pool) => Some(pool),
            Err(error) => {
                tracing::warn!(%error, "the threads of a job were not started");
                None
            }
        }
    }
}

/// Sets the nice value of the current thread. Systems other than Linux have one for the whole process.
fn set_nice(nice: i32) {
    #[cfg(target_os = "linux")]
    if let Err(error) = rustix::process::setpriority_process(None, nice) {
        tracing::debug!(%error, "the priority of a thread was not set");
    }
    #[cfg(not(target_os = "linux"))]
    let _ = nice;
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicBool, Ordering};
    use std::time::{Duration, Instant};

    use rayon::prelude::*;

    use super::*;

    #[test]
    fn work_does_not_wait_for_the_threads_of_other_work() {
        let pools = ThreadPools::new(1);
        let on_all = |work: &(dyn Fn() -> bool + Sync)| (0..2 * pools.threads).into_par_iter().all(|_| work());
        let ended = AtomicBool::new(false);
        let begun = Instant::now();
        // Keeps its threads until the other work has ended.
        let wait = || {
            while !ended.load(Ordering::SeqCst) && begun.elapsed() < Duration::from_mins(1) {
                std::thread::yield_now();
            }
            ended.load(Ordering::SeqCst)
        };
        std::thread::scope(|scope| {
            let long = scope.spawn(|| pools.run(Lane::Batch, || on_all(&wait)));
            assert!(pools.run(Lane::Short, || on_all(&|| true)));
            ended.store(true, Ordering::SeqCst);
            assert!(long.join().unwrap(), "the short work waited");
        });
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn each_lane_has_its_priority() {
        let (pools, nice) = (ThreadPools::new(1), || rustix::process::getpriority_process(None).unwrap());
        let own = nice();
        // A process without privileges cannot raise its priority.
        let of_lanes = Lane::ALL.map(|lane| pools.run(lane, nice));
        assert_eq!(of_lanes, [5, 10, 15].map(|nice: i32| nice.max(own)));
        assert_eq!(nice(), own);
    }

    #[test]
    fn few_idle_pools_are_kept() {
        let pools = ThreadPools::new(1);
        let barrier = std::sync::Barrier::new(KEPT + 2);
        std::thread::scope(|scope| {
            for _ in 0..KEPT + 2 {
                scope.spawn(|| pools.run(Lane::Short, || barrier.wait()));
            }
        });
        assert_eq!(pools.idle(Lane::Short).len(), KEPT);
    }
}
