//! Queued and running jobs behind one lock. A job that nobody waits for is removed, or cancelled if it runs.
//!
//! Each lane has workers of its own. A job that takes longer than the short lane allows gives its worker to a job that
//! waits, and starts again in the long lane.

mod estimates;
mod lanes;
#[cfg(test)]
mod tests;

use std::sync::{Arc, PoisonError};
use std::time::{Duration, Instant};

use tokio::sync::Notify;

use super::coalesced_job::{CoalescedJob, OnStart, QueuedTask, work_key};
use super::cost::WorkRate;
use super::rank::{Lane, Shares};
use super::{Outcome, Refusal, Task, Ticket};
use crate::pipeline;
use crate::single_flight::{self, ResultReceiver};
use crate::store::Digest;
use crate::surface::CancelToken;
use crate::sync::{Condvar, Mutex, MutexGuard};
use crate::telemetry::{SpanKind, TraceSpan};

/// Work of a task, computed before the queue is locked.
#[derive(Clone, Copy)]
struct TaskWork {
    key: Digest,
    /// Expected work, in the units of [`pipeline::estimate_work`].
    units: f64,
    lane: Lane,
}

impl TaskWork {
    fn of(task: &Task) -> Self {
        let units = pipeline::estimate_work(task.input.atoms(), &task.request.options);
        Self { key: work_key(task), units, lane: Lane::of(&task.rank, units) }
    }
}

struct QueueState {
    jobs: Vec<CoalescedJob>,
    /// Shares of the clients in each lane.
    shares: [Shares; Lane::ALL.len()],
    rate: WorkRate,
    /// Waiting workers of each lane, each with its own condition. The last one began to wait last: its memory and
    /// caches are warm.
    idle_workers: [Vec<Arc<Condvar>>; Lane::ALL.len()],
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

    fn waiting_in(&self, lane: Lane) -> impl Iterator<Item = &CoalescedJob> {
        self.waiting().filter(move |job| job.lane == lane)
    }

    fn len(&self, lane: Lane) -> usize {
        self.jobs.iter().filter(|job| job.lane == lane).count()
    }

    /// Wakes up all workers that wait.
    fn wake_all(&mut self) {
        for worker in self.idle_workers.iter_mut().flat_map(|workers| workers.drain(..)) {
            worker.notify_one();
        }
    }

    /// Puts the job at an index into a lane, to be started, and wakes up a worker.
    fn enqueue(&mut self, at: usize, lane: Lane) {
        let job = &mut self.jobs[at];
        job.lane = lane;
        job.tag = self.shares[lane as usize].tag(job.rank.client, job.units);
        if let Some(worker) = self.idle_workers[lane as usize].pop() {
            worker.notify_one();
        }
    }

    /// Creates the job of a task, which is not queued yet.
    fn new_job(&mut self, task: &Task, TaskWork { key, units, lane }: TaskWork) -> CoalescedJob {
        self.next_id += 1;
        let now = Instant::now();
        // A durable job runs after its request was answered.
        let kind = if task.rank.batch { SpanKind::Consumer } else { SpanKind::Internal };
        CoalescedJob {
            id: self.next_id,
            work: key,
            rank: task.rank,
            lane,
            units,
            is_tile: task.request.options.tile.is_some(),
            tag: 0.0,
            accepted: now,
            begun: None,
            cancel: CancelToken::default(),
            is_moving: false,
            progress: Arc::default(),
            span: TraceSpan::start(&task.parent, "job", kind, now),
            outcome: Some(single_flight::channel().0),
            on_start: Vec::new(),
            task: None,
        }
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
}

impl Queue {
    /// Creates a queue with `limit` slots and `workers` workers in each lane.
    pub(super) fn new(limit: usize, workers: usize) -> Self {
        let state = QueueState {
            jobs: Vec::with_capacity(limit.min(1024) + workers),
            shares: Default::default(),
            rate: WorkRate::default(),
            idle_workers: Default::default(),
            closed: false,
            leaving: false,
            next_id: 0,
            published: 0,
        };
        Self { state: Mutex::new(state), idle: Notify::new(), limit, workers }
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
        let work = TaskWork::of(&task);
        let mut state = self.lock();
        if let Some(ticket) = self.join_in(&mut state, &task, work, allowed, &mut on_start)? {
            return Ok(ticket);
        }
        let mut job = state.new_job(&task, work);
        let (ticket, at) = (self.ticket(&job, allowed), state.jobs.len());
        job.on_start.extend(on_start);
        job.task = Some(task);
        state.jobs.push(job);
        state.enqueue(at, work.lane);
        self.publish(&mut state);
        Ok(ticket)
    }

    /// Accepts a task that needs no input: joins an identical job, which takes `on_start` unless it runs. `None` if
    /// there is none and the queue has a free slot.
    pub(super) fn join(
        self: &Arc<Self>,
        task: &Task,
        allowed: Duration,
        on_start: &mut Option<OnStart>,
    ) -> Result<Option<Ticket>, Refusal> {
        let work = TaskWork::of(task);
        self.join_in(&mut self.lock(), task, work, allowed, on_start)
    }

