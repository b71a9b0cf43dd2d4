//! Partitions of a mesh that several processes compute: each runs the first pass over some tiles of the grid, and one
//! of them joins the results and writes the mesh.

use std::fmt::Debug;

use super::control::Control;
use super::error::SurfaceError;
use super::params::SurfaceParams;

/// One of several partitions of a mesh with about the same number of atoms.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MeshPartition {
    /// Number of the partition, from 0.
    pub index: u32,
    /// Number of partitions.
    pub count: u32,
}

/// Next step of a process that works on a mesh.
#[derive(Debug)]
pub enum PartitionStep {
    /// Computes the partition with this number.
    Compute(u32),
    /// Joins the results of another process for the partition with this number.
    Join(u32, Vec<u8>),
}

/// Source of the partitions of one mesh.
pub trait PartitionSource: Debug + Send + Sync {
    /// Returns true if a run has divided the mesh.
    fn is_divided(&self) -> bool;

    /// Divides the mesh of this number of spheres, and returns the number of partitions; `None` if this process
    /// computes all of it, or if a run has begun before.
    fn begin(&self, spheres: usize, params: &SurfaceParams) -> Option<u32>;

    /// Waits for the next step. Returns `None` once there has been one for each partition or, in a process that only
    /// computes partitions, once others work on the rest.
    ///
    /// # Errors
    /// [`SurfaceError::Cancelled`] and [`SurfaceError::Memory`].
    fn next(&self, control: &Control<'_>) -> Result<Option<PartitionStep>, SurfaceError>;

    /// Passes the results of a partition that this process has computed to the process that joins them.
    fn publish(&self, index: u32, results: Vec<u8>);

    /// Notes that a partition is finished: computed by this process, or joined. This process computes a partition
    /// whose results cannot be joined.
    fn finished(&self, index: u32, is_joined: bool);
}
