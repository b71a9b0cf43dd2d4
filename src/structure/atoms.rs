//! Atoms of a structure file as a structure of arrays.

/// The file format that a structure was read from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SourceFormat {
    /// PDB, fixed columns.
    Pdb,
    /// PDBx/mmCIF.
    Mmcif,
}

impl SourceFormat {
    /// `pdb` or `mmcif`.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Pdb => "pdb",
            Self::Mmcif => "mmcif",
        }
    }
}

/// Atoms of every model of a file, in file order. All columns have the same length.
#[derive(Debug, Clone)]
pub struct Structure {
    /// Where it came from.
    pub format: SourceFormat,
    /// PDB id or data block name, if the file says one.
    pub id: Option<String>,
    /// Title, if the file says one.
    pub title: Option<String>,
    /// Coordinates, Å.
    pub x: Vec<f64>,
    /// Coordinates, Å.
    pub y: Vec<f64>,
    /// Coordinates, Å.
    pub z: Vec<f64>,
    /// Atomic numbers; 0 where the element is unknown.
    pub element: Vec<u8>,
}

impl Structure {
    /// Number of atoms in all models.
    #[must_use]
    pub fn len(&self) -> usize {
        self.element.len()
    }

    /// Whether the file holds no atom.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.element.is_empty()
    }
}
