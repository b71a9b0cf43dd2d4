//! Meshes to bytes. Pure: a mesh and an `io::Write` in, no paths, no HTTP.
//!
//! A file is made in two steps, so that whoever sends it knows its length first: [`Encoder::new`] checks the mesh
//! and lays the file out without writing a byte, [`Encoder::write`] streams it. The mesh is never copied as a
//! whole: columns that the format holds as they are go to the writer as they lie in memory, everything else
//! passes through one block of [`block::BLOCK_BYTES`].
//!
//! One unit is one ångström in every format, unless [`Units`] says otherwise. glTF holds positions relative to
//! [`Mesh::centre`], in Å, under a node that moves and scales them; PLY, STL and OBJ have no nodes and hold the structure file's
//! own coordinates, scaled.

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

/// Program and version, as every format that has room for it says it.
const GENERATOR: &str = concat!("molmesh ", env!("CARGO_PKG_VERSION"));

/// What a file says about its mesh besides the mesh.
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
/// Those of `out`, and `InvalidInput` around a [`FormatError`] where the mesh is broken or the format cannot hold
/// it (a GLB of 4 GiB); then nothing has been written.
pub fn write(format: Format, mesh: &Mesh, meta: &Meta, out: &mut dyn Write) -> io::Result<()> {
    Encoder::new(format, mesh, meta)?.write(out)
}

/// Bytes that [`write`] will write, exactly; `None` where it would refuse the mesh, and for OBJ, whose length is
/// known only once every number is text: see [`encoded_len_bound`].
///
/// [`Encoder`] tells the length and writes the file at the price of one check of the mesh.
#[must_use]
pub fn encoded_len(format: Format, mesh: &Mesh, meta: &Meta) -> Option<u64> {
    Encoder::new(format, mesh, meta).ok()?.encoded_len()
}

/// Bytes that [`write`] will write at most: exact wherever [`encoded_len`] is; `None` where it would refuse.
#[must_use]
pub fn encoded_len_bound(format: Format, mesh: &Mesh, meta: &Meta) -> Option<u64> {
    Some(Encoder::new(format, mesh, meta).ok()?.encoded_len_bound())
}

/// A file that is laid out and not yet written.
#[derive(Debug)]
pub struct Encoder<'a> {
    mesh: &'a Mesh,
    plan: Plan,
}

/// What is known of a file before it is written.
#[derive(Debug)]
enum Plan {
    Glb(gltf::GlbPlan),
    Gltf(gltf::GltfPlan),
    Ply(ply::PlyPlan),
    Stl(stl::StlPlan),
    Obj(obj::ObjPlan),
}

impl<'a> Encoder<'a> {
    /// Checks `mesh` and lays the file out. Reads every column of the mesh once, on rayon's pool if it is large.
    ///
    /// # Errors
    /// Any [`FormatError`].
    pub fn new(format: Format, mesh: &'a Mesh, meta: &Meta) -> Result<Self, FormatError> {
        Self::lay_out(format, Packing::of(mesh).into(), mesh, meta, Depth::All)
    }

    /// The same for a mesh that a backend returned, whose invariants hold: does not look at normals and indices
    /// that the format holds as they are. Writing a large GLB then costs hardly more than copying the mesh.
    ///
    /// A mesh that breaks its invariants may be written as a file that breaks them too; nothing panics.
    ///
    /// # Errors
    /// Any [`FormatError`].
    pub fn trusting(format: Format, mesh: &'a Mesh, meta: &Meta) -> Result<Self, FormatError> {
        Self::stored(format, Packing::of(mesh), mesh, meta)
    }

    /// As [`Self::trusting`], with the mesh stored as asked: a [`Storage`], or a [`Packing`] alone. Vertices that are packed so
    /// already are written as they lie.
    ///
    /// # Errors
    /// Any [`FormatError`]; [`FormatError::NotQuantized`] and [`FormatError::NotInUnits`] if `format` has no such
    /// packing or units, [`FormatError::BeyondStep`] if the step is too small for the mesh, [`FormatError::OtherPacking`] if
    /// the mesh is packed otherwise.
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

    /// Bytes of the file, exactly; `None` for OBJ.
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

    /// Bytes of the file at most; exact where [`Self::encoded_len`] is.
    #[must_use]
    pub fn encoded_len_bound(&self) -> u64 {
        match &self.plan {
            Plan::Obj(plan) => plan.len_bound(),
            _ => self.encoded_len().unwrap_or(u64::MAX),
        }
    }

    /// Writes the file and flushes `out`. The same mesh and meta give the same bytes.
    ///
    /// Blocks are large: `out` needs no buffer of its own.
    ///
    /// # Errors
    /// Those of `out`.
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
