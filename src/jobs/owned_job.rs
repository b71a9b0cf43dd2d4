//! Job of which no client knows, and which ends with its owner.

use tokio::sync::watch;
use tracing::Instrument as _;

use super::{JobId, JobStore, JobView, Status};
use crate::store::{Name, Namespace, StoreError};
use crate::sync::Handle;

/// Job that is cancelled when its owner drops it, or whose record is then removed if it has ended. The record of a
/// cancelled job stays until it expires, because a worker may have read that the job is open.
pub(crate) struct OwnedJob {
    jobs: JobStore,
    id: JobId,
    namespace: Namespace,
}

impl OwnedJob {
    /// Owns an accepted job from now on.
    pub(crate) fn new(jobs: JobStore, view: &JobView) -> Self {
        let (id, namespace) = (view.record.id.clone(), view.record.namespace);
        Self { jobs, id, namespace }
    }

    /// Watches the state of the job; `None` if its record was lost.
    pub(crate) async fn watch(&self) -> Result<Option<watch::Receiver<JobView>>, StoreError> {
        self.jobs.watch(&self.id, self.namespace).await
    }
}

impl Drop for OwnedJob {
    fn drop(&mut self) {
        let (jobs, id, namespace) = (self.jobs.clone(), self.id.clone(), self.namespace);
        let end = async move {
            let ended = match jobs.dismiss(&id, namespace).await {
                Ok(Some(view)) if view.record.status != Status::Dismissed => forget(&jobs, &id).await,
                Ok(_) => Ok(()),
                Err(error) => Err(error),
            };
            if let Err(error) = ended {
                tracing::debug!(job_id = %id, %error, "the record of a job that its owner has left expires later");
            }
        };
        Handle::current().spawn(end.in_current_span());
    }
}

/// Removes the record of an ended job.
async fn forget(jobs: &JobStore, id: &JobId) -> Result<(), StoreError> {
    jobs.0.lock().jobs.remove(id);
    jobs.0.store.delete(&Name::ended_job(id.as_str())?).await
}
