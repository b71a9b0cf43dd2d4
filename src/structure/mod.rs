//! Structure files to atoms to spheres: PDB and mmCIF bytes in, [`crate::surface::Spheres`] out.
//!
//! It knows nothing of grids, meshes, HTTP or paths (the archive folder excepted). Positions are Å.

pub mod atoms;
pub mod error;
pub mod radii;
pub mod read;
pub mod select;

pub use atoms::Structure;
pub use error::StructureError;
pub use read::{ReadLimits, read};
pub use select::{Selected, Selection, select};
