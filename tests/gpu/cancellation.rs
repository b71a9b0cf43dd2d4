//! Jobs on a device end soon after their cancellation.

use std::sync::OnceLock;
use std::time::{Duration, Instant};

use molmesh::gpu::{DevicePool, Executor, GpuBackend, PoolDevice, PoolSettings};
use molmesh::surface::{Backend as _, CancelToken, Control, Observer, Stage, SurfaceError, SurfaceKind, SurfaceLimits};

use crate::gpu_support::{engine_with, params, spheres};

/// Maximum time from the cancellation to the end of a job.
const LIMIT: Duration = Duration::from_millis(50);
/// Number of attempts. Other programs may delay one of them; work that does not check is late in each.
const ATTEMPTS: usize = 5;

/// Records the start of the first stage.
#[derive(Default)]
struct Start(OnceLock<Instant>);

impl Observer for Start {
    fn span(&self, _stage: Stage, work: &mut dyn FnMut()) {
        self.0.get_or_init(Instant::now);
        work();
    }
}

#[test]
fn jobs_end_soon_after_cancellation_at_any_time() {
    let build = || Ok(Box::new(engine_with(|_| ())) as Box<dyn Executor>);
    let device = PoolDevice { number: 0, name: "device".to_owned(), build: Box::new(build) };
    let backend = GpuBackend::with_pool(DevicePool::start(vec![device], &PoolSettings::default()).unwrap());
    // 27,000 separate atoms have about 14 million triangles.
    let at = |i: usize| [i % 30, i / 30 % 30, i / 900].map(|k| 4.0 * k as f64);
    let rows: Vec<[f64; 4]> = (0..27_000).map(at).map(|[x, y, z]| [x, y, z, 1.7]).collect();
    let (spheres, params) = (spheres(&rows), params(SurfaceKind::Gaussian, 0.4));
    let attempt = |delay: Duration| {
        let (start, cancel) = (Start::default(), CancelToken::default());
        let control = Control { cancel: cancel.clone(), observer: &start, ..Control::default() };
        let stopped = std::thread::scope(|scope| {
            scope.spawn(|| {
                let started = *start.0.wait();
                std::thread::sleep(delay.saturating_sub(started.elapsed()));
                cancel.cancel();
            });
            backend.run(&spheres, &params, &SurfaceLimits::default(), &control)
        });
        let time = start.0.get().unwrap().elapsed();
        assert_eq!(stopped.map(|_| ()).unwrap_err(), SurfaceError::Cancelled, "{delay:?}");
        time.saturating_sub(delay)
    };
    // In stage bin, and while the device works.
    for delay in [0, 5, 100, 400, 2000].map(Duration::from_millis) {
        let mut times = (0..ATTEMPTS).map(|_| attempt(delay));
        assert!(times.any(|time| time < LIMIT), "{delay:?}");
    }
}
