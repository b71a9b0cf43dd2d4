//! Errors of jobs: refused by the queue, not accepted as durable, failed.

use std::time::Duration;

use thiserror::Error;

use super::SaveError;
use crate::pipeline::JobError;
use crate::store::StoreError;
use crate::structure::strict_validator::{Diagnostic, Level};
use crate::surface::{OutOfMemory, SurfaceError};

/// Error of a task that the queue does not accept.
#[derive(Debug, Clone, PartialEq, Error)]
pub(crate) enum Refusal {
    /// The queue is full.
    #[error("the queue is full: {waiting} waiting, limit {limit}; the jobs ahead take about {} s", wait.as_secs_f64().ceil())]
    QueueFull {
        waiting: usize,
        limit: usize,
        /// Estimated time until the present jobs are finished.
        wait: Duration,
    },
    /// The job would miss its deadline in the queue.
    #[error(
        "the jobs ahead take about {:.0} s and this one about {:.0} s, and it must end within {:.0} s \
         (`jobs.deadline_ms`)",
        wait.as_secs_f64().ceil(),
        expected.as_secs_f64().ceil(),
        allowed.as_secs_f64().floor()
    )]
    TooLate {
        /// Estimated time in the queue.
        wait: Duration,
        /// Estimated duration beside the jobs that run.
        expected: Duration,
        /// Time from acceptance to the result.
        allowed: Duration,
    },
    /// The pool is shutting down.
    #[error("the service is shutting down")]
    Draining,
}

/// Error of an accepted job.
#[derive(Debug, Clone, PartialEq, Error)]
pub(crate) enum Failure {
    /// The job itself failed.
    #[error("{error}")]
    Job {
        error: JobError,
        /// Findings of the strict validator if the file cannot be read; empty otherwise.
        diagnostics: Vec<Diagnostic>,
    },
    /// The strict validator found errors.
    #[error("the strict check found {} errors", errors(diagnostics))]
    Check { diagnostics: Vec<Diagnostic> },
    /// The deadline passed.
    #[error("the deadline of {} s passed", limit.as_secs_f64())]
    Deadline { limit: Duration },
    /// No worker or reader was free in time, so the work did not begin.
    #[error(
        "the work could not begin in time to end within {} s (`jobs.deadline_ms`); the work ahead takes about {} s",
        limit.as_secs_f64(),
        wait.as_secs_f64().ceil()
    )]
    Waited {
        /// Time allowed from acceptance to the result.
        limit: Duration,
        /// Estimated time until a new request would begin.
        wait: Duration,
    },
    /// Memory is not available now.
    #[error(transparent)]
    Memory(#[from] OutOfMemory),
    /// The pool stopped before the job was finished.
    #[error("the service shut down before the job was finished")]
    Stopped,
    /// The job panicked; the message belongs in the log.
    #[error("the job panicked: {message}")]
    Panicked { message: String },
}

impl Failure {
    /// Returns true if the work was cancelled.
    pub(super) const fn is_cancelled(&self) -> bool {
        matches!(self, Self::Job { error: JobError::Surface(SurfaceError::Cancelled), .. })
    }
}

impl From<JobError> for Failure {
    fn from(error: JobError) -> Self {
        match error {
            JobError::Surface(SurfaceError::Memory(error)) => Self::Memory(error),
            error => Self::Job { error, diagnostics: Vec::new() },
        }
    }
}

fn errors(diagnostics: &[Diagnostic]) -> usize {
    diagnostics.iter().filter(|d| d.level == Level::Error).count()
}

/// Error of [`JobStore::accept`](super::JobStore::accept).
#[derive(Debug, Error)]
pub(crate) enum AcceptError {
    /// The queue refused the task.
    #[error(transparent)]
    Refused(#[from] Refusal),
    /// No job can be dispatched now.
    #[error("the queue of jobs does not respond")]
    BrokerDown,
    /// Input or record could not be stored.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The idempotency key was used for another request.
    #[error("the idempotency key was used for another request")]
    OtherRequest,
    /// The operating system has no random numbers.
    #[error("no random numbers: {0}")]
    Random(std::io::Error),
}

/// Error of a durable job that ended without a result.
#[derive(Debug, Clone, Error)]
pub(crate) enum EndError {
    /// The mesh could not be computed.
    #[error(transparent)]
    Job(#[from] Failure),
    /// The mesh could not be stored.
    #[error("{error}")]
    Save {
        error: SaveError,
        /// Grid spacing, Å.
        resolution: f64,
    },
    /// The job was started repeatedly and never finished: it is assumed to crash the process.
    #[error("the job was started {attempts} times and never finished")]
    Poison { attempts: u32 },
    /// Input or parameters cannot be read any more.
    #[error("the job cannot be resumed: {why}")]
    Lost { why: String },
}
