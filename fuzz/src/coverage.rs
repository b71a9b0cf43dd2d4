//! Coverage of the library: which branches an input executes, and how often.

#![expect(unsafe_code, reason = "the compiler passes the counters as pointers")]

use std::sync::atomic::{AtomicU8, AtomicU64, Ordering::Relaxed};
use std::sync::{Mutex, PoisonError};

/// Address and number of the counters of each linked object.
static COUNTERS: Mutex<Vec<(usize, usize)>> = Mutex::new(Vec::new());

/// Receives the counters of an object before `main`, as `-sanitizer-coverage-inline-8bit-counters` demands.
#[unsafe(no_mangle)]
extern "C" fn __sanitizer_cov_8bit_counters_init(start: *mut u8, stop: *mut u8) {
    let range = (start.expose_provenance(), stop.addr() - start.addr());
    let mut counters = COUNTERS.lock().unwrap_or_else(PoisonError::into_inner);
    if !counters.contains(&range) {
        counters.push(range);
    }
}

/// Counters of the program, and the coverage of all inputs so far. Without counters, no coverage is new.
#[derive(Default)]
pub(crate) struct Coverage {
    counters: Vec<&'static [AtomicU8]>,
    /// One byte per counter, with one bit per range of counts.
    seen: Vec<u8>,
}

impl Coverage {
    /// Returns the counters; `None` if the program was built without them.
    pub(crate) fn new() -> Option<Self> {
        let ranges = COUNTERS.lock().unwrap_or_else(PoisonError::into_inner).clone();
        let slice = |&(start, n): &(usize, usize)| {
            let start = std::ptr::with_exposed_provenance::<AtomicU8>(start);
            // SAFETY: the compiler reserves these bytes for the life of the program. They are only read and written
            // here and by instrumented code, and any value is valid.
            unsafe { std::slice::from_raw_parts(start, n) }
        };
        let counters: Vec<_> = ranges.iter().map(slice).collect();
        let n = counters.iter().map(|c| c.len()).sum::<usize>();
        (n > 0).then(|| Self { counters, seen: vec![0; n] })
    }

    /// Sets all counters to zero.
    pub(crate) fn clear(&self) {
        self.counters.iter().copied().flatten().for_each(|counter| counter.store(0, Relaxed));
    }

    /// Adds the coverage since [`Self::clear`]. Returns true if some of it is new.
    pub(crate) fn merge(&mut self) -> bool {
        let mut is_new = false;
        let mut at = 0;
        for counters in &self.counters {
            // SAFETY: eight bytes of counters are one valid number.
            let (head, words, tail) = unsafe { counters.align_to::<AtomicU64>() };
            let words_end = head.len() + 8 * words.len();
            let zero = |i: usize| i >= head.len() && i < words_end && words[(i - head.len()) / 8].load(Relaxed) == 0;
            debug_assert_eq!(words_end + tail.len(), counters.len());
            let mut i = 0;
            while i < counters.len() {
                if zero(i) {
                    i += 8 - (i - head.len()) % 8;
                    continue;
                }
                let bit = bucket(counters[i].load(Relaxed));
                is_new |= bit & !self.seen[at + i] != 0;
                self.seen[at + i] |= bit;
                i += 1;
            }
            at += counters.len();
        }
        is_new
    }

    /// Returns the number of branches that any input executed.
    pub(crate) fn n_covered(&self) -> usize {
        self.seen.iter().filter(|seen| **seen != 0).count()
    }
}

/// Returns the bit of a count: 1, 2, 3, 4 to 7, 8 to 15, 16 to 31, 32 to 127, more.
fn bucket(count: u8) -> u8 {
    match count {
        0 => 0,
        1..=3 => 1 << (count - 1),
        4..=7 => 8,
        8..=15 => 16,
        16..=31 => 32,
        32..=127 => 64,
        128.. => 128,
    }
}
