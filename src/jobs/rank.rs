//! Whose turn it is: people who wait come before work that nobody watches, clients share fairly, and nobody waits for ever.
//!
//! Clients share by start-time fair queueing (Goyal, Vin, Cheng, 1996): a job's tag is the time, counted in work, at which its
//! client's earlier jobs would be done; the lowest tag goes first.

use std::time::Duration;

use rustc_hash::FxHashMap;
use sha2::{Digest as _, Sha256};

/// Urgency of a request that does not say one (RFC 9218).
pub const USUAL_URGENCY: u8 = 3;

/// Whose job it is, and how it stands to others.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Rank {
    /// The client.
    pub client: Client,
    /// Nobody waits for the answer on an open connection.
    pub batch: bool,
    /// 0 (first) to 7 (last) among the same client's jobs of the same kind, as RFC 9218 counts it.
    pub urgency: u8,
}

/// A client, as far as fairness needs to tell one from another.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Client(u64);

impl Client {
    /// The client's number, for records.
    #[must_use]
    pub const fn number(self) -> u64 {
        self.0
    }

    /// The client with a number.
    #[must_use]
    pub const fn numbered(number: u64) -> Self {
        Self(number)
    }

    /// The client that is known by `name`: an address, a key. Nobody can look for a name with the number of another.
    #[must_use]
    pub fn named(name: &str) -> Self {
        Self(Sha256::digest(name.as_bytes()).iter().take(8).fold(0, |number, byte| number << 8 | u64::from(*byte)))
    }
}

impl Default for Rank {
    fn default() -> Self {
        Self { client: Client::default(), batch: false, urgency: USUAL_URGENCY }
    }
}

/// What orders two jobs: lower goes first.
pub(super) type Turn = (bool, f64, u64);

/// The turn of a job that has waited so long. Work that nobody watches stands back for people's until its `patience` is over.
pub(super) fn turn(rank: &Rank, tag: f64, id: u64, waited: Duration, patience: Duration) -> Turn {
    (rank.batch && waited < patience, tag, id)
}

/// Whether `a` goes before `b`.
pub(super) fn before(a: &Turn, b: &Turn) -> bool {
    a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)).then(a.2.cmp(&b.2)).is_lt()
}

/// The clients' shares.
#[derive(Debug, Default)]
pub(super) struct Shares {
    /// Work done so far, as the clients' clock: the tag of the job that began last.
    clock: f64,
    /// Where each client's jobs end on that clock.
    ends: FxHashMap<(Client, bool), f64>,
}

impl Shares {
    /// The tag of a client's next job, which is expected to take `cost`.
    pub(super) fn tag(&mut self, rank: &Rank, cost: f64) -> f64 {
        let end = self.ends.entry((rank.client, rank.batch)).or_insert(self.clock);
        let start = end.max(self.clock);
        *end = start + cost;
        start
    }

    /// A job with this tag begins. Clients whose jobs are all begun are forgotten.
    pub(super) fn begin(&mut self, tag: f64) {
        self.clock = self.clock.max(tag);
        let clock = self.clock;
        if self.ends.len() > 64 {
            self.ends.retain(|_, end| *end > clock);
        }
    }

    /// Nothing waits: nobody owes anybody anything.
    pub(super) fn settle(&mut self) {
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
        // Behind the one that runs, before the rest.
        assert!(first.iter().filter(|t| **t < tag).count() <= 1, "{tag} {first:?}");
        // A client of dear jobs gets fewer of them.
        let dear = rank("dear", false);
        let tags = [shares.tag(&dear, 10.0), shares.tag(&dear, 10.0)];
        assert!(first.iter().filter(|t| **t < tags[1]).count() >= 9);
    }

    #[test]
    fn people_come_before_batches_until_these_have_waited_long() {
        let patience = Duration::from_secs(7);
        let (person, batch) = (rank("a", false), rank("b", true));
        let at = |rank, tag, id, waited| turn(rank, tag, id, waited, patience);
        for waited in [Duration::ZERO, patience / 2] {
            assert!(before(&at(&person, 5.0, 2, waited), &at(&batch, 0.0, 1, waited)));
        }
        assert!(before(&at(&batch, 0.0, 1, patience), &at(&person, 5.0, 2, patience)));
        assert!(before(&at(&person, 1.0, 1, patience), &at(&person, 1.0, 2, patience)));
    }

    #[test]
    fn forgotten_clients_owe_nothing() {
        let mut shares = Shares::default();
        for n in 0..100 {
            let tag = shares.tag(&rank(&n.to_string(), false), 1.0);
            shares.begin(tag + 2.0);
        }
        assert!(shares.ends.len() <= 66, "{}", shares.ends.len());
        shares.settle();
        assert!(shares.tag(&rank("x", false), 1.0).abs() < 1e-12);
    }
}
