//! Backend of a job: improves the triangles of the meshes of another backend if the job requests it, and divides the
//! meshes: into parts with meshes of their own, or by the atoms nearest to their triangles.

use std::ops::Deref;
use std::sync::Arc;

use molmesh_structure::AtomPart;
use molmesh_surface::improve::improve;
use molmesh_surface::{
    Backend, Control, DeviceStatus, MeshOutput, MeshSink, Reservation, Spheres, Stage, SurfaceError, SurfaceLimits,
    SurfaceParams, TriangleQuality,
};

use super::cut::Cut;
use super::parts::{self, Run};

/// Division of a mesh.
#[derive(Clone, Copy)]
pub(super) enum Division<'a> {
    /// Mesh of each part on its own.
    Parts(&'a [AtomPart]),
    /// Triangles of one surface, by the parts of their vertices.
    Cut(&'a Cut<'a>),
}

impl<'a> Division<'a> {
    /// Returns the division by `cut`, which has priority, or into `parts`.
    pub(super) fn of(parts: Option<&'a [AtomPart]>, cut: Option<&'a Cut<'a>>) -> Option<Self> {
        cut.map(Self::Cut).or_else(|| parts.map(Self::Parts))
    }

    /// Returns the parts that have meshes of their own.
    pub(super) const fn parts(self) -> Option<&'a [AtomPart]> {
        match self {
            Self::Parts(parts) => Some(parts),
            Self::Cut(_) => None,
        }
    }

    /// Returns the division of one surface.
    pub(super) const fn cut(self) -> Option<&'a Cut<'a>> {
        match self {
            Self::Parts(_) => None,
            Self::Cut(cut) => Some(cut),
        }
    }
}

/// Returns the backend of a job or, if the job has a division or a high quality, a backend that processes its meshes.
pub(super) fn of_job<'a>(
    backend: &'a dyn Backend,
    division: Option<Division<'a>>,
    quality: TriangleQuality,
) -> AnyBackend<'a> {
    let inner = backend.for_job().map_or(AnyBackend::Borrowed(backend), AnyBackend::Owned);
    if division.is_none() && quality == TriangleQuality::Standard {
        return inner;
    }
    AnyBackend::Owned(Box::new(JobBackend { inner, division, quality }))
}

/// Borrowed or owned backend.
pub(super) enum AnyBackend<'a> {
    Borrowed(&'a dyn Backend),
    Owned(Box<dyn Backend + 'a>),
}

impl<'a> Deref for AnyBackend<'a> {
    type Target = dyn Backend + 'a;

    fn deref(&self) -> &Self::Target {
        match self {
            Self::Borrowed(backend) => *backend,
            Self::Owned(backend) => backend.as_ref(),
        }
    }
}

/// Backend that processes the meshes of another backend.
struct JobBackend<'a> {
    inner: AnyBackend<'a>,
    division: Option<Division<'a>>,
    quality: TriangleQuality,
}

impl JobBackend<'_> {
    /// Returns a mesh that is not divided.
    fn whole(&self, run: &Run<'_>, control: &Control<'_>) -> Result<MeshOutput, SurfaceError> {
        let mut output = self.inner.run(run.spheres, run.single, run.limits, control)?;
        if self.quality == TriangleQuality::High {
            let improved = || improve(&mut output.mesh, run.spheres, run.single, run.limits, control);
            control.span(Stage::Improve, improved)?;
            (output.measures, output.bounds) = (None, None);
        }
        Ok(output)
    }

    /// Meshes each of `parts` and joins the meshes. Limits apply to all parts together, before quantizing.
    fn join(&self, parts: &[AtomPart], run: &Run<'_>, control: &Control<'_>) -> Result<MeshOutput, SurfaceError> {
        let backend = JobBackend { inner: AnyBackend::Borrowed(&*self.inner), division: None, quality: self.quality };
        // The content key names one backend. If it fails after some parts, the fallback meshes all parts again.
        for _attempt in 0..2 {
            let memory = Arc::new(Reservation::new(&control.memory));
            let metered = Control { memory: Arc::<Reservation>::clone(&memory), ..control.clone() };
            if let Some(output) = parts::join(parts, &backend, run, &metered)? {
                memory.keep();
                return Ok(output);
            }
        }
        Err(SurfaceError::Device { why: "different backends meshed the parts".into() })
    }

    /// Meshes all spheres and cuts the mesh. Limits apply to the mesh before the cut.
    fn cut(&self, cut: &Cut<'_>, run: &Run<'_>, control: &Control<'_>) -> Result<MeshOutput, SurfaceError> {
        // The mesh before the cut is freed at the end of this function.
        let memory = Arc::new(Reservation::new(&control.memory));
        let metered = Control { memory: Arc::<Reservation>::clone(&memory), ..control.clone() };
        let atom_ids = run.params.atom_ids || cut.needs_atom_ids();
        // Improvement needs vertices that are not rounded.
        let quantize = run.params.quantize.filter(|_| self.quality == TriangleQuality::Standard);
        let with_atoms = SurfaceParams { atom_ids, quantize, ..run.params.clone() };
        let whole = self.whole(&Run { single: &with_atoms, ..*run }, &metered)?;
        let mut output = cut.apply(whole, run, control)?;
        if !run.params.atom_ids {
            output.mesh.atom_ids = None;
        }
        Ok(output)
    }
}

impl Backend for JobBackend<'_> {
    fn name(&self) -> &'static str {
        self.inner.name()
    }

    fn arithmetic(&self) -> String {
        self.inner.arithmetic()
    }

    fn arithmetics(&self) -> Vec<String> {
        self.inner.arithmetics()
    }

    fn describe(&self) -> String {
        self.inner.describe()
    }

    fn devices(&self) -> Vec<DeviceStatus> {
        self.inner.devices()
    }

    fn write(
        &self,
        spheres: &Spheres,
        params: &SurfaceParams,
        limits: &SurfaceLimits,
        control: &Control<'_>,
        sink: Option<&dyn MeshSink>,
    ) -> Result<MeshOutput, SurfaceError> {
        let run = Run { spheres, params, single: &SurfaceParams { quantize: None, ..params.clone() }, limits };
        let output = match self.division {
            Some(Division::Parts(parts)) => self.join(parts, &run, control),
            Some(Division::Cut(cut)) => self.cut(cut, &run, control),
            None => self.whole(&run, control),
        };
        output?.deliver(params, control, sink)
    }
}
