//! Memory that each client holds of a budget.

use std::sync::atomic::AtomicU64;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};

use rustc_hash::FxHashMap;

/// Shares of the clients in a budget.
#[derive(Debug)]
pub(super) struct MemoryShares {
    /// Fraction of the budget that a client may hold besides its largest work.
    pub(super) share: f64,
    /// Clients that hold memory, or may take some.
    clients: Mutex<FxHashMap<u64, Weak<Holdings>>>,
}

impl MemoryShares {
    /// Creates shares of a budget, of which each is a fraction.
    pub(super) fn new(share: f64) -> Arc<Self> {
        Arc::new(Self { share, clients: Mutex::default() })
    }

    /// Returns the clients.
    pub(super) fn clients(&self) -> MutexGuard<'_, FxHashMap<u64, Weak<Holdings>>> {
        self.clients.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns the holdings of a client.
    pub(super) fn of(self: &Arc<Self>, client: u64) -> Arc<Holdings> {
        let mut clients = self.clients();
        if let Some(holdings) = clients.get(&client).and_then(Weak::upgrade) {
            return holdings;
        }
        let holdings = Arc::new(Holdings { client, bytes: AtomicU64::new(0), shares: Arc::clone(self) });
        clients.insert(client, Arc::downgrade(&holdings));
        holdings
    }
}

/// Memory that the reservations of one client hold.
#[derive(Debug)]
pub(super) struct Holdings {
    client: u64,
    pub(super) bytes: AtomicU64,
    shares: Arc<MemoryShares>,
}

impl Drop for Holdings {
    fn drop(&mut self) {
        let mut clients = self.shares.clients();
        // The client may have come back meanwhile.
        if clients.get(&self.client).is_some_and(|holdings| holdings.strong_count() == 0) {
            clients.remove(&self.client);
        }
    }
}
