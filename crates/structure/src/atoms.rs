//! Atoms of a structure file, stored as a structure of arrays.

use molmesh_surface::OutOfMemory;

use super::annotations::Annotations;
use super::assembly::Assemblies;
use super::contents::Kind;
use super::error::StructureError;
use super::kinds;
use super::radii;
use super::read::Reading;
use super::source::{SourceFields, SourceFormat, Unread};
pub(super) use super::texts::Tables;
use super::texts::{Interner, TextColumn, translate, without_entity};
use super::{pieces, placement};

/// Memory of the rows of a name in tables that exist at once, bytes, besides copies of the name: counts of its chain or
/// of its residue name while their list grows, its number and its colour.
const ROW_BYTES: usize = 320;
/// Memory of a model in the set and in the list of models, bytes.
const MODEL_BYTES: usize = 32;

/// Atoms of all models of a file, in file order. All columns have the same length, except that `label_chain`,
/// `radius` and `charge` may be empty. An atom takes 62 bytes, and 8 more with a radius and a charge.
#[derive(Debug, Clone, PartialEq)]
pub struct Structure {
    /// Format of the source file.
    pub format: SourceFormat,
    /// PDB id or data block name, if the file has one.
    pub id: Option<String>,
    /// Title, if the file has one.
    pub title: Option<String>,
    /// Coordinates, Å.
    pub x: Vec<f64>,
    /// Coordinates, Å.
    pub y: Vec<f64>,
    /// Coordinates, Å.
    pub z: Vec<f64>,
    /// Atomic numbers; 0 where the element is unknown, 1 for deuterium.
    pub element: Vec<u8>,
    /// Atom names without padding, such as `CA` and `O5'`. Author names (`auth_*`) take precedence.
    pub name: TextColumn,
    /// Residue names, such as `ALA` and `HOH`. Author names (`auth_*`) take precedence.
    pub residue: TextColumn,
    /// Author names of chains. The blank chain of a PDB file is the empty string.
    pub chain: TextColumn,
    /// mmCIF chain ids (`label_asym_id`). Empty for PDB files and for files without this column.
    pub label_chain: TextColumn,
    /// Entity of each text of `label_chain`, empty if it is unknown.
    pub entities: Vec<String>,
    /// Author residue numbers; 0 if the file has none.
    pub residue_number: Vec<i32>,
    /// Insertion codes as Latin-1 characters; 0 if there is none.
    pub insertion_code: Vec<u8>,
    /// Alternative locations as Latin-1 characters; 0 if there is none.
    pub altloc: Vec<u8>,
    /// Occupancies; 1 if the file has none.
    pub occupancy: Vec<f32>,
    /// Isotropic displacement parameters (B-factors), Å²; 0 if the file has none.
    pub b_factor: Vec<f32>,
    /// Radii in the file, Å; empty if it has none. Atoms of radius 0 are virtual sites.
    pub radius: Vec<f32>,
    /// Charges in the file, e; empty for all formats but PQR.
    pub charge: Vec<f32>,
    /// Model numbers.
    pub model: Vec<i32>,
    /// True for HETATM records.
    pub hetero: Vec<bool>,
    /// Kinds.
    pub kind: Vec<Kind>,
    /// True for the first atom of a residue. Residue names of one number and insertion code are alternatives of one
    /// residue.
    pub starts_residue: Vec<bool>,
    /// Atoms of the file that were not read.
    pub unread: Unread,
    /// Assemblies that the file describes.
    pub assemblies: Assemblies,
    /// Values of residues that the file has: secondary structure and confidence.
    pub annotations: Annotations,
    /// Messages about unreadable values that were replaced by a default. Their number is bounded.
    pub warnings: Vec<String>,
}

impl Structure {
    /// Returns the number of atoms in all models.
    #[must_use]
    pub fn len(&self) -> usize {
        self.element.len()
    }

