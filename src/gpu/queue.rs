//! What waits for which device, behind one lock: a bounded queue a device, and how each device is doing.

use std::collections::VecDeque;
use std::sync::mpsc::{Receiver, sync_channel};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use super::error::GpuError;
use super::executor::{Finished, GpuJob};
use super::lane::{Entry, Health, Lane, Run, answer, dismiss, why_down};
use super::share::Share;
use crate::surface::{DeviceStatus, SurfaceError};

/// What comes back of a job.
pub(super) type Answer = Result<Finished, GpuError>;

struct State {
    lanes: Vec<Lane>,
    closed: bool,
    next_id: u64,
}

/// The queues of all devices.
pub(super) struct Queues {
    state: Mutex<State>,
    /// A queue has moved, or a device changed its state: submitters look again.
    moved: Condvar,
    /// One for each device's thread.
    filled: Vec<Condvar>,
    /// Jobs that may wait for one device.
    limit: usize,
    /// Jobs that may share a submission.
    batch: usize,
}

/// Where a job went.
pub(super) struct Place {
    pub(super) lane: usize,
    id: u64,
    pub(super) answer: Receiver<Answer>,
}

/// Why a job was not taken.
pub(super) enum NotPlaced {
    /// Every device that may take it has a full queue.
    Full,
    /// No device may take it; why those that are down are.
    NoDevice(String),
}

