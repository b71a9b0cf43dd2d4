//! Executors that do as they are told: they serve, fail, panic, are lost, or hold a job until they are let go.
#![allow(dead_code, reason = "every test crate compiles this file and uses its own part")]
#![allow(clippy::unwrap_used, clippy::panic, unreachable_pub, reason = "tests say what they expect by panicking")]

use std::collections::VecDeque;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex};
use std::time::{Duration, Instant};

use molmesh::gpu::{DevicePool, Executor, Finished, GpuError, GpuJob, PoolDevice, PoolSettings, Prepared};
use molmesh::surface::{
    CancelToken, Control, GridStats, Mesh, MeshOutput, Spheres, Stage, SurfaceError, SurfaceLimits, SurfaceParams,
};

/// What a lost device says, in the manner of drivers.
pub const LOST: &str = "as\n\n  told";

/// What an executor does with one call.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Step {
    Serve,
    /// Waits until it is let go, or until every job of the call is cancelled or late.
    Hold,
    Lose,
    Fail,
    Panic,
    /// Answers fewer jobs than it was given.
    Forget,
    OutOfMemory,
}

/// A device that does as it is told, and writes down what happened to it.
#[derive(Default)]
pub struct Rig {
    /// What the next calls do; the last step, if there is one, stays.
    script: Mutex<VecDeque<Step>>,
    /// Atoms of every job, per call.
    calls: Mutex<Vec<Vec<usize>>>,
    let_go: Mutex<bool>,
    changed: Condvar,
    pub builds: AtomicUsize,
    pub drops: AtomicUsize,
    pub rests: AtomicUsize,
    /// Builds that succeed; none: all.
    pub good_builds: Option<usize>,
}

impl Rig {
    pub fn new(script: &[Step]) -> Arc<Self> {
        Arc::new(Self { script: Mutex::new(script.iter().copied().collect()), ..Self::default() })
    }

    /// A device of which only so many builds succeed.
    pub fn building(script: &[Step], good_builds: usize) -> Arc<Self> {
        let script = Mutex::new(script.iter().copied().collect());
        Arc::new(Self { script, good_builds: Some(good_builds), ..Self::default() })
    }

    /// Jobs in every call so far.
    pub fn calls(&self) -> Vec<usize> {
        self.calls.lock().unwrap().iter().map(Vec::len).collect()
    }

    /// Atoms of every job in every call so far.
    pub fn atoms(&self) -> Vec<Vec<usize>> {
        self.calls.lock().unwrap().clone()
    }

    pub fn let_go(&self) {
        *self.let_go.lock().unwrap() = true;
        self.changed.notify_all();
    }

    fn step(&self) -> Step {
        let mut script = self.script.lock().unwrap();
        match script.len() {
            0 => Step::Serve,
            1 => script[0],
            _ => script.pop_front().unwrap(),
        }
    }

    fn hold(&self, jobs: &[GpuJob]) {
        let over = |job: &GpuJob| job.cancel.is_cancelled() || job.deadline.is_some_and(|d| d <= Instant::now());
        let mut let_go = self.let_go.lock().unwrap();
        while !*let_go && !jobs.iter().all(over) {
            let_go = self.changed.wait_timeout(let_go, Duration::from_millis(1)).unwrap().0;
        }
    }
}

struct Fake(Arc<Rig>);

impl Drop for Fake {
    fn drop(&mut self) {
        self.0.drops.fetch_add(1, Ordering::SeqCst);
    }
}

