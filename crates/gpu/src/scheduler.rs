//! Scheduler: one bounded queue per device, behind one lock. Callers enqueue jobs and device threads take them.

use std::cmp::Reverse;
use std::collections::VecDeque;
use std::sync::atomic::AtomicU64;
use std::sync::{Arc, PoisonError};
use std::time::{Duration, Instant};

use molmesh_surface::devices::MIN_PARTITION_BRICKS;
use molmesh_surface::{DeviceStatus, SurfaceError};
use molmesh_sync::mpsc::{Receiver, sync_channel};
use molmesh_sync::{Condvar, Mutex, MutexGuard};

use super::device_queue::{DeviceQueue, DeviceState, DeviceThread, RunOutcome, down_reasons, reject};
use super::error::GpuError;
use super::job::{GpuJob, JobResult};
use super::partition_handle::PartitionHandle;
use super::queued_job::QueuedJob;
use super::running_batch::RunningBatch;

/// Settings of a pool.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PoolSettings {
    /// Maximum number of jobs that wait for one device; further callers block.
    pub queue: usize,
    /// Maximum number of small jobs that share a submission.
    pub batch: usize,
    /// Pause after a failed rebuild, doubled each time.
    pub rebuild_pause: Duration,
    /// Time without work after which a device releases the memory that it keeps for the next large job.
    pub idle: Duration,
    /// Minimum time without a submission after which a running device is considered hung.
    pub hang_timeout: Duration,
    /// Pause before a device that went down is used again, doubled each time until it finishes a job.
    pub cool_down: Duration,
    /// Bytes of readback buffers that a device allocates before its first job and keeps while it is idle. `None`
    /// allocates none, and keeps up to 2 GiB of buffers from jobs.
    pub readback_bytes: Option<u64>,
    /// Minimum number of bricks per partition of a multi-device job. `None` disables multi-device jobs.
    pub min_partition_bricks: Option<u64>,
}

impl Default for PoolSettings {
    /// Returns the defaults. With 64 waiting jobs, memory runs out before callers block. With 16 jobs per submission,
    /// the fixed cost is negligible. A driver restarts in about half a second: it is retried after 200 ms. The gaps
    /// between consecutive large jobs of one caller are shorter than 5 s. A submission takes less than a second, and
    /// resetting a device less than a minute.
    fn default() -> Self {
        Self {
            queue: 64,
            batch: 16,
            rebuild_pause: Duration::from_millis(200),
            idle: Duration::from_secs(5),
            hang_timeout: Duration::from_secs(10),
            cool_down: Duration::from_mins(1),
            readback_bytes: None,
            min_partition_bricks: Some(MIN_PARTITION_BRICKS),
        }
    }
}

/// State behind the lock.
pub(super) struct SchedulerState {
    pub(super) queues: Vec<DeviceQueue>,
    pub(super) closed: bool,
    next_id: u64,
}

/// Queues of all devices.
pub(super) struct Scheduler {
    state: Mutex<SchedulerState>,
    /// Notified when a queue or the state of a device has changed.
    pub(super) changed: Condvar,
    /// Notified when a job was added, one per device.
    pub(super) added: Vec<Condvar>,
    pub(super) settings: PoolSettings,
}

/// Ticket of an enqueued job.
pub(super) struct DeviceTicket {
    /// Index of the device.
    pub(super) device: usize,
    id: u64,
    pub(super) result: Receiver<JobResult>,
}

/// Reason why a job was not enqueued.
pub(super) enum EnqueueError {
    /// The queues of all eligible devices are still full after a wait.
    Full,
    /// No device is eligible. Contains the reasons of the devices that are down.
    NoDevice(String),
}

impl SchedulerState {
    /// Returns the queue of a thread unless the thread was replaced.
    pub(super) fn queue_of(&mut self, thread: DeviceThread) -> Option<&mut DeviceQueue> {
        self.queues.get_mut(thread.device).filter(|queue| queue.generation == thread.generation)
    }

    /// Adds a job to the queue of device `n`.
    fn push(&mut self, n: usize, job: &GpuJob, partition: Option<PartitionHandle>, retry: bool) -> DeviceTicket {
        let (reply, result) = sync_channel(1);
        let id = self.next_id;
        self.next_id += 1;
        self.queues[n].push(QueuedJob { id, job: job.clone(), partition, retry, reply });
        DeviceTicket { device: n, id, result }
    }
}

impl Scheduler {
    /// Creates the queues of `devices`, given by number and name.
    pub(super) fn new(devices: &[(usize, String)], settings: PoolSettings) -> Self {
        let settings = PoolSettings { queue: settings.queue.max(1), batch: settings.batch.max(1), ..settings };
        let queue = |(number, name): &(usize, String)| {
            DeviceQueue::new(*number, name.clone(), settings.queue, settings.cool_down)
        };
        Self {
            state: Mutex::new(SchedulerState {
                queues: devices.iter().map(queue).collect(),
                closed: false,
                next_id: 0,
            }),
            changed: Condvar::new(),
            added: devices.iter().map(|_| Condvar::new()).collect(),
            settings,
        }
    }

