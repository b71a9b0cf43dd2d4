//! Queued and running jobs behind one lock. A job that nobody waits for is removed, or cancelled if it runs.

use std::sync::{Arc, PoisonError};
use std::time::{Duration, Instant};

use metrics::gauge;
use tokio::sync::Notify;

use super::coalesced_job::{CoalescedJob, OnStart, Progress, QueuedTask, work_key};
use super::cost::WorkRate;
use super::rank::{self, Shares};
use super::{Outcome, Refusal, Task, Ticket};
use crate::pipeline;
use crate::single_flight::{self, ResultReceiver};
use crate::surface::CancelToken;
use crate::sync::{Condvar, Mutex, MutexGuard};
use crate::telemetry::{QUEUE_AGE, QUEUE_DEPTH, QUEUE_WAIT, SpanKind, TraceSpan};

struct QueueState {
    jobs: Vec<CoalescedJob>,
    shares: Shares,
    rate: WorkRate,
    /// Waiting workers, each with its own condition. The last one began to wait last: its memory and caches are warm.
    idle_workers: Vec<Arc<Condvar>>,
    closed: bool,
    /// True once queued durable jobs are left to the next process.
    leaving: bool,
    next_id: u64,
    /// Number of queued jobs that the gauge shows.
    published: usize,
}

impl QueueState {
    fn waiting(&self) -> impl Iterator<Item = &CoalescedJob> {
        self.jobs.iter().filter(|job| job.begun.is_none())
    }

    fn find(&self, id: u64) -> Option<usize> {
        self.jobs.iter().position(|job| job.id == id)
    }
}

/// Bounded queue of jobs.
pub(super) struct Queue {
    state: Mutex<QueueState>,
    idle: Notify,
    limit: usize,
    workers: usize,
    batch_max_delay: Duration,
}

impl Queue {
    /// Creates a queue of `limit` slots in front of `workers` workers. Durable jobs yield to interactive ones for
    /// `batch_max_delay` at most.
    pub(super) fn new(limit: usize, workers: usize, batch_max_delay: Duration) -> Self {
        let state = QueueState {
            jobs: Vec::with_capacity(limit.min(1024) + workers),
            shares: Shares::default(),
            rate: WorkRate::default(),
            idle_workers: Vec::with_capacity(workers),
            closed: false,
            leaving: false,
            next_id: 0,
            published: 0,
        };
        Self { state: Mutex::new(state), idle: Notify::new(), limit, workers, batch_max_delay }
    }

    fn lock(&self) -> MutexGuard<'_, QueueState> {
        // No code under the lock can panic in the middle of a change, so a poisoned state is consistent.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Accepts a task that must be finished within `allowed`: joins an identical job or queues a new one.
    pub(super) fn push(
        self: &Arc<Self>,
        task: Task,
        allowed: Duration,
        mut on_start: Option<OnStart>,
    ) -> Result<Ticket, Refusal> {
        let mut state = self.lock();
        if let Some(ticket) = self.join_in(&mut state, &task, allowed, &mut on_start)? {
            return Ok(ticket);
        }
        let id = state.next_id;
        state.next_id += 1;
        let units = pipeline::estimate_work(task.input.atoms(), &task.job);
        let expected = state.rate.seconds(units);
        let now = Instant::now();
        let (sender, outcome) = single_flight::channel();
        let tag = state.shares.tag(&task.rank, units);
        let (progress, span) = (Arc::new(Progress::default()), job_span(&task, now));
        state.jobs.push(CoalescedJob {
            id,
            work: work_key(&task),
            rank: task.rank,
            units,
            tag,
            accepted: now,
            begun: None,
            cancel: CancelToken::default(),
            progress: Arc::clone(&progress),
            span: span.clone(),
            outcome: Some(sender),
            on_start: on_start.into_iter().collect(),
            task: Some(task),
        });
        self.publish(&mut state);
        let worker = state.idle_workers.pop();
        drop(state);
        if let Some(worker) = worker {
            worker.notify_one();
        }
        Ok(self.ticket(id, Some(outcome), progress, span, (allowed, expected)))
    }

    /// Accepts a task that needs no input: joins an identical job, which takes `on_start` unless it runs. `None` if
    /// there is none and the queue has a free slot.
    pub(super) fn join(
        self: &Arc<Self>,
        task: &Task,
        allowed: Duration,
        on_start: &mut Option<OnStart>,
    ) -> Result<Option<Ticket>, Refusal> {
        self.join_in(&mut self.lock(), task, allowed, on_start)
    }

