//! Decodes columns and converts their rows to atoms, on several threads if there are many rows.

use super::super::atom_layout::{Layout, NONE};
use super::super::atom_site::{self, AtomSite, BadNumber, Span};
use super::super::atoms::{Columns, Tables};
use super::super::duplicates;
use super::super::error::StructureError;
use super::super::pieces;
use super::super::read::Reading;
use super::super::text::{decode, quote};
use super::super::warnings::Warnings;
use super::column::{Cells, DecodedColumn};
use super::column_stream::{DecodeLimits, Raw};
use super::fault::Fault;

/// Bytes of text that take as long to read as a row.
const BYTES_PER_ROW: usize = 80;
/// Rows between two checks of the cancellation flag and charges of memory: a few milliseconds.
const ROWS_PER_CHECK: usize = 1 << 14;

/// Rows of `atom_site`, with the columns in file order. Only the required ones are decoded.
#[derive(Debug)]
pub(super) struct Table<'a> {
    pub(super) names: Vec<String>,
    pub(super) columns: Vec<Option<DecodedColumn<'a>>>,
    /// Number of rows of the file before these.
    pub(super) first: usize,
    /// Number of rows.
    pub(super) len: usize,
}

/// A row of the table.
struct BinaryRow<'t> {
    table: &'t Table<'t>,
    index: usize,
}

impl BinaryRow<'_> {
    /// Returns the cells of a column, or `None` if it has no value in this row.
    #[inline]
    fn cells(&self, column: usize) -> Option<&Cells<'_>> {
        let column = self.table.columns.get(column)?.as_ref()?;
        (!column.is_null(self.index)).then_some(&column.cells)
    }
}

impl atom_site::AtomRow for BinaryRow<'_> {
    type Fault = Box<Fault>;

    #[inline]
    fn text(&self, column: usize) -> Option<Span<'_>> {
        let Some(Cells::Text(texts)) = self.cells(column) else { return None };
        let (start, end) = texts.range(self.index)?;
        Some(Span { text: &texts.joined, start, end })
    }

    #[inline]
    fn real(&self, column: usize) -> Result<Option<f64>, BadNumber> {
        match self.cells(column) {
            None => Ok(None),
            Some(Cells::Int(values)) => Ok(Some(values[self.index].into())),
            Some(Cells::Real(values)) => Some(values[self.index]).filter(|v| v.is_finite()).map(Some).ok_or(BadNumber),
            Some(Cells::Text(_)) => self.text(column).map(Span::real).transpose(),
        }
    }

    #[inline]
    fn integer(&self, column: usize) -> Result<Option<i32>, BadNumber> {
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
        let name = self.table.names.get(column).map_or("", String::as_str);
        Fault::new(found, expected).within(format_args!("{name}, row {}", self.table.first + self.index + 1))
    }
}

/// Converts a real number with an integral value.
#[cold]
fn whole(value: f64) -> Result<i32, BadNumber> {
    let fits = value.fract() == 0.0 && value.abs() <= f64::from(i32::MAX);
    #[expect(clippy::cast_possible_truncation, reason = "an integral value in range")]
    if fits { Ok(value as i32) } else { Err(BadNumber) }
}

/// Returns an upper bound for the memory (bytes) of the decoded columns of the layout.
pub(super) fn decoded_bytes(layout: &Layout, rows: usize) -> u64 {
    let columns = |pairs: &[[usize; 2]]| pairs.iter().flatten().filter(|c| **c != NONE).count();
    let row = columns(&layout.texts()) * size_of::<i32>() + columns(&layout.numbers()) * size_of::<f64>();
    row as u64 * rows as u64
}

/// Returns an upper bound for the memory (bytes) of `rows` decoded rows. A mask takes a byte for each value, a quarter
/// of the smallest value.
pub(super) fn window_bytes(layout: &Layout, rows: usize) -> u64 {
    decoded_bytes(layout, rows) / 4 * 5
}

/// Atoms, their string tables, and warnings about replaced values.
pub(super) type Atoms = (Columns, Tables, Warnings<Box<Fault>>);

/// Decodes the columns of the layout and converts their rows to atoms. Returns the first fault in file order.
///
/// # Errors
/// Returns the errors of cancellation and memory.
pub(super) fn read<'a>(
    raw: &[Raw<'a>],
    layout: Layout,
    bounds: DecodeLimits,
    reading: &Reading<'_>,
) -> Result<Result<Atoms, Box<Fault>>, StructureError> {
    let load = |raw: &Raw<'a>, texts: bool| {
        let column = raw.load(bounds, texts)?;
        let has_nulls = column.lacks_values(texts);
        Ok((column, has_nulls))
    };
    match load_pairs(raw, &layout, n_pieces(bounds.rows, reading) > 1, load) {
        Ok(columns) => {
            let table = Table { names: names(raw), columns, first: 0, len: bounds.rows };
            check_samples(&table, layout, reading)?;
            convert(&table, layout, reading)
        }
        Err(fault) => Ok(Err(fault)),
    }
}

