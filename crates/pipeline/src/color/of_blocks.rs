//! Colours of the atoms of consecutive blocks of a structure.

use indexmap::IndexSet;
use molmesh_structure::Structure;
use molmesh_surface::{Control, MemoryMeter as _, Reservation, SurfaceError};

use super::{AtomColors, ColorError, ColorReport, Coloring, LegendEntry, MAX_ENTRIES, Scheme};
use crate::JobError;

/// Colours of the blocks so far.
pub(in super::super) struct BlockColors {
    coloring: Coloring,
    /// Names of chains or entities, in order of first appearance.
    names: IndexSet<String>,
    report: Option<ColorReport>,
    /// Categories of each group of atoms, in order of first appearance.
    legends: Vec<Vec<LegendEntry>>,
    memory: Reservation,
}

/// Memory of a category, bytes.
const ENTRY_BYTES: u64 = 2 * (size_of::<LegendEntry>() as u64) + 32;

impl BlockColors {
    pub(in super::super) fn new(coloring: Coloring, control: &Control<'_>) -> Self {
        let memory = Reservation::new(&control.memory);
        Self { coloring, names: IndexSet::new(), report: None, legends: Vec::new(), memory }
    }

    /// Returns the colours of the `selected` atoms of the next block. `groups` are the numbers of their groups.
    ///
    /// # Errors
    /// Returns [`ColorError`] if the values of the scheme are missing, and the errors of memory.
    pub(in super::super) fn add(
        &mut self,
        structure: &Structure,
        selected: &[u32],
        groups: &[u32],
    ) -> Result<Vec<[u8; 4]>, JobError> {
        let colors = AtomColors::numbered(structure, selected, &self.coloring, &mut self.names)?;
        let mut first = 0;
        for run in groups.chunk_by(|a, b| a == b) {
            let group = run[0] as usize;
            if self.legends.len() <= group {
                self.memory.grow(ENTRY_BYTES * (group + 1 - self.legends.len()) as u64).map_err(SurfaceError::from)?;
                self.legends.resize(group + 1, Vec::new());
            }
            let mut report = colors.report(&selected[first..first + run.len()]);
            // The values of a palette do not depend on the atoms.
            if self.coloring.scheme.palette().is_none() {
                let n_known = self.legends[group].len();
                add_new(&mut self.legends[group], std::mem::take(&mut report.legend));
                let n_new = (self.legends[group].len() - n_known) as u64;
                self.memory.grow(ENTRY_BYTES * n_new).map_err(SurfaceError::from)?;
            }
            self.report = Some(report);
            first += run.len();
        }
        Ok(selected.iter().map(|&i| colors.of(i as usize)).collect())
    }

    /// Returns the report of all blocks. The legend has the categories in the order of `groups`.
    ///
    /// # Errors
    /// Returns [`ColorError`] if no block has an entity.
    pub(in super::super) fn finish(
        mut self,
        groups: impl Iterator<Item = u32>,
    ) -> Result<(Coloring, ColorReport), ColorError> {
        match self.report {
            Some(mut report) if self.coloring.scheme != Scheme::Entity || !self.names.is_empty() => {
                for group in groups {
                    let legend = self.legends.get_mut(group as usize).map(std::mem::take);
                    add_new(&mut report.legend, legend.unwrap_or_default());
                }
                Ok((self.coloring, report))
            }
            _ => Err(without_entities()),
        }
    }
}

/// Adds the entries to a legend that it lacks.
fn add_new(legend: &mut Vec<LegendEntry>, entries: Vec<LegendEntry>) {
    for entry in entries {
        if legend.len() < MAX_ENTRIES && legend.iter().all(|known| known.label != entry.label) {
            legend.push(entry);
        }
    }
}

/// Returns the number of a name in order of first appearance.
pub(super) fn number(names: &mut IndexSet<String>, name: &str) -> u32 {
    let number = names.get_index_of(name).unwrap_or_else(|| names.insert_full(name.to_owned()).0);
    u32::try_from(number).unwrap_or(0)
}

/// Returns the error of a structure whose entities are unknown.
pub(super) fn without_entities() -> ColorError {
    let why = "the file does not assign chains to entities; only mmCIF and BinaryCIF files can";
    ColorError { scheme: Scheme::Entity.to_string(), why: why.to_owned() }
}
