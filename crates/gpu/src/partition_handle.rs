//! Rendezvous for the partitions of a multi-device job: each publishes its counts and receives its vertex and triangle
//! offsets, and the records of the bricks that it imports from later partitions.

use std::ops::Range;
use std::sync::{Arc, PoisonError};
use std::time::Duration;

use molmesh_surface::{SharedBytes, SurfaceError};
use molmesh_sync::{Condvar, Mutex, MutexGuard};

use super::error::GpuError;
use super::job::GpuJob;
use super::plan::Partition;
use super::plan::partition::total_len;

/// Interval at which a waiting partition checks for cancellation and deadline. Published counts wake it at once.
const POLL_INTERVAL: Duration = Duration::from_millis(5);

/// Handle of one partition of a multi-device job.
#[derive(Clone)]
pub struct PartitionHandle {
    shared: Arc<PartitionedJob>,
    /// Index of the partition.
    pub index: usize,
}

struct PartitionedJob {
    partitions: Vec<Partition>,
    state: Mutex<PublishedCounts>,
    changed: Condvar,
}

struct PublishedCounts {
    counts: Vec<Option<PartitionCounts>>,
    aborted: bool,
    has_flat_vertices: bool,
}

/// Counts that a partition publishes.
#[derive(Clone)]
pub(super) struct PartitionCounts {
    /// Number of vertices.
    pub(super) vertices: u64,
    /// Number of triangles.
    pub(super) triangles: u64,
    /// Records and then offsets of the bricks that earlier partitions import, in the order of
    /// [`PartitionHandle::exports`].
    pub(super) exported: SharedBytes,
}

/// Run of bricks that a partition imports from a later one.
pub(super) struct Import {
    pub(super) bricks: Range<u32>,
    /// Position of the run in `exported`, in bricks.
    pub(super) position: u64,
    /// Number of bricks in `exported`.
    pub(super) n_exported: u64,
    pub(super) exported: SharedBytes,
    /// Number of vertices before the owner's partition.
    pub(super) first_vertex: u64,
}

/// Offsets and imports of a partition, known when all partitions have published their counts.
pub(super) struct Numbering {
    /// Number of vertices and triangles before the partition.
    pub(super) first: [u64; 2],
    /// Number of vertices and triangles of the mesh.
    pub(super) total: [u64; 2],
    pub(super) imports: Vec<Import>,
}

impl PartitionHandle {
    /// Creates the handles of `partitions`, in order.
    #[must_use]
    pub fn for_partitions(partitions: Vec<Partition>) -> Vec<Self> {
        let n = partitions.len();
        let state = PublishedCounts { counts: vec![None; n], aborted: false, has_flat_vertices: false };
        let shared = Arc::new(PartitionedJob { partitions, state: Mutex::new(state), changed: Condvar::new() });
        (0..n).map(|index| Self { shared: Arc::clone(&shared), index }).collect()
    }

    /// Returns the partition.
    #[must_use]
    pub fn partition(&self) -> &Partition {
        &self.shared.partitions[self.index]
    }

    /// Returns true while this partition waits for the counts of others.
    #[must_use]
    pub fn is_waiting(&self) -> bool {
        let state = self.lock();
        state.counts[self.index].is_some() && state.counts.iter().any(Option::is_none)
    }

    /// Aborts the multi-device run: all partitions fail at their next check.
    pub fn abort(&self) {
        self.lock().aborted = true;
        self.shared.changed.notify_all();
    }

    /// Fails if the multi-device run was aborted.
    ///
    /// # Errors
    /// [`SurfaceError::Cancelled`].
    pub(super) fn check(&self) -> Result<(), GpuError> {
        if self.lock().aborted { Err(SurfaceError::Cancelled.into()) } else { Ok(()) }
    }

    /// Runs of bricks of this partition that earlier partitions import.
    pub(super) fn exports(&self) -> Vec<Range<u32>> {
        self.exported_by(self.index).map(|(_, run)| run).collect()
    }

    /// Runs that partition `owner` exports, each with the index of the importing partition.
    fn exported_by(&self, owner: usize) -> impl Iterator<Item = (usize, Range<u32>)> {
        let partitions = &self.shared.partitions;
        let own = partitions[owner].bricks.clone();
        let imports =
            |(k, importer): (usize, &Partition)| importer.imports.clone().into_iter().map(move |run| (k, run));
        partitions[..owner].iter().enumerate().flat_map(imports).filter(move |(_, run)| own.contains(&run.start))
    }

    /// Publishes the counts of this partition.
    pub(super) fn publish(&self, counts: PartitionCounts) {
        self.lock().counts[self.index] = Some(counts);
        self.shared.changed.notify_all();
    }

    /// Waits until all partitions have published their counts.
    ///
    /// # Errors
    /// [`SurfaceError::Cancelled`] if the run was aborted or the job cancelled; [`SurfaceError::Deadline`].
    pub(super) fn await_counts(&self, job: &GpuJob) -> Result<Numbering, GpuError> {
        let mut state = self.lock();
        loop {
            job.check()?;
            if state.aborted {
                return Err(SurfaceError::Cancelled.into());
            }
            let all: Option<Vec<PartitionCounts>> = state.counts.iter().cloned().collect();
            if let Some(all) = all {
                drop(state);
                return Ok(self.numbering(&all));
            }
            state = self.shared.changed.wait_timeout(state, POLL_INTERVAL).unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    fn numbering(&self, all: &[PartitionCounts]) -> Numbering {
        let before =
            |n: usize| all[..n].iter().fold([0, 0], |[v, t], counts| [v + counts.vertices, t + counts.triangles]);
        let mut imports = Vec::new();
        for (owner, counts) in all.iter().enumerate().skip(self.index + 1) {
            let runs: Vec<(usize, Range<u32>)> = self.exported_by(owner).collect();
            let n_exported = runs.iter().map(|(_, run)| total_len(std::slice::from_ref(run))).sum();
            let mut position = 0;
            for (importer, bricks) in runs {
                let n = total_len(std::slice::from_ref(&bricks));
                if importer == self.index {
                    let (exported, [first_vertex, _]) = (Arc::clone(&counts.exported), before(owner));
                    imports.push(Import { bricks, position, n_exported, exported, first_vertex });
                }
                position += n;
            }
        }
        Numbering { first: before(self.index), total: before(all.len()), imports }
    }

    /// Records that some vertex of this partition has no gradient.
    pub(super) fn set_flat_vertices(&self) {
        self.lock().has_flat_vertices = true;
    }

    /// Returns true if some vertex of some partition has no gradient.
    pub(super) fn has_flat_vertices(&self) -> bool {
        self.lock().has_flat_vertices
    }

    fn lock(&self) -> MutexGuard<'_, PublishedCounts> {
        // No code panics between two changes under the lock, so a poisoned state is consistent.
        self.shared.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
