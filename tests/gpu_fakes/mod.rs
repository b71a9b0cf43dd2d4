//! Fake devices with scripted behaviour: they finish jobs, fail, panic, get lost, or block until they are released.
#![allow(dead_code, reason = "every test crate compiles this file and uses some of it")]
#![allow(clippy::unwrap_used, clippy::panic, unreachable_pub, reason = "tests say what they expect by panicking")]

use std::collections::VecDeque;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex};
use std::time::{Duration, Instant};

use molmesh::gpu::{
    DevicePool, Executor, Finished, GpuError, GpuJob, NextJob, PictureBuild, PictureExecutor, PictureJob, PoolDevice,
    PoolSettings, Prepared, SheetBlocks,
};
use molmesh::surface::{
    CancelToken, Control, Exceeded, GridStats, Limit, Mesh, MeshOutput, Spheres, Stage, SurfaceError, SurfaceLimits,
    SurfaceParams,
};

/// Message of a lost device, with line breaks as drivers write them.
pub const LOST: &str = "scripted\n\n  loss";

/// Returns the lack of memory of a device that runs [`Step::OutOfMemory`].
pub fn lack_of_memory() -> Exceeded {
    Exceeded { actual: Some(9), ..Exceeded::new(Limit::DeviceBytes, 5) }.suggest(1.5)
}

/// Behaviour of an executor in one call.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Step {
    Finish,
    /// Blocks until released, or until every job of the call is cancelled or late, and then finishes.
    Block,
    /// Blocks until released, even if the jobs end.
    Hang,
    Lose,
    Fail,
    Panic,
    /// Returns one result too few.
    OmitResult,
    OutOfMemory,
}

/// Device with scripted behaviour that records its calls.
#[derive(Default)]
pub struct FakeDevice {
    /// Behaviour of the next calls; the last step is repeated.
    script: Mutex<VecDeque<Step>>,
    /// Number of atoms of every job, per call.
    calls: Mutex<Vec<Vec<usize>>>,
    released: Mutex<bool>,
    changed: Condvar,
    /// Number of submissions, from which hangs are detected.
    pub submissions: Arc<AtomicU64>,
    pub builds: AtomicUsize,
    pub drops: AtomicUsize,
    /// Bytes that were reserved, and number of calls before the reservation.
    pub reserved: Mutex<Option<(u64, usize)>>,
    next_job: Mutex<Option<NextJob>>,
    /// Number of calls to release idle memory.
    pub idle_releases: AtomicUsize,
    /// Build that blocks until released; `None`: none.
    pub hanging_build: Option<usize>,
    /// Number of builds that succeed; `None`: all.
    pub good_builds: Option<usize>,
}

impl FakeDevice {
    pub fn new(script: &[Step]) -> Arc<Self> {
        Arc::new(Self { script: Mutex::new(script.iter().copied().collect()), ..Self::default() })
    }

    /// Creates a device of which only the first `good_builds` builds succeed.
    pub fn building(script: &[Step], good_builds: usize) -> Arc<Self> {
        let script = Mutex::new(script.iter().copied().collect());
        Arc::new(Self { script, good_builds: Some(good_builds), ..Self::default() })
    }

    /// Creates a device whose build number `build`, counted from 0, blocks until released.
    pub fn hanging_in_build(script: &[Step], build: usize) -> Arc<Self> {
        let script = Mutex::new(script.iter().copied().collect());
        Arc::new(Self { script, hanging_build: Some(build), ..Self::default() })
    }

    /// Number of jobs in every call so far.
    pub fn calls(&self) -> Vec<usize> {
        self.calls.lock().unwrap().iter().map(Vec::len).collect()
    }

    /// Number of atoms of every job in every call so far.
    pub fn atoms(&self) -> Vec<Vec<usize>> {
        self.calls.lock().unwrap().clone()
    }

    /// Returns the job that would run next.
    pub fn next_job(&self) -> Option<GpuJob> {
        self.next_job.lock().unwrap().as_ref().and_then(|next| next())
    }

    pub fn release(&self) {
        *self.released.lock().unwrap() = true;
        self.changed.notify_all();
    }

