//! Distribution of work among threads.

use std::sync::OnceLock;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Runs `work` for 0 to `n` on all threads of the pool and returns the results in order. Items start in ascending
/// order, so the costly ones should come first.
///
/// # Errors
/// The first error of `work`; items that have not started by then are skipped.
pub fn each<T: Send + Sync, E: Send + Sync>(
    n: usize,
    work: impl Fn(usize) -> Result<T, E> + Sync,
) -> Result<Vec<T>, E> {
    let (next, failed) = (AtomicUsize::new(0), OnceLock::new());
    let results: Vec<OnceLock<T>> = (0..n).map(|_| OnceLock::new()).collect();
    let run = || {
        while failed.get().is_none() {
            let i = next.fetch_add(1, Ordering::Relaxed);
            let Some(result) = results.get(i) else { return };
            // A result is set once. Of several errors, the first is kept.
            let _set = match work(i) {
                Ok(value) => result.set(value).is_ok(),
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
        None => Ok(results.into_iter().filter_map(OnceLock::into_inner).collect()),
    }
}
