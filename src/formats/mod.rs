//! Mesh encoders. Pure: they take a mesh and an `io::Write`, without paths or HTTP.
//!
//! Encoding has two steps, so that the length is known before sending: [`Encoder::new`] checks the mesh and computes
//! the layout, [`Encoder::write`] streams the file. The mesh is never copied as a whole: columns in the format's own
//! layout are written from memory, all others pass through one block of `BLOCK_BYTES`.
//!
//! One unit is one ångström in every format, unless [`Units`] says otherwise. glTF holds positions relative to
//! [`Mesh::centre`], in Å, under a node that translates and scales them. PLY, STL and OBJ have no nodes and hold the
//! scaled coordinates of the structure file.

mod block;
mod check;
mod error;
mod format;
mod gltf;
mod obj;
mod ply;
pub mod quantize;
mod stl;
mod storage;
mod text;

use std::io::{self, Write};

use check::Depth;
pub use error::FormatError;
pub use format::{Format, UnknownFormat};
pub use gltf::{GlbSink, GlbSinkError, RandomAccess};
pub use quantize::{Compress, Packing, Step};
pub use storage::{Normals, Storage, Units};

use crate::surface::Mesh;

/// Name and version of the program, for formats with such a field.
const GENERATOR: &str = concat!("molmesh ", env!("CARGO_PKG_VERSION"));

/// Metadata of a mesh for the file.
#[derive(Debug, Clone, Default)]
pub struct Meta {
    /// Name of the mesh, such as the PDB id.
    pub name: Option<String>,
    /// Parameters and report, for `asset.extras` and comments.
    pub extras: serde_json::Map<String, serde_json::Value>,
}

/// Writes `mesh` as `format`.
///
/// # Errors
/// Returns the errors of `out`, and `InvalidInput` with a [`FormatError`] if the mesh is invalid or the format cannot
/// hold it (such as a GLB of 4 GiB); nothing has been written then.
pub fn write(format: Format, mesh: &Mesh, meta: &Meta, out: &mut dyn Write) -> io::Result<()> {
    Encoder::new(format, mesh, meta)?.write(out)
}

/// Returns the exact number of bytes that [`write()`] writes; `None` if it rejects the mesh, and for OBJ, whose length
/// is only known after formatting: see [`encoded_len_bound`].
///
/// [`Encoder`] returns the length and writes the file with a single check of the mesh.
#[must_use]
pub fn encoded_len(format: Format, mesh: &Mesh, meta: &Meta) -> Option<u64> {
    Encoder::new(format, mesh, meta).ok()?.encoded_len()
}

/// Returns the maximum number of bytes that [`write()`] writes: exact if [`encoded_len`] is; `None` if it rejects the
/// mesh.
#[must_use]
pub fn encoded_len_bound(format: Format, mesh: &Mesh, meta: &Meta) -> Option<u64> {
    Some(Encoder::new(format, mesh, meta).ok()?.encoded_len_bound())
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
    Stl(stl::StlPlan),
    Obj(obj::ObjPlan),
}

impl<'a> Encoder<'a> {
    /// Checks `mesh` and computes the layout. Reads every column once, on rayon's pool if the mesh is large.
    ///
    /// # Errors
    /// Any [`FormatError`].
    pub fn new(format: Format, mesh: &'a Mesh, meta: &Meta) -> Result<Self, FormatError> {
        Self::lay_out(format, Packing::of(mesh).into(), mesh, meta, Depth::All)
    }

    /// Returns the encoder of a mesh from a backend, whose invariants hold: skips normals and indices that are copied
    /// unchanged. Writing a large GLB then costs little more than copying the mesh.
    ///
    /// An invalid mesh may then result in an invalid file; nothing panics.
    ///
    /// # Errors
    /// Any [`FormatError`].
    pub fn trusting(format: Format, mesh: &'a Mesh, meta: &Meta) -> Result<Self, FormatError> {
        Self::stored(format, Packing::of(mesh), mesh, meta)
    }

    /// As [`Self::trusting`], with a given [`Storage`] or [`Packing`]. Vertices that are already packed this way are
    /// copied.
    ///
    /// # Errors
    /// Returns any [`FormatError`]: [`FormatError::NotQuantized`] and [`FormatError::NotInUnits`] if `format` has no
    /// such packing or units, [`FormatError::BeyondStep`] if the step is too small for the mesh,
    /// [`FormatError::OtherPacking`] if the mesh has another packing.
    pub fn stored(
        format: Format,
        storage: impl Into<Storage>,
        mesh: &'a Mesh,
        meta: &Meta,
    ) -> Result<Self, FormatError> {
        Self::lay_out(format, storage.into(), mesh, meta, Depth::Needed(format))
    }

    fn lay_out(
        format: Format,
        storage: Storage,
        mesh: &'a Mesh,
        meta: &Meta,
        depth: Depth,
    ) -> Result<Self, FormatError> {
        if storage.packing != Packing::Full && !format.holds_quantized() {
            return Err(FormatError::NotQuantized { format: format.extension() });
        }
        if !format.holds_units(storage.units) {
            return Err(FormatError::NotInUnits { format: format.extension(), units: storage.units.name() });
        }
        if let Packing::Quantized(step) = Packing::of(mesh)
            && storage.packing != Packing::Quantized(step)
        {
            return Err(FormatError::OtherPacking { step: step.length() });
        }
        let summary = check::check(mesh, depth)?;
        let plan = match format {
            Format::Glb => Plan::Glb(gltf::GlbPlan::new(mesh, storage, &summary, meta)?),
            Format::Gltf => Plan::Gltf(gltf::GltfPlan::new(mesh, storage, &summary, meta)?),
            Format::Ply => Plan::Ply(ply::PlyPlan::new(mesh, storage, meta)),
            Format::Stl => Plan::Stl(stl::StlPlan::new(mesh, storage.units, meta)?),
            Format::Obj => Plan::Obj(obj::ObjPlan::new(mesh, storage, &summary, meta)?),
            Format::Png => return Err(FormatError::NotAMesh { format: format.extension() }),
        };
        Ok(Self { mesh, plan })
    }

    /// Returns the exact length of the file, bytes; `None` for OBJ.
    #[must_use]
    pub fn encoded_len(&self) -> Option<u64> {
        match &self.plan {
            Plan::Glb(plan) => Some(plan.len()),
            Plan::Gltf(plan) => Some(plan.len()),
            Plan::Ply(plan) => Some(plan.len()),
            Plan::Stl(plan) => Some(plan.len()),
            Plan::Obj(_) => None,
        }
    }

    /// Returns the maximum length of the file, bytes; exact if [`Self::encoded_len`] is.
    #[must_use]
    pub fn encoded_len_bound(&self) -> u64 {
        match &self.plan {
            Plan::Obj(plan) => plan.len_bound(),
            _ => self.encoded_len().unwrap_or(u64::MAX),
        }
    }

    /// Writes the file and flushes `out`. The same mesh and meta give the same bytes.
    ///
    /// Writes large blocks: `out` needs no buffer.
    ///
    /// # Errors
    /// Returns the errors of `out`.
    pub fn write(&self, out: &mut dyn Write) -> io::Result<()> {
        match &self.plan {
            Plan::Glb(plan) => plan.write(self.mesh, out),
            Plan::Gltf(plan) => plan.write(self.mesh, out),
            Plan::Ply(plan) => plan.write(self.mesh, out),
            Plan::Stl(plan) => plan.write(self.mesh, out),
            Plan::Obj(plan) => plan.write(self.mesh, out),
        }?;
        out.flush()
    }
}
