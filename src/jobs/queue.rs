//! What waits and what runs, behind one lock. Entries that nobody waits for any more leave at once.

use std::collections::VecDeque;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use metrics::gauge;
use tokio::sync::{Notify, oneshot};

use super::{Outcome, Refusal, Task};
use crate::surface::CancelToken;
use crate::telemetry::{QUEUE_DEPTH, QUEUE_WAIT};

/// A job that waits or runs.
pub(super) struct Entry {
    pub(super) id: u64,
    pub(super) task: Task,
    pub(super) cancel: CancelToken,
    pub(super) reply: oneshot::Sender<Outcome>,
    pub(super) accepted: Instant,
}

/// Assumed time of a job before one has run.
const FIRST_GUESS: Duration = Duration::from_millis(250);
/// Weight of the newest job in the moving average of their times.
const NEWEST: f64 = 0.2;

struct State {
    waiting: VecDeque<Entry>,
    running: Vec<(u64, CancelToken)>,
    closed: bool,
    next_id: u64,
    mean_s: f64,
    /// Waiting jobs that the gauge knows of.
    told: usize,
}

/// The queue.
pub(super) struct Queue {
    state: Mutex<State>,
    filled: Condvar,
    idle: Notify,
    limit: usize,
    workers: usize,
}

impl Queue {
    pub(super) fn new(limit: usize, workers: usize) -> Self {
        let state = State {
            waiting: VecDeque::with_capacity(limit),
            running: Vec::with_capacity(workers),
            closed: false,
            next_id: 0,
            mean_s: FIRST_GUESS.as_secs_f64(),
            told: 0,
        };
        Self { state: Mutex::new(state), filled: Condvar::new(), idle: Notify::new(), limit, workers }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        // No code under the lock can panic half way through a change, so a poisoned state is a sound one.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Puts a job at the end of the queue; its id and cancel token come back.
    pub(super) fn push(&self, task: Task, reply: oneshot::Sender<Outcome>) -> Result<(u64, CancelToken), Refusal> {
        let mut state = self.lock();
        if state.closed {
            return Err(Refusal::Draining);
        }
        // A free worker's job counts as running, not as waiting, even before the worker has woken up.
        if state.waiting.len() + state.running.len() >= self.limit + self.workers {
            let (waiting, wait) = (state.waiting.len(), self.wait(&state));
            return Err(Refusal::QueueFull { waiting, limit: self.limit, wait });
        }
        let (id, cancel) = (state.next_id, CancelToken::default());
        state.next_id += 1;
        state.waiting.push_back(Entry { id, task, cancel: cancel.clone(), reply, accepted: Instant::now() });
        self.publish(&mut state);
        drop(state);
        self.filled.notify_one();
        Ok((id, cancel))
    }

    /// The next job; blocks until there is one. `None` once the queue is closed and empty.
    pub(super) fn pop(&self) -> Option<Entry> {
        let mut state = self.lock();
        loop {
            if let Some(entry) = state.waiting.pop_front() {
                state.running.push((entry.id, entry.cancel.clone()));
                self.publish(&mut state);
                return Some(entry);
            }
            if state.closed {
                return None;
            }
            state = self.filled.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// A worker is done with job `id`, which took `time` if it ran to an end.
    pub(super) fn done(&self, id: u64, time: Option<Duration>) {
        let mut state = self.lock();
        state.running.retain(|(running, _)| *running != id);
        if let Some(time) = time {
            state.mean_s += NEWEST * (time.as_secs_f64() - state.mean_s);
        }
        self.publish(&mut state);
        if state.running.is_empty() && state.waiting.is_empty() {
            self.idle.notify_waiters();
        }
    }

    /// Nobody waits for job `id` any more.
    pub(super) fn forget(&self, id: u64) {
        let mut state = self.lock();
        let left = state.waiting.iter().position(|entry| entry.id == id).and_then(|at| state.waiting.remove(at));
        self.publish(&mut state);
        drop(state);
        // The input, which may be large, is freed outside the lock.
        drop(left);
    }

    /// Accepts no more jobs. Those that were accepted still run.
    pub(super) fn close(&self) {
        self.lock().closed = true;
        self.filled.notify_all();
    }

    /// Cancels what runs and drops what waits.
    pub(super) fn cancel_all(&self) {
        let mut state = self.lock();
        state.running.iter().for_each(|(_, cancel)| cancel.cancel());
        let left = std::mem::take(&mut state.waiting);
        self.publish(&mut state);
        drop(state);
        drop(left);
    }

    /// Waits until nothing runs and nothing waits.
    pub(super) async fn idle(&self) {
        loop {
            let notified = self.idle.notified();
            let busy = {
                let state = self.lock();
                !(state.running.is_empty() && state.waiting.is_empty())
            };
            if !busy {
                return;
            }
            notified.await;
        }
    }

    /// How long a job that is accepted now would wait.
    pub(super) fn estimated_wait(&self) -> Duration {
        self.wait(&self.lock())
    }

    #[expect(clippy::cast_precision_loss, reason = "counts of jobs are small")]
    fn wait(&self, state: &State) -> Duration {
        let ahead = (state.waiting.len() + state.running.len() + 1).saturating_sub(self.workers);
        Duration::from_secs_f64(ahead as f64 * state.mean_s / self.workers as f64)
    }

    #[expect(clippy::cast_precision_loss, reason = "gauges are floats, counts of jobs are small")]
    fn publish(&self, state: &mut State) {
        // By difference, so that several pools in one process add up.
        gauge!(QUEUE_DEPTH).increment(state.waiting.len() as f64 - state.told as f64);
        state.told = state.waiting.len();
        gauge!(QUEUE_WAIT).set(self.wait(state).as_secs_f64());
    }
}
