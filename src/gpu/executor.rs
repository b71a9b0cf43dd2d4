//! What runs prepared jobs on one device. The pool knows devices through this alone, so that it can be tested with
//! executors that fail on purpose.

use std::sync::Arc;
use std::time::Instant;

use super::error::GpuError;
use super::prepare::Prepared;
use super::share::Share;
use crate::surface::{CancelToken, MeshOutput, Stage};

/// A job as a device's thread sees it.
#[derive(Debug, Clone)]
pub struct GpuJob {
    /// The work, sized and laid out on the caller's thread.
    pub prepared: Arc<Prepared>,
    /// Checked between dispatches and between tiles.
    pub cancel: CancelToken,
    /// Checked likewise.
    pub deadline: Option<Instant>,
}

/// A finished job.
#[derive(Debug, Clone)]
pub struct Finished {
    /// The mesh and its grid.
    pub meshed: MeshOutput,
    /// Device time per stage in ns, in order; empty where the device has no timestamps.
    pub stages: Vec<(Stage, u64)>,
}

/// Runs jobs on one device.
pub trait Executor: Send {
    /// Runs `jobs`, as few submissions as it can, and answers each: one result per job, in order.
    fn run(&mut self, jobs: &[GpuJob]) -> Vec<Result<Finished, GpuError>>;

    /// Runs one part of a job that several devices make. The mesh has the part's rows, its triangles the numbers that
    /// vertices have in the whole. Whatever becomes of it, the others are told through `share`.
    ///
    /// # Errors
    /// As [`Self::run`]; [`GpuError::Failed`] where the program knows no parts.
    fn part(&mut self, job: &GpuJob, share: &Share) -> Result<Finished, GpuError> {
        let _ = (job, share);
        Err(GpuError::Failed("this program makes meshes whole".to_owned()))
    }

    /// Lets go what is kept for the next job alone and is large: there has been none for a while.
    fn rest(&mut self) {}

    /// Bytes of device memory that it holds now: in use and pooled.
    fn held_bytes(&self) -> u64;
}
