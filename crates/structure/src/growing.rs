//! Columns that grow while a file is read: limits, memory and cancellation are checked once per chunk of rows.

use super::atoms::{Atom, Columns, Structure, Tables};
use super::duplicates;
use super::error::StructureError;
use super::read::Reading;
use super::source::SourceFields;

/// Rows between two checks: a few milliseconds.
const CHUNK: usize = 1 << 16;

/// Columns with reserved memory for some more rows.
#[derive(Debug, Default)]
pub(super) struct GrowingColumns {
    pub(super) columns: Columns,
    /// Number of rows at which the next check is due.
    next_check: usize,
    /// Number of rows at which the next search for atoms at the same position is due.
    next_search: usize,
    /// Reserved memory of texts, bytes.
    text_bytes: u64,
}

impl GrowingColumns {
    /// Takes columns with rows. The caller has reserved their memory.
    pub(super) fn filled(columns: Columns, tables: &Tables) -> Self {
        Self { next_check: columns.len(), next_search: 2 * columns.len(), columns, text_bytes: tables.bytes() }
    }

    /// Returns the finished structure.
    ///
    /// # Errors
    /// Returns the errors of [`Columns::finish`].
    pub(super) fn finish(
        self,
        tables: Tables,
        source: SourceFields,
        reading: &Reading<'_>,
    ) -> Result<Structure, StructureError> {
        reading.keep(tables.bytes() - self.text_bytes)?;
        self.columns.finish(tables, source, reading)
    }

    /// Returns the number of rows that [`Self::push`] may add before [`Self::reserve_chunk`] must be called.
    pub(super) fn space(&self) -> usize {
        self.next_check - self.columns.len()
    }

    /// Adds an atom.
    #[inline]
    pub(super) fn push(&mut self, atom: &Atom) {
        self.columns.push(atom);
    }

    /// Reserves memory for more rows, for `expected` rows in an empty column.
    ///
    /// # Errors
    /// Returns [`StructureError::Limit`], [`StructureError::Memory`] and [`StructureError::Cancelled`].
    pub(super) fn reserve_chunk(
        &mut self,
        tables: &Tables,
        reading: &Reading<'_>,
        expected: usize,
    ) -> Result<(), StructureError> {
        let (n, limit) = (self.columns.len(), reading.limits.max_rows());
        if n < self.next_check {
            return Ok(());
        }
        reading.check()?;
        if n >= limit {
            return Err(reading.limits.too_many_atoms().error());
        }
        // Searches only when the number of rows has doubled, so that the time of all searches grows linearly with the
        // number of rows.
        if n >= self.next_search {
            duplicates::check(n, |row| self.columns.model_and_position(row), reading)?;
            self.next_search = (2 * n).max(CHUNK);
        }
        reading.keep(tables.bytes() - self.text_bytes)?;
        self.text_bytes = tables.bytes();
        if n == self.columns.capacity() {
            let more = if n == 0 { expected } else { (n / 2).max(CHUNK) };
            self.columns.reserve(more.clamp(1, limit - n), reading)?;
        }
        self.next_check = self.columns.capacity().min(n + CHUNK).min(limit);
        Ok(())
    }
}
