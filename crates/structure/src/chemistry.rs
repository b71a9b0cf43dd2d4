//! Refines kinds: polymers become protein or nucleic, ligands become ion, cofactor or glycan.

use std::ops::Range;

use super::atoms::{Slices, Tables};
use super::categories::Entity;
use super::contents::Kind;
use super::element;
use super::kinds::{self, Sequence, Solvent};
use super::residue::{self, Class};
use super::sites;

/// Backbone atoms of amino acids and nucleotides.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
struct Backbone {
    alpha_carbon: bool,
    peptide: bool,
    phosphorus: bool,
    /// A bit for each atom of the sugar.
    sugar: u8,
}

impl Backbone {
    /// Atoms of the sugar of a nucleotide, without the prime.
    const SUGAR: [&str; 5] = ["C1", "C2", "C3", "C4", "O4"];

    fn of(name: &str) -> Self {
        let without_prime = name.strip_suffix(['\'', '*']);
        let sugar = without_prime.and_then(|name| Self::SUGAR.iter().position(|atom| *atom == name));
        Self {
            alpha_carbon: name == "CA",
            peptide: matches!(name, "C" | "N"),
            phosphorus: name == "P",
            sugar: sugar.map_or(0, |bit| 1 << bit),
        }
    }

    fn add(&mut self, other: Self) {
        self.alpha_carbon |= other.alpha_carbon;
        self.peptide |= other.peptide;
        self.phosphorus |= other.phosphorus;
        self.sugar |= other.sugar;
    }

    /// Returns the kind of a residue with these atoms. The alpha carbon comes first: phosphoserine has a phosphorus. A
    /// phosphorus alone is no nucleotide: lipids have one.
    fn kind(self) -> Option<Kind> {
        let n_sugar = self.sugar.count_ones() + u32::from(self.phosphorus && self.sugar != 0);
        match self {
            Self { alpha_carbon: true, peptide: true, .. } => Some(Kind::Protein),
            _ if n_sugar > 1 => Some(Kind::Nucleic),
            Self { alpha_carbon: true, .. } => Some(Kind::Protein),
            _ => None,
        }
    }
}

/// Relation of a residue of ATOM records to a polymer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Membership {
    /// Residue with the name of an amino acid or nucleotide, or that the file declares part of a polymer.
    Polymer,
    /// Residue that the file declares part of another entity.
    Ligand,
    /// Cofactor or saccharide, of which the file declares nothing.
    Listed,
    /// Water, ions, and residues without a name.
    Neutral,
    /// Residue of an unknown name, of which the file declares nothing.
    Unknown,
}

/// Consecutive residues with one name and number. A ligand whose atoms have equal names may be several residues, one of
/// which looks like water or an ion.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct ResidueGroup {
    /// End of their rows.
    end: usize,
    /// True if each is one oxygen with at most two hydrogens.
    is_water: bool,
    /// True if all atoms are metals or halogens.
    is_ion: bool,
}

/// Properties of residue names, atom names and chains, by text id.
pub(super) struct TextClasses<'a> {
    classes: Vec<Class>,
    ions: Vec<bool>,
    backbone: Vec<Backbone>,
    entities: Vec<Option<Entity>>,
    sequence: &'a Sequence,
    tables: &'a Tables,
}

impl<'a> TextClasses<'a> {
    pub(super) fn new(tables: &'a Tables, sequence: &'a Sequence) -> Self {
        Self {
            classes: tables.residue.texts().map(Class::of).collect(),
            ions: tables.residue.texts().map(residue::is_ion).collect(),
            backbone: tables.name.texts().map(Backbone::of).collect(),
            entities: sequence.entities(tables),
            sequence,
            tables,
        }
    }

    fn entity(&self, columns: &Slices<'_>, i: usize) -> Option<Entity> {
        self.entities.get(columns.label_chain[i] as usize).copied().flatten()
    }

    /// Returns true if, according to the file or to a bond, the residue of atom `i` is part of a polymer.
    fn is_declared_polymer(&self, columns: &Slices<'_>, i: usize) -> bool {
        columns.hetero[i]
            || self.entity(columns, i) == Some(Entity::Polymer)
            || self
                .sequence
                .lists(self.tables.chain.text(columns.chain[i]), self.tables.residue.text(columns.residue[i]))
    }

    /// Returns true for the id of the name of an amino acid or nucleotide.
    pub(super) fn is_polymer_name(&self, residue: u32) -> bool {
        matches!(self.classes[residue as usize], Class::AminoAcid | Class::Nucleotide)
    }

    /// Returns true for the id of a name that is in no list of polymers, cofactors or saccharides.
    pub(super) fn is_unknown_name(&self, residue: u32) -> bool {
        self.classes[residue as usize] == Class::Other
    }

    /// Returns the relation to a polymer of the residue of kind polymer that begins with `first`. `group` is that of
    /// the residue before, and becomes that of this one.
    pub(super) fn membership(&self, columns: &Slices<'_>, first: usize, group: &mut ResidueGroup) -> Membership {
        let name = columns.residue[first];
        if self.is_polymer_name(name) || self.is_declared_polymer(columns, first) {
            return Membership::Polymer;
        }
        // Files without residue names have no ligands to tell from a polymer.
        if self.tables.residue.text(name).is_empty() {
            return Membership::Neutral;
        }
        *group = self.group(columns, first, *group);
        match self.entity(columns, first) {
            _ if group.is_ion || group.is_water => Membership::Neutral,
            Some(_) => Membership::Ligand,
            None if self.is_unknown_name(name) => Membership::Unknown,
            None => Membership::Listed,
        }
    }

