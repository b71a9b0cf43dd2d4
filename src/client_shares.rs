//! Shares of bounded pools: the places that one client may hold at once, so that others find some free.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::Instant;

/// Error of a client that holds its share.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct ShareExceeded {
    /// Number of places in a share.
    pub(crate) limit: usize,
}

/// Shares of one pool. Stores only clients that hold places or wait for one, so the callers bound the memory.
#[derive(Debug)]
pub(crate) struct ClientShares {
    limit: usize,
    clients: Mutex<HashMap<u64, Arc<Semaphore>>>,
}

impl ClientShares {
    /// Creates shares of a pool of `places`: the fraction `share` of it, but at least one place.
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a fraction of a number of places")]
    #[expect(clippy::cast_precision_loss, reason = "exact up to 2^53 places")]
    pub(crate) fn new(places: usize, share: f64) -> Arc<Self> {
        let limit = ((places as f64 * share).ceil() as usize).max(1);
        Arc::new(Self { limit, clients: Mutex::default() })
    }

    fn clients(&self) -> MutexGuard<'_, HashMap<u64, Arc<Semaphore>>> {
        self.clients.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns the share of a client, and a place in it that is not taken yet.
    fn share(self: &Arc<Self>, client: u64) -> (Arc<Semaphore>, Place) {
        let mut clients = self.clients();
        let share = clients.entry(client).or_insert_with(|| Arc::new(Semaphore::new(self.limit)));
        (Arc::clone(share), Place { shares: Arc::clone(self), client, permit: None })
    }

    /// Takes a place for a client, until the returned value is dropped.
    pub(crate) fn take(self: &Arc<Self>, client: u64) -> Result<Place, ShareExceeded> {
        let (share, mut place) = self.share(client);
        place.permit = share.try_acquire_owned().ok();
        if place.permit.is_some() { Ok(place) } else { Err(ShareExceeded { limit: self.limit }) }
    }

    /// Takes a place for a client and waits for it until `end`. Requests of a client wait in line.
    pub(crate) async fn wait(self: &Arc<Self>, client: u64, end: Instant) -> Result<Place, ShareExceeded> {
        let (share, mut place) = self.share(client);
        let permit = tokio::time::timeout_at(end, share.acquire_owned()).await;
        // The semaphore is never closed.
        place.permit = permit.ok().and_then(Result::ok);
        if place.permit.is_some() { Ok(place) } else { Err(ShareExceeded { limit: self.limit }) }
    }
}

/// Place of a client in a pool.
#[derive(Debug)]
pub(crate) struct Place {
    shares: Arc<ClientShares>,
    client: u64,
    /// `None` before the place is taken.
    permit: Option<OwnedSemaphorePermit>,
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut clients = self.shares.clients();
        self.permit = None;
        // Each request that holds a place or waits for one refers to the share.
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
        let (first, second) = (shares.take(1).unwrap(), shares.take(1).unwrap());
        assert_eq!(shares.take(1).unwrap_err(), ShareExceeded { limit: 2 });
        let other = shares.take(2).unwrap();
        drop(first);
        let third = shares.take(1).unwrap();
        assert!(shares.take(1).is_err());
        drop((second, third, other));
        assert!(shares.clients().is_empty(), "clients without places are forgotten");
    }

    #[test]
    fn a_share_has_at_least_one_place_and_at_most_all() {
        for (places, share, limit) in [(1, 0.25, 1), (8, 0.0, 1), (1024, 0.25, 256), (256, 1.0, 256), (7, 0.5, 4)] {
            assert_eq!(ClientShares::new(places, share).limit, limit, "{places} {share}");
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
        // A request that leaves keeps no place.
        waiting[1].abort();
        drop(held);
        assert!(shares.take(1).is_err(), "new requests do not overtake waiting ones");
        for task in waiting {
            drop(task.await);
        }
        assert_eq!(*order.lock().unwrap(), [0, 2]);
        assert!(shares.clients().is_empty(), "clients without places are forgotten");
    }
}
