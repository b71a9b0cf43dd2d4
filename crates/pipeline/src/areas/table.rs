//! Tables of exact areas.

use std::io::{self, Write};

use molmesh_structure::{Structure, table};
use molmesh_surface::{AreaParts, Control, Reservation, SurfaceError, named};
use rustc_hash::FxHashMap;

use super::{ATOMS_PER_CHECK, AtomAreas};

/// Rows of a table of areas.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum AreaLevel {
    /// A row for each atom.
    Atom,
    /// A row for each residue.
    #[default]
    Residue,
    /// A row for each chain.
    Chain,
}

named!(AreaLevel, Atom => "atom", Residue => "residue", Chain => "chain");

/// Row of a table: some atoms with the sums of their areas, Å².
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AreaRow {
    /// Index of the first atom in the structure.
    pub first: usize,
    /// Number of atoms.
    pub atoms: u64,
    /// Area. It is the sum of three parts for a solvent-excluded surface, and one part otherwise.
    pub parts: AreaParts,
    /// Area without the other side; with an interface only.
    pub alone: Option<f64>,
}

impl AtomAreas {
    /// Returns the number of atoms.
    #[must_use]
    pub fn len(&self) -> usize {
        self.atoms.len()
    }

    /// Returns true if there is no atom.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.atoms.is_empty()
    }

    /// Returns true if the areas have parts: those of a solvent-excluded surface.
    #[must_use]
    pub fn has_parts(&self) -> bool {
        self.has_parts
    }

    /// Returns the rows of a table. Chains are in the order of their first atoms, and contain all copies. A residue
    /// ends with its last consecutive atom. The rows are charged to `memory`.
    ///
    /// # Errors
    /// Fails if the memory budget is used up, or the work is cancelled.
    pub fn rows(
        &self,
        structure: &Structure,
        level: AreaLevel,
        control: &Control<'_>,
        memory: &Reservation,
    ) -> Result<Vec<AreaRow>, SurfaceError> {
        let mut rows: Vec<AreaRow> = Vec::new();
        let mut of_chains = FxHashMap::default();
        let mut before = None;
        for (n, &atom) in self.atoms.iter().enumerate() {
            control.check_every(n, ATOMS_PER_CHECK)?;
            let i = atom as usize;
            let row = match level {
                AreaLevel::Atom => rows.len(),
                // The first atom of a copy has a lower index than the last one of the copy before.
                AreaLevel::Residue => {
                    let is_same = before.is_some_and(|last| last < i && structure.same_residue(last, i));
                    rows.len() - usize::from(is_same)
                }
                AreaLevel::Chain => {
                    memory.reserve_entries(&mut of_chains, 1)?;
                    *of_chains.entry(structure.chain.id(i)).or_insert(rows.len())
                }
            };
            if row == rows.len() {
                memory.reserve_rows(&mut rows, 1)?;
                let alone = self.alone.as_ref().map(|_| 0.0);
                rows.push(AreaRow { first: i, atoms: 0, parts: AreaParts::default(), alone });
            }
            rows[row].atoms += 1;
            rows[row].parts += self.areas[n];
            if let (Some(sum), Some(alone)) = (&mut rows[row].alone, &self.alone) {
                *sum += alone[n];
            }
            before = Some(i);
        }
        Ok(rows)
    }

    /// Writes a table as CSV (RFC 4180, lines end in LF) with areas in Å², rounded to 0.0001 Å². With an interface, it
    /// has the atoms of both sides, and the columns `alone` and `buried`. With a solvent-excluded surface, it has the
    /// columns `contact`, `toroidal` and `concave`.
    ///
    /// # Errors
    /// Returns the errors of `out`, and a [`SurfaceError`] as an error of kind `Other`.
    pub fn write_csv(
        &self,
        structure: &Structure,
        level: AreaLevel,
        control: &Control<'_>,
        out: &mut dyn Write,
    ) -> io::Result<()> {
        let columns = match level {
            AreaLevel::Atom => 0..8,
            AreaLevel::Residue => 3..8,
            AreaLevel::Chain => 6..8,
        };
        let counts = level != AreaLevel::Atom;
        let mut header = table::COLUMNS[columns.clone()].to_vec();
        header.extend(counts.then_some("atoms"));
        header.push("area");
        if self.has_parts {
            header.extend(["contact", "toroidal", "concave"]);
        }
        if self.alone.is_some() {
            header.extend(["alone", "buried"]);
        }
        let memory = Reservation::new(&control.memory);
        let rows = self.rows(structure, level, control, &memory).map_err(io::Error::other)?;
        table::write_rows(out, &header, rows, |text, AreaRow { first, atoms, parts, alone }| {
            table::put_columns(text, structure, first, columns.clone());
            if counts {
                write!(text, ",{atoms}")?;
            }
            let area = parts.total();
            write!(text, ",{area:.4}")?;
            if self.has_parts {
                write!(text, ",{:.4},{:.4},{:.4}", parts.contact, parts.toroidal, parts.concave)?;
            }
            if let Some(alone) = alone {
                write!(text, ",{alone:.4},{:.4}", alone - area)?;
            }
            Ok(())
        })
    }
}