    /// Returns the number of atoms of the file, including those that are not read.
    #[must_use]
    pub fn n_in_file(&self) -> u64 {
        self.len() as u64 + self.unread.blocks + self.unread.spheres
    }

    /// Returns true if there is no atom.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.element.is_empty()
    }

    /// Returns an upper bound of the memory of the tables by name and model that work on the structure makes, bytes: to
    /// select, summarize and colour atoms.
    #[must_use]
    pub fn table_bytes(&self) -> u64 {
        let columns = [&self.name, &self.residue, &self.chain, &self.label_chain];
        let of_names: usize = columns.iter().flat_map(|column| column.texts()).map(|name| ROW_BYTES + name.len()).sum();
        let of_entities: usize = self.entities.iter().map(String::len).sum();
        let n_models = self.model.chunk_by(|a, b| a == b).count();
        (of_names + of_entities + MODEL_BYTES * n_models) as u64
    }

    /// Returns the van der Waals radius of atom `i`, Å: the radius in the file or, without one, of the element.
    #[must_use]
    pub fn vdw_radius(&self, i: usize) -> f32 {
        self.radius.get(i).copied().unwrap_or_else(|| radii::vdw_radius(self.element[i]))
    }

    /// Returns the source of the radii, for reports.
    #[must_use]
    pub fn radii_name(&self) -> &'static str {
        if self.radius.is_empty() { radii::TABLE } else { radii::OF_FILE }
    }

    /// Returns true if two atoms belong to the same residue and have the same residue name. Looks at the atoms between
    /// them.
    #[must_use]
    pub fn same_residue(&self, a: usize, b: usize) -> bool {
        self.residue.id(a) == self.residue.id(b) && !self.starts_residue[a.min(b) + 1..=a.max(b)].contains(&true)
    }

    /// Returns true if atom `i` is hydrogen or deuterium.
    #[must_use]
    pub fn is_hydrogen(&self, i: usize) -> bool {
        self.element[i] == 1
    }
}

/// One row of the columns. Texts are ids into the [`Tables`].
#[derive(Debug, Clone, Copy)]
pub(super) struct Atom {
    pub(super) position: [f64; 3],
    /// Atomic number, with [`element::GUESSED`] if the file does not contain it.
    pub(super) element: u8,
    pub(super) name: u32,
    pub(super) residue: u32,
    pub(super) chain: u32,
    /// Chain by `label_asym_id`; the segment id while a PDB file is read.
    pub(super) label_chain: u32,
    pub(super) residue_number: i32,
    pub(super) insertion_code: u8,
    pub(super) altloc: u8,
    pub(super) occupancy: f32,
    pub(super) b_factor: f32,
    pub(super) model: i32,
    pub(super) hetero: bool,
    /// Polymer or ligand. [`kinds::assign`] determines the final kind when all atoms have been read.
    pub(super) kind: Kind,
}

