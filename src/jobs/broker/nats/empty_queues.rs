//! Memory of empty queues. The server answers a request to an empty queue slowly while other queues are long.

use tokio::time::Instant;

use super::POLL;
use crate::jobs::broker::order::QUEUES;

/// Queues that had no job when this node last asked them.
#[derive(Debug, Default)]
pub(super) struct EmptyQueues {
    /// Start of the last request to each queue that found no job.
    asked: [Option<Instant>; QUEUES.len()],
    /// Time of the last news of a job in each queue.
    filled: [Option<Instant>; QUEUES.len()],
}

impl EmptyQueues {
    /// Notes that a request that began at `asked` found no job.
    pub(super) fn note_empty(&mut self, queue: usize, asked: Instant) {
        self.asked[queue] = Some(asked);
    }

    /// Notes news of a job. A request that began before may have missed the job, even if its answer arrives later.
    pub(super) fn note_job(&mut self, queue: usize, now: Instant) {
        self.filled[queue] = Some(now);
    }

    /// Returns true if a queue was found empty since the last news of a job, and within the last second: a job that
    /// returns to its queue is no news.
    pub(super) fn contains(&self, queue: usize, now: Instant) -> bool {
        self.asked[queue].is_some_and(|asked| now < asked + POLL && self.filled[queue] < Some(asked))
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn a_queue_is_empty_for_a_second_unless_there_is_news_of_a_job() {
        let (mut queues, begun) = (EmptyQueues::default(), Instant::now());
        let after = |ms| begun + Duration::from_millis(ms);
        assert!(!queues.contains(0, begun), "it was not asked yet");
        queues.note_empty(0, begun);
        assert!(queues.contains(0, begun) && queues.contains(0, after(999)));
        assert!(!queues.contains(0, begun + POLL) && !queues.contains(1, begun));
        queues.note_job(1, after(1));
        assert!(queues.contains(0, after(2)), "the job is in another queue");
        queues.note_job(0, after(3));
        assert!(!queues.contains(0, after(4)));
        // The answer to a request that began before the news.
        queues.note_empty(0, after(2));
        assert!(!queues.contains(0, after(5)));
        queues.note_empty(0, after(6));
        assert!(queues.contains(0, after(7)));
    }
}
