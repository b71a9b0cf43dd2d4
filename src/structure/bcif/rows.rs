//! Decodes columns and converts their rows to atoms, on several threads if there are many rows.

use super::super::atom_site::{self, AtomSite, Layout, Span, Wrong};
use super::super::atoms::{Columns, Tables};
use super::super::error::StructureError;
use super::super::pieces;
use super::super::read::Reading;
use super::super::text::{decode, quote};
use super::super::warnings::Warnings;
use super::column::{Bounds, Cells, Column, Raw};
use super::fault::Fault;

/// Bytes of text that take the time of a row.
const BYTES_PER_ROW: usize = 80;
/// Rows between two checks of the cancellation flag and charges of memory: a few milliseconds.
const ROWS_PER_CHECK: usize = 1 << 14;

/// Columns of `atom_site` in file order. Only the required ones are decoded.
struct Table<'a> {
    raw: &'a [Raw<'a>],
    columns: Vec<Option<Column<'a>>>,
}

/// A row of the table.
struct Row<'t> {
    table: &'t Table<'t>,
    index: usize,
}

impl Row<'_> {
    /// Returns the cells of a column, or `None` if it has no value in this row.
    #[inline]
    fn cells(&self, column: usize) -> Option<&Cells<'_>> {
        let column = self.table.columns.get(column)?.as_ref()?;
        (!column.is_null(self.index)).then_some(&column.cells)
    }
}

impl atom_site::Row for Row<'_> {
    type Fault = Box<Fault>;

    #[inline]
    fn text(&self, column: usize) -> Option<Span<'_>> {
        let Some(Cells::Text(texts)) = self.cells(column) else { return None };
        let (start, end) = texts.range(self.index)?;
        Some(Span { text: &texts.joined, start, end })
    }

    #[inline]
    fn real(&self, column: usize) -> Result<Option<f64>, Wrong> {
        match self.cells(column) {
            None => Ok(None),
            Some(Cells::Int(values)) => Ok(Some(values[self.index].into())),
            Some(Cells::Real(values)) => Some(values[self.index]).filter(|v| v.is_finite()).map(Some).ok_or(Wrong),
            Some(Cells::Text(_)) => self.text(column).map(Span::real).transpose(),
        }
    }

    #[inline]
    fn integer(&self, column: usize) -> Result<Option<i32>, Wrong> {
        match self.cells(column) {
            None => Ok(None),
            Some(Cells::Int(values)) => Ok(Some(values[self.index])),
            Some(Cells::Real(values)) => whole(values[self.index]).map(Some),
            Some(Cells::Text(_)) => self.text(column).map(Span::integer).transpose(),
        }
    }

    #[cold]
    fn fault(&self, column: usize, expected: String) -> Box<Fault> {
        let found = match self.cells(column) {
            None => "nothing".to_owned(),
            Some(Cells::Int(values)) => values[self.index].to_string(),
            Some(Cells::Real(values)) => values[self.index].to_string(),
            Some(Cells::Text(texts)) => texts
                .range(self.index)
                .map_or_else(|| "nothing".to_owned(), |(start, end)| quote(&texts.joined[start..end])),
        };
        let name = self.table.raw.get(column).map_or_else(Default::default, |raw| decode(raw.name));
        Fault::new(found, expected).within(format_args!("{name}, row {}", self.index + 1))
    }
}

/// Converts a real number with an integral value.
#[cold]
fn whole(value: f64) -> Result<i32, Wrong> {
    let fits = value.fract() == 0.0 && value.abs() <= f64::from(i32::MAX);
    #[expect(clippy::cast_possible_truncation, reason = "an integral value in range")]
    if fits { Ok(value as i32) } else { Err(Wrong) }
}

/// Returns an upper bound for the memory (bytes) of the decoded columns of the layout.
pub(super) fn decoded_bytes(layout: &Layout, rows: usize) -> u64 {
    let columns = |pairs: &[[usize; 2]]| pairs.iter().flatten().filter(|c| **c != atom_site::NONE).count();
    let row = columns(&layout.texts()) * size_of::<i32>() + columns(&layout.numbers()) * size_of::<f64>();
    row as u64 * rows as u64
}

