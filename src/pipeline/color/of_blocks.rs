//! Colours of the atoms of consecutive blocks of a structure.

use indexmap::IndexSet;

use super::{AtomColors, ColorError, ColorReport, Coloring, MAX_ENTRIES, Scheme};
use crate::structure::Structure;

/// Colours of the blocks so far.
pub(in super::super) struct BlockColors {
    coloring: Coloring,
    /// Names of chains or entities, in order of first appearance.
    names: IndexSet<String>,
    report: Option<ColorReport>,
}

impl BlockColors {
    pub(in super::super) fn new(coloring: Coloring) -> Self {
        Self { coloring, names: IndexSet::new(), report: None }
    }

    /// Returns the colours of the `selected` atoms of the next block.
    ///
    /// # Errors
    /// Returns [`ColorError`] if the values of the scheme are missing.
    pub(in super::super) fn add(
        &mut self,
        structure: &Structure,
        selected: &[u32],
    ) -> Result<Vec<[u8; 4]>, ColorError> {
        let colors = AtomColors::numbered(structure, selected, &self.coloring, &mut self.names)?;
        let new = colors.report(selected);
        match &mut self.report {
            None => self.report = Some(new),
            Some(report) => {
                for entry in new.legend {
                    let is_known = report.legend.iter().any(|known| known.label == entry.label);
                    if !is_known && report.legend.len() < MAX_ENTRIES {
                        report.legend.push(entry);
                    }
                }
            }
        }
        Ok(selected.iter().map(|&i| colors.of(i as usize)).collect())
    }

    /// Returns the report of all blocks.
    ///
    /// # Errors
    /// Returns [`ColorError`] if no block has an entity.
    pub(in super::super) fn finish(self) -> Result<(Coloring, ColorReport), ColorError> {
        match self.report {
            Some(report) if self.coloring.scheme != Scheme::Entity || !self.names.is_empty() => {
                Ok((self.coloring, report))
            }
            _ => Err(without_entities()),
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
