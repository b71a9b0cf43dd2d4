//! Those who were refused and told when to come back: their places are held, so that the time they were told turns out right.
//! A request is known by its work when it comes back.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use rustc_hash::FxHashMap;

use super::flight::WorkKey;

/// Refused ones that are kept in mind.
const MOST: usize = 100_000;
/// Longest time that is told.
const LONGEST: Duration = Duration::from_mins(10);
/// How long a place is held for one who does not come.
const GRACE: Duration = Duration::from_secs(3);
/// How much too early still is in time: clocks and networks differ.
const EARLY: Duration = Duration::from_millis(300);

/// The refused ones, by the time that they were told.
#[derive(Debug, Default)]
pub(super) struct Returns {
    told: FxHashMap<WorkKey, Instant>,
    /// In the order of time.
    line: VecDeque<(Instant, WorkKey)>,
    /// When the last one in line would begin, to the fraction of a second.
    end: Option<Instant>,
}

impl Returns {
    /// Whether `work` was told to come back by now.
    pub(super) fn is_due(&self, work: &WorkKey, now: Instant) -> bool {
        self.told.get(work).is_some_and(|back| *back <= now + EARLY)
    }

    /// Places that are held for those who should be here, or are about to be.
    pub(super) fn held(&mut self, now: Instant) -> usize {
        while let Some((back, work)) = self.line.front().copied() {
            if back + GRACE >= now {
                break;
            }
            self.line.pop_front();
            self.told.remove(&work);
        }
        self.line.partition_point(|(back, _)| *back <= now + EARLY)
    }

    /// `work` is here.
    pub(super) fn came(&mut self, work: &WorkKey) {
        let Some(back) = self.told.remove(work) else { return };
        let at = self.line.partition_point(|(other, _)| *other < back);
        let Some(n) = self.line.range(at..).position(|(_, other)| other == work) else { return };
        self.line.remove(at + n);
    }

    /// Tells `work` when to come back: in whole seconds, behind everybody who was told before. A place is free after
    /// `first`, another one every `each`.
    pub(super) fn tell(&mut self, work: WorkKey, first: Duration, each: Duration, now: Instant) -> Duration {
        if let Some(back) = self.told.get(&work) {
            // It came too early: what it was told stands.
            return back.saturating_duration_since(now);
        }
        let behind = self.end.map_or(now, |end| end.max(now) + each);
        let begin = behind.max(now + first).min(now + LONGEST);
        let seconds = begin.saturating_duration_since(now).as_secs_f64().ceil().max(1.0);
        let wait = Duration::from_secs_f64(seconds);
        if self.line.len() < MOST && wait < LONGEST {
            self.end = Some(begin);
            let at = self.line.partition_point(|(back, _)| *back <= now + wait);
            self.line.insert(at, (now + wait, work));
            self.told.insert(work, now + wait);
        }
        wait
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::Job;
    use crate::store::Digest;

    fn work(n: u32) -> WorkKey {
        WorkKey::new(&Digest::of(&n.to_le_bytes()), &Job::default(), false)
    }

    #[test]
    fn everybody_gets_a_turn_of_their_own() {
        let (mut returns, now) = (Returns::default(), Instant::now());
        let (first, each) = (Duration::from_millis(200), Duration::from_millis(250));
        let waits: Vec<u64> = (0..40).map(|n| returns.tell(work(n), first, each, now).as_secs()).collect();
        assert!(waits.is_sorted() && waits[0] == 1, "{waits:?}");
        // Four a second.
        assert!((9..=11).contains(&waits[39]), "{waits:?}");
        assert!(!returns.is_due(&work(0), now));
        let later = now + Duration::from_secs(1);
        assert!(returns.is_due(&work(0), later) && !returns.is_due(&work(39), later));
        assert!((3..=6).contains(&returns.held(later)), "{}", returns.held(later));
        // Too early: nothing changes.
        assert!(returns.tell(work(39), first, each, later).as_secs() + 2 >= waits[39]);
        let before = returns.held(later);
        returns.came(&work(0));
        assert_eq!(returns.held(later), before - 1);
        assert!(!returns.is_due(&work(0), later));
        // Who does not come loses the place.
        assert_eq!(returns.held(now + LONGEST), 0);
        assert!(returns.told.is_empty());
    }

    #[test]
    fn times_are_bounded_and_so_is_the_line() {
        let (mut returns, now) = (Returns::default(), Instant::now());
        let wait = returns.tell(work(0), Duration::from_hours(1), Duration::ZERO, now);
        assert_eq!((wait, returns.line.len()), (LONGEST, 0));
        assert_eq!(returns.tell(work(1), Duration::ZERO, Duration::ZERO, now), Duration::from_secs(1));
    }
}