    fn join_in(
        self: &Arc<Self>,
        state: &mut QueueState,
        task: &Task,
        allowed: Duration,
        on_start: &mut Option<OnStart>,
    ) -> Result<Option<Ticket>, Refusal> {
        if state.closed {
            return Err(Refusal::Draining);
        }
        let (work, now) = (work_key(task), Instant::now());
        let same = |job: &&mut CoalescedJob| job.work == work && !job.cancel.is_cancelled();
        if let Some(job) = state.jobs.iter_mut().find(same) {
            job.rank.batch &= task.rank.batch;
            let joined_running = job.begun.is_some();
            if !joined_running {
                job.on_start.extend(on_start.take());
            }
            if let Some(context) = &task.parent.context {
                job.span.link(context.clone());
            }
            let outcome = job.outcome.as_ref().map(ResultReceiver::of);
            let (progress, span) = (Arc::clone(&job.progress), job.span.clone());
            let mut ticket = self.ticket(job.id, outcome, progress, span, (allowed, state.rate.seconds(job.units)));
            (ticket.is_shared, ticket.joined_running) = (true, joined_running);
            return Ok(Some(ticket));
        }
        if state.leaving && task.rank.batch {
            let id = state.next_id;
            state.next_id += 1;
            // The next process runs the job. Without a sender the ticket ends as stopped.
            return Ok(Some(self.ticket(id, None, Arc::default(), job_span(task, now), (allowed, 0.0))));
        }
        // A broker has queued durable jobs; no more are claimed than there are workers.
        if task.rank.batch {
            return Ok(None);
        }
        let wait = self.wait(state, now);
        // A job of a free worker counts as running before the worker has woken up.
        if state.jobs.len() >= self.limit + self.workers {
            return Err(Refusal::QueueFull { waiting: state.waiting().count(), limit: self.limit, wait });
        }
        if wait > allowed {
            return Err(Refusal::TooLate { wait, allowed });
        }
        Ok(None)
    }

    /// Creates the ticket of a job that is allowed a time and expected to take a number of seconds. To be finished in
    /// time, it must begin by then, but half of the time is never given up.
    fn ticket(
        self: &Arc<Self>,
        job: u64,
        outcome: Option<ResultReceiver<Outcome>>,
        progress: Arc<Progress>,
        span: TraceSpan,
        (allowed, expected): (Duration, f64),
    ) -> Ticket {
        let (queue, now) = (Arc::clone(self), Instant::now());
        let running = Duration::try_from_secs_f64(expected).unwrap_or(Duration::MAX).min(allowed / 2);
        let (deadline, start_by) = (now + allowed, now + allowed.saturating_sub(running));
        let (is_shared, joined_running) = (false, false);
        Ticket { queue, job, outcome, deadline, start_by, allowed, progress, span, is_shared, joined_running }
    }

    /// Takes the next job; blocks until there is one. `None` once the queue is closed and empty.
    pub(super) fn pop(&self) -> Option<QueuedTask> {
        let mut state = self.lock();
        let filled = Arc::new(Condvar::new());
        loop {
            if let Some(entry) = self.take(&mut state) {
                self.publish(&mut state);
                return Some(entry);
            }
            if state.closed {
                return None;
            }
            state.idle_workers.push(Arc::clone(&filled));
            state = filled.wait(state).unwrap_or_else(PoisonError::into_inner);
            state.idle_workers.retain(|worker| !Arc::ptr_eq(worker, &filled));
        }
    }

    /// Takes the most urgent job of the client with the lowest tag.
    fn take(&self, state: &mut QueueState) -> Option<QueuedTask> {
        let now = Instant::now();
        let waited = |job: &CoalescedJob| now.saturating_duration_since(job.accepted);
        let turn = |job: &CoalescedJob| rank::turn(&job.rank, job.tag, job.id, waited(job), self.batch_max_delay);
        let next = state.waiting().reduce(|a, b| if rank::before(&turn(b), &turn(a)) { b } else { a })?;
        let (client, batch) = (next.rank.client, next.rank.batch);
        let own = state.waiting().filter(|job| job.rank.client == client && job.rank.batch == batch);
        let id = own.min_by_key(|job| (job.rank.urgency, job.id))?.id;
        let tag = next.tag;
        state.shares.begin(tag);
        let at = state.find(id)?;
        let job = &mut state.jobs[at];
        job.begun = Some(now);
        job.progress.begin();
        Some(QueuedTask {
            id,
            task: job.task.take()?,
            cancel: job.cancel.clone(),
            progress: Arc::clone(&job.progress),
            on_start: std::mem::take(&mut job.on_start),
            accepted: job.accepted,
            span: job.span.clone(),
        })
    }

    /// Removes a finished job and sends its outcome to every ticket. `time` is the duration of a successful run.
    pub(super) fn done(&self, id: u64, outcome: Option<Outcome>, time: Option<Duration>) {
        let mut state = self.lock();
        let Some(at) = state.find(id) else { return };
        let job = state.jobs.swap_remove(at);
        if let Some(time) = time {
            state.rate.learn(job.units, time.as_secs_f64());
        }
        self.after_removal(&mut state);
        drop(state);
        if let Some((sender, outcome)) = job.outcome.zip(outcome) {
            sender.send_replace(Some(outcome));
        }
    }

