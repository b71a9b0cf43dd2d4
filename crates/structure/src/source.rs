//! Contents of a file besides the columns of its atoms.

use molmesh_surface::named;

use super::annotations::Annotations;
use super::assembly::Assemblies;
use super::kinds::Sequence;

/// The file format that a structure was read from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SourceFormat {
    /// PDB, fixed columns.
    Pdb,
    /// PDBx/mmCIF.
    Mmcif,
    /// BinaryCIF: PDBx/mmCIF in MessagePack.
    BinaryCif,
    /// PQR: atoms with charges and radii.
    Pqr,
    /// XYZ: frames of elements and coordinates.
    Xyz,
}

named!(SourceFormat, Pdb => "pdb", Mmcif => "mmcif", BinaryCif => "bcif", Pqr => "pqr", Xyz => "xyz");

/// Numbers of the atoms of a file that its structure does not contain.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Unread {
    /// Atoms of data blocks after the first one with atoms.
    pub blocks: u64,
    /// Spheres that represent several residues (`ihm_sphere_obj_site`).
    pub spheres: u64,
}

/// Fields of a structure that are not columns.
#[derive(Debug, Clone)]
pub(super) struct SourceFields {
    pub(super) format: SourceFormat,
    pub(super) id: Option<String>,
    pub(super) title: Option<String>,
    pub(super) sequence: Sequence,
    pub(super) assemblies: Assemblies,
    pub(super) annotations: Annotations,
    pub(super) unread: Unread,
    /// Radius of each atom, Å; empty if the file has none. The reader counts their memory for the structure.
    pub(super) radii: Vec<f32>,
    /// Charge of each atom, e; empty if the file has none. Their memory is counted like that of the radii.
    pub(super) charges: Vec<f32>,
    pub(super) warnings: Vec<String>,
}

impl SourceFields {
    /// Returns the fields of a file that has only atoms.
    pub(super) fn new(format: SourceFormat) -> Self {
        Self {
            format,
            id: None,
            title: None,
            sequence: Sequence::default(),
            assemblies: Assemblies::default(),
            annotations: Annotations::default(),
            unread: Unread::default(),
            radii: Vec::new(),
            charges: Vec::new(),
            warnings: Vec::new(),
        }
    }
}
