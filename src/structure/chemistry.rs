//! Refines kinds: polymers become protein or nucleic, ligands become ion, cofactor or glycan.

use super::atoms::{Slices, Tables};
use super::categories::Entity;
use super::contents::Kind;
use super::element;
use super::kinds::{self, Sequence};
use super::residue::{self, Class};

/// Backbone atoms of amino acids and nucleotides.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
struct Backbone {
    alpha_carbon: bool,
    peptide: bool,
    sugar_or_phosphate: bool,
}

impl Backbone {
    fn of(name: &str) -> Self {
        Self {
            alpha_carbon: name == "CA",
            peptide: matches!(name, "C" | "N"),
            sugar_or_phosphate: matches!(name, "P" | "C1'" | "C3'" | "C4'" | "C1*" | "C3*" | "C4*"),
        }
    }

    fn add(&mut self, other: Self) {
        self.alpha_carbon |= other.alpha_carbon;
        self.peptide |= other.peptide;
        self.sugar_or_phosphate |= other.sugar_or_phosphate;
    }

    /// Returns the kind of a residue with these atoms. The alpha carbon comes first: phosphoserine has a phosphorus.
    fn kind(self) -> Option<Kind> {
        match self {
            Self { alpha_carbon: true, peptide: true, .. } => Some(Kind::Protein),
            Self { sugar_or_phosphate: true, .. } => Some(Kind::Nucleic),
            Self { alpha_carbon: true, .. } => Some(Kind::Protein),
            _ => None,
        }
    }
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
            entities: tables.label_chain.texts().map(|chain| sequence.entities.get(chain).copied()).collect(),
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

    /// Returns true if all atoms of a residue are metals or halogens. Atoms without an element count as such if the
    /// residue has the name of an ion.
    fn is_ion(&self, columns: &Slices<'_>, rows: std::ops::Range<usize>) -> bool {
        let listed = self.ions[columns.residue[rows.start] as usize];
        columns.element[rows].iter().all(|&z| if z == 0 { listed } else { element::forms_ions(z) })
    }

    /// Replaces the kinds polymer and ligand by the more specific kinds.
    pub(super) fn refine(&self, columns: &mut Slices<'_>) {
        let (mut first, mut before) = (0, None);
        while first < columns.len() {
            let end = (first + 1..columns.len()).find(|&i| !kinds::same_residue(columns, i, first));
            let end = end.unwrap_or(columns.len());
            let class = self.classes[columns.residue[first] as usize];
            let is_ion = !matches!(class, Class::AminoAcid | Class::Nucleotide) && self.is_ion(columns, first..end);
            let kind = polymer_kind(columns, self, first..end, class, before);
            let other = match class {
                Class::Cofactor => Kind::Cofactor,
                Class::Saccharide => Kind::Glycan,
                _ if self.entity(columns, first) == Some(Entity::Branched) => Kind::Glycan,
                _ => Kind::Ligand,
            };
            for i in first..end {
                columns.kind[i] = match columns.kind[i] {
                    Kind::Water => Kind::Water,
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
    rows: std::ops::Range<usize>,
    class: Class,
    before: Option<(usize, Kind)>,
) -> Kind {
    let first = rows.start;
    match class {
        Class::AminoAcid => return Kind::Protein,
        Class::Nucleotide => return Kind::Nucleic,
        _ => {}
    }
    let declared = texts.is_declared_polymer(columns, first);
    match class {
        Class::Cofactor if !declared => return Kind::Cofactor,
        Class::Saccharide if !declared => return Kind::Glycan,
        _ => {}
    }
    let mut backbone = Backbone::default();
    columns.name[rows].iter().for_each(|&name| backbone.add(texts.backbone[name as usize]));
    let of_chain = before.filter(|&(atom, _)| declared && kinds::same_chain(columns, atom, first));
    let of_chain = of_chain.map(|(_, kind)| kind).filter(|kind| matches!(kind, Kind::Protein | Kind::Nucleic));
    backbone.kind().or(of_chain).unwrap_or(Kind::Polymer)
}
