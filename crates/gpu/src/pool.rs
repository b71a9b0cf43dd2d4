//! Device pool: one thread and one bounded queue per device.
//!
//! A job goes to the least loaded device. If the device fails, the job is retried once on the rebuilt device, alone,
//! and then on the other devices. A device that fails too often in a row cools down before it is used again. A device
//! that hangs cools down as well; waiting callers detect the hang, and its thread is abandoned and replaced. A large
//! job runs on several idle devices, and if that fails, on one. The pool checks cancellation and deadline while a job
//! waits; the executor checks them while it runs.

use std::io;
use std::ops::Range;
use std::sync::{Arc, PoisonError};
use std::time::Duration;

use molmesh_surface::{DeviceStatus, Stage, SurfaceError};
use molmesh_sync::Mutex;
use molmesh_sync::mpsc::RecvTimeoutError;
use molmesh_sync::thread::{self, JoinHandle};

use super::device_queue::DeviceThread;
use super::error::GpuError;
use super::job::{Finished, GpuJob, JobResult};
use super::multi_device::{join, n_partitions};
use super::partition_handle::PartitionHandle;
use super::scheduler::{DeviceTicket, EnqueueError, PoolSettings, Scheduler};
use super::worker::{self, Build};

/// Interval at which a waiting caller checks for cancellation and deadline. Results wake it at once.
const POLL_INTERVAL: Duration = Duration::from_millis(5);
/// Maximum number of attempts at a job on one device.
const MAX_ATTEMPTS: usize = 2;
/// Maximum number of devices on which a job may hang, because the job may be the cause.
const MAX_HANGS: usize = 2;

/// Device of a pool.
pub struct PoolDevice {
    /// Number of the device.
    pub number: usize,
    /// Name of the device, for display.
    pub name: String,
    /// Builds the executor.
    pub build: Build,
}

/// Devices with their threads. Dropping the pool stops and joins the threads, except those that hang.
pub struct DevicePool {
    scheduler: Arc<Scheduler>,
    devices: Vec<SharedDevice>,
    threads: Mutex<Vec<(DeviceThread, JoinHandle<()>)>>,
}

/// Device that successive threads share.
type SharedDevice = Arc<PoolDevice>;

/// Finished job with the devices that ran it.
#[derive(Debug, Clone)]
pub struct CompletedJob {
    /// Mesh and stage times. In a multi-device job a stage's time is the longest of all devices.
    pub finished: Finished,
    /// Devices in the order of their partitions.
    pub devices: Vec<DeviceWork>,
}

/// Contribution of a device to a job.
#[derive(Debug, Clone)]
pub struct DeviceWork {
    /// Name of the device, for display.
    pub device: String,
    /// Device time per stage, ns.
    pub stages: Vec<(Stage, u64)>,
}

impl CompletedJob {
    /// Names of the devices, for display.
    #[must_use]
    pub fn device(&self) -> String {
        describe(&self.devices.iter().map(|work| work.device.as_str()).collect::<Vec<_>>())
    }
}

/// Describes one device by its name and several by their number and names.
pub(super) fn describe(devices: &[&str]) -> String {
    match devices {
        [] => "no device is up".to_owned(),
        [one] => (*one).to_owned(),
        all => format!("{} devices: {}", all.len(), all.join(", ")),
    }
}

/// Outcome of an attempt to run a job on several devices.
enum MultiDeviceOutcome {
    Done(Box<CompletedJob>),
    /// The job itself failed: it is invalid, late or cancelled.
    JobFailed(GpuError),
    /// Devices failed: number of failures per device, and the first reason.
    DevicesFailed(Vec<usize>, GpuError),
    /// The job is too small, or fewer than two devices are idle.
    NotApplicable,
}

impl DevicePool {
    /// Starts one thread per device and waits until every device is up or down. A device that hangs during its
    /// build is down.
    ///
    /// # Errors
    /// [`GpuError::NoDevice`] with the reasons of all devices if none is up; [`GpuError::Failed`] if a thread cannot be
    /// started.
    pub fn start(devices: Vec<PoolDevice>, settings: &PoolSettings) -> Result<Self, GpuError> {
        let known: Vec<(usize, String)> = devices.iter().map(|d| (d.number, d.name.clone())).collect();
        let scheduler = Arc::new(Scheduler::new(&known, *settings));
        let pool =
            Self { scheduler, devices: devices.into_iter().map(Arc::new).collect(), threads: Mutex::new(Vec::new()) };
        for n in 0..pool.devices.len() {
            let failed = |e: io::Error| GpuError::Failed(format!("the thread of a device cannot be started: {e}"));
            pool.spawn(n).map_err(failed)?;
        }
        while !pool.scheduler.wait_until_started(POLL_INTERVAL) {
            pool.check_for_hangs();
        }
        if pool.scheduler.is_any_up() { Ok(pool) } else { Err(GpuError::NoDevice(pool.scheduler.down_reasons())) }
    }

