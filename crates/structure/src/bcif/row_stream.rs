//! Rows of a BinaryCIF file in blocks, so that the memory depends on a block and on the texts of the file.

use molmesh_surface::{Control, MemoryMeter as _, Reservation};

use super::super::assembly::Assemblies;
use super::super::atom_layout::Layout;
use super::super::atoms::{Columns, Structure};
use super::super::divisions::{self, BlockFindings};
use super::super::error::StructureError;
use super::super::pieces;
use super::super::read::{ReadLimits, Reading, check};
use super::super::source::SourceFields;
use super::super::stream::Block;
use super::column::DecodedColumn;
use super::column_stream::{ColumnStream, DecodeLimits, Raw};
use super::fault::Fault;
use super::msgpack::Cursor;
use super::rows::{self, Table};
use super::skeleton::Skeleton;
use super::{BinaryBlock, SiteColumns, first_block};

/// Rows of a column that are checked at a time.
const CHECKED: usize = 1 << 16;
/// Memory of the buffers of a column, bytes.
const BUFFERS: u64 = 1 << 18;

/// Rows of the first data block that has atoms with coordinates.
pub(in super::super) struct RowStream {
    columns: Vec<Option<ColumnStream<'static>>>,
    /// Decoded rows that are not in a block yet.
    table: Table<'static>,
    layout: Layout,
    location: String,
    source: SourceFields,
    /// Number of rows in the file.
    n_rows: usize,
    /// Number of rows of a block.
    block_rows: usize,
    /// Number of rows with memory in `memory`.
    held: usize,
    findings: BlockFindings,
    /// Memory of the rows, the texts and `source`.
    memory: Reservation,
}

impl RowStream {
    /// Begins to read a file in blocks of `block_rows` rows. Returns `None` if it is one block. Decodes all columns
    /// once to check them.
    ///
    /// # Errors
    /// Returns the errors of [`super::read_skeleton`] except those of rows.
    pub(in super::super) fn open(
        skeleton: &Skeleton,
        block_rows: usize,
        limits: &ReadLimits,
        control: &Control<'_>,
    ) -> Result<Option<Self>, StructureError> {
        let (rows, unread) = first_block(Cursor::of_skeleton(skeleton), limits, |block, passed| {
            let reading = Reading::new(limits, control);
            let Some(site) = block.site(&reading, passed)? else { return Ok(None) };
            if site.bounds.rows <= block_rows {
                return Ok(Some(None));
            }
            Self::of_block(block, site, block_rows, reading).map(|rows| Some(Some(rows)))
        })?;
        if rows.is_some() && unread.counts.blocks > 0 {
            let found = "atoms in several data blocks".to_owned();
            return Err(StructureError::NotAStream { found, expected: "one data block with atoms" });
        }
        Ok(rows)
    }

