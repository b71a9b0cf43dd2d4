//! Structure files to atoms to spheres: PDB, mmCIF and BinaryCIF bytes in, [`crate::surface::Spheres`] out.
//!
//! It knows nothing of grids, meshes, HTTP or paths (the archive folder excepted). Positions are Å.
//!
//! [`read()`] goes straight from bytes to columns; [`Selection`] says which atoms are meshed, [`Contents`] what there
//! is to select; [`radii`] gives every element a radius; [`referee`] asks a second, strict reader for its opinion.

mod altloc;
pub mod archive;
mod atom_site;
pub mod atoms;
mod bcif;
mod cif;
pub mod contents;
pub mod element;
mod entities;
pub mod error;
mod inflate;
mod kinds;
mod mmcif;
mod number;
mod pdb;
pub mod radii;
pub mod read;
pub mod referee;
mod residue;
mod scan;
pub mod select;
mod sites;
mod sniff;
mod survey;
mod text;
mod texts;
mod warnings;

pub use archive::{Archive, ArchiveError, EntryId, Stamp};
pub use atoms::{SourceFormat, Structure};
pub use contents::{Contents, Kind};
pub use error::StructureError;
pub use read::{ReadLimits, read};
pub use select::{BadKinds, LeftOut, Selected, Selection, select};
pub use survey::{Survey, survey};
pub use texts::TextColumn;