impl Queues {
    pub(super) fn new(devices: &[(usize, String)], limit: usize, batch: usize) -> Self {
        let lane = |(number, name): &(usize, String)| Lane::new(*number, name.clone(), limit);
        Self {
            state: Mutex::new(State { lanes: devices.iter().map(lane).collect(), closed: false, next_id: 0 }),
            moved: Condvar::new(),
            filled: devices.iter().map(|_| Condvar::new()).collect(),
            limit: limit.max(1),
            batch: batch.max(1),
        }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        // No code under the lock can panic half way through a change, so a poisoned state is a sound one.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Gives `job` to the least loaded device that is up and that `tries` allows: fewer than `most` there. One that has failed the job before is preferred, as its rebuilt self is likelier to be well than its neighbour is
    /// to be idle.
    pub(super) fn place(&self, job: &GpuJob, tries: &[usize], most: usize) -> Result<Place, NotPlaced> {
        let mut state = self.lock();
        let State { lanes, next_id, .. } = &mut *state;
        let may = |n: usize, lane: &Lane| tries[n] < most && matches!(lane.health, Health::Up);
        if !lanes.iter().enumerate().any(|(n, lane)| may(n, lane)) {
            return Err(NotPlaced::NoDevice(why_down(lanes)));
        }
        let best = lanes
            .iter_mut()
            .enumerate()
            .filter(|(n, lane)| may(*n, lane) && lane.waiting.len() < self.limit)
            .min_by_key(|(n, lane)| (std::cmp::Reverse(tries[*n]), lane.weight, lane.finished));
        let Some((n, lane)) = best else { return Err(NotPlaced::Full) };
        let (reply, answer) = sync_channel(1);
        let id = *next_id;
        *next_id += 1;
        let entry = Entry { id, job: job.clone(), share: None, alone: tries.iter().any(|t| *t > 0), reply };
        lane.weight += entry.weight();
        lane.waiting.push_back(entry);
        drop(state);
        self.filled[n].notify_one();
        Ok(Place { lane: n, id, answer })
    }

    /// Devices that are up and have nothing large to do, least loaded first.
    pub(super) fn free(&self) -> Vec<usize> {
        let state = self.lock();
        let mut free: Vec<usize> = (0..state.lanes.len()).filter(|&n| state.lanes[n].is_free()).collect();
        free.sort_by_key(|&n| (state.lanes[n].weight, state.lanes[n].finished));
        free
    }

    /// Gives the parts of `job` to as many devices, all at once: so the parts of two jobs wait in the same order on every
    /// device, and neither waits for the other's. `None` where one of the devices is not free any more.
    pub(super) fn place_parts(&self, job: &GpuJob, parts: Vec<(usize, Share)>) -> Option<Vec<Place>> {
        let mut state = self.lock();
        let State { lanes, next_id, .. } = &mut *state;
        if !parts.iter().all(|(n, _)| lanes[*n].is_free() && lanes[*n].waiting.len() < self.limit) {
            return None;
        }
        let mut places = Vec::with_capacity(parts.len());
        for (n, share) in parts {
            let (reply, answer) = sync_channel(1);
            let id = *next_id;
            *next_id += 1;
            let entry = Entry { id, job: job.clone(), share: Some(share), alone: true, reply };
            lanes[n].weight += entry.weight();
            lanes[n].waiting.push_back(entry);
            places.push(Place { lane: n, id, answer });
        }
        drop(state);
        for place in &places {
            self.filled[place.lane].notify_one();
        }
        Some(places)
    }

    /// Waits until something has moved, for `most` at most.
    pub(super) fn moved(&self, most: Duration) {
        drop(self.moved.wait_timeout(self.lock(), most));
    }

    /// Nobody waits for this job any more. If it runs already, its thread finds that out by itself.
    pub(super) fn forget(&self, place: &Place) {
        let mut state = self.lock();
        let lane = &mut state.lanes[place.lane];
        let at = lane.waiting.iter().position(|entry| entry.id == place.id);
        let left = at.and_then(|at| lane.waiting.remove(at));
        lane.weight -= left.as_ref().map_or(0, Entry::weight);
        drop(state);
        self.moved.notify_all();
        // Its atoms, which may be many, are freed outside the lock.
        drop(left);
    }

    /// What device `n` runs next: one job, or several small ones; nothing where none came for `rest`. `None` once the device
    /// is down or the queues are closed.
    pub(super) fn next(&self, n: usize, rest: Duration) -> Option<Vec<Entry>> {
        let mut state = self.lock();
        let mut rested = false;
        loop {
            let closed = state.closed;
            let lane = &mut state.lanes[n];
            if closed || matches!(lane.health, Health::Down(_)) {
                return None;
            }
            let mut taken = Vec::new();
            while let Some(first) = lane.waiting.pop_front() {
                if let Some(error) = first.over() {
                    lane.weight -= first.weight();
                    answer(first, Err(error));
                    continue;
                }
                let shares = first.shares();
                taken.push(first);
                if shares {
                    self.gather(&mut lane.waiting, &mut taken);
                }
                break;
            }
            if !taken.is_empty() {
                lane.running = taken.len();
                lane.shared += u64::from(taken.len() > 1);
                drop(state);
                self.moved.notify_all();
                return Some(taken);
            }
            if rested {
                return Some(taken);
            }
            let waited = self.filled[n].wait_timeout(state, rest).unwrap_or_else(PoisonError::into_inner);
            (state, rested) = (waited.0, waited.1.timed_out());
        }
    }

    /// Device `n` holds so much memory.
    pub(super) fn holds(&self, n: usize, bytes: u64) {
        self.lock().lanes[n].held_bytes = bytes;
    }

    /// Moves small jobs from `waiting` to `taken`, wherever in the queue they stand: a large one before them keeps its
    /// place at the head and is next.
    fn gather(&self, waiting: &mut VecDeque<Entry>, taken: &mut Vec<Entry>) {
        let mut at = 0;
        while at < waiting.len() && taken.len() < self.batch {
            if waiting[at].shares() && waiting[at].over().is_none() {
                taken.extend(waiting.remove(at));
            } else {
                at += 1;
            }
        }
    }

    /// Device `n` has run `jobs`: books the outcomes, then answers. A verdict on the device comes before the answers,
    /// so that whoever tries again finds it as it stands.
    pub(super) fn done(&self, n: usize, jobs: Vec<Entry>, answers: Vec<Answer>, run: Run) {
        let Run { time, held_bytes, lost, down } = run;
        let mut left = VecDeque::new();
        {
            let mut state = self.lock();
            let lane = &mut state.lanes[n];
            for (job, answer) in jobs.iter().zip(&answers) {
                lane.weight -= job.weight();
                match answer {
                    Ok(_) => {
                        lane.finished += 1;
                        lane.spread += u64::from(job.share.is_some());
                    }
                    Err(error) if error.is_the_devices() => lane.failed += 1,
                    // The job's own fault was found out by a device that works.
                    Err(_) => {}
                }
            }
            if answers.iter().any(shows_health) {
                lane.streak = 0;
            }
            lane.running = 0;
            lane.busy += time;
            lane.lost += u64::from(lost);
            lane.held_bytes = held_bytes;
            if let Some(why) = &down {
                left = lane.fell(why);
            }
        }
        self.moved.notify_all();
        jobs.into_iter().zip(answers).for_each(|(job, result)| answer(job, result));
        dismiss(left, &down.unwrap_or_default());
    }

    /// Counts a rebuild of device `n`, unless `most` were made in a row already. Whether it may be made.
    pub(super) fn rebuilding(&self, n: usize, most: usize) -> bool {
        let lane = &mut self.lock().lanes[n];
        let may = lane.streak < most;
        lane.streak += usize::from(may);
        lane.rebuilds += u64::from(may);
        may
    }

    /// Rebuilds of device `n` since it last finished a job.
    pub(super) fn streak(&self, n: usize) -> usize {
        self.lock().lanes[n].streak
    }

    /// Device `n` takes jobs from now on.
    pub(super) fn up(&self, n: usize) {
        let mut state = self.lock();
        if matches!(state.lanes[n].health, Health::Starting) {
            state.lanes[n].health = Health::Up;
        }
        drop(state);
        self.moved.notify_all();
    }

    /// Device `n` takes no jobs any more; those that wait are answered.
    pub(super) fn down(&self, n: usize, why: &str) {
        let left = self.lock().lanes[n].fell(why);
        self.moved.notify_all();
        self.filled[n].notify_all();
        dismiss(left, why);
    }

    /// Waits until every device is up or down. True if one is up.
    pub(super) fn started(&self) -> bool {
        let mut state = self.lock();
        while state.lanes.iter().any(|lane| matches!(lane.health, Health::Starting)) {
            state = self.moved.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
        state.lanes.iter().any(|lane| matches!(lane.health, Health::Up))
    }

    /// Waits for `time`, or until the queues are closed. False if they are.
    pub(super) fn pause(&self, n: usize, time: Duration) -> bool {
        let end = Instant::now() + time;
        let mut state = self.lock();
        while !state.closed {
            let Some(rest) = end.checked_duration_since(Instant::now()).filter(|rest| !rest.is_zero()) else {
                return true;
            };
            state = self.filled[n].wait_timeout(state, rest).unwrap_or_else(PoisonError::into_inner).0;
        }
        false
    }

    /// Why devices are down, one after the other.
    pub(super) fn why_down(&self) -> String {
        why_down(&self.lock().lanes)
    }

    /// Runs nothing more; what waits is answered.
    pub(super) fn close(&self) {
        let mut state = self.lock();
        state.closed = true;
        let left: VecDeque<Entry> = state.lanes.iter_mut().flat_map(|lane| lane.waiting.drain(..)).collect();
        drop(state);
        self.filled.iter().for_each(Condvar::notify_all);
        self.moved.notify_all();
        dismiss(left, "the devices are being closed");
    }

    /// How every device is doing.
    pub(super) fn status(&self) -> Vec<DeviceStatus> {
        self.lock().lanes.iter().map(Lane::status).collect()
    }
}

/// Whether an answer proves that the device can work.
pub(super) fn shows_health(answer: &Answer) -> bool {
    match answer {
        Ok(_) => true,
        Err(GpuError::Surface(error)) => *error != SurfaceError::Cancelled,
        Err(_) => false,
    }
}