macro_rules! columns {
    ($($field:ident: $type:ty = $from:expr),+ $(,)?) => {
        /// Columns that are being filled.
        #[derive(Debug, Default)]
        pub(super) struct Columns { $(pub(super) $field: Vec<$type>),+ }

        impl Columns {
            /// Bytes of an atom.
            const BYTES_PER_ROW: usize = 0 $(+ size_of::<$type>())+;

            /// Allocates memory for exactly `n` more atoms, which belongs to the structure.
            pub(super) fn reserve(&mut self, n: usize, reading: &Reading<'_>) -> Result<(), StructureError> {
                let needed = Self::bytes(n);
                let memory = reading.reserve(needed)?;
                let refused = |_refused| OutOfMemory::System { needed };
                $(self.$field.try_reserve_exact(n).map_err(refused)?;)+
                memory.keep();
                Ok(())
            }

            #[inline]
            pub(super) fn push(&mut self, atom: &Atom) {
                $(self.$field.push($from(atom));)+
            }

            /// Returns `n` zeroed atoms, to be filled through [`Self::slices`]. The caller reserves their memory.
            pub(super) fn zeroed(n: usize) -> Self {
                Self { $($field: vec![<$type>::default(); n]),+ }
            }

            /// Returns mutable slices of all columns, which can be split among threads.
            pub(super) fn slices(&mut self) -> Slices<'_> {
                Slices { next: 0, $($field: &mut self.$field),+ }
            }

            /// Releases unused capacity if it is large.
            fn shrink(&mut self) {
                $(if self.$field.capacity() > self.$field.len() + self.$field.len() / 8 + 1024 {
                    self.$field.shrink_to_fit();
                })+
            }
        }

        /// A range of rows, filled from its beginning.
        #[derive(Debug)]
        pub(super) struct Slices<'a> { next: usize, $(pub(super) $field: &'a mut [$type]),+ }

        impl<'a> Slices<'a> {
            /// Splits off the first `n` rows.
            pub(super) fn split(self, n: usize) -> (Self, Self) {
                $(let $field = self.$field.split_at_mut(n);)+
                (Slices { next: 0, $($field: $field.0),+ }, Slices { next: 0, $($field: $field.1),+ })
            }

            /// Fills the next row. Returns false if none is left.
            #[inline]
            pub(super) fn put(&mut self, atom: &Atom) -> bool {
                let i = self.next;
                if i >= self.element.len() {
                    return false;
                }
                $(self.$field[i] = $from(atom);)+
                self.next += 1;
                true
            }
        }
    };
}

columns! {
    x: f64 = |a: &Atom| a.position[0],
    y: f64 = |a: &Atom| a.position[1],
    z: f64 = |a: &Atom| a.position[2],
    element: u8 = |a: &Atom| a.element,
    name: u32 = |a: &Atom| a.name,
    residue: u32 = |a: &Atom| a.residue,
    chain: u32 = |a: &Atom| a.chain,
    label_chain: u32 = |a: &Atom| a.label_chain,
    residue_number: i32 = |a: &Atom| a.residue_number,
    insertion_code: u8 = |a: &Atom| a.insertion_code,
    altloc: u8 = |a: &Atom| a.altloc,
    occupancy: f32 = |a: &Atom| a.occupancy,
    b_factor: f32 = |a: &Atom| a.b_factor,
    model: i32 = |a: &Atom| a.model,
    hetero: bool = |a: &Atom| a.hetero,
    kind: Kind = |a: &Atom| a.kind,
    starts_residue: bool = |_: &Atom| false,
}

impl Slices<'_> {
    pub(super) fn len(&self) -> usize {
        self.element.len()
    }

    /// Returns the number of rows that are not filled.
    pub(super) fn space(&self) -> usize {
        self.element.len() - self.next
    }

    /// Starts again with the first row.
    pub(super) fn rewind(&mut self) {
        self.next = 0;
    }
}

/// Joins the string tables of consecutive rows, and translates the ids in these rows.
pub(super) fn join<'r>(parts: impl IntoIterator<Item = (Slices<'r>, Tables)>) -> Tables {
    let mut all = Tables::default();
    let mut parts: Vec<_> = parts.into_iter().map(|(rows, tables)| (rows, all.adopt(&tables))).collect();
    pieces::map(&mut parts, |(rows, [name, residue, chain, label_chain])| {
        translate(rows.name, name);
        translate(rows.residue, residue);
        translate(rows.chain, chain);
        translate(rows.label_chain, label_chain);
    });
    all
}

impl Columns {
    pub(super) fn len(&self) -> usize {
        self.element.len()
    }

    /// Returns the number of rows that fit without allocating.
    pub(super) fn capacity(&self) -> usize {
        self.element.capacity()
    }

    /// Returns the memory of `n` atoms, bytes.
    pub(super) const fn bytes(n: usize) -> u64 {
        (Self::BYTES_PER_ROW * n) as u64
    }