    fn of_block<'a>(
        block: &BinaryBlock<'a>,
        site: SiteColumns<'a>,
        block_rows: usize,
        reading: Reading<'_>,
    ) -> Result<Self, StructureError> {
        let (SiteColumns { raw, layout, bounds, location }, source) = block.source(site, &reading)?;
        let open = |raw: &Raw<'a>, texts: bool| open(raw, bounds, texts, &location, &reading);
        let opened = rows::load_pairs(&raw, &layout, rows::n_pieces(bounds.rows, &reading) > 1, open)?;
        let (mut streams, mut columns) = (Vec::new(), Vec::new());
        for opened in opened {
            let (stream, column) = opened.unzip();
            streams.push(stream);
            columns.push(column);
        }
        let table = Table { names: rows::names(&raw), columns, first: 0, len: 0 };
        Ok(Self {
            columns: streams,
            table,
            layout,
            location,
            source,
            n_rows: bounds.rows,
            block_rows,
            held: 0,
            findings: BlockFindings::default(),
            memory: reading.text,
        })
    }

    /// Takes the assemblies of the file.
    pub(in super::super) fn take_assemblies(&mut self) -> Assemblies {
        std::mem::take(&mut self.source.assemblies)
    }

    /// Returns the next block; `None` at the end. The memory of its structure stays added to the meter of `control`.
    ///
    /// # Errors
    /// Returns the errors of [`super::read_skeleton`], and [`StructureError::NotAStream`] if the whole file would give
    /// other atoms.
    pub(in super::super) fn next(
        &mut self,
        limits: &ReadLimits,
        control: &Control<'_>,
    ) -> Result<Option<Block>, StructureError> {
        let mut size = self.block_rows;
        loop {
            check(control)?;
            self.fill(size, &Reading::new(limits, control))?;
            let n = self.table.len;
            if n == 0 {
                return self.findings.check("the categories `entity` and `struct_asym`").map(|()| None);
            }
            let (metered, memory) = control.with_reservation();
            let reading = Reading::of_block(limits, &metered);
            let structure = self.structure(&reading)?;
            let is_last = self.table.first + n == self.n_rows;
            let Some(len) = (if is_last { Some(n) } else { divisions::last_division(&structure) }) else {
                // All residues depend on each other.
                size = size.saturating_mul(2);
                continue;
            };
            self.findings.add(&reading);
            // Subtracts the memory of reading first.
            drop(reading);
            memory.keep();
            self.remove(len);
            return Ok(Some(Block { structure, len }));
        }
    }

    /// Decodes rows until there are `size`, or all.
    fn fill(&mut self, size: usize, reading: &Reading<'_>) -> Result<(), StructureError> {
        let n = size.min(self.n_rows - self.table.first).saturating_sub(self.table.len);
        let len = self.table.len + n;
        if len > self.held {
            let bytes = |rows: usize| rows::window_bytes(&self.layout, rows);
            self.memory.grow(bytes(len) - bytes(self.held))?;
            self.held = len;
        }
        let read = |(stream, column): &mut (&mut ColumnStream<'static>, &mut DecodedColumn<'static>)| {
            column.reserve(n);
            stream.read(n, column)
        };
        let pairs = self.columns.iter_mut().zip(&mut self.table.columns);
        let mut pairs: Vec<_> = pairs.filter_map(|(stream, column)| stream.as_mut().zip(column.as_mut())).collect();
        let is_parallel = rows::n_pieces(n, reading) > 1;
        let all: Vec<Result<(), Box<Fault>>> =
            if is_parallel { pieces::map(&mut pairs, read) } else { pairs.iter_mut().map(read).collect() };
        all.into_iter().collect::<Result<(), _>>().map_err(|fault| fault.within(&self.location))?;
        self.table.len = len;
        Ok(())
    }

    /// Converts the decoded rows.
    fn structure(&self, reading: &Reading<'_>) -> Result<Structure, StructureError> {
        let memory = reading.reserve(Columns::bytes(self.table.len))?;
        let atoms = rows::convert(&self.table, self.layout, reading)?;
        let (columns, tables, warnings) = atoms.map_err(|fault| fault.within(&self.location))?;
        memory.keep();
        let mut source = self.source.clone();
        source.warnings.splice(..0, warnings.messages(|fault| fault.within(&self.location).into()));
        columns.finish(tables, source, reading)
    }

    /// Removes the first `n` decoded rows.
    fn remove(&mut self, n: usize) {
        for column in self.table.columns.iter_mut().flatten() {
            column.remove(n);
        }
        self.table.first += n;
        self.table.len -= n;
    }
}

/// Column whose rows have been checked.
type Opened = (ColumnStream<'static>, DecodedColumn<'static>);

/// Checks all rows of a column. Returns it without decoded rows, and true if there are rows without a value.
fn open(
    raw: &Raw<'_>,
    bounds: DecodeLimits,
    texts: bool,
    location: &str,
    reading: &Reading<'_>,
) -> Result<(Opened, bool), StructureError> {
    let within = |fault: Box<Fault>| fault.within(location);
    let (mut stream, mut column) = raw.open(bounds, texts).map_err(within)?;
    reading.text.grow(BUFFERS + column.text_bytes())?;
    let mut has_nulls = false;
    let mut rest = bounds.rows;
    while rest > 0 {
        reading.check()?;
        let n = rest.min(CHECKED);
        stream.read(n, &mut column).map_err(within)?;
        has_nulls |= column.lacks_values(texts);
        column.remove(n);
        rest -= n;
    }
    stream.end().map_err(within)?;
    let (stream, column) = raw.open(bounds, texts).map_err(within)?;
    Ok(((stream.into_owned(), column.into_owned()), has_nulls))
}
