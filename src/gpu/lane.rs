//! One device's queue: what waits there, and how the device stands.

use std::collections::VecDeque;
use std::sync::mpsc::SyncSender;
use std::time::{Duration, Instant};

use super::error::GpuError;
use super::executor::GpuJob;
use super::queue::Answer;
use super::share::Share;
use crate::surface::{DeviceStatus, SurfaceError};

/// Weight of a large job, or of a part of one; a small one's is 1.
const LARGE: u64 = 16;

/// A job that waits.
pub(super) struct Entry {
    pub(super) id: u64,
    pub(super) job: GpuJob,
    /// The part of it that is to be made here; none: all of it.
    pub(super) share: Option<Share>,
    /// It has failed before, and must not take others with it.
    pub(super) alone: bool,
    pub(super) reply: SyncSender<Answer>,
}

impl Entry {
    pub(super) fn shares(&self) -> bool {
        !self.alone && self.job.prepared.is_small()
    }

    /// What it adds to a device's load: a large job is many times the work of a small one.
    pub(super) fn weight(&self) -> u64 {
        if self.share.is_none() && self.job.prepared.is_small() { 1 } else { LARGE }
    }

    /// Why it need not run any more.
    pub(super) fn over(&self) -> Option<GpuError> {
        let late = self.job.deadline.is_some_and(|deadline| deadline <= Instant::now());
        let cancelled = self.job.cancel.is_cancelled().then_some(GpuError::Surface(SurfaceError::Cancelled));
        cancelled.or(late.then_some(GpuError::Deadline))
    }
}

/// What a device's thread found out while it ran jobs.
pub(super) struct Run {
    /// How long it took.
    pub(super) time: Duration,
    /// Bytes of the device's memory that are held now.
    pub(super) held_bytes: u64,
    /// It failed: what ran there is thrown away.
    pub(super) lost: bool,
    /// Why it is given up, if it is.
    pub(super) down: Option<String>,
}

/// How a device stands.
pub(super) enum Health {
    /// Its thread builds it for the first time.
    Starting,
    Up,
    Down(String),
}

/// A device's queue, and how it stands.
pub(super) struct Lane {
    pub(super) number: usize,
    pub(super) name: String,
    pub(super) waiting: VecDeque<Entry>,
    /// Jobs that run now, and their weight.
    pub(super) running: usize,
    pub(super) weight: u64,
    pub(super) health: Health,
    /// Rebuilds since the last finished job.
    pub(super) streak: usize,
    pub(super) finished: u64,
    pub(super) failed: u64,
    /// Time that it spent on jobs.
    pub(super) busy: Duration,
    /// Times that what ran on it was thrown away.
    pub(super) lost: u64,
    pub(super) rebuilds: u64,
    pub(super) shared: u64,
    /// Parts of jobs, among the finished.
    pub(super) spread: u64,
    pub(super) held_bytes: u64,
}

impl Lane {
    /// One that is about to be built.
    pub(super) fn new(number: usize, name: String, limit: usize) -> Self {
        Self {
            number,
            name,
            waiting: VecDeque::with_capacity(limit),
            running: 0,
            weight: 0,
            health: Health::Starting,
            streak: 0,
            finished: 0,
            failed: 0,
            busy: Duration::ZERO,
            lost: 0,
            rebuilds: 0,
            shared: 0,
            spread: 0,
            held_bytes: 0,
        }
    }

    /// Whether it is up and has nothing large to do.
    pub(super) fn is_free(&self) -> bool {
        matches!(self.health, Health::Up) && self.weight < LARGE
    }

    /// How it is doing.
    pub(super) fn status(&self) -> DeviceStatus {
        DeviceStatus {
            number: self.number,
            name: self.name.clone(),
            down: match &self.health {
                Health::Starting => Some("it is being built".to_owned()),
                Health::Up => None,
                Health::Down(why) => Some(why.clone()),
            },
            waiting: self.waiting.len() + self.running,
            finished: self.finished,
            failed: self.failed,
            busy: self.busy,
            lost: self.lost,
            rebuilds: self.rebuilds,
            shared: self.shared,
            spread: self.spread,
            held_bytes: self.held_bytes,
        }
    }

    /// Marks it down, unless it is, and hands out what waits.
    pub(super) fn fell(&mut self, why: &str) -> VecDeque<Entry> {
        if !matches!(self.health, Health::Down(_)) {
            self.health = Health::Down(one_line(why));
        }
        self.held_bytes = 0;
        let left = std::mem::take(&mut self.waiting);
        self.weight -= left.iter().map(Entry::weight).sum::<u64>();
        left
    }
}

/// Why devices are down, one after the other.
pub(super) fn why_down(lanes: &[Lane]) -> String {
    let why = |lane: &Lane| match &lane.health {
        Health::Down(why) => Some(format!("{} {}: {why}", lane.number, lane.name)),
        Health::Starting | Health::Up => None,
    };
    lanes.iter().filter_map(why).collect::<Vec<_>>().join("; ")
}

/// Drivers and validation speak in paragraphs; reasons stand on one line of a banner, an error or a header.
pub(super) fn one_line(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// Answers a job. The other parts of one that is not made are not waited for.
pub(super) fn answer(entry: Entry, answer: Answer) {
    let Entry { reply, share, .. } = entry;
    if let (Some(share), Err(_)) = (share, &answer) {
        share.abandon();
    }
    // Whoever has left does not want to know.
    drop(reply.send(answer));
}

/// Answers jobs that their device will not run.
pub(super) fn dismiss(left: VecDeque<Entry>, why: &str) {
    for entry in left {
        answer(entry, Err(GpuError::NoDevice(why.to_owned())));
    }
}
