//! Backend that divides its meshes: into parts with meshes of their own, or by the atoms nearest to their triangles.

use std::ops::Deref;
use std::sync::Arc;

use super::cut::Cut;
use super::parts::{self, Run};
use super::work::mesh_work;
use crate::structure::AtomPart;
use crate::surface::{
    Backend, Control, DeviceStatus, MeshOutput, MeshSink, Reservation, Spheres, SurfaceError, SurfaceKind,
    SurfaceLimits, SurfaceParams,
};

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

/// Returns `backend` or, with a `division`, a backend that divides the meshes of `backend`.
pub(super) fn divided<'a>(backend: &'a dyn Backend, division: Option<Division<'a>>) -> AnyBackend<'a> {
    let inner = AnyBackend::Borrowed(backend);
    match division {
        Some(division) => AnyBackend::Owned(Box::new(DividedBackend { inner, division })),
        None => inner,
    }
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

/// Backend that divides the meshes of another backend.
struct DividedBackend<'a> {
    /// The chosen backend, or the one that it assigned to the job.
    inner: AnyBackend<'a>,
    division: Division<'a>,
}

impl DividedBackend<'_> {
    /// Meshes each of `parts` and joins the meshes. Limits apply to all parts together, before quantizing.
    fn join(&self, parts: &[AtomPart], run: &Run<'_>, control: &Control<'_>) -> Result<MeshOutput, SurfaceError> {
        let work = parts.iter().map(|part| mesh_work(part.rows.len() as f64, run.params.resolution)).sum();
        let assigned = self.inner.for_job(run.params.surface, work);
        let backend = assigned.as_deref().unwrap_or(&*self.inner);
        // The content key names one backend. If it fails after some parts, the fallback meshes all parts again.
        for _attempt in 0..2 {
            let memory = Arc::new(Reservation::new(&control.memory));
            let metered = Control { memory: Arc::<Reservation>::clone(&memory), ..control.clone() };
            if let Some(output) = parts::join(parts, backend, run, &metered)? {
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
        let with_atoms = SurfaceParams { atom_ids, ..run.params.clone() };
        let whole = self.inner.run(run.spheres, &with_atoms, run.limits, &metered)?;
        let mut output = cut.apply(whole, run, control)?;
        if !run.params.atom_ids {
            output.mesh.atom_ids = None;
        }
        Ok(output)
    }
}

impl Backend for DividedBackend<'_> {
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

    fn supports(&self, surface: SurfaceKind) -> bool {
        self.inner.supports(surface)
    }

    fn devices(&self) -> Vec<DeviceStatus> {
        self.inner.devices()
    }

    fn for_job(&self, surface: SurfaceKind, work: f64) -> Option<Box<dyn Backend + '_>> {
        let inner = AnyBackend::Owned(self.inner.for_job(surface, work)?);
        Some(Box::new(DividedBackend { inner, division: self.division }))
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
            Division::Parts(parts) => self.join(parts, &run, control),
            Division::Cut(cut) => self.cut(cut, &run, control),
        };
        output?.deliver(params, control, sink)
    }
}