    /// Returns model and position of a row.
    pub(super) fn model_and_position(&self, row: usize) -> (i32, [f64; 3]) {
        (self.model[row], [self.x[row], self.y[row], self.z[row]])
    }

    /// Returns a warning about the atoms of unknown elements; `None` if there are none or the file contains all radii.
    fn unknown_elements(&self, tables: &Tables, radii_of_file: &[f32]) -> Option<String> {
        if !radii_of_file.is_empty() || !self.element.contains(&0) {
            return None;
        }
        let mut unknown = (0..self.len()).filter(|&i| self.element[i] == 0 && self.kind[i] != Kind::VirtualSite);
        let first = unknown.next()?;
        let (name, residue) = (tables.name.text(self.name[first]), tables.residue.text(self.residue[first]));
        let (atom, radius) = (format!("atom {} (`{name}` of residue `{residue}`)", first + 1), radii::FALLBACK);
        Some(match unknown.count() {
            0 => format!("{atom} has no known element; its radius is {radius} Å"),
            more => format!("{atom} and {more} more have no known element; their radius is {radius} Å"),
        })
    }

    /// Returns the finished structure, if not too many atoms have the same position.
    pub(super) fn finish(
        mut self,
        mut tables: Tables,
        mut source: SourceFields,
        reading: &Reading<'_>,
    ) -> Result<Structure, StructureError> {
        let mut warnings = std::mem::take(&mut source.warnings);
        let by_name = reading.reserve(2 * tables.bytes())?;
        warnings.extend(placement::check(&self, reading)?);
        warnings.extend(kinds::assign(&mut self, &tables, &source, reading)?);
        for (kind, _) in self.kind.iter_mut().zip(&source.radii).filter(|(_, radius)| **radius == 0.0) {
            *kind = Kind::VirtualSite;
        }
        if tables.label_chain.is_empty() || source.format == SourceFormat::Pdb {
            self.label_chain = Vec::new();
            tables.label_chain = Interner::default();
        }
        // Kinds were found by tables of names.
        drop(by_name);
        let entity = |chain_ix| source.sequence.entity_id(&tables, chain_ix).unwrap_or_default();
        let entities = (0..tables.label_chain.texts().len()).map(entity);
        reading.keep(entities.clone().map(|entity| (size_of::<String>() + entity.len()) as u64).sum())?;
        let entities = entities.map(str::to_owned).collect();
        self.shrink();
        reading.keep(source.assemblies.bytes())?;
        source.annotations.keep(self.starts_residue.iter().filter(|starts| **starts).count(), reading)?;
        warnings.extend(self.unknown_elements(&tables, &source.radii));
        reading.check()?;
        Ok(self.into_structure(tables, SourceFields { warnings, ..source }, entities))
    }

    /// Returns the structure of rows whose kinds are known. `entities` are those of the texts of `label_chain`.
    pub(super) fn into_structure(self, tables: Tables, source: SourceFields, entities: Vec<String>) -> Structure {
        Structure {
            format: source.format,
            id: source.id,
            title: source.title,
            x: self.x,
            y: self.y,
            z: self.z,
            element: self.element,
            name: tables.name.column(self.name),
            residue: tables.residue.column(self.residue),
            chain: tables.chain.column(self.chain),
            label_chain: tables.label_chain.column_of(self.label_chain, without_entity),
            entities,
            residue_number: self.residue_number,
            insertion_code: self.insertion_code,
            altloc: self.altloc,
            occupancy: self.occupancy,
            b_factor: self.b_factor,
            radius: source.radii,
            charge: source.charges,
            model: self.model,
            hetero: self.hetero,
            kind: self.kind,
            starts_residue: self.starts_residue,
            unread: source.unread,
            assemblies: source.assemblies,
            annotations: source.annotations,
            warnings: source.warnings,
        }
    }
}
