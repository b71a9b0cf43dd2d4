//! Threads: how work is handed out, and where the threads of a process that meshes once begin.
//!
//! A new thread begins on the processor of the thread that made it, and some kernels (those of small virtual machines
//! above all) leave it there for milliseconds although another processor is idle: longer than a small protein takes.

use std::sync::OnceLock;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Runs `work` for 0 to `n` on all threads, each taking the next that nobody has, and returns the results in order. The
/// calling thread never waits for one that does not come: whatever nobody else takes it does itself.
///
/// # Errors
/// The first that `work` meets; what has not begun by then does not.
pub(super) fn each<T: Send + Sync, E: Send + Sync>(
    n: usize,
    work: impl Fn(usize) -> Result<T, E> + Sync,
) -> Result<Vec<T>, E> {
    let (next, failed) = (AtomicUsize::new(0), OnceLock::new());
    let slots: Vec<OnceLock<T>> = (0..n).map(|_| OnceLock::new()).collect();
    let run = || {
        while failed.get().is_none() {
            let i = next.fetch_add(1, Ordering::Relaxed);
            let Some(slot) = slots.get(i) else { return };
            // Each slot and the first failure are set once.
            let _first = match work(i) {
                Ok(value) => slot.set(value).is_ok(),
                Err(error) => failed.set(error).is_ok(),
            };
        }
    };
    rayon::scope(|scope| {
        for _ in 1..rayon::current_num_threads().min(n) {
            scope.spawn(|_| run());
        }
        run();
    });
    match failed.into_inner() {
        Some(error) => Err(error),
        None => Ok(slots.into_iter().filter_map(OnceLock::into_inner).collect()),
    }
}

/// The processors that a pool's threads begin on.
#[cfg(target_os = "linux")]
pub(super) struct Homes {
    allowed: rustix::thread::CpuSet,
    /// The calling thread's.
    own: usize,
}

#[cfg(target_os = "linux")]
impl Homes {
    /// Keeps the calling thread on its processor until [`Self::free`]: others are about to be given theirs. `None` where
    /// the system does not allow it.
    pub(super) fn hold() -> Option<Self> {
        use rustix::thread::{CpuSet, sched_getaffinity, sched_getcpu, sched_setaffinity};

        let (allowed, own) = (sched_getaffinity(None).ok()?, sched_getcpu());
        let mut here = CpuSet::new();
        here.set(own);
        sched_setaffinity(None, &here).ok()?;
        Some(Self { allowed, own })
    }

    /// Moves the calling thread, the pool's `index`th from 1, to a processor of its own, if there are enough.
    pub(super) fn spread(&self, index: usize) {
        use rustix::thread::{CpuSet, sched_setaffinity};

        let mut others = (0..CpuSet::MAX_CPU).filter(|&cpu| cpu != self.own && self.allowed.is_set(cpu));
        let mut target = self.allowed;
        if let Some(cpu) = index.checked_sub(1).and_then(|i| others.nth(i)) {
            target.clear();
            target.set(cpu);
        }
        // Where it fails, the scheduler decides, as always.
        let _moved = sched_setaffinity(None, &target).is_ok();
    }

    /// Lets the calling thread go wherever it was allowed to.
    pub(super) fn free(&self) {
        let _freed = rustix::thread::sched_setaffinity(None, &self.allowed).is_ok();
    }
}

/// There is no portable way to choose a thread's processor.
#[cfg(not(target_os = "linux"))]
pub(super) struct Homes;

#[cfg(not(target_os = "linux"))]
impl Homes {
    pub(super) fn hold() -> Option<Self> {
        None
    }

    pub(super) fn spread(&self, _index: usize) {}

    pub(super) fn free(&self) {}
}
