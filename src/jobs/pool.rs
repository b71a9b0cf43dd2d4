//! The pool: worker threads, their queue, and the memory budget that they share.

use std::io;
use std::sync::Arc;
use std::time::Duration;

use metrics::counter;

use super::devices::DeviceMonitor;
use super::queue::Queue;
use super::rank::{Lane, Rank};
use super::threads::ThreadPools;
use super::{Budget, Client, Input, OnStart, Refusal, Structures, Task, Ticket, worker};
use crate::picture::SelectedRenderer;
use crate::pipeline::{self, Choice, JobLimits, Options, file_arithmetic};
use crate::surface::Backend;
use crate::telemetry::{JOBS_SUBMITTED, Tracer};

/// Settings of a [`Pool`].
#[derive(Clone)]
pub(crate) struct Settings {
    /// Number of concurrent jobs of each lane.
    pub(crate) workers: usize,
    /// Number of queued jobs.
    pub(crate) queue: usize,
    /// Limits of every job.
    pub(crate) limits: JobLimits,
    /// Memory budget for uploads and meshes.
    pub(crate) budget: Budget,
    /// Structures of recent jobs and requests.
    pub(crate) structures: Arc<Structures>,
    /// Renderer of pictures.
    pub(crate) renderer: SelectedRenderer,
    /// Receiver of the time that each job took.
    pub(crate) meter: Option<UsageRecorder>,
    /// Exporter for the spans of resumed jobs.
    pub(crate) tracer: Tracer,
}

#[cfg(test)]
impl Settings {
    /// Returns settings for tests: CPU pictures and a small cache of structures.
    pub(super) fn for_test(workers: usize, budget: Budget) -> Self {
        Self {
            workers,
            queue: 8,
            limits: JobLimits::default(),
            structures: Structures::new(1 << 20, &budget, None),
            budget,
            renderer: SelectedRenderer::cpu("a test"),
            meter: None,
            tracer: Tracer::default(),
        }
    }
}

/// Callback with the time that a worker spent on a job of a client, successful or not. A shared job is charged to its
/// first client. The callback precedes the outcome.
pub(crate) type UsageRecorder = Arc<dyn Fn(Client, Duration) + Send + Sync>;

/// State that workers share.
pub(super) struct WorkerContext {
    pub(super) queue: Arc<Queue>,
    pub(super) backend: Arc<dyn Backend>,
    pub(super) reason: String,
    pub(super) settings: Settings,
    pub(super) threads: ThreadPools,
    monitor: DeviceMonitor,
}

impl WorkerContext {
    /// Returns the backend of a job, with the reason.
    pub(super) fn choice(&self, input: &Input, options: &Options) -> Choice<'_> {
        match self.backend.cpu() {
            Some(backend) if !pipeline::suits_gpu(input.atoms(), options) => {
                Choice { backend, reason: "auto: the job does not suit a GPU" }
            }
            _ => Choice { backend: self.backend.as_ref(), reason: &self.reason },
        }
    }

    /// Updates metrics and log with the state of the devices.
    pub(super) fn publish_devices(&self) {
        self.monitor.publish(&self.backend.devices());
    }
}

/// A running pool. Dropping it cancels running jobs.
pub(crate) struct Pool {
    pub(super) shared: Arc<WorkerContext>,
}

impl Pool {
    /// Starts the workers. `reason` is the reason for the choice of the backend, for reports.
    pub(crate) fn start(settings: Settings, backend: Arc<dyn Backend>, reason: String) -> io::Result<Self> {
        let workers = settings.workers;
        let pool = Self::without_workers(settings, backend, reason);
        for (n, lane) in Lane::ALL.into_iter().flat_map(|lane| (0..workers).map(move |n| (n, lane))) {
            let shared = Arc::clone(&pool.shared);
            let name = format!("molmesh-{lane:?}-{n}").to_lowercase();
            std::thread::Builder::new().name(name).spawn(move || worker::work(&shared, lane))?;
        }
        Ok(pool)
    }

    /// Creates a pool whose workers have not started.
    pub(super) fn without_workers(settings: Settings, backend: Arc<dyn Backend>, reason: String) -> Self {
        let queue = Arc::new(Queue::new(settings.queue, settings.workers));
        let (threads, monitor) = (ThreadPools::new(settings.workers), DeviceMonitor::default());
        Self { shared: Arc::new(WorkerContext { queue, backend, reason, settings, threads, monitor }) }
    }

