//! Why a job is not accepted or promised, and why one that was ends without a mesh.

use std::time::Duration;

use thiserror::Error;

use super::{Exhausted, SaveError};
use crate::pipeline::JobError;
use crate::store::StoreError;
use crate::structure::referee::{Diagnostic, Level};

/// Why a job is not accepted.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum Refusal {
    /// As many jobs wait as may.
    #[error("{waiting} jobs are waiting, the limit is {limit}; the next place is free in about {} s", wait.as_secs_f64().ceil())]
    QueueFull {
        /// Jobs that wait.
        waiting: usize,
        /// Jobs that may wait.
        limit: usize,
        /// Estimated time until the queue has moved.
        wait: Duration,
    },
    /// The job would wait for longer than it has.
    #[error("the jobs ahead take about {} s, longer than the {} s that this one has", wait.as_secs_f64().ceil(), allowed.as_secs_f64())]
    TooLate {
        /// Estimated time in the queue.
        wait: Duration,
        /// Time from acceptance to the mesh.
        allowed: Duration,
    },
    /// The pool is shutting down.
    #[error("the service is shutting down")]
    Draining,
}

/// Why an accepted job ended without a mesh.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum Failure {
    /// The job itself failed.
    #[error("{error}")]
    Job {
        /// Why.
        error: JobError,
        /// What the referee says of a file that cannot be read; empty otherwise.
        diagnostics: Vec<Diagnostic>,
    },
    /// A strict check was asked for, and the referee found errors.
    #[error("the strict check found {} errors", errors(diagnostics))]
    Check {
        /// Everything that it found.
        diagnostics: Vec<Diagnostic>,
    },
    /// The deadline passed.
    #[error("the deadline of {} s passed", limit.as_secs_f64())]
    Deadline {
        /// Time that was allowed.
        limit: Duration,
    },
    /// Too much memory is held by meshes that clients have not taken yet.
    #[error(transparent)]
    Memory(#[from] Exhausted),
    /// The pool stopped before the job was done.
    #[error("the service shut down before the job was done")]
    Stopped,
    /// The job panicked; the message is for the log.
    #[error("the job panicked: {message}")]
    Panicked {
        /// What the panic said.
        message: String,
    },
}

fn errors(diagnostics: &[Diagnostic]) -> usize {
    diagnostics.iter().filter(|d| d.level == Level::Error).count()
}

/// Why a job cannot be promised.
#[derive(Debug, Error)]
pub enum PromiseError {
    /// The queue has no room.
    #[error(transparent)]
    Refused(#[from] Refusal),
    /// The record cannot be kept.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The idempotency key belongs to another request.
    #[error("the idempotency key was used for another request")]
    OtherRequest,
    /// No random numbers.
    #[error("no random numbers: {0}")]
    Random(std::io::Error),
}

/// Why a promised job ended without a result.
#[derive(Debug, Clone, Error)]
pub enum EndError {
    /// There is no mesh.
    #[error(transparent)]
    Job(#[from] Failure),
    /// There is one, but no file of it.
    #[error("{error}")]
    Save {
        /// Why.
        error: SaveError,
        /// The grid spacing, Å.
        resolution: f64,
    },
    /// It was begun so many times without an end that it is taken for what ended the process.
    #[error("the job was begun {attempts} times and never ended")]
    Poison {
        /// Times that it was begun.
        attempts: u32,
    },
    /// Its input or its parameters cannot be read any more.
    #[error("the job cannot be taken up again: {why}")]
    Lost {
        /// Why.
        why: String,
    },
}
