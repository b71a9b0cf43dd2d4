//! Mesh of spheres: chooses how a backend meshes them, improves the triangles, and divides the mesh into parts with
//! meshes of their own, or by the atoms nearest to its triangles.

use molmesh_structure::AtomPart;
use molmesh_surface::improve::improve;
use molmesh_surface::{
    Backend, Control, MeshOutput, Spheres, Stage, SurfaceError, SurfaceLimits, SurfaceParams, TriangleQuality,
};

use super::cut::Cut;
use super::parts;

/// Spheres and their division, with the backend that meshes them.
#[derive(Clone, Copy)]
pub(super) struct Meshing<'a> {
    pub(super) backend: &'a dyn Backend,
    pub(super) spheres: &'a Spheres,
    /// Parts that have meshes of their own; `None` for one surface.
    pub(super) parts: Option<&'a [AtomPart]>,
    /// Division of one surface.
    pub(super) cut: Option<&'a Cut<'a>>,
    pub(super) quality: TriangleQuality,
    pub(super) limits: &'a SurfaceLimits,
}

impl Meshing<'_> {
    /// Returns the mesh with `params`.
    ///
    /// # Errors
    /// Returns the errors of the backend, of the improvement and of the division.
    pub(super) fn mesh(&self, params: &SurfaceParams, control: &Control<'_>) -> Result<MeshOutput, SurfaceError> {
        let output = match (self.cut, self.parts) {
            (Some(cut), _) => self.cut(cut, params, control),
            (None, Some(parts)) => self.join(parts, params, control),
            (None, None) => self.surface(params, control),
        };
        output?.deliver(params, control, None)
    }

    /// Returns the improved mesh of all spheres, with the identity of its backend.
    fn surface(&self, params: &SurfaceParams, control: &Control<'_>) -> Result<MeshOutput, SurfaceError> {
        let is_improved = self.quality == TriangleQuality::High;
        // Improvement needs vertices that are not rounded.
        let params = &SurfaceParams { quantize: params.quantize.filter(|_| !is_improved), ..params.clone() };
        let mut output = self.backend.run(self.spheres, params, self.limits, control)?;
        if is_improved {
            let improved = || improve(&mut output.mesh, self.spheres, params, self.limits, control);
            control.span(Stage::Improve, improved)?;
            (output.measures, output.bounds) = (None, None);
        }
        output.made_by = output.made_by.or_else(|| Some(self.backend.identity()));
        Ok(output)
    }

    /// Meshes each of `parts` and joins the meshes. Limits apply to all parts together, before quantizing.
    fn join(
        &self,
        parts: &[AtomPart],
        params: &SurfaceParams,
        control: &Control<'_>,
    ) -> Result<MeshOutput, SurfaceError> {
        let Self { spheres, limits, .. } = *self;
        let run = parts::Run { spheres, params, single: &SurfaceParams { quantize: None, ..params.clone() }, limits };
        let mesh = |spheres: &Spheres, limits: &SurfaceLimits, control: &Control<'_>| {
            Meshing { spheres, limits, ..*self }.surface(run.single, control)
        };
        // The content key names one backend. If it fails after some parts, the fallback meshes all parts again.
        for _attempt in 0..2 {
            let (metered, memory) = control.with_reservation();
            if let Some(output) = parts::join(parts, mesh, &run, &metered)? {
                memory.keep();
                return Ok(output);
            }
        }
        Err(SurfaceError::Device { why: "different backends meshed the parts".into() })
    }

    /// Meshes all spheres and cuts the mesh. Limits apply to the mesh before the cut.
    fn cut(&self, cut: &Cut<'_>, params: &SurfaceParams, control: &Control<'_>) -> Result<MeshOutput, SurfaceError> {
        // The mesh before the cut is freed at the end of this function.
        let metered = control.metered();
        let with_atoms = SurfaceParams { atom_ids: params.atom_ids || cut.needs_atom_ids(), ..params.clone() };
        let mut output = cut.apply(self.surface(&with_atoms, &metered)?, params, self.limits, control)?;
        if !params.atom_ids {
            output.mesh.atom_ids = None;
        }
        Ok(output)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

    use molmesh_surface::{BackendJob, CpuBackend};

    use super::*;
    use crate::{AutoBackend, Choice, JobLimits, params, run};

    /// GPU that fails after this number of meshes.
    struct FailingGpu(AtomicUsize);

    impl Backend for FailingGpu {
        fn name(&self) -> &'static str {
            "gpu"
        }

        fn describe(&self) -> String {
            String::new()
        }

        fn write(&self, job: &BackendJob<'_>) -> Result<MeshOutput, SurfaceError> {
            let left = self.0.fetch_update(Relaxed, Relaxed, |left| left.checked_sub(1));
            left.map_err(|_none| SurfaceError::Device { why: "lost".into() })?;
            CpuBackend::default().write(job)
        }
    }

    #[test]
    fn all_parts_come_from_one_backend() {
        let options = params::parse([("split", "residue-group"), ("select", "all")]).unwrap().options;
        for (n_meshes, expected) in [(100, ("gpu", false, true)), (1, ("cpu", true, true))] {
            let auto = AutoBackend::new(Box::new(CpuBackend::default()), Box::new(FailingGpu(n_meshes.into())));
            let (choice, control) = (Choice { backend: &auto, reason: "" }, Control::default());
            let sample = include_bytes!("../../../samples/4pti.pdb");
            let report = run(sample, &options, &JobLimits::default(), &choice, &control, &(), None).unwrap().report;
            assert_eq!((report.backend, report.fallback.is_some(), report.parts.len() > 1), expected);
        }
    }
}
