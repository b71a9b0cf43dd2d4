//! Jobs for devices: prepared on the caller's thread, independent of the device that runs them.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use molmesh_surface::cpu::{LATTICE_BYTES, distance, scan};
use molmesh_surface::lattice::Lattice;
use molmesh_surface::{
    CancelToken, Control, MemoryMeter, MeshOutput, Spheres, Stage, SurfaceError, SurfaceLimits, SurfaceParams,
    candidates,
};

use super::error::GpuError;
use super::plan::{Arcs, Plan};
use super::sheets::SheetBlocks;

/// Maximum number of atoms of a small job. Latency dominates its cost, so several small jobs share a submission.
const MAX_SMALL_ATOMS: usize = 5_000;

/// Input of a job that any device can run.
#[derive(Debug)]
pub struct Prepared {
    /// Atoms in canonical order.
    pub lattice: Lattice,
    /// Bricks of the lattice.
    pub plan: Plan,
    /// Surface parameters.
    pub params: SurfaceParams,
    /// Limits.
    pub limits: SurfaceLimits,
    /// Meter of the mesh's memory.
    memory: Arc<dyn MemoryMeter>,
    /// True once the mesh is added to the meter. Prevents a second addition if another device repeats the job.
    is_counted: AtomicBool,
}

impl Prepared {
    /// Prepares a job.
    ///
    /// # Errors
    /// Any [`SurfaceError`] that can be detected without a device.
    pub fn new(
        spheres: &Spheres,
        params: &SurfaceParams,
        limits: &SurfaceLimits,
        control: &Control<'_>,
    ) -> Result<Self, SurfaceError> {
        control.check()?;
        candidates::check(spheres, params, limits)?;
        control.memory.grow(LATTICE_BYTES * spheres.len() as u64)?;
        let lattice = Lattice::new(spheres, params, control)?;
        control.check()?;
        let mut plan = Plan::new(&lattice, limits, control)?;
        if let Some((union, bounds)) = distance::boundary(&lattice, params, limits, control)? {
            control.check()?;
            plan.arcs = Arcs::new(union, &bounds, &lattice, &mut plan, limits, control)?;
        }
        let memory = Arc::clone(&control.memory);
        Ok(Self { lattice, plan, params: params.clone(), limits: *limits, memory, is_counted: AtomicBool::new(false) })
    }

    /// Checks the size of a mesh, given as numbers of vertices and triangles, against the limits.
    pub(super) fn check_size(&self, [n_vertices, n_triangles]: [u64; 2]) -> Result<(), SurfaceError> {
        scan::check_size(&self.params, &self.limits, n_vertices, n_triangles)
    }

    /// Checks the size of a complete mesh like [`Self::check_size`], rejects an empty mesh, and adds the memory of the
    /// mesh to the meter.
    pub(super) fn check_mesh(&self, size: [u64; 2]) -> Result<(), SurfaceError> {
        if size[1] == 0 {
            Err(SurfaceError::NoSurface { isovalue: self.params.level() })
        } else {
            self.check_size(size)?;
            if !self.is_counted.swap(true, Ordering::Relaxed) {
                self.memory.grow(self.params.mesh_bytes(size[0], size[1]))?;
            }
            Ok(())
        }
    }

    /// Returns true if the job may share a submission with others.
    #[must_use]
    pub fn is_small(&self) -> bool {
        self.lattice.atoms.len() <= MAX_SMALL_ATOMS
    }
}

/// Job with its cancellation token and deadline.
#[derive(Debug, Clone)]
pub struct GpuJob {
    /// Input.
    pub prepared: Arc<Prepared>,
    /// Cancellation token, checked between dispatches and between chunks.
    pub cancel: CancelToken,
    /// Deadline, checked together with the token.
    pub deadline: Option<Instant>,
}

impl GpuJob {
    /// Fails if the job was cancelled or its deadline has passed.
    ///
    /// # Errors
    /// [`SurfaceError::Cancelled`], [`SurfaceError::Deadline`].
    pub fn check(&self) -> Result<(), SurfaceError> {
        if self.cancel.is_cancelled() {
            return Err(SurfaceError::Cancelled);
        }
        let late = self.deadline.is_some_and(|deadline| deadline <= Instant::now());
        if late { Err(SurfaceError::Deadline) } else { Ok(()) }
    }
}

/// Finished job.
#[derive(Debug, Clone)]
pub struct Finished {
    /// Mesh and grid.
    pub meshed: MeshOutput,
    /// Device time per stage in ns, in stage order; empty if the device has no timestamps.
    pub stages: Vec<(Stage, u64)>,
    /// Sums over the sheets of the mesh's bricks.
    pub sheets: SheetBlocks,
}

impl Finished {
    /// Adds the measures of the mesh, unless it is not closed.
    ///
    /// # Errors
    /// [`GpuError::Failed`] if the device's sums contradict each other or the mesh.
    pub fn measure(&mut self, prepared: &Prepared) -> Result<(), GpuError> {
        let Prepared { plan, lattice, params, .. } = prepared;
        let unit = params.quantize.map_or(lattice.spacing, |step| f64::from(step.length()));
        self.meshed.measures = self.sheets.measures(plan, unit, self.meshed.size())?;
        // Frees the readback buffers that hold only sheets.
        self.sheets = SheetBlocks::default();
        Ok(())
    }
}

/// Result of a job.
pub type JobResult = Result<Finished, GpuError>;