    fn step(&self) -> Step {
        let mut script = self.script.lock().unwrap();
        match script.len() {
            0 => Step::Finish,
            1 => script[0],
            _ => script.pop_front().unwrap(),
        }
    }

    fn block(&self, jobs: &[GpuJob]) {
        let over = |job: &GpuJob| job.cancel.is_cancelled() || job.deadline.is_some_and(|d| d <= Instant::now());
        let mut released = self.released.lock().unwrap();
        while !*released && !jobs.iter().all(over) {
            released = self.changed.wait_timeout(released, Duration::from_millis(1)).unwrap().0;
        }
    }
}

impl FakeDevice {
    fn hang(&self) {
        let mut released = self.released.lock().unwrap();
        while !*released {
            released = self.changed.wait(released).unwrap();
        }
    }
}

struct FakeExecutor(Arc<FakeDevice>);

impl Drop for FakeExecutor {
    fn drop(&mut self) {
        self.0.drops.fetch_add(1, Ordering::SeqCst);
    }
}

impl Executor for FakeExecutor {
    fn run(&mut self, jobs: &[GpuJob]) -> Vec<Result<Finished, GpuError>> {
        self.0.calls.lock().unwrap().push(jobs.iter().map(|j| j.prepared.lattice.atoms.len()).collect());
        let step = self.0.step();
        match step {
            Step::Block => self.0.block(jobs),
            Step::Hang => self.0.hang(),
            _ => {}
        }
        let result = |job: &GpuJob| match step {
            Step::Finish | Step::Block | Step::OmitResult if job.cancel.is_cancelled() => {
                Err(GpuError::Surface(SurfaceError::Cancelled))
            }
            Step::Finish | Step::Block | Step::OmitResult if job.deadline.is_some_and(|d| d <= Instant::now()) => {
                Err(GpuError::Surface(SurfaceError::Deadline))
            }
            Step::Finish | Step::Block | Step::Hang | Step::OmitResult => Ok(Finished {
                meshed: MeshOutput::new(Mesh::default(), GridStats { grid_points: 7, ..GridStats::default() }),
                stages: vec![(Stage::Field, 2_000), (Stage::Emit, 1_000)],
                sheets: SheetBlocks::without_surface(job.prepared.plan.bricks.len()),
            }),
            Step::Lose => Err(GpuError::Lost(LOST.to_owned())),
            Step::Fail => Err(GpuError::Failed("scripted failure".to_owned())),
            Step::Panic => panic!("scripted failure"),
            Step::OutOfMemory => Err(GpuError::OutOfMemory(Box::new(lack_of_memory()))),
        };
        let n = if step == Step::OmitResult { jobs.len() - 1 } else { jobs.len() };
        jobs[..n].iter().map(result).collect()
    }

    fn submission_counter(&self) -> Arc<AtomicU64> {
        Arc::clone(&self.0.submissions)
    }

    fn set_next_job(&mut self, next: NextJob) {
        *self.0.next_job.lock().unwrap() = Some(next);
    }

    fn reserve_memory(&mut self, bytes: u64) {
        *self.0.reserved.lock().unwrap() = Some((bytes, self.0.calls().len()));
    }

    fn release_idle_memory(&mut self) {
        self.0.idle_releases.fetch_add(1, Ordering::SeqCst);
    }

    fn held_bytes(&self) -> u64 {
        if self.0.idle_releases.load(Ordering::SeqCst) == 0 { 4096 } else { 1024 }
    }
}

/// Device for pictures with scripted behaviour. Its pictures are black.
pub struct FakePictures(Arc<FakeDevice>);

impl FakePictures {
    pub fn new(script: &[Step]) -> Arc<Self> {
        Arc::new(Self(FakeDevice::new(script)))
    }

    /// Creates a device whose first build blocks until released.
    pub fn hanging_in_build() -> Arc<Self> {
        Arc::new(Self(FakeDevice::hanging_in_build(&[], 0)))
    }

    pub fn build(&self) -> PictureBuild {
        let fake = Arc::clone(&self.0);
        Arc::new(move || {
            let n = fake.builds.fetch_add(1, Ordering::SeqCst);
            if fake.hanging_build == Some(n) {
                fake.hang();
            }
            Ok(Box::new(FakeExecutor(Arc::clone(&fake))))
        })
    }

