//! What waits and what runs, behind one lock. Work that nobody waits for any more leaves at once.

use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use metrics::gauge;
use tokio::sync::{Notify, oneshot};

use super::cost::Rate;
use super::flight::{Claim, Entry, Flight, Progress, Waiter, WorkKey};
use super::rank::{self, Shares};
use super::returns::Returns;
use super::{Outcome, Refusal, Task};
use crate::pipeline;
use crate::surface::CancelToken;
use crate::telemetry::{QUEUE_AGE, QUEUE_DEPTH, QUEUE_WAIT, SpanKind, TraceSpan};

struct State {
    flights: Vec<Flight>,
    shares: Shares,
    rate: Rate,
    closed: bool,
    /// Promised jobs that do not run yet are left for the next start.
    leaving: bool,
    next_id: u64,
    returns: Returns,
    /// Waiting jobs that the gauge knows of.
    told: usize,
}

impl State {
    fn waiting(&self) -> impl Iterator<Item = &Flight> {
        self.flights.iter().filter(|flight| flight.begun.is_none())
    }

    fn find(&mut self, id: u64) -> Option<usize> {
        self.flights.iter().position(|flight| flight.id == id)
    }
}

/// A right to an outcome, as the queue gives it.
pub(super) struct Place {
    pub(super) flight: u64,
    pub(super) waiter: u64,
    pub(super) outcome: oneshot::Receiver<Outcome>,
    pub(super) progress: Arc<Progress>,
    /// The span of the work.
    pub(super) span: TraceSpan,
    /// The same work was in the house already.
    pub(super) shared: bool,
    /// It runs already, so that no claim is called.
    pub(super) begun: bool,
}

/// The queue.
pub(super) struct Queue {
    state: Mutex<State>,
    filled: Condvar,
    idle: Notify,
    limit: usize,
    workers: usize,
    patience: Duration,
}