    /// Accepts a task whose mesh must be finished within `allowed`, time in the queue included. `on_start` is called
    /// before the work starts, unless the task joins a running job.
    pub(crate) fn submit(&self, task: Task, allowed: Duration, on_start: Option<OnStart>) -> Result<Ticket, Refusal> {
        let ticket = self.shared.queue.push(task, allowed, on_start)?;
        count(&ticket);
        Ok(ticket)
    }

    /// Accepts a task, without its input, that joins an identical job. `None` if there is none and the
    /// queue has a free slot for [`Self::submit`].
    pub(super) fn join(
        &self,
        task: &Task,
        allowed: Duration,
        on_start: &mut Option<OnStart>,
    ) -> Result<Option<Ticket>, Refusal> {
        let ticket = self.shared.queue.join(task, allowed, on_start)?;
        if let Some(ticket) = &ticket {
            count(ticket);
        }
        Ok(ticket)
    }

    /// Estimates the duration of a job on this machine, without its time in the queue.
    pub(crate) fn expected(&self, input: &Input, options: &Options) -> Duration {
        let seconds = self.seconds(pipeline::estimate_work(input.atoms(), options));
        Duration::try_from_secs_f64(seconds).unwrap_or(Duration::MAX)
    }

    /// Estimates the duration of `units` of work on this machine, s.
    pub(crate) fn seconds(&self, units: f64) -> f64 {
        self.shared.queue.expected(units)
    }

    /// Returns the lane of a job.
    pub(crate) fn lane(rank: &Rank, input: &Input, options: &Options) -> Lane {
        Lane::of(rank, pipeline::estimate_work(input.atoms(), options))
    }

    /// Estimates the queueing time of a job of a lane that is accepted now.
    pub(crate) fn estimated_wait(&self, lane: Lane) -> Duration {
        self.shared.queue.estimated_wait(lane)
    }

    /// Runs the work of a short request that is not a job on threads of its own.
    pub(crate) fn run<T: Send>(&self, work: impl FnOnce() -> T + Send) -> T {
        self.shared.threads.run(Lane::Short, work)
    }

    /// Returns true if a job waits for a worker.
    pub(crate) fn has_waiting(&self) -> bool {
        self.shared.queue.has_waiting()
    }

    /// Returns the settings.
    pub(crate) fn settings(&self) -> &Settings {
        &self.shared.settings
    }

    /// Returns the backend.
    pub(crate) fn backend(&self) -> &Arc<dyn Backend> {
        &self.shared.backend
    }

    /// Returns the backend of a job, with the reason.
    pub(crate) fn choice(&self, input: &Input, options: &Options) -> Choice<'_> {
        self.shared.choice(input, options)
    }

    /// Returns the reason for the choice of the backend.
    pub(crate) fn reason(&self) -> &str {
        &self.shared.reason
    }

    /// Returns the arithmetics that a job's file may have, provided that the renderer does not fall back.
    pub(crate) fn file_arithmetics(&self, options: &Options) -> Vec<String> {
        let renderer = options.picture.map(|_| self.shared.settings.renderer.renderer.arithmetic());
        let backends = self.shared.backend.arithmetics();
        backends.iter().map(|backend| file_arithmetic(backend, renderer.as_deref())).collect()
    }

    /// Updates metrics and log with the state of the queue and the devices, as every finished job does.
    pub(crate) fn publish(&self) {
        self.shared.queue.refresh();
        self.shared.publish_devices();
    }

    /// Leaves queued durable jobs for the next process: their tickets end as stopped.
    pub(crate) fn leave(&self) {
        self.shared.queue.leave();
    }

    /// Accepts no more jobs and waits for the accepted ones.
    pub(crate) async fn finish(&self) {
        self.shared.queue.close();
        self.shared.queue.idle().await;
    }

    /// Accepts no more jobs and cancels the accepted ones, whose tickets end as stopped.
    pub(crate) fn cancel(&self) {
        self.shared.queue.close();
        self.shared.queue.cancel_all();
    }
}

fn count(ticket: &Ticket) {
    let mode = if ticket.is_durable { "async" } else { "sync" };
    let dedup = if ticket.is_shared { "yes" } else { "no" };
    counter!(JOBS_SUBMITTED, "mode" => mode, "dedup" => dedup).increment(1);
}

impl Drop for Pool {
    fn drop(&mut self) {
        self.cancel();
    }
}
