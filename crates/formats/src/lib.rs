//! Mesh encoders, which write a mesh to an `io::Write`. They do not depend on paths or HTTP.
//!
//! Encoding has two steps, so that the length is known before sending: [`Encoder::new`] checks the mesh and computes
//! the layout, [`Encoder::write`] streams the file. The mesh is never copied as a whole: columns in the format's own
//! layout are written from memory, all others are converted in one block of `BLOCK_BYTES`.
//!
//! One unit is one ångström in every format, unless [`Units`] selects another unit. glTF contains positions relative to
//! [`Mesh::centre`], in Å, and a node that translates and scales them. The other formats have no nodes and contain the
//! scaled coordinates of the structure file.

mod block;
mod check;
mod error;
mod format;
mod gltf;
mod lines;
mod msms;
mod obj;
mod ply;
mod ply_text;
pub mod quantize;
mod stl;
mod storage;
mod text;
pub mod tileset;
mod vtp;

use std::io::{self, Write};

pub use error::FormatError;
pub use format::{Format, UnknownFormat};
pub use gltf::{CompressedGlb, GlbSink, GlbSinkError, Pieces, RandomAccess, linear_of_srgb};
use molmesh_surface::Mesh;
pub use quantize::{Compress, Packing, Step};
pub use storage::{Normals, Storage, Units};

/// Name of the program, for formats with such a field; without its version, since equal meshes have equal bytes in
/// every release.
const GENERATOR: &str = "molmesh";

/// Metadata of a mesh for the file.
#[derive(Debug, Clone, Default)]
pub struct Meta {
    /// Name of the mesh, such as the PDB id.
    pub name: Option<String>,
    /// Parameters and report, for `asset.extras` and comments.
    pub extras: serde_json::Map<String, serde_json::Value>,
}

/// Encoder of a file whose layout is known.
#[derive(Debug)]
pub struct Encoder<'a> {
    mesh: &'a Mesh,
    plan: Plan,
}

/// Layout of a file.
#[derive(Debug)]
enum Plan {
    Glb(gltf::GlbPlan),
    Gltf(gltf::GltfPlan),
    Ply(ply::PlyPlan),
    PlyText(ply_text::PlyTextPlan),
    Stl(stl::StlPlan),
    Obj(obj::ObjPlan),
    Vtp(vtp::VtpPlan),
    Msms(msms::MsmsPlan),
}

impl<'a> Encoder<'a> {
    /// Checks `mesh` and computes the layout. Reads only the columns whose values the format relies on. The others are
    /// copied unchanged, so the file of an invalid mesh may be invalid. With [`Packing::of`], vertices are stored as
    /// they are in memory.
    ///
    /// # Errors
    /// Returns any [`FormatError`].
    pub fn new(format: Format, storage: impl Into<Storage>, mesh: &'a Mesh, meta: &Meta) -> Result<Self, FormatError> {
        Self::with_bounds(format, storage, mesh, None, meta)
    }

    /// Acts as [`Self::new`], but does not read the positions if their `bounds` are known: lowest and highest position
    /// relative to the mesh's centre, per axis, Å.
    ///
    /// # Errors
    /// Returns the errors of [`Self::new`].
    pub fn with_bounds(
        format: Format,
        storage: impl Into<Storage>,
        mesh: &'a Mesh,
        bounds: Option<[[f32; 3]; 2]>,
        meta: &Meta,
    ) -> Result<Self, FormatError> {
        let storage = storage.into();
        if storage.packing != Packing::Full && !format.holds_quantized() {
            return Err(FormatError::QuantizationNotSupported { format: format.name() });
        }
        if !format.holds_units(storage.units) {
            return Err(FormatError::UnitsNotSupported { format: format.name(), units: storage.units.name() });
        }
        if mesh.placements.is_some() && !format.holds_instances() {
            return Err(FormatError::InstancesNotSupported { format: format.name() });
        }
        if let Packing::Quantized(step) = Packing::of(mesh)
            && storage.packing != Packing::Quantized(step)
        {
            return Err(FormatError::AlreadyQuantized { step: step.length() });
        }
        let summary = check::check(mesh, format, bounds)?;
        let plan = match format {
            Format::Glb => Plan::Glb(gltf::GlbPlan::new(mesh, storage, &summary, meta)?),
            Format::Gltf => Plan::Gltf(gltf::GltfPlan::new(mesh, storage, &summary, meta)?),
            Format::Ply => Plan::Ply(ply::PlyPlan::new(mesh, storage, meta)),
            Format::PlyText => Plan::PlyText(ply_text::PlyTextPlan::new(mesh, storage, &summary, meta)?),
            Format::Stl => Plan::Stl(stl::StlPlan::new(mesh, storage.units, meta)?),
            Format::Obj => Plan::Obj(obj::ObjPlan::new(mesh, storage, &summary, meta)?),
            Format::Vtp => Plan::Vtp(vtp::VtpPlan::new(mesh, storage, meta)),
            Format::Vert => Plan::Msms(msms::MsmsPlan::vertices(mesh, &summary, meta)?),
            Format::Face => Plan::Msms(msms::MsmsPlan::faces(mesh, meta)),
            Format::Png => return Err(FormatError::NotAMeshFormat { format: format.name() }),
        };
        Ok(Self { mesh, plan })
    }

    /// Returns the exact length of the file, bytes; `None` for OBJ, text PLY and MSMS.
    #[must_use]
    pub fn encoded_len(&self) -> Option<u64> {
        match &self.plan {
            Plan::Glb(plan) => Some(plan.len()),
            Plan::Gltf(plan) => Some(plan.len()),
            Plan::Ply(plan) => Some(plan.len),
            Plan::Stl(plan) => Some(plan.len),
            Plan::Vtp(plan) => Some(plan.len),
            Plan::PlyText(_) | Plan::Obj(_) | Plan::Msms(_) => None,
        }
    }

    /// Returns the maximum length of the file, bytes; exact if [`Self::encoded_len`] is.
    #[must_use]
    pub fn encoded_len_bound(&self) -> u64 {
        match &self.plan {
            Plan::PlyText(plan) => plan.len_bound,
            Plan::Obj(plan) => plan.len_bound,
            Plan::Msms(plan) => plan.len_bound,
            _ => self.encoded_len().unwrap_or(u64::MAX),
        }
    }

    /// Writes the file and flushes `out`. The same mesh and meta give the same bytes.
    ///
    /// Writes large blocks, so `out` needs no buffer.
    ///
    /// # Errors
    /// Returns the errors of `out`.
    pub fn write(&self, out: &mut dyn Write) -> io::Result<()> {
        match &self.plan {
            Plan::Glb(plan) => plan.write(self.mesh, out),
            Plan::Gltf(plan) => plan.write(self.mesh, out),
            Plan::Ply(plan) => plan.write(self.mesh, out),
            Plan::PlyText(plan) => plan.write(self.mesh, out),
            Plan::Stl(plan) => plan.write(self.mesh, out),
            Plan::Obj(plan) => plan.write(self.mesh, out),
            Plan::Vtp(plan) => plan.write(self.mesh, out),
            Plan::Msms(plan) => plan.write(self.mesh, out),
        }?;
        out.flush()
    }
}