/// Atoms, their string tables, and warnings about replaced values.
pub(super) type Atoms = (Columns, Tables, Warnings<Box<Fault>>);

/// Decodes the columns of the layout and converts their rows to atoms. Returns the first fault in file order.
///
/// # Errors
/// Returns the errors of cancellation and memory.
pub(super) fn read(
    raw: &[Raw<'_>],
    layout: Layout,
    bounds: Bounds,
    reading: &Reading<'_>,
) -> Result<Result<Atoms, Box<Fault>>, StructureError> {
    let n_pieces = reading.n_pieces(BYTES_PER_ROW * bounds.rows);
    let table = match load(raw, &layout, bounds, n_pieces > 1) {
        Ok(columns) => Table { raw, columns },
        Err(fault) => return Ok(Err(fault)),
    };
    let mut columns = Columns::zeroed(bounds.rows);
    let mut rest = columns.slices();
    let mut parts = Vec::with_capacity(n_pieces);
    let size = bounds.rows.div_ceil(n_pieces);
    for first in (0..bounds.rows).step_by(size) {
        let n = size.min(bounds.rows - first);
        let (slices, others) = rest.split(n);
        parts.push((first..first + n, (slices, AtomSite::new(layout))));
        rest = others;
    }
    let read = pieces::map(&mut parts, |(rows, (slices, site))| -> Result<_, StructureError> {
        let mut n_texts = 0;
        for index in rows.clone() {
            if index % ROWS_PER_CHECK == 0 {
                reading.check()?;
                reading.hold_texts(site.tables.n_texts() - n_texts)?;
                n_texts = site.tables.n_texts();
            }
            match site.atom(&Row { table: &table, index }) {
                Ok(atom) => slices.put(&atom),
                Err(fault) => return Ok(Err(fault)),
            };
        }
        Ok(Ok(()))
    });
    for piece in read {
        if let Err(fault) = piece? {
            return Ok(Err(fault));
        }
    }
    let (tables, warnings) = atom_site::join(parts.into_iter().map(|(_, part)| part).collect());
    reading.keep_texts(tables.n_texts())?;
    Ok(Ok((columns, tables, warnings)))
}

/// A column and its fallback, if required.
type Pair<'a> = [Option<Column<'a>>; 2];

/// Decodes columns, in parallel if asked to. The second of a pair is required only if the first has rows without a
/// value.
fn load<'a>(
    raw: &[Raw<'a>],
    layout: &Layout,
    bounds: Bounds,
    parallel: bool,
) -> Result<Vec<Option<Column<'a>>>, Box<Fault>> {
    let texts = layout.texts().map(|pair| (pair, true));
    let numbers = layout.numbers().map(|pair| (pair, false));
    let mut wanted: Vec<_> = texts.into_iter().chain(numbers).collect();
    let load = |&mut ([first, second], texts): &mut ([usize; 2], bool)| -> Result<Pair<'a>, Box<Fault>> {
        let load = |column: usize| raw.get(column).map(|raw| raw.load(bounds, texts)).transpose();
        let (first, mut fallback) = (load(first)?, None);
        if first.as_ref().is_some_and(Column::has_nulls) {
            fallback = load(second)?;
        }
        Ok([first, fallback])
    };
    let loaded = if parallel { pieces::map(&mut wanted, load) } else { wanted.iter_mut().map(load).collect() };
    let mut columns: Vec<Option<Column<'a>>> = Vec::new();
    columns.resize_with(raw.len(), || None);
    for ((places, _), pair) in wanted.into_iter().zip(loaded) {
        for (place, column) in places.into_iter().zip(pair?) {
            if let (Some(slot), Some(column)) = (columns.get_mut(place), column) {
                *slot = Some(column);
            }
        }
    }
    Ok(columns)
}