    pub fn builds(&self) -> usize {
        self.0.builds.load(Ordering::SeqCst)
    }

    /// Number of pictures that were begun.
    pub fn calls(&self) -> usize {
        self.0.calls().len()
    }

    pub fn release(&self) {
        self.0.release();
    }
}

impl PictureExecutor for FakeExecutor {
    fn draw(&mut self, _: &PictureJob) -> Result<Vec<[u8; 4]>, GpuError> {
        self.0.calls.lock().unwrap().push(Vec::new());
        match self.0.step() {
            Step::Hang => self.0.hang(),
            Step::Lose => return Err(GpuError::Lost(LOST.to_owned())),
            Step::Fail => return Err(GpuError::Failed("scripted failure".to_owned())),
            Step::Panic => panic!("scripted failure"),
            _ => {}
        }
        Ok(Vec::new())
    }
}

/// No pause between rebuilds, so that tests need not wait for it, and no idle time.
pub const SETTINGS: PoolSettings = PoolSettings {
    queue: 64,
    batch: 16,
    rebuild_pause: Duration::ZERO,
    idle: Duration::MAX,
    hang_timeout: Duration::MAX,
    cool_down: Duration::MAX,
    readback_bytes: None,
    min_partition_bricks: None,
};

/// Devices of a pool.
pub fn devices(fakes: &[Arc<FakeDevice>]) -> Vec<PoolDevice> {
    let device = |(number, fake): (usize, &Arc<FakeDevice>)| {
        let fake = Arc::clone(fake);
        let build = move || {
            let n = fake.builds.fetch_add(1, Ordering::SeqCst);
            if fake.hanging_build == Some(n) {
                fake.hang();
            }
            if fake.good_builds.is_some_and(|good| n >= good) {
                return Err(GpuError::Failed("scripted build failure".to_owned()));
            }
            Ok(Box::new(FakeExecutor(Arc::clone(&fake))) as Box<dyn Executor>)
        };
        PoolDevice { number, name: format!("fake {number}"), build: Box::new(build) }
    };
    fakes.iter().enumerate().map(device).collect()
}

pub fn pool(fakes: &[Arc<FakeDevice>], settings: PoolSettings) -> Arc<DevicePool> {
    Arc::new(DevicePool::start(devices(fakes), &settings).unwrap())
}

pub fn spheres(n: usize) -> Spheres {
    let at = |i: usize| f64::from(u32::try_from(i).unwrap()) * 2.0;
    Spheres::new((0..n).map(at).collect(), vec![0.0; n], vec![0.0; n], vec![1.7; n]).unwrap()
}

/// Creates a job of `n_atoms`; jobs of more than 5,000 atoms do not share a submission.
pub fn job(n_atoms: usize) -> GpuJob {
    let (params, limits) = (SurfaceParams::default(), SurfaceLimits::default());
    let prepared = Prepared::new(&spheres(n_atoms), &params, &limits, &Control::default()).unwrap();
    GpuJob { prepared: Arc::new(prepared), cancel: CancelToken::default(), deadline: None }
}

/// Thread that runs a job and returns the name of its device.
pub type Running = std::thread::JoinHandle<Result<String, GpuError>>;

/// Runs `job` on a new thread.
pub fn start(pool: &Arc<DevicePool>, job: &GpuJob) -> Running {
    let (pool, job) = (Arc::clone(pool), job.clone());
    std::thread::spawn(move || pool.run(&job).map(|completed| completed.device()))
}

#[track_caller]
pub fn wait_for(what: &str, mut done: impl FnMut() -> bool) {
    let start = Instant::now();
    while !done() {
        assert!(start.elapsed() < Duration::from_secs(20), "timed out waiting for {what}");
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// Waits until `load` jobs wait for or run on device `n`.
#[track_caller]
pub fn wait_for_load(pool: &DevicePool, n: usize, load: usize) {
    wait_for(&format!("{load} jobs on device {n}"), || pool.status()[n].waiting == load);
}
