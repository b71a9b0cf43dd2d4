//! Wall time and progress of stages. The core itself has no clock.

use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use molmesh_surface::{Control, Observer, Stage};

/// Receiver of progress.
pub trait ProgressSink: Sync {
    /// Reports the fraction of a stage that is done, from 0 to 1. Several threads call it, at most a few thousand times
    /// a job.
    fn progress(&self, stage: &'static str, fraction: f64) {
        let _ = (stage, fraction);
    }

    /// Reports the start and the wall time of a completed stage. Interleaved stages are reported as if they ran in
    /// turn.
    fn ended(&self, stage: &'static str, begun: Instant, time: Duration) {
        let _ = (stage, begun, time);
    }
}

impl ProgressSink for () {}

/// Measures the wall time of stages.
///
/// The stages of a backend run interleaved on several threads. The wall time of their pass is divided among them in
/// proportion to the time that the threads spend in each stage. Times that a device reports remain unchanged, and the
/// rest of the pass is `roundtrip`: transfers and waiting for the device. Devices that run in parallel may report more
/// than the wall time; their stages are then scaled to it.
pub struct StageClock<'a> {
    sink: &'a dyn ProgressSink,
    busy_ns: [AtomicU64; Stage::ALL.len()],
    device_ns: [AtomicU64; Stage::ALL.len()],
    wall_ms: Mutex<Vec<(&'static str, f64)>>,
}

impl<'a> StageClock<'a> {
    /// Creates a clock that reports to `sink`.
    #[must_use]
    pub fn new(sink: &'a dyn ProgressSink) -> Self {
        Self { sink, busy_ns: Default::default(), device_ns: Default::default(), wall_ms: Mutex::default() }
    }

    /// Runs `work` and adds its wall time to the stage `name`.
    pub fn time<T>(&self, name: &'static str, work: impl FnOnce() -> T) -> T {
        self.sink.progress(name, 0.0);
        let start = Instant::now();
        let value = work();
        self.push(name, start, start.elapsed().as_secs_f64() * 1e3);
        value
    }

    /// Runs a pass of a backend and divides its wall time among its stages, which the backend reports through
    /// [`Observer::span`] and [`Observer::elapsed`].
    pub fn pass<T>(&self, work: impl FnOnce() -> T) -> T {
        let start = Instant::now();
        let value = work();
        let wall = start.elapsed().as_secs_f64() * 1e3;
        let take =
            |ns: &[AtomicU64; Stage::ALL.len()]| ns.each_ref().map(|ns| ns.swap(0, Ordering::Relaxed) as f64 / 1e6);
        let (busy, device) = (take(&self.busy_ns), take(&self.device_ns));
        let reported: f64 = busy.iter().chain(&device).sum();
        let by_device = device.iter().any(|ms| *ms > 0.0);
        // Times of host threads are scaled to the pass. Times of devices are kept if they fit into it.
        let scale = if by_device && reported <= wall { 1.0 } else { wall / reported };
        let mut begun = start;
        let mut push = |name, ms: f64| {
            self.push(name, begun, ms);
            begun += duration(ms);
        };
        for ((stage, host), device) in Stage::ALL.into_iter().zip(busy).zip(device) {
            if host + device > 0.0 {
                push(stage.name(), (host + device) * scale);
            }
        }
        if by_device {
            push("roundtrip", (wall - reported * scale).max(0.0));
        }
        value
    }

    /// Takes the wall time of each stage, ms, in execution order.
    pub fn finish(&self) -> Vec<(&'static str, f64)> {
        std::mem::take(&mut *self.wall_ms.lock().unwrap_or_else(std::sync::PoisonError::into_inner))
    }

    /// Adds a run of a stage. The runs of a stage are summed.
    fn push(&self, name: &'static str, begun: Instant, ms: f64) {
        self.sink.ended(name, begun, duration(ms));
        let mut times = self.wall_ms.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        match times.iter_mut().find(|(known, _)| *known == name) {
            Some((_, sum)) => *sum += ms,
            None => times.push((name, ms)),
        }
    }
}

/// Scope of work: its cancellation, memory and observer, which is its clock.
pub struct WorkScope<'a> {
    pub(super) clock: &'a StageClock<'a>,
    pub(super) control: Control<'a>,
}

impl<'a> WorkScope<'a> {
    /// Creates the scope of work that `control` limits and `clock` observes.
    #[must_use]
    pub fn new(clock: &'a StageClock<'a>, control: &Control<'a>) -> Self {
        Self { clock, control: Control { observer: clock, ..control.clone() } }
    }
}

