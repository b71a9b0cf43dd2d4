//! Structure files: reads PDB, mmCIF, BinaryCIF, PQR and XYZ, and selects atoms as [`molmesh_surface::Spheres`].
//! Positions are in Å.
//!
//! The crate does not depend on grids, meshes or HTTP. Only [`Archive`] reads files from disk.
//!
//! [`read()`] parses bytes into columns. [`Selection`] chooses the atoms to mesh, and [`Contents`] lists what can be
//! selected. [`radii`] assigns a van der Waals radius to every element. [`strict_validator`] checks a file with a
//! second, strict reader.

mod altloc;
pub mod annotations;
mod archive;
mod assembly;
mod atom_layout;
mod atom_site;
mod atoms;
mod bcif;
mod bonds;
mod categories;
mod chain_placements;
mod chemistry;
mod cif;
pub mod contents;
mod copies;
mod data_blocks;
mod decoder;
mod divisions;
mod duplicates;
pub mod element;
mod error;
mod fields;
mod growing;
mod kind_set;
mod kinds;
pub mod map;
mod mmcif;
mod models;
mod number;
mod pdb;
mod pieces;
mod placement;
mod pqr;
pub mod radii;
pub mod read;
mod residue;
mod residues;
mod scan;
pub mod select;
mod sites;
mod sniff;
mod source;
mod spheres;
mod split;
mod stored;
pub mod stream;
mod strict_cost;
pub mod strict_validator;
mod survey;
pub mod table;
mod text;
mod texts;
mod warnings;
mod xyz;

pub use archive::{Archive, ArchiveError, EntryId, Opened, Stamp};
pub use assembly::{Assemblies, Operator};
pub use atoms::Structure;
pub use chain_placements::Placements;
pub use contents::{Contents, Kind};
pub use copies::{AssemblyRules, PlacedCopy, Unit};
pub use decoder::{GZIP_MAGIC, ZSTD_MAGIC, is_complete_gzip};
pub use error::StructureError;
pub use kind_set::KindSet;
pub use read::{ReadLimits, detect_format, read, read_with};
pub use select::{
    BadExpression, Context, Expression, KindCount, LeftOut, ModelChoice, ResidueCount, Selected, SelectedBlocks,
    SelectedOfBlock, Selection, select, select_with,
};
pub use source::{SourceFormat, Unread};
pub use spheres::from_spheres;
pub use split::{AtomPart, Split};
pub use survey::{Survey, survey};
pub use texts::TextColumn;