    fn join_in(
        self: &Arc<Self>,
        state: &mut QueueState,
        task: &Task,
        work: TaskWork,
        allowed: Duration,
        on_start: &mut Option<OnStart>,
    ) -> Result<Option<Ticket>, Refusal> {
        if state.closed {
            return Err(Refusal::Draining);
        }
        let now = Instant::now();
        let same = |job: &CoalescedJob| job.work == work.key && (job.is_moving || !job.cancel.is_cancelled());
        if let Some(at) = state.jobs.iter().position(same) {
            let joined_running = state.jobs[at].begun.is_some();
            if state.jobs[at].rank.batch && !task.rank.batch {
                state.jobs[at].rank.batch = false;
                let lane = Lane::of(&task.rank, state.jobs[at].units);
                if !joined_running {
                    state.enqueue(at, lane);
                }
            }
            let job = &mut state.jobs[at];
            if !joined_running {
                job.on_start.extend(on_start.take());
            }
            if let Some(context) = &task.parent.context {
                job.span.link(context.clone());
            }
            let mut ticket = self.ticket(job, allowed);
            (ticket.is_durable, ticket.is_shared, ticket.joined_running) = (task.rank.batch, true, joined_running);
            return Ok(Some(ticket));
        }
        if state.leaving && task.rank.batch {
            // The next process runs the job. Without a sender the ticket ends as stopped.
            return Ok(Some(self.ticket(&CoalescedJob { outcome: None, ..state.new_job(task, work) }, allowed)));
        }
        // A broker has queued durable jobs; no more are claimed than there are workers.
        if task.rank.batch {
            return Ok(None);
        }
        let TaskWork { units, lane, .. } = work;
        let (wait, expected) = (self.wait(state, lane, now), Self::expected_now(state, lane, units, now));
        // A job of a free worker counts as running before the worker has woken up.
        if state.len(lane) >= self.limit + self.workers {
            return Err(Refusal::QueueFull { waiting: state.waiting_in(lane).count(), limit: self.limit, wait });
        }
        // A job alone in its lane always tries: only jobs that run correct the estimate.
        if state.len(lane) > 0 && wait.saturating_add(expected) > allowed {
            return Err(Refusal::TooLate { wait, expected, allowed });
        }
        Ok(None)
    }

    /// Creates the ticket of the first request for a job.
    fn ticket(self: &Arc<Self>, job: &CoalescedJob, allowed: Duration) -> Ticket {
        Ticket {
            queue: Arc::clone(self),
            job: job.id,
            lane: job.lane,
            outcome: job.outcome.as_ref().map(ResultReceiver::of),
            deadline: Instant::now() + allowed,
            allowed,
            progress: Arc::clone(&job.progress),
            span: job.span.clone(),
            is_durable: job.rank.batch,
            is_shared: false,
            joined_running: false,
        }
    }

    /// Takes the next job of a lane; blocks until there is one. `None` once the queue is closed and the lane is empty.
    pub(super) fn pop(&self, lane: Lane) -> Option<QueuedTask> {
        let mut state = self.lock();
        let filled = Arc::new(Condvar::new());
        loop {
            if let Some(entry) = Self::take(&mut state, lane) {
                self.publish(&mut state);
                return Some(entry);
            }
            // A job that moves to the long lane is still to come.
            let is_last = lane != Lane::Long || !state.jobs.iter().any(|job| job.is_moving);
            if state.closed && is_last {
                return None;
            }
            state.idle_workers[lane as usize].push(Arc::clone(&filled));
            state = filled.wait(state).unwrap_or_else(PoisonError::into_inner);
            state.idle_workers[lane as usize].retain(|worker| !Arc::ptr_eq(worker, &filled));
        }
    }

    /// Takes the most urgent job of the client with the lowest tag.
    fn take(state: &mut QueueState, lane: Lane) -> Option<QueuedTask> {
        let next = state.waiting_in(lane).min_by(|a, b| a.tag.total_cmp(&b.tag).then(a.id.cmp(&b.id)))?;
        let (client, tag) = (next.rank.client, next.tag);
        let own = state.waiting_in(lane).filter(|job| job.rank.client == client);
        let id = own.min_by_key(|job| (job.rank.urgency, job.id))?.id;
        state.shares[lane as usize].begin(tag);
        let at = state.find(id)?;
        let job = &mut state.jobs[at];
        job.begun = Some(Instant::now());
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

    /// Removes a finished job and sends its outcome to every ticket. `time` is the duration of a run that tells how
    /// long such jobs take; one without success would have taken longer. That of a tile is not used.
    pub(super) fn done(&self, id: u64, outcome: Option<Outcome>, time: Option<Duration>) {
        let mut state = self.lock();
        let Some(at) = state.find(id) else { return };
        let job = state.jobs.swap_remove(at);
        let is_success = matches!(outcome, Some(Ok(_)));
        let time = time.filter(|_| !job.is_tile).map(|time| time.as_secs_f64());
        if let Some(seconds) = time.filter(|seconds| is_success || *seconds > state.rate.seconds(job.units)) {
            state.rate.learn(job.units, seconds);
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
        if state.closed {
            state.wake_all();
        }
        if state.jobs.is_empty() {
            state.shares.iter_mut().for_each(Shares::reset);
            self.idle.notify_waiters();
        }
        self.publish(state);
    }

    /// Accepts no more jobs. Accepted jobs still run.
    pub(super) fn close(&self) {
        let mut state = self.lock();
        state.closed = true;
        state.wake_all();
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
        self.after_removal(&mut state);
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
}
