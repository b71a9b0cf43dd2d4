//! Time after which work on a device is considered hung.

use std::time::Duration;

/// Maximum time of a submission on a slow device, as a multiple of its estimated time.
const MAX_SLOWDOWN: f64 = 100.0;

/// Maximum time of a build and of the first submission, as a multiple of the minimum limit of a submission. Drivers
/// take seconds to open a device and to compile its pipelines, and some compile them at their first use.
const FIRST_FACTOR: u32 = 3;

/// Returns the time limit of a submission: `minimum`, or more for a large amount of `work` on a slow device. `fastest`
/// is the shortest time per unit of work so far, s; without it, the limit is that of a build.
pub(super) fn of_submission(minimum: Duration, work: u64, fastest: Option<f64>) -> Duration {
    let Some(per_unit) = fastest else { return of_build(minimum) };
    Duration::try_from_secs_f64(MAX_SLOWDOWN * per_unit * work as f64).map_or(Duration::MAX, |limit| limit.max(minimum))
}

/// Returns the time limit of a build: opening a device and compiling its pipelines. `minimum` is that of a submission.
pub(super) const fn of_build(minimum: Duration) -> Duration {
    minimum.saturating_mul(FIRST_FACTOR)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slow_devices_have_more_time_for_large_batches() {
        let limit = |work, fastest| of_submission(Duration::from_secs(10), work, fastest);
        assert_eq!(limit(1 << 40, None), Duration::from_secs(30), "nothing is known about the device");
        assert_eq!(limit(50_000, Some(1e-7)), Duration::from_secs(10));
        assert_eq!(limit(50_000, Some(1e-4)), Duration::from_secs(500));
        assert_eq!(limit(u64::MAX, Some(1e9)), Duration::MAX);
    }
}
