//! Versions of the algorithms that determine the bytes of meshes, pictures and documents.
//!
//! They are part of content keys and `ETag`s, instead of the version of the program: a release that changes no number
//! here gives the same keys for the same bytes. A change of the code that changes bytes increases the number of the
//! changed part. `tests/http/recorded_bytes.rs` compares recorded bytes and names the number.

use molmesh_surface::SurfaceKind;

use super::Options;

/// Version of what precedes a surface: reading, selection, radii. All files and documents depend on it.
const STRUCTURES: u32 = 1;

/// Version of what follows a surface and is common to all kinds: simplification, parts, colours, formats.
const MESHES: u32 = 2;

/// Version of the drawing of a picture.
const PICTURES: u32 = 1;

/// Version of documents: lists of atoms, colours and areas, tilesets.
const DOCUMENTS: u32 = 1;

/// Versions of the meshes of each kind of surface. The test covers the CPU on one architecture and one PDB file: a
/// change of the code for other architectures or of another reader increases its number by hand. The arithmetic of a
/// GPU contains a hash of the shaders.
const GAUSSIAN: u32 = 1;
const SOFT_OBJECT: u32 = 1;
const INVERSE_SQUARE: u32 = 1;
const VDW: u32 = 1;
const SAS: u32 = 1;
const SES: u32 = 1;

/// Returns the version of the meshes of a surface.
const fn surface(kind: SurfaceKind) -> u32 {
    match kind {
        SurfaceKind::Gaussian => GAUSSIAN,
        SurfaceKind::SoftObject => SOFT_OBJECT,
        SurfaceKind::InverseSquare => INVERSE_SQUARE,
        SurfaceKind::Vdw => VDW,
        SurfaceKind::Sas => SAS,
        SurfaceKind::Ses => SES,
    }
}

/// Names the versions that determine the file of a job.
#[must_use]
pub fn file_versions(options: &Options) -> String {
    let picture = options.picture.map(|_| format!(" pictures {PICTURES}")).unwrap_or_default();
    let surface = surface(options.params.surface);
    format!("structures {STRUCTURES} surface {surface} meshes {MESHES}{picture}")
}

/// Names the versions that determine the documents of a structure.
#[must_use]
pub fn document_versions() -> String {
    format!("structures {STRUCTURES} documents {DOCUMENTS}")
}