    /// Sets the kind of residues of [`Membership::Unknown`] in ATOM records to polymer.
    pub(super) fn unlinked_to_polymer(&self, columns: &mut Slices<'_>, solvent: &Solvent) {
        for i in 0..columns.len() {
            let is_unlinked = columns.kind[i] == Kind::Ligand && !columns.hetero[i] && !solvent.has(columns.residue[i]);
            if is_unlinked && self.is_unknown_name(columns.residue[i]) && self.entity(columns, i).is_none() {
                columns.kind[i] = Kind::Polymer;
            }
        }
    }

    /// Returns true if a residue is one oxygen with at most two hydrogens, and virtual sites.
    fn has_atoms_of_water(&self, columns: &Slices<'_>, mut rows: Range<usize>) -> bool {
        // Not a part of a residue that has several names.
        let is_start = |i: usize| i == columns.len() || columns.starts_residue[i];
        if !(is_start(rows.start) && is_start(rows.end)) {
            return false;
        }
        let (mut oxygen, mut hydrogens) = (None, [None; 2]);
        let is_same = |known: &mut Option<u32>, name: u32| *known.get_or_insert(name) == name;
        rows.all(|i| {
            let name = columns.name[i];
            match columns.element[i] {
                8 => is_same(&mut oxygen, name),
                1 => hydrogens.iter_mut().any(|known| is_same(known, name)),
                0 => sites::is_site(self.tables.name.text(name)),
                _ => false,
            }
        }) && oxygen.is_some()
    }

    /// Returns the group of the residue that begins with `first`; `latest` if that belongs to it.
    fn group(&self, columns: &Slices<'_>, first: usize, latest: ResidueGroup) -> ResidueGroup {
        if first < latest.end {
            return latest;
        }
        let same_name = |i: usize| {
            columns.residue[i] == columns.residue[first]
                && columns.residue_number[i] == columns.residue_number[first]
                && columns.insertion_code[i] == columns.insertion_code[first]
                && kinds::same_chain(columns, i, first)
        };
        let mut group = ResidueGroup { end: first, is_water: true, is_ion: true };
        while group.end < columns.len() && same_name(group.end) {
            let end = kinds::residue_end(columns, group.end);
            group.is_water = group.is_water && self.has_atoms_of_water(columns, group.end..end);
            group.is_ion = group.is_ion && self.is_ion(columns, group.end..end);
            group.end = end;
        }
        group
    }

    /// Returns true if all atoms of a residue are metals or halogens. Atoms without an element count as such if the
    /// residue has the name of an ion.
    fn is_ion(&self, columns: &Slices<'_>, rows: Range<usize>) -> bool {
        let listed = self.ions[columns.residue[rows.start] as usize];
        columns.element[rows].iter().all(|&z| if z == 0 { listed } else { element::forms_ions(z) })
    }

    /// Replaces the kinds polymer and ligand by the more specific kinds.
    pub(super) fn refine(&self, columns: &mut Slices<'_>) {
        let (mut first, mut before) = (0, None);
        let mut group = ResidueGroup::default();
        while first < columns.len() {
            let end = kinds::residue_end(columns, first);
            let class = self.classes[columns.residue[first] as usize];
            let is_known = self.is_polymer_name(columns.residue[first]);
            if !is_known {
                group = self.group(columns, first, group);
            }
            let is_ion = !is_known && group.is_ion;
            let kind = polymer_kind(columns, self, first..end, class, before);
            let other = match class {
                Class::Cofactor => Kind::Cofactor,
                Class::Saccharide => Kind::Glycan,
                _ if self.entity(columns, first) == Some(Entity::Branched) => Kind::Glycan,
                _ => Kind::Ligand,
            };
            let is_water = !is_known
                && group.is_water
                && (columns.kind[first] != Kind::Polymer || !self.is_declared_polymer(columns, first));
            for i in first..end {
                columns.kind[i] = match columns.kind[i] {
                    Kind::Water => Kind::Water,
                    _ if is_water => Kind::Water,
                    _ if is_ion => Kind::Ion,
                    Kind::Polymer => kind,
                    _ => other,
                };
            }
            before = Some((first, columns.kind[first]));
            first = end;
        }
    }
}

/// Returns the kind of a residue of a polymer. `before` has an atom of the preceding residue, and its kind.
fn polymer_kind(
    columns: &Slices<'_>,
    texts: &TextClasses<'_>,
    rows: Range<usize>,
    class: Class,
    before: Option<(usize, Kind)>,
) -> Kind {
    let first = rows.start;
    match class {
        Class::AminoAcid => return Kind::Protein,
        Class::Nucleotide => return Kind::Nucleic,
        _ => {}
    }
    let mut backbone = Backbone::default();
    columns.name[rows].iter().for_each(|&name| backbone.add(texts.backbone[name as usize]));
    let is_declared = texts.is_declared_polymer(columns, first) || !columns.starts_residue[first];
    let of_chain = before.filter(|&(atom, _)| is_declared && kinds::same_chain(columns, atom, first));
    let of_chain = of_chain.map(|(_, kind)| kind).filter(|kind| matches!(kind, Kind::Protein | Kind::Nucleic));
    backbone.kind().or(of_chain).unwrap_or(Kind::Polymer)
}
