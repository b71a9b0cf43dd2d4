//! A job before it meets a device: the lattice and everything that follows from it without a device.

use crate::surface::candidates;
use crate::surface::lattice::Lattice;
use crate::surface::plan::Plan;
use crate::surface::{Control, Spheres, SurfaceError, SurfaceLimits, SurfaceParams};

/// A job, ready for any device.
#[derive(Debug)]
pub struct Prepared {
    /// Atoms in canonical order.
    pub lattice: Lattice,
    /// Its bricks.
    pub plan: Plan,
    /// What was asked for.
    pub params: SurfaceParams,
    /// What may be used.
    pub limits: SurfaceLimits,
}

impl Prepared {
    /// Prepares a job on the caller's thread.
    ///
    /// # Errors
    /// Any [`SurfaceError`] that needs no device to be seen.
    pub fn new(
        spheres: &Spheres,
        params: &SurfaceParams,
        limits: &SurfaceLimits,
        control: &Control<'_>,
    ) -> Result<Self, SurfaceError> {
        control.check()?;
        candidates::check(spheres, params, limits)?;
        let lattice = Lattice::new(spheres, params)?;
        control.check()?;
        let plan = Plan::new(&lattice, limits, control)?;
        Ok(Self { lattice, plan, params: params.clone(), limits: *limits })
    }

    /// Whether it is small enough to share a submission with others: what it costs is latency, not work.
    #[must_use]
    pub fn is_small(&self) -> bool {
        self.lattice.atoms.len() <= 5_000
    }
}
