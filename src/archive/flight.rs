//! One fetch for everybody who wants the same entry. It runs on its own, so it ends whoever goes away.

use std::collections::HashMap;
use std::future::Future;
use std::sync::{Arc, Mutex, PoisonError};

use tokio::sync::watch;

use crate::structure::EntryId;

type Seat<T> = watch::Receiver<Option<T>>;
/// What it takes to start a flight.
type Crew<T> = (watch::Sender<Option<T>>, Landing<T>);
type UnderWay<T> = Mutex<HashMap<EntryId, Seat<T>>>;

/// What is being fetched.
#[derive(Debug)]
pub(super) struct Flights<T>(Arc<UnderWay<T>>);

impl<T: Clone + Send + Sync + 'static> Flights<T> {
    pub(super) fn new() -> Self {
        Self(Arc::default())
    }

    /// The result of the flight for `id` that is under way, or of a new one. None if it ended without a result: it
    /// panicked, or the runtime stops.
    pub(super) async fn join<F>(&self, id: &EntryId, start: impl FnOnce() -> F) -> Option<T>
    where
        F: Future<Output = T> + Send + 'static,
    {
        let (mut result, takes_off) = self.board(id);
        // Not under the lock: a runtime that stops drops what it is given at once.
        if let Some((sender, landing)) = takes_off {
            let flight = start();
            tokio::spawn(async move {
                let value = flight.await;
                drop(landing);
                sender.send_replace(Some(value));
            });
        }
        result.wait_for(Option::is_some).await.ok().and_then(|value| value.clone())
    }

    /// A seat in the flight for `id`, and what it takes to start it where there was none.
    fn board(&self, id: &EntryId) -> (Seat<T>, Option<Crew<T>>) {
        let mut under_way = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(result) = under_way.get(id) {
            return (result.clone(), None);
        }
        let (sender, result) = watch::channel(None);
        under_way.insert(id.clone(), result.clone());
        (result, Some((sender, Landing { flights: Arc::clone(&self.0), id: id.clone() })))
    }
}

/// Takes a flight off the board, however it ends.
struct Landing<T> {
    flights: Arc<UnderWay<T>>,
    id: EntryId,
}

impl<T> Drop for Landing<T> {
    fn drop(&mut self) {
        self.flights.lock().unwrap_or_else(PoisonError::into_inner).remove(&self.id);
    }
}
