//! Data blocks of an mmCIF or BinaryCIF file that are not read: their atoms, and what the error message of a file
//! without atoms says about them.

use super::error::StructureError;
use super::source::Unread;
use super::text;

/// Category of spheres that represent several residues, in files of integrative models.
pub(super) const SPHERES: &str = "ihm_sphere_obj_site";

/// Atoms that the reader of a file passed.
#[derive(Debug, Default)]
pub(super) struct UnreadAtoms {
    pub(super) counts: Unread,
    /// Names and numbers of atoms of the first blocks.
    blocks: Vec<String>,
    n_blocks: usize,
}

impl UnreadAtoms {
    /// Maximum number of blocks in the warning.
    const NAMED: usize = 20;

    /// Adds the atoms of a block.
    pub(super) fn add_block(&mut self, name: Option<&str>, atoms: u64) {
        if atoms == 0 {
            return;
        }
        self.counts.blocks = self.counts.blocks.saturating_add(atoms);
        self.n_blocks += 1;
        if self.blocks.len() < Self::NAMED {
            self.blocks.push(format!("`{}` ({atoms} atoms)", name.unwrap_or_default()));
        }
    }

    /// Returns warnings about the atoms.
    pub(super) fn warnings(self) -> impl Iterator<Item = String> {
        let Unread { blocks, spheres } = self.counts;
        let blocks = (blocks > 0).then(|| {
            format!(
                "only the first data block with atoms is read; left out: {}",
                text::list(self.blocks, self.n_blocks)
            )
        });
        let spheres = (spheres > 0).then(|| format!("{spheres} spheres of `{SPHERES}` are left out"));
        blocks.into_iter().chain(spheres)
    }
}

/// Blocks and categories that the reader passed, for the error message of a file without atoms.
#[derive(Debug, Default)]
pub(super) struct Passed {
    categories: Vec<String>,
    blocks: usize,
    /// True if the atoms have fractional coordinates.
    pub(super) has_fractions: bool,
}

impl Passed {
    /// Maximum number of categories in the message.
    const KEPT: usize = 10;

    pub(super) fn block(&mut self) {
        self.blocks += 1;
    }

    /// Returns true if the message already lists the maximum number of categories.
    pub(super) fn is_full(&self) -> bool {
        self.categories.len() >= Self::KEPT
    }

    /// Adds an `atom_site` without coordinates, described by `Layout::missing`. It is always part of the message.
    pub(super) fn lacking(&mut self, missing: String) {
        self.categories.push(missing);
    }

    /// Adds a category, by its name without underscore.
    pub(super) fn category(&mut self, name: impl AsRef<str> + Into<String>) {
        if !self.is_full() && !self.categories.iter().any(|c| c == name.as_ref()) {
            self.categories.push(name.into());
        }
    }

    /// Returns the error for a file of this `format` that ends, in this block, without atoms.
    pub(super) fn no_atoms(self, format: &str, block: Option<String>) -> StructureError {
        let block = block.map_or_else(|| "no named data block".to_owned(), |b| format!("data block {b}"));
        let more = if self.blocks > 1 { format!(" (the last of {})", self.blocks) } else { String::new() };
        let n = self.categories.len();
        if self.has_fractions {
            let found = format!(
                "{format} with {block}{more}, a crystal structure of small molecules with fractional coordinates only; \
                 Cartesian coordinates (`_atom_site.Cartn_x`) are needed"
            );
            return StructureError::NoAtoms { found };
        }
        let found = if n == 0 {
            format!("{format} with {block}{more} and nothing in it")
        } else {
            format!("{format} with {block}{more}, categories {}", text::list(self.categories, n))
        };
        StructureError::NoAtoms { found }
    }
}
