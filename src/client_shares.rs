//! Shares of bounded pools: the places that one client may hold at once, so that others find some free.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Error of a client that holds its share.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct ShareExceeded {
    /// Number of places in a share.
    pub(crate) limit: usize,
}

/// Shares of one pool. Stores only clients that hold places, so the pool bounds the memory.
#[derive(Debug)]
pub(crate) struct ClientShares {
    limit: usize,
    held: Mutex<HashMap<u64, usize>>,
}

impl ClientShares {
    /// Creates shares of a pool of `places`: the fraction `share` of it, but at least one place.
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a fraction of a number of places")]
    #[expect(clippy::cast_precision_loss, reason = "exact up to 2^53 places")]
    pub(crate) fn new(places: usize, share: f64) -> Arc<Self> {
        let limit = ((places as f64 * share).ceil() as usize).max(1);
        Arc::new(Self { limit, held: Mutex::default() })
    }

    fn held(&self) -> MutexGuard<'_, HashMap<u64, usize>> {
        self.held.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes a place for a client, until the returned value is dropped.
    pub(crate) fn take(self: &Arc<Self>, client: u64) -> Result<Place, ShareExceeded> {
        let mut held = self.held();
        let places = held.entry(client).or_insert(0);
        if *places >= self.limit {
            return Err(ShareExceeded { limit: self.limit });
        }
        *places += 1;
        Ok(Place { shares: Arc::clone(self), client })
    }
}

/// Place of a client in a pool.
#[derive(Debug)]
pub(crate) struct Place {
    shares: Arc<ClientShares>,
    client: u64,
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut held = self.shares.held();
        if let Some(places) = held.get_mut(&self.client) {
            *places -= 1;
            if *places == 0 {
                held.remove(&self.client);
            }
        }
    }
}

#[cfg(test)]
mod tests {
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
        assert!(shares.held().is_empty(), "clients without places are forgotten");
    }

    #[test]
    fn a_share_has_at_least_one_place_and_at_most_all() {
        for (places, share, limit) in [(1, 0.25, 1), (8, 0.0, 1), (1024, 0.25, 256), (256, 1.0, 256), (7, 0.5, 4)] {
            assert_eq!(ClientShares::new(places, share).limit, limit, "{places} {share}");
        }
    }
}
