//! Sets of kinds of atoms, with the names by which they are selected.

use super::contents::Kind;

/// Set of kinds.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct KindSet(u16);

impl KindSet {
    /// All polymers.
    pub const POLYMER: Self = Self::of(&[Kind::Protein, Kind::Nucleic, Kind::Polymer]);
    /// Ligands, cofactors and glycans.
    pub const LIGAND: Self = Self::of(&[Kind::Ligand, Kind::Cofactor, Kind::Glycan]);
    /// All kinds except virtual sites.
    pub const ALL: Self = Self(Self::POLYMER.0 | Self::LIGAND.0 | Self::of(&[Kind::Ion, Kind::Water]).0);

    /// Sets that have a name, in documentation order.
    pub const NAMED: [(&'static str, Self); 8] = [
        ("polymer", Self::POLYMER),
        ("protein", Self::of(&[Kind::Protein])),
        ("nucleic", Self::of(&[Kind::Nucleic])),
        ("ligand", Self::LIGAND),
        ("cofactor", Self::of(&[Kind::Cofactor])),
        ("glycan", Self::of(&[Kind::Glycan])),
        ("ion", Self::of(&[Kind::Ion])),
        ("water", Self::of(&[Kind::Water])),
    ];

    const fn of(kinds: &[Kind]) -> Self {
        let (mut bits, mut i) = (0, 0);
        while i < kinds.len() {
            bits |= 1 << kinds[i] as u16;
            i += 1;
        }
        Self(bits)
    }

    /// Returns the set with a name.
    #[must_use]
    pub fn named(name: &str) -> Option<Self> {
        Self::NAMED.iter().find(|(known, _)| *known == name).map(|(_, set)| *set)
    }

    /// Returns true if the set contains `kind`.
    #[must_use]
    pub const fn has(self, kind: Kind) -> bool {
        self.0 & 1 << kind as u16 != 0
    }

    /// Returns the kinds in either set.
    #[must_use]
    pub const fn or(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }

    /// Returns the kinds in both sets.
    #[must_use]
    pub const fn and(self, other: Self) -> Self {
        Self(self.0 & other.0)
    }

    /// Returns the kinds that are not in the set, except virtual sites.
    #[must_use]
    pub const fn complement(self) -> Self {
        Self(Self::ALL.0 & !self.0)
    }
}
