//! Memory that serves again: working columns of one job become those of the next, without the system in between.
//! Getting and returning two megabytes takes it longer than sorting the atoms that they hold takes sixteen threads.

use std::ops::{Deref, DerefMut};
use std::sync::{Mutex, PoisonError};

use memmap2::MmapMut;

/// Bytes of the largest piece that is kept; what is larger costs little beside the work on it.
const LARGEST: usize = 16 << 20;
/// Bytes that are kept idle at most.
const MOST: usize = 64 << 20;
/// An idle piece may be this many times too large for whom it serves.
const SLACK: usize = 4;

/// The idle pieces of this process.
static IDLE: Pool = Pool::new(MOST, LARGEST);

/// Idle pieces, those that came last at the end.
#[derive(Debug)]
struct Pool {
    idle: Mutex<Vec<MmapMut>>,
    most: usize,
    largest: usize,
}

impl Pool {
    const fn new(most: usize, largest: usize) -> Self {
        Self { idle: Mutex::new(Vec::new()), most, largest }
    }

    /// The smallest idle piece that holds `bytes` and is not far too large.
    fn take(&self, bytes: usize) -> Option<MmapMut> {
        let mut idle = self.idle.lock().unwrap_or_else(PoisonError::into_inner);
        let fits = |map: &MmapMut| (bytes..=bytes.saturating_mul(SLACK)).contains(&map.len());
        let best = (0..idle.len()).filter(|&i| fits(&idle[i])).min_by_key(|&i| idle[i].len())?;
        Some(idle.remove(best))
    }

    /// Keeps a piece; those that have been idle longest go until the others fit.
    fn give(&self, map: MmapMut) {
        if map.len() > self.largest {
            return;
        }
        let mut idle = self.idle.lock().unwrap_or_else(PoisonError::into_inner);
        idle.push(map);
        let mut held: usize = idle.iter().map(|map| map.len()).sum();
        let over = idle.iter().take_while(|map| {
            let goes = held > self.most;
            held -= if goes { map.len() } else { 0 };
            goes
        });
        let over = over.count();
        // The system takes them back behind the lock.
        let gone: Vec<MmapMut> = idle.drain(..over).collect();
        drop(idle);
        drop(gone);
    }
}

/// A piece of memory that goes back to the idle ones when it is dropped. What it holds at first is anything.
#[derive(Debug)]
pub(super) struct Recycled(Option<MmapMut>);

impl Recycled {
    /// `bytes` or more, from the idle pieces or else by `make`.
    pub(super) fn new(bytes: usize, make: impl FnOnce() -> Option<MmapMut>) -> Option<Self> {
        IDLE.take(bytes).or_else(make).map(|map| Self(Some(map)))
    }
}

impl Deref for Recycled {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        self.0.as_deref().unwrap_or_default()
    }
}

impl DerefMut for Recycled {
    fn deref_mut(&mut self) -> &mut [u8] {
        self.0.as_deref_mut().unwrap_or_default()
    }
}

impl Drop for Recycled {
    fn drop(&mut self) {
        if let Some(map) = self.0.take() {
            IDLE.give(map);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn map(bytes: usize) -> MmapMut {
        MmapMut::map_anon(bytes).unwrap()
    }

    fn lengths(pool: &Pool) -> Vec<usize> {
        pool.idle.lock().unwrap().iter().map(|map| map.len()).collect()
    }

    #[test]
    fn the_best_fitting_piece_serves_again() {
        let pool = Pool::new(1000, 500);
        for bytes in [300, 100, 200, 501] {
            pool.give(map(bytes));
        }
        assert_eq!(lengths(&pool), [300, 100, 200], "what is too large is not kept");
        let take = |bytes| pool.take(bytes).map(|map| map.len());
        assert_eq!((take(24), take(301)), (None, None), "far too large, too small");
        assert_eq!((take(101), take(101), take(101), take(25)), (Some(200), Some(300), None, Some(100)));
    }

    #[test]
    fn the_longest_idle_go_first() {
        let pool = Pool::new(1000, 500);
        for n in 1..=4 {
            pool.give(map(100 * n));
        }
        assert_eq!(lengths(&pool), [100, 200, 300, 400]);
        pool.give(map(250));
        assert_eq!(lengths(&pool), [300, 400, 250]);
    }

    #[test]
    fn a_piece_is_as_large_as_it_was_asked_for() {
        let piece = Recycled::new(70_000, || Some(map(70_000))).unwrap();
        assert!(piece.len() >= 70_000);
        assert!(Recycled::new(usize::MAX, || None).is_none());
    }
}
