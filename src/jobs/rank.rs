//! Order of queued jobs: lanes with workers of their own, and in each lane fair shares for clients.
//!
//! Shares follow start-time fair queueing (Goyal, Vin, Cheng, 1996): the tag of a job is the virtual time, in units of
//! work, at which the earlier jobs of its client would be finished; the lowest tag runs first.

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
    /// Urgency from 0 (first) to 7 (last) as in RFC 9218.
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

/// Jobs that share workers. Jobs of one lane never wait for those of another.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Lane {
    /// Requests that take a moment.
    Short,
    /// Other requests, for which a client waits.
    Long,
    /// Durable jobs.
    Batch,
}

/// Largest work of a job in the lane of short ones, in the units of [`crate::pipeline::estimate_work`]: about 50 ms on
/// two cores. Not a time, whose estimate depends on the jobs of all clients.
const SHORT_WORK: f64 = 12_500.0;

impl Lane {
    pub(super) const ALL: [Self; 3] = [Self::Short, Self::Long, Self::Batch];

    /// Returns the lane of a job with this amount of work.
    pub(super) fn of(rank: &Rank, units: f64) -> Self {
        match rank.batch {
            true => Self::Batch,
            false if units > SHORT_WORK => Self::Long,
            false => Self::Short,
        }
    }
}

/// Virtual time of fair queueing.
#[derive(Debug, Default)]
pub(super) struct Shares {
    /// Virtual time: the tag of the job that started last.
    clock: f64,
    /// Virtual end of the jobs of each client.
    ends: FxHashMap<Client, f64>,
}

impl Shares {
    /// Returns the tag of the client's next job, which has the expected work `cost`.
    pub(super) fn tag(&mut self, client: Client, cost: f64) -> f64 {
        let end = self.ends.entry(client).or_insert(self.clock);
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

    #[test]
    fn clients_alternate_however_many_jobs_one_has() {
        let mut shares = Shares::default();
        let (greedy, modest) = (Client::named("greedy"), Client::named("modest"));
        let first: Vec<f64> = (0..50).map(|_| shares.tag(greedy, 1.0)).collect();
        shares.begin(first[0]);
        let tag = shares.tag(modest, 1.0);
        // After the running job, before the others.
        assert!(first.iter().filter(|t| **t < tag).count() <= 1, "{tag} {first:?}");
        // A client with larger jobs gets fewer of them.
        let large = Client::named("large");
        let tags = [shares.tag(large, 10.0), shares.tag(large, 10.0)];
        assert!(first.iter().filter(|t| **t < tags[1]).count() >= 9);
    }

    #[test]
    fn durable_and_long_jobs_have_lanes_of_their_own() {
        let [request, durable] = [false, true].map(|batch| Rank { batch, ..Rank::default() });
        assert_eq!([Lane::of(&request, 1e3), Lane::of(&request, 1e5)], [Lane::Short, Lane::Long]);
        assert_eq!([Lane::of(&durable, 1e3), Lane::of(&durable, 1e5)], [Lane::Batch; 2]);
    }

    #[test]
    fn idle_clients_are_forgotten() {
        let mut shares = Shares::default();
        for n in 0..100 {
            let tag = shares.tag(Client::named(&n.to_string()), 1.0);
            shares.begin(tag + 2.0);
        }
        assert!(shares.ends.len() <= 66, "{}", shares.ends.len());
        shares.reset();
        assert!(shares.tag(Client::named("x"), 1.0).abs() < 1e-12);
    }
}