impl Executor for Fake {
    fn run(&mut self, jobs: &[GpuJob]) -> Vec<Result<Finished, GpuError>> {
        self.0.calls.lock().unwrap().push(jobs.iter().map(|j| j.prepared.lattice.atoms.len()).collect());
        let step = self.0.step();
        if step == Step::Hold {
            self.0.hold(jobs);
        }
        let answer = |job: &GpuJob| match step {
            Step::Serve | Step::Hold | Step::Forget if job.cancel.is_cancelled() => {
                Err(GpuError::Surface(SurfaceError::Cancelled))
            }
            Step::Serve | Step::Hold | Step::Forget if job.deadline.is_some_and(|d| d <= Instant::now()) => {
                Err(GpuError::Deadline)
            }
            Step::Serve | Step::Hold | Step::Forget => Ok(Finished {
                meshed: MeshOutput::new(Mesh::default(), GridStats { samples: 7, ..GridStats::default() }),
                stages: vec![(Stage::Field, 2_000), (Stage::Emit, 1_000)],
            }),
            Step::Lose => Err(GpuError::Lost(LOST.to_owned())),
            Step::Fail => Err(GpuError::Failed("as told".to_owned())),
            Step::Panic => panic!("as told"),
            Step::OutOfMemory => Err(GpuError::OutOfMemory { needed: 9, available: 5, suggested_resolution: 1.5 }),
        };
        let n = if step == Step::Forget { jobs.len() - 1 } else { jobs.len() };
        jobs[..n].iter().map(answer).collect()
    }

    fn rest(&mut self) {
        self.0.rests.fetch_add(1, Ordering::SeqCst);
    }

    fn held_bytes(&self) -> u64 {
        if self.0.rests.load(Ordering::SeqCst) == 0 { 4096 } else { 1024 }
    }
}

/// No pause between rebuilds, so that tests need not wait for it, and no rest.
pub const SETTINGS: PoolSettings =
    PoolSettings { queue: 64, batch: 16, pause: Duration::ZERO, rest: Duration::MAX, spread_bricks: None };

/// The rigs as devices of a pool.
pub fn devices(rigs: &[Arc<Rig>]) -> Vec<PoolDevice> {
    let device = |(number, rig): (usize, &Arc<Rig>)| {
        let rig = Arc::clone(rig);
        let build = move || {
            let n = rig.builds.fetch_add(1, Ordering::SeqCst);
            if rig.good_builds.is_some_and(|good| n >= good) {
                return Err(GpuError::Failed("no build as told".to_owned()));
            }
            Ok(Box::new(Fake(Arc::clone(&rig))) as Box<dyn Executor>)
        };
        PoolDevice { number, name: format!("fake {number}"), build: Box::new(build) }
    };
    rigs.iter().enumerate().map(device).collect()
}

pub fn pool(rigs: &[Arc<Rig>], settings: PoolSettings) -> Arc<DevicePool> {
    Arc::new(DevicePool::start(devices(rigs), &settings).unwrap())
}

pub fn spheres(n: usize) -> Spheres {
    let at = |i: usize| f64::from(u32::try_from(i).unwrap()) * 2.0;
    Spheres::new((0..n).map(at).collect(), vec![0.0; n], vec![0.0; n], vec![1.7; n]).unwrap()
}

/// A job of so many atoms: more than 5,000 do not share a submission.
pub fn job(n_atoms: usize) -> GpuJob {
    let (params, limits) = (SurfaceParams::default(), SurfaceLimits::default());
    let prepared = Prepared::new(&spheres(n_atoms), &params, &limits, &Control::default()).unwrap();
    GpuJob { prepared: Arc::new(prepared), cancel: CancelToken::default(), deadline: None }
}

/// What came of a job: the device that did it.
pub type Ran = std::thread::JoinHandle<Result<String, GpuError>>;

/// Runs `job` on a thread of its own.
pub fn start(pool: &Arc<DevicePool>, job: &GpuJob) -> Ran {
    let (pool, job) = (Arc::clone(pool), job.clone());
    std::thread::spawn(move || pool.run(&job).map(|(_, device)| device))
}

#[track_caller]
pub fn wait_for(what: &str, mut done: impl FnMut() -> bool) {
    let start = Instant::now();
    while !done() {
        assert!(start.elapsed() < Duration::from_secs(20), "still not: {what}");
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// Waits until device `n` has so many jobs, waiting or running.
#[track_caller]
pub fn wait_for_load(pool: &DevicePool, n: usize, load: usize) {
    wait_for(&format!("{load} jobs on device {n}"), || pool.status()[n].waiting == load);
}
