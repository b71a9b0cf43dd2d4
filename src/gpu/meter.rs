//! What an engine counts besides its jobs' results, for whoever measures it: submissions, and device time from the first
//! stage's begin to the last one's end, with what lies between.

use std::cell::Cell;

/// Counters since the last look.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Metered {
    /// Submissions that were made.
    pub submissions: u64,
    /// Device time from first to last stage of each submission, summed, ns; 0 where the device has no timestamps. Stages
    /// on a device may overlap, and gaps between them count here.
    pub device_ns: u64,
}

/// The counters of an engine.
#[derive(Debug, Default)]
pub(super) struct Meter(Cell<Metered>);

impl Meter {
    pub(super) fn count_submission(&self) {
        let was = self.0.get();
        self.0.set(Metered { submissions: was.submissions + 1, ..was });
    }

    /// Adds the time between the first and the last of some `ticks` of `period` ns.
    pub(super) fn add_span(&self, ticks: &[u64], period: f64) {
        let (first, last) = (ticks.iter().min(), ticks.iter().max());
        let span = first.zip(last).map_or(0, |(first, last)| last - first);
        let was = self.0.get();
        self.0.set(Metered { device_ns: was.device_ns + super::recording::ticks_to_ns(span, period), ..was });
    }

    pub(super) fn take(&self) -> Metered {
        self.0.take()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spans_and_submissions_add_up_and_are_taken_once() {
        let meter = Meter::default();
        meter.add_span(&[5, 7, 7, 15], 2.0);
        meter.add_span(&[100, 130], 2.0);
        meter.add_span(&[], 2.0);
        meter.count_submission();
        assert_eq!(meter.take(), Metered { submissions: 1, device_ns: 80 });
        assert_eq!(meter.take(), Metered::default());
    }
}
