//! The pool: worker threads, their queue, and the memory budget that they share.

use std::io;
use std::sync::Arc;
use std::time::{Duration, Instant};

use metrics::counter;

use super::devices::Watch;
use super::queue::Queue;
use super::{Budget, Client, OnStart, Refusal, Task, Ticket, worker};
use crate::picture::SelectedRenderer;
use crate::pipeline::{self, Job, JobLimits, maker};
use crate::surface::Backend;
use crate::telemetry::{JOBS_SUBMITTED, Tracer};

/// Settings of a [`Pool`].
#[derive(Clone)]
pub struct Settings {
    /// Number of concurrent jobs, at least 1.
    pub workers: usize,
    /// Number of queued jobs.
    pub queue: usize,
    /// Maximum time that a durable job yields to interactive ones.
    pub batch_max_delay: Duration,
    /// Limits of every job.
    pub limits: JobLimits,
    /// Memory budget for uploads and meshes.
    pub budget: Budget,
    /// Renderer of pictures.
    pub renderer: SelectedRenderer,
    /// Receiver of the time that each job took.
    pub meter: Option<Arc<dyn Meter>>,
    /// Exporter for the spans of resumed jobs.
    pub tracer: Tracer,
}

/// Receiver of the computing time that clients use.
pub trait Meter: std::fmt::Debug + Send + Sync {
    /// Records that a worker spent `time` on a job of `client`, successful or not. A shared job is charged to its first
    /// client. Called before the outcome is sent.
    fn spent(&self, client: Client, time: Duration);
}

/// State that workers share.
pub(super) struct Shared {
    pub(super) queue: Arc<Queue>,
    pub(super) backend: Arc<dyn Backend>,
    pub(super) reason: String,
    pub(super) limits: JobLimits,
    pub(super) budget: Budget,
    pub(super) workers: usize,
    pub(super) renderer: SelectedRenderer,
    pub(super) meter: Option<Arc<dyn Meter>>,
    tracer: Tracer,
    watch: Watch,
}

impl Shared {
    /// Updates metrics and log with the state of the devices.
    pub(super) fn publish_devices(&self) {
        self.watch.publish(&self.backend.devices());
    }
}

/// A running pool. Dropping it cancels running jobs.
pub struct Pool {
    shared: Arc<Shared>,
}

impl Pool {
    /// Starts the workers. `reason` says why this backend was chosen, for reports.
    ///
    /// # Errors
    /// That of the operating system if a thread cannot be started.
    pub fn start(settings: Settings, backend: Arc<dyn Backend>, reason: String) -> io::Result<Self> {
        let Settings { workers, queue, batch_max_delay, limits, budget, renderer, meter, tracer } = settings;
        let workers = workers.max(1);
        let queue = Arc::new(Queue::new(queue, workers, batch_max_delay));
        let watch = Watch::default();
        let shared = Shared { queue, backend, reason, limits, budget, workers, renderer, meter, tracer, watch };
        let pool = Self { shared: Arc::new(shared) };
        for n in 0..workers {
            let shared = Arc::clone(&pool.shared);
            std::thread::Builder::new().name(format!("molmesh-job-{n}")).spawn(move || worker::work(&shared))?;
        }
        Ok(pool)
    }

    /// Accepts a task whose mesh must be finished within `allowed`, time in the queue included. `on_start` is called
    /// before the work starts, unless the task joins a running job.
    ///
    /// # Errors
    /// Any [`Refusal`].
    pub fn submit(&self, task: Task, allowed: Duration, on_start: Option<OnStart>) -> Result<Ticket, Refusal> {
        let mode = if task.rank.batch { "async" } else { "sync" };
        let deadline = Instant::now() + allowed;
        let admission = self.shared.queue.push(task, allowed, on_start)?;
        let dedup = if admission.shared { "yes" } else { "no" };
        counter!(JOBS_SUBMITTED, "mode" => mode, "dedup" => dedup).increment(1);
        Ok(Ticket { queue: Arc::clone(&self.shared.queue), admission, deadline, allowed })
    }

    /// Estimates the duration of a job on this machine, s, without its time in the queue.
    #[must_use]
    pub fn expected(&self, input: &[u8], job: &Job) -> f64 {
        self.shared.queue.expected(pipeline::estimate_work(input, job))
    }

    /// Estimates the queueing time of a job that is accepted now.
    #[must_use]
    pub fn estimated_wait(&self) -> Duration {
        self.shared.queue.estimated_wait()
    }

    /// Returns the backend.
    #[must_use]
    pub fn backend(&self) -> &Arc<dyn Backend> {
        &self.shared.backend
    }

    /// Returns why the backend was chosen.
    #[must_use]
    pub fn reason(&self) -> &str {
        &self.shared.reason
    }

    /// Returns the renderer of pictures.
    #[must_use]
    pub fn renderer(&self) -> &SelectedRenderer {
        &self.shared.renderer
    }

    /// Returns the arithmetic of a job's file, provided that neither backend nor renderer falls back to another one.
    #[must_use]
    pub fn maker(&self, job: &Job) -> String {
        let renderer = job.picture.map(|_| self.shared.renderer.renderer.arithmetic());
        maker(&self.shared.backend.arithmetic(), renderer.as_deref())
    }

    /// Number of concurrent jobs.
    #[must_use]
    pub fn workers(&self) -> usize {
        self.shared.workers
    }

    /// Updates metrics and log with the state of the queue and the devices, as every finished job does.
    pub fn publish(&self) {
        self.shared.queue.refresh();
        self.shared.publish_devices();
    }

    /// Exporter for the spans of resumed jobs.
    pub(super) fn tracer(&self) -> &Tracer {
        &self.shared.tracer
    }

    /// Returns the memory budget for uploads and meshes.
    #[must_use]
    pub fn budget(&self) -> &Budget {
        &self.shared.budget
    }

    /// Leaves queued durable jobs for the next process: their tickets end as stopped.
    pub fn leave(&self) {
        self.shared.queue.leave();
    }

    /// Accepts no more jobs and waits for the accepted ones until `end`; then cancels the rest, whose tickets end as
    /// stopped. Returns true if every job finished.
    pub async fn drain(&self, end: impl Future<Output = ()>) -> bool {
        self.shared.queue.close();
        let in_time = tokio::select! {
            () = self.shared.queue.idle() => true,
            () = end => false,
        };
        if !in_time {
            self.shared.queue.cancel_all();
        }
        in_time
    }
}

impl Drop for Pool {
    fn drop(&mut self) {
        self.shared.queue.close();
        self.shared.queue.cancel_all();
    }
}