    /// Starts the current thread of device `n`.
    fn spawn(&self, n: usize) -> io::Result<()> {
        let (scheduler, device) = (Arc::clone(&self.scheduler), Arc::clone(&self.devices[n]));
        let thread = self.scheduler.begin_thread(n);
        let builder = thread::Builder::new().name(format!("molmesh-gpu-{}", device.number));
        let started = builder.spawn(move || worker::work(&scheduler, thread, &device.build));
        let handle = started.inspect_err(|_failed| self.scheduler.end_thread(thread))?;
        self.threads.lock().unwrap_or_else(PoisonError::into_inner).push((thread, handle));
        Ok(())
    }

    /// Takes hung devices down, fails their jobs, and starts the threads that will use the devices after the cool-down.
    fn check_for_hangs(&self) {
        self.check_devices(0..self.devices.len(), self.scheduler.settings.hang_timeout);
    }

    /// Does the work of [`Self::check_for_hangs`] for some devices.
    pub(super) fn check_devices(&self, devices: Range<usize>, hang_timeout: Duration) {
        for n in self.scheduler.take_hung(devices, hang_timeout) {
            // Without a thread the device stays down.
            drop(self.spawn(n));
        }
    }

    /// Runs a job on one or several devices and waits for it.
    ///
    /// # Errors
    /// Any [`GpuError`] of the job; [`GpuError::NoDevice`] with the reasons if all devices are down.
    pub fn run(&self, job: &GpuJob) -> Result<CompletedJob, GpuError> {
        match self.run_on_several(job) {
            MultiDeviceOutcome::Done(completed) => Ok(*completed),
            MultiDeviceOutcome::JobFailed(error) => Err(error),
            MultiDeviceOutcome::DevicesFailed(failures, why) => self.run_on_one(job, failures, Some(why)),
            MultiDeviceOutcome::NotApplicable => self.run_on_one(job, vec![0; self.devices.len()], None),
        }
    }

    /// Runs a job on device `n`, an index in the pool, only.
    ///
    /// # Errors
    /// Those of [`Self::run`].
    pub fn run_on_device(&self, n: usize, job: &GpuJob) -> JobResult {
        let failures = (0..self.devices.len()).map(|other| if other == n { 0 } else { MAX_ATTEMPTS }).collect();
        self.run_on_one(job, failures, None).map(|completed| completed.finished)
    }

    /// Runs a job on one device. `failures` counts the failed attempts so far per device; `last_error` is the error of
    /// the last one.
    fn run_on_one(
        &self,
        job: &GpuJob,
        mut failures: Vec<usize>,
        mut last_error: Option<GpuError>,
    ) -> Result<CompletedJob, GpuError> {
        let is_hang = |error: &GpuError| matches!(error, GpuError::Hung { .. });
        let mut hangs = usize::from(last_error.as_ref().is_some_and(is_hang));
        loop {
            let ticket = match self.scheduler.enqueue(job, &failures, MAX_ATTEMPTS, POLL_INTERVAL) {
                Ok(ticket) => ticket,
                Err(EnqueueError::Full) => {
                    job.check()?;
                    continue;
                }
                // The error of this job is more specific than the reasons of the devices.
                Err(EnqueueError::NoDevice(why)) => return Err(last_error.unwrap_or(GpuError::NoDevice(why))),
            };
            let n = ticket.device;
            match self.wait_for_all(job, &[ticket]).into_iter().next() {
                Some(Ok(finished)) => {
                    let devices = vec![self.work_of(n, &finished)];
                    return Ok(CompletedJob { finished, devices });
                }
                Some(Err(error)) if error.is_device_failure() && !matches!(error, GpuError::OutOfMemory(_)) => {
                    failures[n] += 1;
                    hangs += usize::from(is_hang(&error));
                    if hangs >= MAX_HANGS {
                        return Err(error);
                    }
                    last_error = Some(error);
                }
                Some(Err(error)) => return Err(error),
                None => return Err(thread_ended()),
            }
        }
    }

