//! Division of the selected atoms into parts: each gets its own closed mesh, or its triangles of one surface.

use molmesh_surface::{Control, Exceeded, Limit, named};
use rustc_hash::FxHashMap;

use super::altloc::ATOMS_PER_CHECK;
use super::atoms::Structure;
use super::contents::Kind;
use super::copies::Unit;
use super::error::StructureError;
use super::read::{ReadLimits, check_every};
use super::select::Selected;

/// Rule that divides atoms into parts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Split {
    /// One mesh of all atoms.
    #[default]
    None,
    /// One part per author chain; in an assembly, one per copy of a chain.
    Chain,
    /// One part per entity.
    Entity,
    /// One part per model, for `model=all`.
    Model,
    /// One part per group of kinds: polymer, ligand (with cofactors), glycan, ion, water.
    ResidueGroup,
    /// One part per pocket, with the triangles that line it, and one for the rest of the surface.
    Pocket,
}

named!(Split, None => "none", Chain => "chain", Entity => "entity", ResidueGroup => "residue-group", Pocket => "pocket";
    Model => "model");

impl Split {
    /// Returns the parameter that divides the surface, with its value.
    #[must_use]
    pub fn parameter(self) -> String {
        if self == Self::Model { "model=all".to_owned() } else { format!("split={self}") }
    }

    /// Returns the error for more parts than allowed.
    #[must_use]
    pub fn too_many_parts(self, limits: &ReadLimits) -> StructureError {
        let limit = if self == Self::Model { Limit::ModelParts } else { Limit::Parts };
        Exceeded { subject: self.parameter().into(), ..Exceeded::new(limit, limits.max_parts) }.error()
    }
}

/// Atoms of one part.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AtomPart {
    /// Name: at most 40 characters and the number of the copy in an assembly, or `model` and its number.
    pub name: String,
    /// Rows of [`Selected::atoms`], ascending.
    pub rows: Vec<u32>,
}

/// Maximum length of a name from the file, characters. Chains of the PDB have at most four.
const MAX_NAME: usize = 40;

/// Name of the blank chain, as in the parameter `chains`.
const BLANK_CHAIN: &str = "_";
/// Name of atoms whose entity is unknown.
const UNKNOWN_ENTITY: &str = "unknown";

/// Memory of an atom in a part, bytes: a row in a growing list and its key.
const BYTES_PER_ROW: u64 = 16;

impl Selected {
    /// Divides the selected atoms into parts, in order of first appearance; `None` for rules that do not divide atoms.
    /// The units of an assembly are parts. Adds the memory of the parts to the meter of `control`.
    ///
    /// # Errors
    /// Returns [`StructureError::Limit`], [`StructureError::NoEntities`] for [`Split::Entity`] if the file has no
    /// entities, and the errors of memory and cancellation.
    pub fn parts(
        &self,
        structure: &Structure,
        split: Split,
        limits: &ReadLimits,
        control: &Control<'_>,
    ) -> Result<Option<Vec<AtomPart>>, StructureError> {
        if !self.units.is_empty() {
            control.memory.grow((size_of::<u32>() * self.atoms.len()) as u64)?;
            // The number of atoms fits 32 bits.
            let row = |row: usize| u32::try_from(row).unwrap_or(u32::MAX);
            let part = |unit: &Unit| AtomPart { name: unit.name.clone(), rows: unit.rows.clone().map(row).collect() };
            return Ok(Some(self.units.iter().map(part).collect()));
        }
        if matches!(split, Split::None | Split::Pocket) {
            return Ok(None);
        }
        if split == Split::Entity && structure.entities.iter().all(String::is_empty) {
            return Err(StructureError::NoEntities);
        }
        control.memory.grow(BYTES_PER_ROW * self.atoms.len() as u64)?;
        let mut parts = Vec::new();
        let mut found: FxHashMap<(i64, &str), usize> = FxHashMap::default();
        let mut copies = self.copies.iter().enumerate().peekable();
        for (row, index) in (0_usize..).zip(0_u32..).take(self.atoms.len()) {
            check_every(control, row, ATOMS_PER_CHECK)?;
            while copies.peek().is_some_and(|(_, copy)| copy.rows.end <= row) {
                copies.next();
            }
            if !self.has(self.atoms[row]) {
                continue;
            }
            let i = self.atoms[row] as usize;
            let number = match split {
                Split::Chain => copies.peek().map_or(0, |(copy, _)| i64::try_from(copy + 1).unwrap_or(i64::MAX)),
                Split::Model => i64::from(structure.model[i]),
                _ => 0,
            };
            let key = (number, name(structure, split, i));
            let part = match found.get(&key) {
                Some(&part) => part,
                None if parts.len() as u64 >= limits.max_parts => {
                    return Err(split.too_many_parts(limits));
                }
                None => {
                    found.insert(key, parts.len());
                    parts.push(AtomPart { name: shown(split, key), rows: Vec::new() });
                    parts.len() - 1
                }
            };
            parts[part].rows.push(index);
        }
        Ok(Some(parts))
    }
}

/// Returns the name of the part of atom `i`, without the number of a copy.
fn name(structure: &Structure, split: Split, i: usize) -> &str {
    let (name, if_empty) = match split {
        Split::None | Split::Model | Split::Pocket => ("", ""),
        Split::Chain => (structure.chain.get(i), BLANK_CHAIN),
        Split::Entity => {
            let entity = structure.entities.get(structure.label_chain.id(i) as usize);
            (entity.map_or("", String::as_str), UNKNOWN_ENTITY)
        }
        Split::ResidueGroup => (group(structure.kind[i]), ""),
    };
    if name.is_empty() { if_empty } else { name }
}

/// Returns the group of a kind.
const fn group(kind: Kind) -> &'static str {
    match kind {
        Kind::Protein | Kind::Nucleic | Kind::Polymer => "polymer",
        Kind::Cofactor | Kind::Ligand | Kind::VirtualSite => "ligand",
        Kind::Glycan => "glycan",
        Kind::Ion => "ion",
        Kind::Water => "water",
    }
}

/// Returns the name of a part: the number of a model, or the name in the file and, in an assembly, the number of the
/// copy, from 1.
fn shown(split: Split, (number, name): (i64, &str)) -> String {
    let name: String = name.chars().take(MAX_NAME).collect();
    match split {
        Split::Model => format!("model {number}"),
        _ if number == 0 => name,
        _ => format!("{name}-{number}"),
    }
}