impl Queue {
    /// A queue of so many places in front of so many workers; `patience` is how long promised jobs stand back.
    pub(super) fn new(limit: usize, workers: usize, patience: Duration) -> Self {
        let state = State {
            flights: Vec::with_capacity(limit.min(1024) + workers),
            shares: Shares::default(),
            rate: Rate::default(),
            closed: false,
            leaving: false,
            next_id: 0,
            returns: Returns::default(),
            told: 0,
        };
        Self { state: Mutex::new(state), filled: Condvar::new(), idle: Notify::new(), limit, workers, patience }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        // No code under the lock can panic half way through a change, so a poisoned state is a sound one.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes a job in: into the work that is the same, or at its place in the queue. `allowed` is the time that it has.
    pub(super) fn push(&self, task: Task, allowed: Duration, claim: Option<Claim>) -> Result<Place, Refusal> {
        let work = WorkKey::new(&task.digest, &task.job, task.strict);
        let (reply, outcome) = oneshot::channel();
        let mut state = self.lock();
        if state.closed {
            return Err(Refusal::Draining);
        }
        let waiter = state.next_id;
        state.next_id += 1;
        let same = |f: &&mut Flight| f.work == work && !f.cancel.is_cancelled();
        if let Some(flight) = state.flights.iter_mut().find(same) {
            flight.waiters.push(Waiter { id: waiter, reply });
            flight.rank.batch &= task.rank.batch;
            let begun = flight.begun.is_some();
            // Work that runs cannot be held back any more: whoever claims it records that by itself.
            flight.claims.extend(claim.filter(|_| !begun));
            if let Some(context) = &task.parent.context {
                flight.span.link(context.clone());
            }
            let (progress, span) = (Arc::clone(&flight.progress), flight.span.clone());
            return Ok(Place { flight: flight.id, waiter, outcome, progress, span, shared: true, begun });
        }
        if state.leaving && task.rank.batch {
            // Its promise is kept by the next process: nobody will answer on the other end.
            let (progress, span) = (Arc::default(), job_span(&task, Instant::now()));
            return Ok(Place { flight: waiter, waiter, outcome, progress, span, shared: false, begun: false });
        }
        let now = Instant::now();
        let units = pipeline::work(&task.input, &task.job);
        // A free worker's job counts as running, not as waiting, even before the worker has woken up. Places are held for those
        // who were told to come back, but not so many that workers could run out of work if they do not. Whoever comes back
        // on time finds as many places again: times are told in whole seconds, so they come in bursts.
        let room = self.limit + self.workers;
        let due = state.returns.is_due(&work, now);
        let (held, room) =
            if due { (0, room + self.limit) } else { (state.returns.held(now).min(self.limit / 2), room) };
        if state.flights.len() + held >= room {
            let waiting = state.waiting().count();
            let wait = self.room_in(&mut state, work, now);
            return Err(Refusal::QueueFull { waiting, limit: self.limit, wait });
        }
        state.returns.came(&work);
        let wait = self.wait(&state, now);
        if wait > allowed {
            return Err(Refusal::TooLate { wait, allowed });
        }
        let tag = state.shares.tag(&task.rank, units);
        let (progress, span) = (Arc::new(Progress::default()), job_span(&task, now));
        state.flights.push(Flight {
            id: waiter,
            work,
            rank: task.rank,
            units,
            tag,
            accepted: now,
            begun: None,
            cancel: CancelToken::default(),
            progress: Arc::clone(&progress),
            span: span.clone(),
            waiters: vec![Waiter { id: waiter, reply }],
            claims: claim.into_iter().collect(),
            task: Some(task),
        });
        self.publish(&mut state);
        drop(state);
        self.filled.notify_one();
        Ok(Place { flight: waiter, waiter, outcome, progress, span, shared: false, begun: false })
    }

    /// The next job; blocks until there is one. `None` once the queue is closed and empty.
    pub(super) fn pop(&self) -> Option<Entry> {
        let mut state = self.lock();
        loop {
            if let Some(entry) = self.take(&mut state) {
                self.publish(&mut state);
                return Some(entry);
            }
            if state.closed {
                return None;
            }
            state = self.filled.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// The job whose turn it is: the client's with the lowest tag, and of this client's the most urgent one.
    fn take(&self, state: &mut State) -> Option<Entry> {
        let now = Instant::now();
        let waited = |f: &Flight| now.saturating_duration_since(f.accepted);
        let turn = |f: &Flight| rank::turn(&f.rank, f.tag, f.id, waited(f), self.patience);
        let next = state.waiting().reduce(|a, b| if rank::before(&turn(b), &turn(a)) { b } else { a })?;
        let (client, batch) = (next.rank.client, next.rank.batch);
        let own = state.waiting().filter(|f| f.rank.client == client && f.rank.batch == batch);
        let id = own.min_by_key(|f| (f.rank.urgency, f.id))?.id;
        let tag = next.tag;
        state.shares.begin(tag);
        let at = state.find(id)?;
        let flight = &mut state.flights[at];
        flight.begun = Some(now);
        flight.progress.begin();
        Some(Entry {
            id,
            task: flight.task.take()?,
            cancel: flight.cancel.clone(),
            progress: Arc::clone(&flight.progress),
            claims: std::mem::take(&mut flight.claims),
            accepted: flight.accepted,
            span: flight.span.clone(),
        })
    }

    /// A worker is done with job `id`: everybody who waits gets the outcome. `time` is what it took, if it ran to an end.
    pub(super) fn done(&self, id: u64, outcome: Option<&Outcome>, time: Option<Duration>) {
        let mut state = self.lock();
        let Some(at) = state.find(id) else { return };
        let flight = state.flights.swap_remove(at);
        if let Some(time) = time {
            state.rate.learn(flight.units, time.as_secs_f64());
        }
        if state.flights.is_empty() {
            state.shares.settle();
            self.idle.notify_waiters();
        }
        self.publish(&mut state);
        drop(state);
        if let Some(outcome) = outcome {
            for waiter in flight.waiters {
                // Who has left meanwhile does not mind.
                drop(waiter.reply.send(outcome.clone()));
            }
        }
    }

    /// A waiter has left. The work that nobody waits for any more leaves the queue, or is stopped.
    pub(super) fn forget(&self, flight: u64, waiter: u64) {
        let mut state = self.lock();
        let Some(at) = state.find(flight) else { return };
        let found = &mut state.flights[at];
        found.waiters.retain(|w| w.id != waiter);
        if !found.waiters.is_empty() {
            return;
        }
        found.cancel.cancel();
        let left = found.begun.is_none().then(|| state.flights.swap_remove(at));
        if state.flights.is_empty() {
            state.shares.settle();
            self.idle.notify_waiters();
        }
        self.publish(&mut state);
        drop(state);
        // The input, which may be large, is freed outside the lock.
        if let Some(flight) = left {
            flight.span.fail("nobody waits for it any more");
            flight.span.end();
        }
    }

    /// Accepts no more jobs. Those that were accepted still run.
    pub(super) fn close(&self) {
        self.lock().closed = true;
        self.filled.notify_all();
    }

    /// From now on promised jobs that do not run yet are left: whoever waits for them is told that it was stopped.
    pub(super) fn leave(&self) {
        let mut state = self.lock();
        state.leaving = true;
        let (left, stay): (Vec<_>, Vec<_>) =
            std::mem::take(&mut state.flights).into_iter().partition(|f| f.begun.is_none() && f.rank.batch);
        state.flights = stay;
        if state.flights.is_empty() {
            self.idle.notify_waiters();
        }
        self.publish(&mut state);
        drop(state);
        drop(left);
    }

    /// Cancels what runs and drops what waits. Whoever waits is told that it was stopped, not that it was cancelled.
    pub(super) fn cancel_all(&self) {
        let mut state = self.lock();
        let (left, mut running): (Vec<_>, Vec<_>) =
            std::mem::take(&mut state.flights).into_iter().partition(|flight| flight.begun.is_none());
        let mut told = Vec::new();
        for flight in &mut running {
            flight.cancel.cancel();
            told.append(&mut flight.waiters);
        }
        state.flights = running;
        self.publish(&mut state);
        drop(state);
        drop((left, told));
    }

    /// Waits until nothing runs and nothing waits.
    pub(super) async fn idle(&self) {
        loop {
            let notified = self.idle.notified();
            if self.lock().flights.is_empty() {
                return;
            }
            notified.await;
        }
    }

    /// How long a job that is accepted now would wait.
    pub(super) fn estimated_wait(&self) -> Duration {
        self.wait(&self.lock(), Instant::now())
    }

    /// Expected seconds of a job.
    pub(super) fn expected(&self, units: f64) -> f64 {
        self.lock().rate.seconds(units)
    }

    /// Work ahead of a new job, shared out to the workers.
    fn wait(&self, state: &State, now: Instant) -> Duration {
        if state.flights.len() < self.workers {
            return Duration::ZERO;
        }
        let left = |flight: &Flight| {
            let spent = flight.begun.map_or(0.0, |begun| now.saturating_duration_since(begun).as_secs_f64());
            let cost = state.rate.seconds(flight.units);
            // A job that takes longer than expected is not known to be over soon.
            (cost - spent).max(0.1 * cost)
        };
        let ahead: f64 = state.flights.iter().map(left).sum();
        Duration::try_from_secs_f64(ahead / self.workers as f64).unwrap_or(Duration::MAX)
    }

    /// When a place will be free for one who is refused now.
    fn room_in(&self, state: &mut State, work: WorkKey, now: Instant) -> Duration {
        let all: f64 = state.flights.iter().map(|flight| state.rate.seconds(flight.units)).sum();
        let mean = state.rate.mean(all / state.flights.len().max(1) as f64) / self.workers as f64;
        let each = Duration::try_from_secs_f64(mean).unwrap_or(Duration::MAX);
        state.returns.tell(work, each, each, now)
    }

    /// Tells metrics how it stands: what waits grows older while nothing happens.
    pub(super) fn refresh(&self) {
        self.publish(&mut self.lock());
    }

    #[expect(clippy::cast_precision_loss, reason = "gauges are floats, counts of jobs are small")]
    fn publish(&self, state: &mut State) {
        let now = Instant::now();
        let waiting = state.waiting().count();
        let oldest = state.waiting().map(|f| now.saturating_duration_since(f.accepted)).max().unwrap_or_default();
        // By difference, so that several pools in one process add up.
        gauge!(QUEUE_DEPTH).increment(waiting as f64 - state.told as f64);
        state.told = waiting;
        gauge!(QUEUE_AGE).set(oldest.as_secs_f64());
        gauge!(QUEUE_WAIT).set(self.wait(state, now).as_secs_f64());
    }
}

/// Starts the span of a job, below that of the first request for it.
fn job_span(task: &Task, start: Instant) -> TraceSpan {
    // Nobody waits for an asynchronous job in its request.
    let kind = if task.rank.batch { SpanKind::Consumer } else { SpanKind::Internal };
    TraceSpan::start(&task.parent, "job", kind, start)
}
