//! Shares of limits: the number of slots that one client may hold at once, so that some stay free for others.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::Instant;

/// Error of a client that holds its share.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct ShareExceeded {
    /// Number of slots in a share.
    pub(crate) limit: usize,
}

/// Shares of one limit. Stores only clients that hold slots or wait for one, so the callers bound the memory.
#[derive(Debug)]
pub(crate) struct ClientShares {
    limit: usize,
    clients: Mutex<HashMap<u64, Arc<Semaphore>>>,
}

impl ClientShares {
    /// Creates shares of a limit of `slots`: the fraction `share` of it, but at least one slot.
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a fraction of a number of slots")]
    #[expect(clippy::cast_precision_loss, reason = "exact up to 2^53 slots")]
    pub(crate) fn new(slots: usize, share: f64) -> Arc<Self> {
        let limit = ((slots as f64 * share).ceil() as usize).max(1);
        Arc::new(Self { limit, clients: Mutex::default() })
    }

    fn clients(&self) -> MutexGuard<'_, HashMap<u64, Arc<Semaphore>>> {
        self.clients.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns the share of a client, and an empty permit for a slot in it.
    fn share(self: &Arc<Self>, client: u64) -> (Arc<Semaphore>, SharePermit) {
        let mut clients = self.clients();
        let share = clients.entry(client).or_insert_with(|| Arc::new(Semaphore::new(self.limit)));
        (Arc::clone(share), SharePermit { shares: Arc::clone(self), client, permit: None })
    }

    /// Returns the number of requests that must end before a new one of the client gets a slot, in units of its share:
    /// below 1, it gets one at once.
    pub(crate) fn load(&self, client: u64) -> f64 {
        // Each request that holds a slot or waits for one refers to the share, and so does the map.
        let requests = self.clients().get(&client).map_or(0, |share| Arc::strong_count(share) - 1);
        requests as f64 / self.limit as f64
    }

    /// Takes a slot for a client until the permit is dropped.
    pub(crate) fn take(self: &Arc<Self>, client: u64) -> Result<SharePermit, ShareExceeded> {
        let (share, mut slot) = self.share(client);
        slot.permit = share.try_acquire_owned().ok();
        if slot.permit.is_some() { Ok(slot) } else { Err(ShareExceeded { limit: self.limit }) }
    }

    /// Waits for a slot for a client, at most until `end`. Requests of one client get their slots in order of arrival.
    pub(crate) async fn wait(self: &Arc<Self>, client: u64, end: Instant) -> Result<SharePermit, ShareExceeded> {
        let (share, mut slot) = self.share(client);
        let permit = tokio::time::timeout_at(end, share.acquire_owned()).await;
        // The semaphore is never closed.
        slot.permit = permit.ok().and_then(Result::ok);
        if slot.permit.is_some() { Ok(slot) } else { Err(ShareExceeded { limit: self.limit }) }
    }
}

/// Slot that a client holds or waits for.
#[derive(Debug)]
pub(crate) struct SharePermit {
    shares: Arc<ClientShares>,
    client: u64,
    /// `None` before the slot is taken.
    permit: Option<OwnedSemaphorePermit>,
}

impl Drop for SharePermit {
    fn drop(&mut self) {
        let mut clients = self.shares.clients();
        self.permit = None;
        // Each request that holds a slot or waits for one refers to the share.
        if clients.get(&self.client).is_some_and(|share| Arc::strong_count(share) == 1) {
            clients.remove(&self.client);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn a_client_holds_its_share_and_leaves_the_rest_to_others() {
        let shares = ClientShares::new(6, 0.25);
        let first = shares.take(1).unwrap();
        assert_eq!((shares.load(1), shares.load(2)), (0.5, 0.0));
        let second = shares.take(1).unwrap();
        assert_eq!(shares.take(1).unwrap_err(), ShareExceeded { limit: 2 });
        let other = shares.take(2).unwrap();
        drop(first);
        let third = shares.take(1).unwrap();
        assert!(shares.take(1).is_err());
        drop((second, third, other));
        assert!(shares.clients().is_empty(), "clients without slots are forgotten");
    }

    #[test]
    fn a_share_has_at_least_one_place_and_at_most_all() {
        for (slots, share, limit) in [(1, 0.25, 1), (8, 0.0, 1), (1024, 0.25, 256), (256, 1.0, 256), (7, 0.5, 4)] {
            assert_eq!(ClientShares::new(slots, share).limit, limit, "{slots} {share}");
        }
    }

    #[tokio::test]
    async fn requests_of_a_client_wait_in_line_for_its_share() {
        let shares = ClientShares::new(4, 0.25);
        let soon = || Instant::now() + Duration::from_millis(100);
        let held = shares.wait(1, soon()).await.unwrap();
        assert_eq!(shares.wait(1, soon()).await.unwrap_err(), ShareExceeded { limit: 1 });
        let order = Arc::new(Mutex::new(Vec::new()));
        let waiting: Vec<_> = (0..3)
            .map(|n| {
                let (shares, order) = (Arc::clone(&shares), Arc::clone(&order));
                tokio::spawn(async move {
                    let _place = shares.wait(1, Instant::now() + Duration::from_mins(1)).await.unwrap();
                    order.lock().unwrap().push(n);
                })
            })
            .collect();
        tokio::task::yield_now().await;
        shares.wait(2, soon()).await.expect("another client has its own share");
        // A request that leaves keeps no slot.
        waiting[1].abort();
        drop(held);
        assert!(shares.take(1).is_err(), "new requests do not overtake waiting ones");
        for task in waiting {
            drop(task.await);
        }
        assert_eq!(*order.lock().unwrap(), [0, 2]);
        assert!(shares.clients().is_empty(), "clients without slots are forgotten");
    }
}