    pub(super) fn lock(&self) -> MutexGuard<'_, SchedulerState> {
        // No code panics between two changes under the lock, so a poisoned state is consistent.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Enqueues `job` at the least loaded device that is up and on which it has failed fewer than `max_failures` times.
    /// Prefers a device that already failed this job: it has just been rebuilt, and the others are probably busy. If
    /// all queues are full, waits until a queue or a device changes, at most for `timeout`.
    pub(super) fn enqueue(
        &self,
        job: &GpuJob,
        failures: &[usize],
        max_failures: usize,
        timeout: Duration,
    ) -> Result<DeviceTicket, EnqueueError> {
        let mut state = self.lock();
        let queues = &state.queues;
        let eligible = |n: &usize| failures[*n] < max_failures && matches!(queues[*n].state, DeviceState::Up);
        if !(0..queues.len()).any(|n| eligible(&n)) {
            return Err(EnqueueError::NoDevice(down_reasons(queues)));
        }
        let best = (0..queues.len())
            .filter(|n| eligible(n) && queues[*n].waiting.len() < self.settings.queue)
            .min_by_key(|&n| (Reverse(failures[n]), queues[n].load, queues[n].counters.finished));
        let Some(n) = best else {
            drop(self.changed.wait_timeout(state, timeout));
            return Err(EnqueueError::Full);
        };
        let ticket = state.push(n, job, None, failures.iter().any(|n| *n > 0));
        drop(state);
        self.added[n].notify_one();
        Ok(ticket)
    }

    /// Returns the idle devices, least loaded first.
    pub(super) fn idle_devices(&self) -> Vec<usize> {
        let state = self.lock();
        let mut idle: Vec<usize> = (0..state.queues.len()).filter(|&n| state.queues[n].is_idle()).collect();
        idle.sort_by_key(|&n| (state.queues[n].load, state.queues[n].counters.finished));
        idle
    }

    /// Enqueues the partitions of `job` at their devices, all at once: the partitions of two jobs are then in the same
    /// order on every device and never wait for each other. `None` if one of the devices is no longer idle.
    pub(super) fn enqueue_partitions(
        &self,
        job: &GpuJob,
        partitions: Vec<(usize, PartitionHandle)>,
    ) -> Option<Vec<DeviceTicket>> {
        let mut state = self.lock();
        let accepts = |queue: &DeviceQueue| queue.is_idle() && queue.waiting.len() < self.settings.queue;
        if !partitions.iter().all(|(n, _)| accepts(&state.queues[*n])) {
            return None;
        }
        let tickets: Vec<DeviceTicket> =
            partitions.into_iter().map(|(n, partition)| state.push(n, job, Some(partition), false)).collect();
        drop(state);
        for ticket in &tickets {
            self.added[ticket.device].notify_one();
        }
        Some(tickets)
    }

    /// Removes a job from its queue. A running job checks its cancellation token by itself.
    pub(super) fn cancel(&self, ticket: &DeviceTicket) {
        let mut state = self.lock();
        let queue = &mut state.queues[ticket.device];
        let position = queue.waiting.iter().position(|job| job.id == ticket.id);
        let removed = position.and_then(|at| queue.waiting.remove(at));
        queue.load -= removed.as_ref().map_or(0, QueuedJob::load);
        drop(state);
        self.changed.notify_all();
        // The input, which may be large, is freed outside the lock.
        drop(removed);
    }

    /// Waits for the next batch of a device: one job, or several small ones. The batch is empty if no job came for
    /// [`PoolSettings::idle`]. Returns `None` once the device is down, its thread replaced, or the scheduler closed.
    /// `submissions` is the counter of the executor.
    pub(super) fn next_batch(&self, thread: DeviceThread, submissions: &Arc<AtomicU64>) -> Option<Vec<QueuedJob>> {
        let mut state = self.lock();
        state.queue_of(thread)?.running = None;
        let mut timed_out = false;
        loop {
            let closed = state.closed;
            let queue = state.queue_of(thread)?;
            if closed || matches!(queue.state, DeviceState::Down(_)) {
                return None;
            }
            let mut batch = Vec::new();
            while let Some(first) = queue.waiting.pop_front() {
                if let Err(error) = first.job.check() {
                    queue.load -= first.load();
                    first.reply(Err(error.into()));
                    continue;
                }
                let batchable = first.is_batchable();
                batch.push(first);
                if batchable {
                    self.fill_batch(&mut queue.waiting, &mut batch);
                }
                break;
            }
            if !batch.is_empty() {
                queue.running = Some(RunningBatch::new(&batch, Arc::clone(submissions), Instant::now()));
                queue.counters.shared += u64::from(batch.len() > 1);
                drop(state);
                self.changed.notify_all();
                return Some(batch);
            }
            if timed_out {
                return Some(batch);
            }
            let waited = self.added[thread.device]
                .wait_timeout(state, self.settings.idle)
                .unwrap_or_else(PoisonError::into_inner);
            (state, timed_out) = (waited.0, waited.1.timed_out());
        }
    }

