//! Broker within a process. A new process dispatches the unfinished jobs of the store again.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::sync::{Arc, PoisonError};

use futures_util::future::BoxFuture;
use futures_util::stream::{self, BoxStream, StreamExt as _};
use metrics::gauge;
use tokio::sync::{Notify, broadcast};

use super::order::QueueOrder;
use super::{Broker, Claim, ClaimEnd, Dispatch, DispatchError, JobEvent, WorkLock};
use crate::jobs::record::JobId;
use crate::store::Digest;
use crate::sync::{Handle, Mutex, MutexGuard, sleep};
use crate::telemetry::BROKER_QUEUED;

/// Number of events that a slow follower may miss before it skips some.
const EVENTS: usize = 256;

/// Place of a job that the broker holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Place {
    queue: usize,
    /// Number in the order of dispatch.
    number: u64,
}

#[derive(Debug, Default)]
struct BrokerState {
    /// Queued jobs, queue by queue.
    queued: BTreeMap<Place, JobId>,
    order: QueueOrder,
    /// All jobs that are queued, delayed or claimed.
    held: HashMap<JobId, Place>,
    /// Work that is being done.
    locked: HashSet<Digest>,
    next: u64,
}

impl BrokerState {
    fn enqueue(&mut self, id: JobId, place: Place) {
        self.queued.insert(place, id);
        self.publish_queued();
    }

    fn take(&mut self, prefers_gpu: bool) -> Option<JobId> {
        let first = |queue| self.queued.range(Place { queue, number: 0 }..=Place { queue, number: u64::MAX }).next();
        let place = self.order.next(prefers_gpu).into_iter().find_map(|queue| first(queue).map(|(place, _)| *place))?;
        self.order.claimed(place.queue);
        let id = self.queued.remove(&place);
        self.publish_queued();
        id
    }

    fn publish_queued(&self) {
        gauge!(BROKER_QUEUED).set(u32::try_from(self.queued.len()).unwrap_or(u32::MAX));
    }
}

struct BrokerShared {
    state: Mutex<BrokerState>,
    filled: Notify,
    events: broadcast::Sender<(JobId, JobEvent)>,
    limit: usize,
}

impl BrokerShared {
    fn lock(&self) -> MutexGuard<'_, BrokerState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes the next job. Passes the notification on if further jobs are queued: two notifications without a waiter
    /// count as one.
    fn take(&self, prefers_gpu: bool) -> Option<JobId> {
        let mut state = self.lock();
        let taken = state.take(prefers_gpu);
        if taken.is_some() && !state.queued.is_empty() {
            self.filled.notify_one();
        }
        taken
    }

    /// Ends a claim, which lasts as long as the process otherwise.
    fn end(self: Arc<Self>, id: JobId, end: ClaimEnd) {
        match end {
            ClaimEnd::Done | ClaimEnd::Abandon => drop(self.lock().held.remove(&id)),
            ClaimEnd::Release(delay) if delay.is_zero() => self.requeue(id),
            ClaimEnd::Release(delay) => drop(Handle::current().spawn(async move {
                sleep(delay).await;
                self.requeue(id);
            })),
        }
    }

    fn requeue(&self, id: JobId) {
        let mut state = self.lock();
        if let Some(place) = state.held.get(&id).copied() {
            state.enqueue(id, place);
            drop(state);
            self.filled.notify_one();
        }
    }
}

/// Broker within a process. Clones share one queue.
#[derive(Clone)]
pub(crate) struct MemoryBroker(Arc<BrokerShared>);

impl MemoryBroker {
    /// Creates an empty broker that queues at most `limit` jobs.
    pub(crate) fn new(limit: usize) -> Self {
        let (events, _) = broadcast::channel(EVENTS);
        Self(Arc::new(BrokerShared { state: Mutex::default(), filled: Notify::new(), events, limit }))
    }

    /// Returns true if no job is queued or claimed.
    #[cfg(test)]
    pub(crate) fn is_empty(&self) -> bool {
        self.0.lock().held.is_empty()
    }

    /// Returns true if a job is queued or claimed.
    #[cfg(test)]
    pub(crate) fn holds(&self, id: &JobId) -> bool {
        self.0.lock().held.contains_key(id)
    }
}

impl Broker for MemoryBroker {
    fn dispatch<'a>(&'a self, job: &'a Dispatch) -> BoxFuture<'a, Result<bool, DispatchError>> {
        let mut state = self.0.lock();
        let queued = if state.held.contains_key(&job.id) {
            Ok(false)
        } else if state.queued.len() >= self.0.limit {
            Err(DispatchError::Full)
        } else {
            let place = Place { queue: job.queue(), number: state.next };
            state.next += 1;
            state.held.insert(job.id.clone(), place);
            state.enqueue(job.id.clone(), place);
            Ok(true)
        };
        drop(state);
        if queued == Ok(true) {
            self.0.filled.notify_one();
        }
        Box::pin(std::future::ready(queued))
    }

    fn claim(&self, prefers_gpu: bool) -> BoxFuture<'_, Claim> {
        Box::pin(async move {
            loop {
                let filled = self.0.filled.notified();
                if let Some(id) = self.0.take(prefers_gpu) {
                    let (broker, claimed) = (Arc::clone(&self.0), id.clone());
                    return Claim::new(id, move |end| {
                        broker.end(claimed, end);
                        Box::pin(std::future::ready(()))
                    });
                }
                filled.await;
            }
        })
    }

    fn lock<'a>(&'a self, work: &'a Digest) -> BoxFuture<'a, Option<WorkLock>> {
        let (broker, work) = (Arc::clone(&self.0), *work);
        let is_free = broker.lock().locked.insert(work);
        let lock = is_free.then(|| {
            WorkLock::new(move || {
                broker.lock().locked.remove(&work);
            })
        });
        Box::pin(std::future::ready(lock))
    }

    fn publish(&self, id: &JobId, event: JobEvent) {
        // Without followers there is no receiver.
        drop(self.0.events.send((id.clone(), event)));
    }

    fn events(&self, id: &JobId) -> BoxFuture<'_, BoxStream<'static, JobEvent>> {
        let (receiver, id) = (self.0.events.subscribe(), id.clone());
        let next = |(mut receiver, id): (broadcast::Receiver<(JobId, JobEvent)>, JobId)| async move {
            loop {
                match receiver.recv().await {
                    Ok((of, event)) if of == id => return Some((event, (receiver, id))),
                    Ok(_) | Err(broadcast::error::RecvError::Lagged(_)) => {}
                    Err(broadcast::error::RecvError::Closed) => return None,
                }
            }
        };
        Box::pin(std::future::ready(stream::unfold((receiver, id), next).boxed()))
    }

    fn flush(&self) -> BoxFuture<'_, ()> {
        Box::pin(std::future::ready(()))
    }

    fn queued(&self) -> usize {
        self.0.lock().queued.len()
    }

    fn limit(&self) -> usize {
        self.0.limit
    }

    fn losses(&self) -> usize {
        0
    }

    fn down(&self) -> Option<String> {
        None
    }
}
