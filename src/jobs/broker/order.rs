//! Queues of a broker, and the order in which a claim asks them.
//!
//! Jobs have three levels of urgency and two kinds: those that suit a GPU, and the others. Each level has a queue of
//! each kind, in the order of dispatch. Three of four claims first ask the queues of a higher level, and within a level
//! the queue of the jobs that suit the worker. Every fourth claim asks the queues in turn, so that none starves.

use super::Dispatch;

/// Names of the queues. Those of jobs that suit a GPU have odd numbers.
pub(super) const QUEUES: [&str; 6] = ["high-cpu", "high-gpu", "normal-cpu", "normal-gpu", "low-cpu", "low-gpu"];
/// Level of each urgency from 0 to 7: high, normal, low.
const LEVEL: [usize; 8] = [0, 0, 0, 1, 1, 2, 2, 2];
/// Number of claims of which one asks the queues in turn.
const TURN: usize = 4;

/// Returns true if the jobs of a queue suit a GPU.
pub(super) const fn suits_gpu(queue: usize) -> bool {
    queue % 2 == 1
}

impl Dispatch {
    /// Returns the number of the queue of the job.
    pub(super) fn queue(&self) -> usize {
        2 * LEVEL[usize::from(self.urgency.min(7))] + usize::from(self.suits_gpu)
    }
}

/// Order of the queues for the claims of a worker.
#[derive(Debug, Default)]
pub(super) struct QueueOrder {
    /// Number of claims that got a job.
    claims: usize,
    /// Queue whose turn it is.
    turn: usize,
}

impl QueueOrder {
    fn is_in_turn(&self) -> bool {
        self.claims % TURN == TURN - 1
    }

    /// Returns the numbers of all queues, in the order in which the next claim asks them.
    pub(super) fn next(&self, prefers_gpu: bool) -> [usize; QUEUES.len()] {
        std::array::from_fn(|place| {
            if self.is_in_turn() { (self.turn + place) % QUEUES.len() } else { place ^ usize::from(prefers_gpu) }
        })
    }

    /// Notes that a claim got a job from a queue.
    pub(super) fn claimed(&mut self, queue: usize) {
        if self.is_in_turn() {
            self.turn = queue + 1;
        }
        self.claims += 1;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::jobs::record::JobId;

    #[test]
    fn urgencies_have_three_levels() {
        let name = |urgency, suits_gpu| {
            let job = Dispatch { id: JobId::random(&[0; 32], 0).unwrap(), urgency, suits_gpu };
            QUEUES[job.queue()]
        };
        let names: Vec<_> = (0..=7).map(|urgency| name(urgency, false)).collect();
        let [high, normal, low] = ["high-cpu", "normal-cpu", "low-cpu"];
        assert_eq!(names, [high, high, high, normal, normal, low, low, low]);
        assert_eq!([0, 3, 7].map(|urgency| name(urgency, true)), ["high-gpu", "normal-gpu", "low-gpu"]);
    }

    #[test]
    fn workers_prefer_urgent_jobs_then_those_that_suit_them() {
        let names = |prefers_gpu| QueueOrder::default().next(prefers_gpu).map(|queue| QUEUES[queue]);
        assert_eq!(names(false), QUEUES);
        assert_eq!(names(true), ["high-gpu", "high-cpu", "normal-gpu", "normal-cpu", "low-gpu", "low-cpu"]);
    }

    #[test]
    fn no_queue_starves() {
        let counts = |prefers_gpu| {
            let (mut order, mut counts) = (QueueOrder::default(), [0; QUEUES.len()]);
            for _ in 0..TURN * QUEUES.len() {
                let [first, ..] = order.next(prefers_gpu);
                order.claimed(first);
                counts[first] += 1;
            }
            counts
        };
        assert_eq!(counts(false), [19, 1, 1, 1, 1, 1]);
        assert_eq!(counts(true), [1, 19, 1, 1, 1, 1]);
    }
}