    /// Returns the job that a device will run alone after the current batch. `None` if there is no such job yet, or if
    /// the current batch has failed before and therefore must not overlap with another job.
    pub(super) fn next_job(&self, thread: DeviceThread) -> Option<GpuJob> {
        let mut state = self.lock();
        let queue = state.queue_of(thread)?;
        let next = queue.waiting.front().filter(|next| next.is_alone())?;
        let runs_retry = queue.running.as_ref().is_none_or(|running| running.is_retry);
        (!runs_retry).then(|| next.job.clone())
    }

    /// Sets the bytes of memory that a device holds.
    pub(super) fn set_held_bytes(&self, thread: DeviceThread, bytes: u64) {
        if let Some(queue) = self.lock().queue_of(thread) {
            queue.counters.held_bytes = bytes;
        }
    }

    /// Moves small jobs from anywhere in `waiting` to `batch`. A large job ahead of them becomes the next batch.
    fn fill_batch(&self, waiting: &mut VecDeque<QueuedJob>, batch: &mut Vec<QueuedJob>) {
        let mut at = 0;
        while at < waiting.len() && batch.len() < self.settings.batch {
            if waiting[at].is_batchable() && waiting[at].job.check().is_ok() {
                batch.extend(waiting.remove(at));
            } else {
                at += 1;
            }
        }
    }

    /// Records the results of a batch before it sends them, so that callers that retry find the state of the device
    /// updated. If the thread was replaced, its callers have an error already, and the results are dropped.
    pub(super) fn finish_batch(
        &self,
        thread: DeviceThread,
        batch: Vec<QueuedJob>,
        results: Vec<JobResult>,
        outcome: RunOutcome,
    ) {
        let RunOutcome { time, held_bytes, failed, down } = outcome;
        let mut left = VecDeque::new();
        {
            let mut state = self.lock();
            let Some(queue) = state.queue_of(thread) else { return };
            for (job, result) in batch.iter().zip(&results) {
                queue.load -= job.load();
                match result {
                    Ok(_) => {
                        queue.counters.finished += 1;
                        queue.counters.partitions += u64::from(job.partition.is_some());
                    }
                    Err(error) if error.is_device_failure() => queue.counters.failed += 1,
                    Err(_) => {}
                }
            }
            if results.iter().any(proves_device_works) {
                queue.consecutive_rebuilds = 0;
                queue.cool_down = self.settings.cool_down;
            }
            let bricks = queue.running.take().map_or(0, |running| running.bricks);
            if bricks > 0 && results.iter().all(Result::is_ok) {
                let per_brick = time.as_secs_f64() / bricks as f64;
                queue.fastest = Some(queue.fastest.map_or(per_brick, |fastest| fastest.min(per_brick)));
            }
            if failed && down.is_none() {
                queue.running = Some(RunningBatch::build(Instant::now()));
            }
            queue.counters.busy += time;
            queue.counters.lost += u64::from(failed);
            queue.counters.held_bytes = held_bytes;
            if let Some(why) = &down {
                left = queue.mark_down(why);
            }
        }
        self.changed.notify_all();
        batch.into_iter().zip(results).for_each(|(job, result)| job.reply(result));
        reject(left, &down.unwrap_or_default());
    }

    /// Stops all device threads and rejects all waiting jobs.
    pub(super) fn close(&self) {
        let mut state = self.lock();
        state.closed = true;
        let left: VecDeque<QueuedJob> = state.queues.iter_mut().flat_map(|queue| queue.waiting.drain(..)).collect();
        drop(state);
        self.added.iter().for_each(Condvar::notify_all);
        self.changed.notify_all();
        reject(left, "the devices are being closed");
    }

    /// Status of every device.
    pub(super) fn status(&self) -> Vec<DeviceStatus> {
        self.lock().queues.iter().map(DeviceQueue::status).collect()
    }
}

/// Returns true if a result proves that the device works.
pub(super) fn proves_device_works(result: &JobResult) -> bool {
    match result {
        Ok(_) => true,
        Err(GpuError::Surface(error)) => !matches!(error, SurfaceError::Cancelled | SurfaceError::Deadline),
        Err(_) => false,
    }
}
