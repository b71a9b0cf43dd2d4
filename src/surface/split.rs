//! Work for one thread or for all of them.
//!
//! Handing work to other threads costs a wake-up each time, some ten microseconds, and threads that look for work in vain
//! keep processors busy meanwhile. Where a job is small, or others are prepared beside it and give the processors enough to
//! do, it stays where it is.

use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;

/// Atoms of the largest job whose host work stays on its caller's thread in any case: half a millisecond of work, or one.
const FEW: usize = 2048;

/// Callers that place atoms or plan bricks at present.
static CALLERS: AtomicUsize = AtomicUsize::new(0);

/// One of them, for as long as this lives.
#[derive(Debug)]
pub(super) struct Caller(&'static AtomicUsize);

impl Caller {
    /// One more.
    pub(super) fn new() -> Self {
        Self::among(&CALLERS)
    }

    fn among(callers: &'static AtomicUsize) -> Self {
        callers.fetch_add(1, Ordering::Relaxed);
        Self(callers)
    }

    /// Whether its work on `n` atoms stays on its thread, by how many callers there are. From four on, one thread each keeps up
    /// with a device that sends its meshes to the host; jobs of 60,000 atoms from eight callers, spread over 64 threads, kept
    /// all of them busy with looking for work. The result of the work does not depend on it.
    pub(super) fn few(&self, n: usize) -> bool {
        n <= FEW.saturating_mul(self.0.load(Ordering::Relaxed).saturating_pow(3))
    }
}

impl Drop for Caller {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}

/// What can be gone through by one thread or by all.
pub(super) trait Items: IntoIterator + IntoParallelIterator<Item = <Self as IntoIterator>::Item> {}

impl<I: IntoIterator + IntoParallelIterator<Item = <I as IntoIterator>::Item>> Items for I {}

/// Runs `work` on each of `items`: on this thread where `few`, on all otherwise.
pub(super) fn each<I: Items>(few: bool, items: I, work: impl Fn(<I as IntoIterator>::Item) + Send + Sync) {
    if few { items.into_iter().for_each(work) } else { items.into_par_iter().for_each(work) }
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;
    use std::sync::Mutex;
    use std::thread::current;

    use super::*;

    #[test]
    fn small_jobs_stay_on_the_calling_thread() {
        let here = current().id();
        for few in [true, false] {
            let threads = Mutex::new(HashSet::new());
            each(few, (0..64).collect::<Vec<_>>(), |_| _ = threads.lock().unwrap().insert(current().id()));
            // The thread of the test does not belong to the pool.
            assert_eq!(threads.into_inner().unwrap().contains(&here), few);
            let mut cells = [0; 5];
            each(few, cells.iter_mut().enumerate().collect::<Vec<_>>(), |(i, cell)| *cell = i + 1);
            assert_eq!(cells, [1, 2, 3, 4, 5]);
        }
    }

    #[test]
    fn the_more_callers_the_larger_the_jobs_that_stay() {
        static HERE: AtomicUsize = AtomicUsize::new(0);
        let mut callers = Vec::new();
        let mut stays = |n_callers: usize| {
            callers.truncate(n_callers);
            callers.resize_with(n_callers, || Caller::among(&HERE));
            [FEW, FEW + 1, 60_000, usize::MAX].map(|n| callers[0].few(n))
        };
        assert_eq!(stays(1), [true, false, false, false]);
        assert_eq!(stays(2), [true, true, false, false]);
        assert_eq!(stays(4), [true, true, true, false]);
        // Those that have left do not count any more.
        assert_eq!(stays(1), [true, false, false, false]);
    }
}
