//! Order of queued jobs: interactive jobs before durable ones, fair shares for clients, bounded delays.
//!
//! Shares follow start-time fair queueing (Goyal, Vin, Cheng, 1996): the tag of a job is the virtual time, in units of
//! work, at which the earlier jobs of its client would be finished; the lowest tag runs first.

use std::time::Duration;

use rustc_hash::FxHashMap;
use sha2::{Digest as _, Sha256};

/// Urgency of a request without a `Priority` header (RFC 9218).
pub(crate) const DEFAULT_URGENCY: u8 = 3;

/// Client and priority of a job.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Rank {
    /// Client.
    pub(crate) client: Client,
    /// True for a background job: no connection waits for the result.
    pub(crate) batch: bool,
    /// Urgency among the jobs of the same client, from 0 (first) to 7 (last) as in RFC 9218.
    pub(crate) urgency: u8,
}

/// Identity of a client for fair queueing.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) struct Client(pub(crate) u64);

impl Client {
    /// Returns the client with this `name`, an address or a key. Numbers are truncated SHA-256 hashes, so a client
    /// cannot choose a name with the number of another client.
    pub(crate) fn named(name: &str) -> Self {
        Self(Sha256::digest(name.as_bytes()).iter().take(8).fold(0, |number, byte| number << 8 | u64::from(*byte)))
    }
}

impl Default for Rank {
    fn default() -> Self {
        Self { client: Client::default(), batch: false, urgency: DEFAULT_URGENCY }
    }
}

/// Sort key of a job: the lowest one runs first.
pub(super) type Turn = (bool, f64, u64);

/// Returns the sort key of a job. Durable jobs yield to interactive ones until they have waited for `batch_max_delay`.
pub(super) fn turn(rank: &Rank, tag: f64, id: u64, waited: Duration, batch_max_delay: Duration) -> Turn {
    (rank.batch && waited < batch_max_delay, tag, id)
}

/// Returns true if `a` runs before `b`.
pub(super) fn before(a: &Turn, b: &Turn) -> bool {
    a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)).then(a.2.cmp(&b.2)).is_lt()
}

/// Virtual time of fair queueing.
#[derive(Debug, Default)]
pub(super) struct Shares {
    /// Virtual time: the tag of the job that started last.
    clock: f64,
    /// Virtual end of the jobs of each client.
    ends: FxHashMap<(Client, bool), f64>,
}

impl Shares {
    /// Returns the tag of the client's next job, which has the expected work `cost`.
    pub(super) fn tag(&mut self, rank: &Rank, cost: f64) -> f64 {
        let end = self.ends.entry((rank.client, rank.batch)).or_insert(self.clock);
        let start = end.max(self.clock);
        *end = start + cost;
        start
    }

    /// Advances the virtual time to the tag of a job that starts. Forgets clients without queued jobs.
    pub(super) fn begin(&mut self, tag: f64) {
        self.clock = self.clock.max(tag);
        let clock = self.clock;
        if self.ends.len() > 64 {
            self.ends.retain(|_, end| *end > clock);
        }
    }

    /// Starts over when no job is left.
    pub(super) fn reset(&mut self) {
        self.ends.clear();
        self.clock = 0.0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rank(client: &str, batch: bool) -> Rank {
        Rank { client: Client::named(client), batch, ..Rank::default() }
    }

    #[test]
    fn clients_alternate_however_many_jobs_one_has() {
        let mut shares = Shares::default();
        let (greedy, modest) = (rank("greedy", false), rank("modest", false));
        let first: Vec<f64> = (0..50).map(|_| shares.tag(&greedy, 1.0)).collect();
        shares.begin(first[0]);
        let tag = shares.tag(&modest, 1.0);
        // After the running job, before the others.
        assert!(first.iter().filter(|t| **t < tag).count() <= 1, "{tag} {first:?}");
        // A client with larger jobs gets fewer of them.
        let large = rank("large", false);
        let tags = [shares.tag(&large, 10.0), shares.tag(&large, 10.0)];
        assert!(first.iter().filter(|t| **t < tags[1]).count() >= 9);
    }

    #[test]
    fn interactive_jobs_run_before_durable_ones_up_to_the_maximum_delay() {
        let delay = Duration::from_secs(7);
        let (person, batch) = (rank("a", false), rank("b", true));
        let at = |rank, tag, id, waited| turn(rank, tag, id, waited, delay);
        for waited in [Duration::ZERO, delay / 2] {
            assert!(before(&at(&person, 5.0, 2, waited), &at(&batch, 0.0, 1, waited)));
        }
        assert!(before(&at(&batch, 0.0, 1, delay), &at(&person, 5.0, 2, delay)));
        assert!(before(&at(&person, 1.0, 1, delay), &at(&person, 1.0, 2, delay)));
    }

    #[test]
    fn idle_clients_are_forgotten() {
        let mut shares = Shares::default();
        for n in 0..100 {
            let tag = shares.tag(&rank(&n.to_string(), false), 1.0);
            shares.begin(tag + 2.0);
        }
        assert!(shares.ends.len() <= 66, "{}", shares.ends.len());
        shares.reset();
        assert!(shares.tag(&rank("x", false), 1.0).abs() < 1e-12);
    }
}