    /// Notes that a ticket of job `id` was dropped. Removes or cancels the job if that was the last one.
    pub(super) fn leave_job(&self, id: u64) {
        let mut state = self.lock();
        let Some(at) = state.find(id) else { return };
        if !state.jobs[at].is_abandoned() {
            return;
        }
        state.jobs[at].cancel.cancel();
        let removed = state.jobs[at].begun.is_none().then(|| state.jobs.swap_remove(at));
        self.after_removal(&mut state);
        drop(state);
        // Frees the input, which may be large, without the lock.
        if let Some(job) = removed {
            job.span.fail("all clients disconnected");
            job.span.end();
        }
    }

    /// Updates the metrics and, if no job is left, the shares and the callers of `idle`.
    fn after_removal(&self, state: &mut QueueState) {
        if state.jobs.is_empty() {
            state.shares.reset();
            self.idle.notify_waiters();
        }
        self.publish(state);
    }

    /// Accepts no more jobs. Accepted jobs still run.
    pub(super) fn close(&self) {
        let mut state = self.lock();
        state.closed = true;
        for worker in state.idle_workers.drain(..) {
            worker.notify_one();
        }
    }

    /// Leaves queued durable jobs, now and from now on, for the next process: their tickets end as stopped.
    pub(super) fn leave(&self) {
        let mut state = self.lock();
        state.leaving = true;
        let (left, stay): (Vec<_>, Vec<_>) =
            std::mem::take(&mut state.jobs).into_iter().partition(|job| job.begun.is_none() && job.rank.batch);
        state.jobs = stay;
        self.after_removal(&mut state);
        drop(state);
        drop(left);
    }

    /// Cancels running jobs and drops queued ones. Their tickets end as stopped, not as cancelled.
    pub(super) fn cancel_all(&self) {
        let mut state = self.lock();
        let (left, mut running): (Vec<_>, Vec<_>) =
            std::mem::take(&mut state.jobs).into_iter().partition(|job| job.begun.is_none());
        let mut senders = Vec::new();
        for job in &mut running {
            job.cancel.cancel();
            senders.push(job.outcome.take());
        }
        state.jobs = running;
        self.publish(&mut state);
        drop(state);
        drop((left, senders));
    }

    /// Waits until no job is queued or running.
    pub(super) async fn idle(&self) {
        loop {
            let notified = self.idle.notified();
            if self.lock().jobs.is_empty() {
                return;
            }
            notified.await;
        }
    }

    /// Estimates the queueing time of a job that is accepted now.
    pub(super) fn estimated_wait(&self) -> Duration {
        self.wait(&self.lock(), Instant::now())
    }

    /// Returns true if a job waits for a worker.
    pub(super) fn has_waiting(&self) -> bool {
        self.lock().waiting().next().is_some()
    }

    /// Estimates the duration of a job of `units` work, s.
    pub(super) fn expected(&self, units: f64) -> f64 {
        self.lock().rate.seconds(units)
    }

    /// Estimates the remaining work of all jobs, divided by the number of workers.
    fn wait(&self, state: &QueueState, now: Instant) -> Duration {
        if state.jobs.len() < self.workers {
            return Duration::ZERO;
        }
        let left = |job: &CoalescedJob| {
            let spent = job.begun.map_or(0.0, |begun| now.saturating_duration_since(begun).as_secs_f64());
            let cost = state.rate.seconds(job.units);
            // A job that takes longer than expected may still run for a while.
            (cost - spent).max(0.1 * cost)
        };
        let ahead: f64 = state.jobs.iter().map(left).sum();
        Duration::try_from_secs_f64(ahead / self.workers as f64).unwrap_or(Duration::MAX)
    }

    /// Updates the metrics of the queue: the age of queued jobs grows without any event.
    pub(super) fn refresh(&self) {
        self.publish(&mut self.lock());
    }

    #[expect(clippy::cast_precision_loss, reason = "gauges are floats, counts of jobs are small")]
    fn publish(&self, state: &mut QueueState) {
        let now = Instant::now();
        let waiting = state.waiting().count();
        let oldest = state.waiting().map(|job| now.saturating_duration_since(job.accepted)).max().unwrap_or_default();
        // Incremented by the difference, so that several pools in one process add up.
        gauge!(QUEUE_DEPTH).increment(waiting as f64 - state.published as f64);
        state.published = waiting;
        gauge!(QUEUE_AGE).set(oldest.as_secs_f64());
        gauge!(QUEUE_WAIT).set(self.wait(state, now).as_secs_f64());
    }
}

/// Starts the span of a job, below that of the first request for it.
fn job_span(task: &Task, start: Instant) -> TraceSpan {
    // A durable job runs after its request was answered.
    let kind = if task.rank.batch { SpanKind::Consumer } else { SpanKind::Internal };
    TraceSpan::start(&task.parent, "job", kind, start)
}
