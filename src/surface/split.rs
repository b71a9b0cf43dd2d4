//! Work for one thread or for all of them.
//!
//! Handing work to other threads costs a wake-up each time, some ten microseconds, and threads that look for work in vain
//! keep processors busy meanwhile. Where a job is small, or others are prepared beside it and give the processors enough to
//! do, it stays where it is.

use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;

/// Atoms of the largest job whose host work stays on its caller's thread in any case: less than a millisecond of work.
pub(super) const FEW: usize = 5120;

/// Callers that prepare a job at present.
static CALLERS: AtomicUsize = AtomicUsize::new(0);

/// A caller that prepares a job, for as long as this lives: the more there are, the larger the jobs that stay on their
/// callers' threads.
#[derive(Debug)]
#[must_use = "it counts while it lives"]
pub struct Caller(&'static AtomicUsize);

impl Default for Caller {
    /// One more.
    fn default() -> Self {
        Self::among(&CALLERS)
    }
}

impl Caller {
    fn among(callers: &'static AtomicUsize) -> Self {
        callers.fetch_add(1, Ordering::Relaxed);
        Self(callers)
    }
}

impl Drop for Caller {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}

/// Whether work on `n` atoms stays on its thread, by how many callers there are. From four on, one thread each keeps up with a
/// device that sends its meshes to the host; eight callers of jobs of 60,000 atoms, spread over 64 threads, had all of them
/// busy with looking for work, at half the rate. The result of the work does not depend on it.
pub(super) fn few(n: usize) -> bool {
    few_among(n, CALLERS.load(Ordering::Relaxed))
}

fn few_among(n: usize, callers: usize) -> bool {
    n <= FEW.saturating_mul(callers.max(1).saturating_pow(2))
}

/// What can be gone through by one thread or by all.
pub(super) trait Items: IntoIterator + IntoParallelIterator<Item = <Self as IntoIterator>::Item> {}

impl<I: IntoIterator + IntoParallelIterator<Item = <I as IntoIterator>::Item>> Items for I {}

/// Runs `work` on each of `items`: on this thread where `few`, on all otherwise.
pub(super) fn each<I: Items>(few: bool, items: I, work: impl Fn(<I as IntoIterator>::Item) + Send + Sync) {
    if few { items.into_iter().for_each(work) } else { items.into_par_iter().for_each(work) }
}

/// Likewise, with what comes of each, in order.
pub(super) fn map<I: Items, R: Send>(
    few: bool,
    items: I,
    work: impl Fn(<I as IntoIterator>::Item) -> R + Send + Sync,
) -> Vec<R> {
    if few { items.into_iter().map(work).collect() } else { items.into_par_iter().map(work).collect() }
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;
    use std::thread::current;

    use super::*;

    #[test]
    fn few_stay_on_their_thread_and_many_leave_it() {
        let here = current().id();
        for few in [true, false] {
            let threads: HashSet<_> = map(few, (0..64).collect::<Vec<_>>(), |_| current().id()).into_iter().collect();
            assert_eq!(threads.contains(&here), few, "no thread of the test is one of the pool's");
            let squares = map(few, vec![3, 1, 2], |n| n * n);
            assert_eq!(squares, [9, 1, 4]);
            let mut cells = [0; 5];
            each(few, cells.iter_mut().enumerate().collect::<Vec<_>>(), |(i, cell)| *cell = i + 1);
            assert_eq!(cells, [1, 2, 3, 4, 5]);
        }
    }

    #[test]
    fn the_more_callers_the_larger_the_jobs_that_stay() {
        assert_eq!([0, 1, 2, 100].map(|callers| few_among(FEW, callers)), [true; 4]);
        assert_eq!([0, 1, 2, 100].map(|callers| few_among(2 * FEW, callers)), [false, false, true, true]);
        assert_eq!([2, 3, 4].map(|callers| few_among(60_000, callers)), [false, false, true]);
    }

    #[test]
    fn callers_are_counted_while_they_are_there() {
        static HERE: AtomicUsize = AtomicUsize::new(0);
        let now = || HERE.load(Ordering::Relaxed);
        let one = Caller::among(&HERE);
        let two = Caller::among(&HERE);
        assert_eq!(now(), 2);
        drop(one);
        assert_eq!(now(), 1);
        drop(two);
        assert_eq!(now(), 0);
    }
}
