//! The device pool: one thread a device, a bounded queue before each, and callers that wait for their answers.
//!
//! A job goes to the least loaded device. If the device fails, the job is tried once more there, alone and on the
//! rebuilt device, then on the others; a device that fails too often in a row is given up. A large job is spread over the
//! devices that are free, and where that fails it goes to one, as any other. Cancellation and deadline are looked at while a
//! job waits, here, and while it runs, by the executor.

use std::io;
use std::sync::Arc;
use std::sync::mpsc::RecvTimeoutError;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use super::error::GpuError;
use super::executor::{Finished, GpuJob};
use super::queue::{Answer, NotPlaced, Place, Queues};
use super::spread::Spread;
use super::worker::{self, Build, Times};
use crate::surface::devices::SPREAD_BRICKS;
use crate::surface::{DeviceStatus, Stage, SurfaceError};

/// How often a waiting caller looks whether it was cancelled. Answers do not wait for it.
pub(super) const TICK: Duration = Duration::from_millis(5);
/// Attempts at a job on one device.
const TRIES: usize = 2;

/// A device and how it is built.
pub struct PoolDevice {
    /// Its number.
    pub number: usize,
    /// Its name, for people.
    pub name: String,
    /// Makes what runs jobs on it.
    pub build: Build,
}

/// Sizes of a pool.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PoolSettings {
    /// Jobs that wait for one device; callers of more wait for room.
    pub queue: usize,
    /// Small jobs that may share a submission.
    pub batch: usize,
    /// Pause after a failed rebuild, doubled each time.
    pub pause: Duration,
    /// How long a device has nothing to do before it lets go what it keeps for the next large job.
    pub rest: Duration,
    /// Bricks that each device gets at least of a job that is spread over several; none: no job is.
    pub spread_bricks: Option<u64>,
}

impl Default for PoolSettings {
    /// 64 jobs wait, so that a caller never does before memory runs short; 16 share a submission, after which another
    /// one costs less than waiting for a longer batch; a driver that restarts takes about half a second; five seconds are
    /// longer than a caller takes to come with the next of several large jobs.
    fn default() -> Self {
        let (pause, rest) = (Duration::from_millis(200), Duration::from_secs(5));
        Self { queue: 64, batch: 16, pause, rest, spread_bricks: Some(SPREAD_BRICKS) }
    }
}

/// Devices with their threads. Dropping it ends and joins the threads.
pub struct DevicePool {
    pub(super) queues: Arc<Queues>,
    threads: Vec<JoinHandle<()>>,
    pub(super) names: Vec<String>,
    pub(super) spread_bricks: Option<u64>,
}

/// A finished job and who made it.
#[derive(Debug, Clone)]
pub struct Ran {
    /// The job. Of one that several devices made, a stage's time is the longest of theirs.
    pub finished: Finished,
    /// Each device that had a part in it, in the order of their parts.
    pub by: Vec<Work>,
}

/// What a device did of a job.
#[derive(Debug, Clone)]
pub struct Work {
    /// Its name, for people.
    pub device: String,
    /// Device time per stage, ns.
    pub stages: Vec<(Stage, u64)>,
}

impl Ran {
    /// The device that made it, or all of them, for people.
    #[must_use]
    pub fn device(&self) -> String {
        describe(&self.by.iter().map(|work| work.device.as_str()).collect::<Vec<_>>())
    }
}

/// One device by its name, several by their number and names.
pub(super) fn describe(devices: &[&str]) -> String {
    match devices {
        [] => "no device is up".to_owned(),
        [one] => (*one).to_owned(),
        all => format!("{} devices: {}", all.len(), all.join(", ")),
    }
}

impl DevicePool {
    /// Starts a thread for each device and waits until every device is built or has failed to be.
    ///
    /// # Errors
    /// [`GpuError::NoDevice`] with every device's reason if none could be built, [`GpuError::Failed`] if a thread cannot
    /// be started.
    pub fn start(devices: Vec<PoolDevice>, settings: &PoolSettings) -> Result<Self, GpuError> {
        let known: Vec<(usize, String)> = devices.iter().map(|d| (d.number, d.name.clone())).collect();
        let queues = Arc::new(Queues::new(&known, settings.queue, settings.batch));
        let names = known.into_iter().map(|(_, name)| name).collect();
        let mut pool =
            Self { queues, threads: Vec::with_capacity(devices.len()), names, spread_bricks: settings.spread_bricks };
        for (n, device) in devices.into_iter().enumerate() {
            let (queues, times) = (Arc::clone(&pool.queues), Times { pause: settings.pause, rest: settings.rest });
            let thread = std::thread::Builder::new().name(format!("molmesh-gpu-{}", device.number));
            let started = thread.spawn(move || worker::work(&queues, n, &device.build, times));
            let failed = |e: io::Error| GpuError::Failed(format!("a device's thread cannot be started: {e}"));
            pool.threads.push(started.map_err(failed)?);
        }
        if pool.queues.started() { Ok(pool) } else { Err(GpuError::NoDevice(pool.queues.why_down())) }
    }

