//! Numbers of models in PDB and PQR files, by the records between their atoms.

use std::collections::HashSet;
use std::ops::Range;

use super::atoms::Columns;

/// Record at the beginning or end of a model.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ModelBoundary {
    /// MODEL, with its number if it has one.
    Begins(Option<i32>),
    /// ENDMDL.
    Ends,
    /// END: the end of a model, or of a part of a structure.
    EndsPart,
}

/// Boundary of a model, with its position among the atoms.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Mark {
    /// Number of atoms before it.
    pub(super) row: usize,
    pub(super) boundary: ModelBoundary,
}

/// Sets the model numbers of all rows. Without MODEL and ENDMDL records, a part of the file that an END record ends is
/// a model if it has the atoms of the part before, and otherwise belongs to the same structure.
pub(super) fn number(marks: &[Mark], columns: &mut Columns) {
    if marks.iter().all(|mark| mark.boundary == ModelBoundary::EndsPart) {
        return number_parts(marks, columns);
    }
    let mut rows = &mut columns.model[..];
    let mut models = Models::default();
    let mut first = 0;
    for mark in marks {
        rows = models.fill(rows, mark.row - first);
        first = mark.row;
        match mark.boundary {
            ModelBoundary::Begins(number) => models.begin(number),
            ModelBoundary::Ends | ModelBoundary::EndsPart => models.current = None,
        }
    }
    let n = rows.len();
    models.fill(rows, n);
}

/// Sets the model numbers of a file whose parts are separated by END records only.
fn number_parts(marks: &[Mark], columns: &mut Columns) {
    let (mut model, mut before) = (1, 0..0);
    for end in marks.iter().map(|mark| mark.row).chain([columns.len()]) {
        let part = before.end..end;
        if part.is_empty() {
            continue;
        }
        model += i32::from(has_same_atoms(columns, before, part.clone()));
        columns.model[part.clone()].fill(model);
        before = part;
    }
}

/// Returns true if two parts of a file have the same atoms, apart from their positions.
fn has_same_atoms(columns: &Columns, a: Range<usize>, b: Range<usize>) -> bool {
    let s = columns;
    s.name[a.clone()] == s.name[b.clone()]
        && s.residue[a.clone()] == s.residue[b.clone()]
        && s.chain[a.clone()] == s.chain[b.clone()]
        && s.residue_number[a.clone()] == s.residue_number[b.clone()]
        && s.insertion_code[a.clone()] == s.insertion_code[b.clone()]
        && s.altloc[a] == s.altloc[b]
}

/// Assigns atoms to models. A repeated model number, or atoms after the end of a model, begin a new model.
#[derive(Default)]
struct Models {
    current: Option<i32>,
    highest: i32,
    seen: HashSet<i32>,
}

impl Models {
    fn begin(&mut self, number: Option<i32>) {
        let next = self.highest.saturating_add(1);
        let number = number.filter(|n| !self.seen.contains(n)).unwrap_or(next);
        self.highest = self.highest.max(number);
        self.seen.insert(number);
        self.current = Some(number);
    }

    /// Assigns the first `n` rows to the current model, and returns the others.
    fn fill<'r>(&mut self, rows: &'r mut [i32], n: usize) -> &'r mut [i32] {
        let (rows, others) = rows.split_at_mut(n);
        if n > 0 && self.current.is_none() {
            self.begin(None);
        }
        rows.fill(self.current.unwrap_or_default());
        others
    }
}