    /// Runs a large job on the idle devices.
    fn run_on_several(&self, job: &GpuJob) -> MultiDeviceOutcome {
        let idle = self.scheduler.idle_devices();
        let plan = &job.prepared.plan;
        let n = n_partitions(plan.bricks.len() as u64, idle.len(), self.scheduler.settings.min_partition_bricks);
        if n < 2 {
            return MultiDeviceOutcome::NotApplicable;
        }
        let handles = PartitionHandle::for_partitions(plan.partitions(n));
        let [first, _, ..] = &handles[..] else { return MultiDeviceOutcome::NotApplicable };
        let first = first.clone();
        let Some(tickets) = self.scheduler.enqueue_partitions(job, idle.into_iter().zip(handles).collect()) else {
            return MultiDeviceOutcome::NotApplicable;
        };
        let results = self.wait_for_all(job, &tickets);
        let (mut partitions, mut devices, mut job_errors) = (Vec::new(), Vec::new(), Vec::new());
        let (mut failures, mut device_error) = (vec![0; self.devices.len()], None);
        for (ticket, result) in tickets.iter().zip(results) {
            match result {
                Ok(finished) => {
                    devices.push(self.work_of(ticket.device, &finished));
                    partitions.push(finished);
                }
                Err(error) if error.is_device_failure() => {
                    // A device without the memory for a partition does not have it for the whole job either.
                    let no_memory = matches!(error, GpuError::OutOfMemory(_));
                    failures[ticket.device] = if no_memory { MAX_ATTEMPTS } else { 1 };
                    device_error.get_or_insert(error);
                }
                Err(error) => job_errors.push(error),
            }
        }
        if let Err(error) = job.check() {
            return MultiDeviceOutcome::JobFailed(error.into());
        }
        if let Some(error) = device_error {
            return MultiDeviceOutcome::DevicesFailed(failures, error);
        }
        // Partitions that were aborted because another one failed report a cancellation.
        job_errors.sort_by_key(|error| *error == GpuError::Surface(SurfaceError::Cancelled));
        if let Some(error) = job_errors.into_iter().next() {
            return MultiDeviceOutcome::JobFailed(error);
        }
        let finished = join(partitions, first.has_flat_vertices());
        MultiDeviceOutcome::Done(Box::new(CompletedJob { finished, devices }))
    }

    /// Waits for the results of all tickets of a job, in order. The failure of a partition aborts the others; their
    /// results are awaited nevertheless, because their devices are busy until then. If the job is cancelled or late,
    /// removes its entries from the queues and does not wait.
    fn wait_for_all(&self, job: &GpuJob, tickets: &[DeviceTicket]) -> Vec<JobResult> {
        let mut results = Vec::with_capacity(tickets.len());
        while let Some(ticket) = tickets.get(results.len()) {
            match ticket.result.recv_timeout(POLL_INTERVAL) {
                Ok(result) => results.push(result),
                Err(RecvTimeoutError::Disconnected) => results.push(Err(thread_ended())),
                Err(RecvTimeoutError::Timeout) => {
                    self.check_for_hangs();
                    if let Err(error) = job.check() {
                        for ticket in &tickets[results.len()..] {
                            self.scheduler.cancel(ticket);
                            results.push(ticket.result.try_recv().unwrap_or_else(|_pending| Err(error.clone().into())));
                        }
                    }
                }
            }
        }
        results
    }

    fn work_of(&self, n: usize, finished: &Finished) -> DeviceWork {
        DeviceWork { device: self.devices[n].name.clone(), stages: finished.stages.clone() }
    }

    /// Gives up device `n`, an index in the pool.
    pub fn give_up(&self, n: usize, why: &str) {
        self.scheduler.give_up(n, why);
    }

    /// Status of every device.
    #[must_use]
    pub fn status(&self) -> Vec<DeviceStatus> {
        self.check_for_hangs();
        self.scheduler.status()
    }
}

/// Error of a job whose device thread has ended.
fn thread_ended() -> GpuError {
    GpuError::Failed("its thread ended before the job did".to_owned())
}

impl Drop for DevicePool {
    fn drop(&mut self) {
        self.scheduler.close();
        self.scheduler.wait_until_ended(self.scheduler.settings.hang_timeout);
        for (thread, handle) in self.threads.lock().unwrap_or_else(PoisonError::into_inner).drain(..) {
            // A thread that hangs ends with the process.
            if self.scheduler.has_ended(thread) {
                // The thread catches its own panics.
                drop(handle.join());
            }
        }
    }
}