    /// Runs a job on some device, or on several, and waits for it. The name of who did it comes back too.
    ///
    /// # Errors
    /// Any [`GpuError`]: of the job, or [`GpuError::NoDevice`] with what the devices died of.
    pub fn run(&self, job: &GpuJob) -> Result<(Finished, String), GpuError> {
        let ran = self.ran(job)?;
        let device = ran.device();
        Ok((ran.finished, device))
    }

    /// Likewise, with what each device did.
    ///
    /// # Errors
    /// As [`Self::run`].
    pub fn ran(&self, job: &GpuJob) -> Result<Ran, GpuError> {
        match self.spread(job) {
            Spread::Done(ran) => Ok(*ran),
            Spread::Over(error) => Err(error),
            Spread::Failed(failures, why) => self.run_on(job, failures, Some(why)),
            Spread::No => self.run_on(job, vec![0; self.names.len()], None),
        }
    }

    /// Runs a job on device `n` (by its place in the pool) alone.
    ///
    /// # Errors
    /// As [`Self::run`].
    pub fn run_only_on(&self, n: usize, job: &GpuJob) -> Result<Finished, GpuError> {
        let tries = (0..self.names.len()).map(|other| if other == n { 0 } else { TRIES }).collect();
        self.run_on(job, tries, None).map(|ran| ran.finished)
    }

    /// Runs a job on one device. It has failed `tries` times on each, for `last` at last.
    fn run_on(&self, job: &GpuJob, mut tries: Vec<usize>, mut last: Option<GpuError>) -> Result<Ran, GpuError> {
        loop {
            let place = match self.queues.place(job, &tries, TRIES) {
                Ok(place) => place,
                Err(NotPlaced::Full) => {
                    over(job)?;
                    self.queues.moved(TICK);
                    continue;
                }
                Err(NotPlaced::NoDevice(why)) => {
                    // What this very job met with says more than what devices died of before.
                    return Err(last.unwrap_or(GpuError::NoDevice(why)));
                }
            };
            match self.wait(job, &place) {
                Ok(finished) => {
                    let work = Work { device: self.names[place.lane].clone(), stages: finished.stages.clone() };
                    return Ok(Ran { finished, by: vec![work] });
                }
                Err(error @ GpuError::OutOfMemory { .. }) => return Err(error),
                Err(error) if error.is_the_devices() => {
                    tries[place.lane] += 1;
                    last = Some(error);
                }
                Err(error) => return Err(error),
            }
        }
    }

    fn wait(&self, job: &GpuJob, place: &Place) -> Answer {
        loop {
            match place.answer.recv_timeout(TICK) {
                Ok(answer) => return answer,
                Err(RecvTimeoutError::Disconnected) => {
                    return Err(thread_ended());
                }
                Err(RecvTimeoutError::Timeout) => {
                    if let Err(error) = over(job) {
                        self.queues.forget(place);
                        return Err(error);
                    }
                }
            }
        }
    }

    /// Gives device `n` (by its place in the pool) up.
    pub fn give_up(&self, n: usize, why: &str) {
        self.queues.down(n, why);
    }

    /// How every device is doing.
    #[must_use]
    pub fn status(&self) -> Vec<DeviceStatus> {
        self.queues.status()
    }
}

/// What a caller gets whose job's thread is no more.
pub(super) fn thread_ended() -> GpuError {
    GpuError::Failed("its thread ended before the job did".to_owned())
}

/// Fails if nobody wants the job any more.
pub(super) fn over(job: &GpuJob) -> Result<(), GpuError> {
    if job.cancel.is_cancelled() {
        return Err(GpuError::Surface(SurfaceError::Cancelled));
    }
    if job.deadline.is_some_and(|deadline| deadline <= Instant::now()) { Err(GpuError::Deadline) } else { Ok(()) }
}

impl Drop for DevicePool {
    fn drop(&mut self) {
        self.queues.close();
        for thread in self.threads.drain(..) {
            // What panics in there is caught in there.
            drop(thread.join());
        }
    }
}