/// Returns the names of columns.
pub(super) fn names(raw: &[Raw<'_>]) -> Vec<String> {
    raw.iter().map(|raw| decode(raw.name).into_owned()).collect()
}

/// Returns the number of pieces for a number of rows.
pub(super) fn n_pieces(rows: usize, reading: &Reading<'_>) -> usize {
    reading.n_pieces(BYTES_PER_ROW * rows)
}

/// Converts rows to atoms. Returns the first fault in file order.
///
/// # Errors
/// Returns the errors of cancellation and memory.
pub(super) fn convert(
    table: &Table<'_>,
    layout: Layout,
    reading: &Reading<'_>,
) -> Result<Result<Atoms, Box<Fault>>, StructureError> {
    let n_pieces = n_pieces(table.len, reading);
    let mut columns = Columns::zeroed(table.len);
    let mut rest = columns.slices();
    let mut parts = Vec::with_capacity(n_pieces);
    let size = table.len.div_ceil(n_pieces);
    for first in (0..table.len).step_by(size) {
        let n = size.min(table.len - first);
        let (slices, others) = rest.split(n);
        parts.push((first..first + n, (slices, AtomSite::new(layout))));
        rest = others;
    }
    let read = pieces::map(&mut parts, |(rows, (slices, site))| -> Result<_, StructureError> {
        let mut text_bytes = 0;
        for index in rows.clone() {
            if index % ROWS_PER_CHECK == 0 {
                reading.check()?;
                reading.hold_texts(site.tables.bytes() - text_bytes)?;
                text_bytes = site.tables.bytes();
            }
            match site.atom(&BinaryRow { table, index }) {
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
    reading.keep(tables.bytes())?;
    Ok(Ok((columns, tables, warnings)))
}

/// Number of rows from which on samples are checked first.
const SAMPLED_FROM: usize = 1 << 20;
/// Number of rows of a sample.
const SAMPLE: usize = 1 << 14;
/// Number of samples.
const N_SAMPLES: usize = 8;

/// Rejects a file if samples of its rows contain too many atoms at the same position. Does not depend on the number of
/// threads. Ignores other errors, which the conversion of all rows reports.
fn check_samples(table: &Table<'_>, layout: Layout, reading: &Reading<'_>) -> Result<(), StructureError> {
    if table.len < SAMPLED_FROM {
        return Ok(());
    }
    for first in (0..table.len - SAMPLE).step_by(table.len / N_SAMPLES) {
        reading.check()?;
        let _memory = reading.reserve(Columns::bytes(SAMPLE))?;
        let (mut columns, mut site) = (Columns::zeroed(SAMPLE), AtomSite::new(layout));
        let mut rows = columns.slices();
        for index in first..first + SAMPLE {
            match site.atom(&BinaryRow { table, index }) {
                Ok(atom) => rows.put(&atom),
                Err(_fault) => return Ok(()),
            };
        }
        duplicates::check(SAMPLE, |row| columns.model_and_position(row), reading)?;
    }
    Ok(())
}

/// Reads the columns of the layout, in parallel if requested. The second of a pair is required only if the first has
/// rows without a usable value. `load` returns a column, read as texts if its second argument is true, and true if it
/// has such rows.
pub(super) fn load_pairs<'a, T: Send, E: Send>(
    raw: &[Raw<'a>],
    layout: &Layout,
    parallel: bool,
    load: impl Fn(&Raw<'a>, bool) -> Result<(T, bool), E> + Sync,
) -> Result<Vec<Option<T>>, E> {
    let texts = layout.texts().map(|pair| (pair, true));
    let numbers = layout.numbers().map(|pair| (pair, false));
    let mut wanted: Vec<_> = texts.into_iter().chain(numbers).collect();
    let load = |&mut ([first, second], texts): &mut ([usize; 2], bool)| -> Result<[Option<T>; 2], E> {
        let load = |column: usize| raw.get(column).map(|raw| load(raw, texts)).transpose();
        Ok(match load(first)? {
            Some((first, true)) => [Some(first), load(second)?.map(|(second, _)| second)],
            first => [first.map(|(first, _)| first), None],
        })
    };
    let loaded = if parallel { pieces::map(&mut wanted, load) } else { wanted.iter_mut().map(load).collect() };
    let mut columns: Vec<Option<T>> = Vec::new();
    columns.resize_with(raw.len(), || None);
    for ((indices, _), pair) in wanted.into_iter().zip(loaded) {
        for (index, column) in indices.into_iter().zip(pair?) {
            if let (Some(slot), Some(column)) = (columns.get_mut(index), column) {
                *slot = Some(column);
            }
        }
    }
    Ok(columns)
}
