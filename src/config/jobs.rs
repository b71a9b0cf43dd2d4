//! The worker pool: how much runs, how much waits, how long.

use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The worker pool.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct JobsConfig {
    /// Jobs that run at once. Default 2: the backend spreads one job over all cores, and a second one fills them
    /// while the first reads its file or measures its mesh. GPUs take more: see `devices.jobs`.
    pub workers: usize,
    /// Jobs that wait. Default 64: at a typical 0.1 s a job on two workers the last one waits three seconds,
    /// which is as long as anybody waits for an answer; more would only make refusals late. As many again are there for
    /// requests that were refused and come back when they were told to.
    pub queue: usize,
    /// Requests for meshes in the house at once, from the submission of the job to the last byte of the answer.
    /// Default 256: each holds a thread while its mesh is written, and leaves threads for reading files.
    pub deliveries: usize,
    /// Time from acceptance to the finished mesh, ms, waiting included. Default 60,000: proxies commonly cut an
    /// exchange after a minute.
    pub deadline_ms: u64,
    /// Time that a request waits for its mesh, ms, before the answer is the promise of a job instead. Default 10,000: people
    /// who wait longer want to see how far it is.
    pub sync_wait_ms: u64,
    /// Time from acceptance to the result of a promised job, ms, waiting included. Default 3,600,000: nobody holds a
    /// connection for it.
    pub batch_deadline_ms: u64,
    /// Time after which a promised job that waits goes as well, ms, whoever else waits. Default 10,000: people's requests come
    /// first, but nobody waits for ever.
    pub patience_ms: u64,
    /// Times that a promised job is begun at most. Default 3: a job that ended the process so often will end it again.
    pub attempts: u32,
    /// Time for which a promised job's mesh is held and offered again while the store does not take it, ms. Default 60,000:
    /// longer than a service takes that is started again. After that it is made anew, `attempts` times in all.
    pub store_patience_ms: u64,
    /// Results of synchronous requests that are kept at once, beside their answers. Default 4: more would compete with
    /// the meshing; what is not kept is made again when somebody asks.
    pub keepers: usize,
}

impl Default for JobsConfig {
    fn default() -> Self {
        Self {
            workers: 2,
            queue: 64,
            deliveries: 256,
            deadline_ms: 60_000,
            sync_wait_ms: 10_000,
            batch_deadline_ms: 3_600_000,
            patience_ms: 10_000,
            attempts: 3,
            store_patience_ms: 60_000,
            keepers: 4,
        }
    }
}

impl JobsConfig {
    /// Time that a request waits for its mesh.
    #[must_use]
    pub fn sync_wait(&self) -> Duration {
        Duration::from_millis(self.sync_wait_ms)
    }

    /// Time from acceptance to the result of a promised job.
    #[must_use]
    pub fn batch_deadline(&self) -> Duration {
        Duration::from_millis(self.batch_deadline_ms)
    }

    /// Time for which a promised job's mesh is held and offered again while the store does not take it.
    #[must_use]
    pub fn store_patience(&self) -> Duration {
        Duration::from_millis(self.store_patience_ms)
    }

    /// Time after which a promised job that waits goes as well.
    #[must_use]
    pub fn patience(&self) -> Duration {
        Duration::from_millis(self.patience_ms)
    }

    /// Time from acceptance to the finished mesh.
    #[must_use]
    pub fn deadline(&self) -> Duration {
        Duration::from_millis(self.deadline_ms)
    }
}
