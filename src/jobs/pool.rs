//! The pool: worker threads, the queue in front of them, the memory that they share.

use std::io;
use std::sync::Arc;
use std::time::{Duration, Instant};

use metrics::counter;

use super::devices::Watch;
use super::queue::Queue;
use super::{Budget, Claim, Client, Refusal, Task, Ticket, worker};
use crate::picture::Drawer;
use crate::pipeline::{self, Job, JobLimits, maker};
use crate::surface::Backend;
use crate::telemetry::{JOBS_SUBMITTED, Tracer};

/// Sizes of a pool.
#[derive(Clone)]
pub struct Settings {
    /// Jobs that run at once, at least 1.
    pub workers: usize,
    /// Jobs that wait.
    pub queue: usize,
    /// How long promised jobs stand back for those that somebody waits for.
    pub patience: Duration,
    /// Limits of every job.
    pub limits: JobLimits,
    /// Memory for uploads and meshes.
    pub budget: Budget,
    /// What draws pictures.
    pub drawer: Drawer,
    /// Who is told what workers spend; none: nobody.
    pub meter: Option<Arc<dyn Meter>>,
    /// Where the spans of jobs go that come from an earlier process.
    pub tracer: Tracer,
}

/// Is told what clients cost.
pub trait Meter: std::fmt::Debug + Send + Sync {
    /// A worker has spent `time` on a job of `client`, well or in vain. Work that several take part in is the first one's.
    /// Called before anybody gets the outcome.
    fn spent(&self, client: Client, time: Duration);
}

/// What workers share.
pub(super) struct Shared {
    pub(super) queue: Arc<Queue>,
    pub(super) backend: Arc<dyn Backend>,
    pub(super) reason: String,
    pub(super) limits: JobLimits,
    pub(super) budget: Budget,
    pub(super) workers: usize,
    pub(super) drawer: Drawer,
    pub(super) meter: Option<Arc<dyn Meter>>,
    tracer: Tracer,
    watch: Watch,
}

impl Shared {
    /// Tells metrics and log how the devices are doing.
    pub(super) fn publish_devices(&self) {
        self.watch.publish(&self.backend.devices());
    }
}

/// A running pool. Dropping it cancels what runs.
pub struct Pool {
    shared: Arc<Shared>,
}

impl Pool {
    /// Starts the workers. `reason` says why this backend was taken, for reports.
    ///
    /// # Errors
    /// That of the system, if a thread cannot be started.
    pub fn start(settings: Settings, backend: Arc<dyn Backend>, reason: String) -> io::Result<Self> {
        let Settings { workers, queue, patience, limits, budget, drawer, meter, tracer } = settings;
        let workers = workers.max(1);
        let queue = Arc::new(Queue::new(queue, workers, patience));
        let watch = Watch::default();
        let shared = Shared { queue, backend, reason, limits, budget, workers, drawer, meter, tracer, watch };
        let pool = Self { shared: Arc::new(shared) };
        for n in 0..workers {
            let shared = Arc::clone(&pool.shared);
            std::thread::Builder::new().name(format!("molmesh-job-{n}")).spawn(move || worker::work(&shared))?;
        }
        Ok(pool)
    }

    /// Accepts a job that has `allowed` time until its mesh must be there, waiting included, or says at once why not. `claim`
    /// is called before the work begins.
    ///
    /// # Errors
    /// Any [`Refusal`].
    pub fn submit(&self, task: Task, allowed: Duration, claim: Option<Claim>) -> Result<Ticket, Refusal> {
        let mode = if task.rank.batch { "async" } else { "sync" };
        let deadline = Instant::now() + allowed;
        let place = self.shared.queue.push(task, allowed, claim)?;
        let dedup = if place.shared { "yes" } else { "no" };
        counter!(JOBS_SUBMITTED, "mode" => mode, "dedup" => dedup).increment(1);
        Ok(Ticket { queue: Arc::clone(&self.shared.queue), place, deadline, allowed })
    }

    /// Expected time of a job on this machine, s, once it runs.
    #[must_use]
    pub fn expected(&self, input: &[u8], job: &Job) -> f64 {
        self.shared.queue.expected(pipeline::work(input, job))
    }

    /// How long a job that is accepted now would wait.
    #[must_use]
    pub fn estimated_wait(&self) -> Duration {
        self.shared.queue.estimated_wait()
    }

    /// The backend.
    #[must_use]
    pub fn backend(&self) -> &Arc<dyn Backend> {
        &self.shared.backend
    }

    /// Why the backend was taken.
    #[must_use]
    pub fn reason(&self) -> &str {
        &self.shared.reason
    }

    /// What draws pictures.
    #[must_use]
    pub fn drawer(&self) -> &Drawer {
        &self.shared.drawer
    }

    /// Arithmetic of a job's file, if neither the backend nor the renderer falls back to another.
    #[must_use]
    pub fn maker(&self, job: &Job) -> String {
        let renderer = job.picture.map(|_| self.shared.drawer.renderer.arithmetic());
        maker(&self.shared.backend.arithmetic(), renderer.as_deref())
    }

    /// Jobs that run at once.
    #[must_use]
    pub fn workers(&self) -> usize {
        self.shared.workers
    }

    /// Tells metrics and log how the queue and the backend's devices are doing, as every finished job does.
    pub fn publish(&self) {
        self.shared.queue.refresh();
        self.shared.publish_devices();
    }

    /// Where the spans of jobs go that come from an earlier process.
    pub(super) fn tracer(&self) -> &Tracer {
        &self.shared.tracer
    }

    /// Memory for uploads and meshes.
    #[must_use]
    pub fn budget(&self) -> &Budget {
        &self.shared.budget
    }

    /// From now on promised jobs that do not run yet are left: their tickets end as stopped.
    pub fn leave(&self) {
        self.shared.queue.leave();
    }

    /// Accepts no more jobs and waits for those that were accepted, until `end` at most; then cancels the rest, whose
    /// tickets end as stopped. True if all of them ended by themselves.
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