fn duration(ms: f64) -> Duration {
    Duration::try_from_secs_f64(ms / 1e3).unwrap_or_default()
}

impl Observer for StageClock<'_> {
    fn span(&self, stage: Stage, work: &mut dyn FnMut()) {
        let start = Instant::now();
        work();
        let ns = u64::try_from(start.elapsed().as_nanos()).unwrap_or(u64::MAX);
        self.busy_ns[stage as usize].fetch_add(ns, Ordering::Relaxed);
    }

    fn elapsed(&self, stage: Stage, ns: u64) {
        self.device_ns[stage as usize].fetch_add(ns, Ordering::Relaxed);
    }

    fn progress(&self, stage: Stage, done: usize, total: usize) {
        self.sink.progress(stage.name(), done as f64 / total.max(1) as f64);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn device_times_are_kept_and_the_rest_is_the_roundtrip() {
        let clock = StageClock::new(&());
        clock.pass(|| {
            clock.span(Stage::Bin, &mut || {});
            clock.elapsed(Stage::Field, 2_000_000);
            clock.elapsed(Stage::Field, 1_000_000);
            std::thread::sleep(std::time::Duration::from_millis(8));
        });
        let times = clock.finish();
        let of = |name: &str| times.iter().find(|(n, _)| *n == name).map(|(_, ms)| *ms).unwrap();
        assert!((of("field") - 3.0).abs() < 1e-9, "{times:?}");
        assert!(of("roundtrip") >= 4.9 && of("bin") < 1.0, "{times:?}");
    }

    #[test]
    fn runs_of_a_stage_are_summed() {
        let clock = StageClock::new(&());
        for _ in 0..2 {
            clock.pass(|| {
                clock.elapsed(Stage::Field, 1_000_000);
                std::thread::sleep(Duration::from_millis(2));
            });
        }
        let times = clock.finish();
        assert_eq!(times.iter().filter(|(name, _)| *name == "field").count(), 1, "{times:?}");
        assert!(times.iter().any(|(name, ms)| *name == "field" && (ms - 2.0).abs() < 1e-9), "{times:?}");
    }

    #[test]
    fn parallel_devices_share_the_wall_time() {
        let clock = StageClock::new(&());
        let start = Instant::now();
        clock.pass(|| {
            clock.elapsed(Stage::Field, 3_000_000_000_000);
            clock.elapsed(Stage::Emit, 1_000_000_000_000);
        });
        let (wall, times) = (start.elapsed().as_secs_f64() * 1e3, clock.finish());
        let of = |name: &str| times.iter().find(|(n, _)| *n == name).map(|(_, ms)| *ms).unwrap();
        assert!((of("field") / of("emit") - 3.0).abs() < 1e-6 && of("roundtrip") < 1e-6, "{times:?}");
        assert!(of("field") + of("emit") <= wall, "{times:?}: more than {wall}");
    }

    #[test]
    fn the_sink_receives_the_start_of_each_stage() {
        struct Recorder(Mutex<Vec<(&'static str, Instant, Duration)>>);
        impl ProgressSink for Recorder {
            fn ended(&self, stage: &'static str, begun: Instant, time: Duration) {
                self.0.lock().unwrap().push((stage, begun, time));
            }
        }
        let (recorder, start) = (Recorder(Mutex::default()), Instant::now());
        let clock = StageClock::new(&recorder);
        clock.time("read", || ());
        clock.pass(|| {
            clock.elapsed(Stage::Field, 1000);
            clock.elapsed(Stage::Emit, 1000);
            std::thread::sleep(Duration::from_millis(1));
        });
        let stages = recorder.0.into_inner().unwrap();
        assert_eq!(stages.iter().map(|(name, ..)| *name).collect::<Vec<_>>(), ["read", "field", "emit", "roundtrip"]);
        for pair in stages.windows(2) {
            assert!(pair[0].1 >= start && pair[0].1 + pair[0].2 <= pair[1].1, "{stages:?}");
        }
    }

    #[test]
    fn without_a_device_the_stages_share_the_wall_time() {
        let clock = StageClock::new(&());
        clock.pass(|| clock.span(Stage::Field, &mut || std::thread::sleep(std::time::Duration::from_millis(2))));
        let times = clock.finish();
        assert_eq!(times.iter().map(|(name, _)| *name).collect::<Vec<_>>(), ["field"]);
    }
}
