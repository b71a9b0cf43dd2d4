//! Undecoded columns of a category, and the decoding of their rows.

use std::borrow::Cow;

use super::super::text::decode;
use super::column::{Cells, DecodedColumn, Texts};
use super::decode::{CHUNK, ValueStream};
use super::encoding::{Chain, Strings};
use super::fault::Fault;
use super::msgpack::{Cursor, PackToken};
use super::payload::Payload;

/// An undecoded column.
#[derive(Debug, Clone, Copy)]
pub(super) struct Raw<'a> {
    pub(super) name: &'a [u8],
    data: Cursor<'a>,
    mask: Option<Cursor<'a>>,
}

/// Limits of decoding.
#[derive(Debug, Clone, Copy)]
pub(super) struct DecodeLimits {
    /// Number of rows in the category.
    pub(super) rows: usize,
    /// Maximum number of distinct texts in a column.
    pub(super) texts: usize,
}

impl<'a> Raw<'a> {
    pub(super) fn read(at: &mut Cursor<'a>) -> Result<Self, Box<Fault>> {
        let (mut name, mut data, mut mask) = (None, None, None);
        at.map(|key, value| {
            let mut head = *value;
            match key {
                b"name" => name = Some(value.text()?),
                b"data" => data = Some(*value),
                b"mask" if head.next()? != PackToken::Nil => mask = Some(*value),
                _ => {}
            }
            Ok(())
        })?;
        let name = name.ok_or_else(|| Fault::new("a column without a name", "`name`"))?;
        let data = data.ok_or_else(|| Fault::new("nothing", "`data`").within(decode(name)))?;
        Ok(Self { name, data, mask })
    }

    /// Decodes the column. If `texts` is true, integers are converted to texts.
    pub(super) fn load(&self, bounds: DecodeLimits, texts: bool) -> Result<DecodedColumn<'a>, Box<Fault>> {
        let (mut stream, mut column) = self.open(bounds, texts)?;
        column.reserve(bounds.rows);
        stream.read(bounds.rows, &mut column)?;
        stream.end()?;
        column.mask = column.mask.filter(|mask| mask.contains(&true));
        Ok(column)
    }

    /// Begins to decode the column. Returns the rows, and a column without rows for them.
    pub(super) fn open(
        &self,
        bounds: DecodeLimits,
        texts: bool,
    ) -> Result<(ColumnStream<'a>, DecodedColumn<'a>), Box<Fault>> {
        self.open_parts(bounds, texts).map_err(|fault| fault.within(decode(self.name)))
    }

    fn open_parts(
        &self,
        bounds: DecodeLimits,
        texts: bool,
    ) -> Result<(ColumnStream<'a>, DecodedColumn<'a>), Box<Fault>> {
        let mask = self.mask.map(|mask| open_mask(mask, bounds.rows).map_err(|f| f.within("mask"))).transpose()?;
        let (data, chain) = encoded(self.data)?;
        let (values, cells) = if let Some(strings) = chain.strings() {
            let (ids, texts) = strings.open(data, bounds).map_err(|f| f.within("StringArray"))?;
            (ids, Cells::Text(texts))
        } else {
            let values = chain.decode(data.bytes(), max_values(bounds.rows))?;
            let cells = match (values.is_real(), texts) {
                (false, false) => Cells::Int(Vec::new()),
                (true, false) => Cells::Real(Vec::new()),
                (false, true) => Cells::Text(Texts::written()),
                (true, true) => return Err(Fault::new("real numbers", "texts")),
            };
            (values, cells)
        };
        let column = DecodedColumn { cells, mask: mask.is_some().then(Vec::new) };
        let (name, is_dictionary) = (decode(self.name).into_owned(), chain.strings().is_some());
        let buffer = Vec::new();
        Ok((ColumnStream { name, values, mask, is_dictionary, rows: bounds.rows, n: 0, buffer }, column))
    }
}

/// Rows of a column that are not decoded yet.
#[derive(Debug)]
pub(super) struct ColumnStream<'a> {
    name: String,
    values: ValueStream<'a>,
    mask: Option<ValueStream<'a>>,
    /// True if the values are ids of texts.
    is_dictionary: bool,
    /// Number of rows in the category.
    rows: usize,
    /// Number of decoded rows.
    n: usize,
    buffer: Vec<i32>,
}

impl ColumnStream<'_> {
    /// Copies the data that is in memory.
    pub(super) fn into_owned(self) -> ColumnStream<'static> {
        let (values, mask) = (self.values.into_owned(), self.mask.map(ValueStream::into_owned));
        ColumnStream { name: self.name, values, mask, buffer: self.buffer, ..self }
    }

    /// Decodes the next `n` rows to the end of `column`.
    pub(super) fn read(&mut self, n: usize, column: &mut DecodedColumn<'_>) -> Result<(), Box<Fault>> {
        self.n += n;
        let read = self.read_mask(n, column).map_err(|fault| fault.within("mask"));
        read.and_then(|()| self.read_cells(n, column)).map_err(|fault| fault.within(&self.name))
    }

    /// Checks that no values are left.
    pub(super) fn end(&mut self) -> Result<(), Box<Fault>> {
        self.check_end().map_err(|fault| fault.within(&self.name))
    }

    fn check_end(&mut self) -> Result<(), Box<Fault>> {
        if let Some(mask) = &mut self.mask {
            mask.end().and_then(|n| whole_column(n, self.rows)).map_err(|fault| fault.within("mask"))?;
        }
        let n = self.values.end().map_err(|fault| located(fault, self.is_dictionary, true))?;
        whole_column(n, self.rows).map_err(|fault| located(fault, self.is_dictionary, false))
    }

    /// Decodes a mask of rows without a value: 1 is `.`, 2 is `?`.
    fn read_mask(&mut self, mut n: usize, column: &mut DecodedColumn<'_>) -> Result<(), Box<Fault>> {
        let (Some(stream), Some(mask)) = (&mut self.mask, &mut column.mask) else { return Ok(()) };
        while n > 0 {
            self.buffer.clear();
            stream.ints(n.min(CHUNK), &mut self.buffer)?;
            if let Some(odd) = self.buffer.iter().find(|value| !(0..=2).contains(*value)) {
                return Err(Fault::new(odd.to_string(), "0 (a value), 1 (.) or 2 (?)"));
            }
            mask.extend(self.buffer.iter().map(|&value| value != 0));
            n -= n.min(CHUNK);
        }
        if stream.n == self.n { Ok(()) } else { whole_column(stream.n, self.rows) }
    }

    fn read_cells(&mut self, mut n: usize, column: &mut DecodedColumn<'_>) -> Result<(), Box<Fault>> {
        let Self { values: stream, buffer, is_dictionary, .. } = self;
        let decoded = |decoded: Result<(), Box<Fault>>| decoded.map_err(|fault| located(fault, *is_dictionary, true));
        match &mut column.cells {
            Cells::Int(values) => stream.ints(n, values)?,
            Cells::Real(values) => stream.reals(n, values)?,
            Cells::Text(texts) => {
                while n > 0 {
                    let (start, part) = (texts.ids.len(), n.min(CHUNK));
                    if texts.are_written {
                        buffer.clear();
                        stream.ints(part, buffer)?;
                        texts.write(buffer);
                    } else {
                        decoded(stream.ints(part, &mut texts.ids))?;
                        check_ids(&texts.ids[start..], texts.offsets.len().saturating_sub(1))
                            .map_err(|fault| located(fault, true, false))?;
                    }
                    n -= part;
                }
            }
        }
        if stream.n == self.n {
            return Ok(());
        }
        whole_column(stream.n, self.rows).map_err(|fault| located(fault, *is_dictionary, false))
    }
}

/// Adds the location of a fault in values, which are the ids of texts if `is_dictionary` is true. `in_data` is true for
/// a fault of their encodings.
#[cold]
#[expect(clippy::unnecessary_box_returns, reason = "a boxed fault keeps results small")]
fn located(fault: Box<Fault>, is_dictionary: bool, in_data: bool) -> Box<Fault> {
    match (is_dictionary, in_data) {
        (false, _) => fault,
        (true, false) => fault.within("StringArray"),
        (true, true) => fault.within("data").within("StringArray"),
    }
}

/// Rejects ids of texts that do not exist.
fn check_ids(ids: &[i32], n_texts: usize) -> Result<(), Box<Fault>> {
    match ids.iter().find(|&&id| usize::try_from(id).map_or(id != -1, |id| id >= n_texts)) {
        Some(odd) => {
            Err(Fault::new(format!("text {odd}"), format!("-1 (none) or one of the {n_texts} that are there")))
        }
        None => Ok(()),
    }
}

/// Returns the maximum number of values in an intermediate step of decoding `n` values. Run-length pairs take two.
const fn max_values(n: usize) -> usize {
    n.saturating_add(1).saturating_mul(2)
}

fn whole_column(found: usize, rows: usize) -> Result<(), Box<Fault>> {
    if found == rows { Ok(()) } else { Err(Fault::new(format!("{found} values"), format!("{rows}, as rowCount says"))) }
}

/// Reads encoded data and its chain of encodings.
fn encoded(at: Cursor<'_>) -> Result<(Payload<'_>, Chain<'_>), Box<Fault>> {
    let data = at.required("data", Cursor::bytes)?;
    let chain = at.required("encoding", |value| Ok(*value))?;
    Ok((data, Chain::read(chain)?))
}

/// Begins to decode a mask.
fn open_mask(mask: Cursor<'_>, rows: usize) -> Result<ValueStream<'_>, Box<Fault>> {
    let (data, chain) = encoded(mask)?;
    let values = chain.decode(data.bytes(), max_values(rows))?;
    values.require_ints()?;
    Ok(values)
}

impl<'a> Strings<'a> {
    /// Begins to decode ids of texts. Returns them, and a column without rows.
    fn open(&self, data: Payload<'a>, bounds: DecodeLimits) -> Result<(ValueStream<'a>, Texts<'a>), Box<Fault>> {
        let decode = |at, what, bytes: Payload<'a>, most| {
            let chain = Chain::read(at).map_err(|fault| fault.within(what))?;
            Ok::<_, Box<Fault>>(chain.decode(bytes.bytes(), max_values(most)))
        };
        let offsets = decode(self.offset_chain, "offsetEncoding", self.offsets, bounds.texts)?;
        let offsets = offsets.and_then(all_ints).and_then(|offsets| self.byte_offsets(offsets));
        let offsets = offsets.map_err(|fault| fault.within("offsets"))?;
        let ids = decode(self.data_chain, "dataEncoding", data, bounds.rows)?;
        let ids = ids.and_then(|ids| ids.require_ints().map(|()| ids)).map_err(|fault| fault.within("data"))?;
        Ok((ids, Texts { joined: Cow::Borrowed(self.joined), offsets, ids: Vec::new(), are_written: false }))
    }

    /// Checks that the offsets are ascending, and converts them from UTF-16 code units, which the reference
    /// implementation writes, to bytes.
    fn byte_offsets(&self, offsets: Vec<i32>) -> Result<Vec<u32>, Box<Fault>> {
        let text = if self.joined.is_ascii() { None } else { std::str::from_utf8(self.joined).ok() };
        let mut characters = text.map(str::chars);
        let (mut units, mut bytes) = (0_usize, 0_usize);
        let mut byte_offset = |offset: i32| {
            let offset = usize::try_from(offset).ok()?;
            let Some(characters) = &mut characters else {
                bytes = offset;
                return (offset <= self.joined.len()).then_some(offset);
            };
            while units < offset {
                let next = characters.next()?;
                units += next.len_utf16();
                bytes += next.len_utf8();
            }
            (units == offset).then_some(bytes)
        };
        let mut last = 0;
        let mut out = Vec::with_capacity(offsets.len());
        for offset in offsets {
            let at = byte_offset(offset).filter(|_| offset >= last).and_then(|at| u32::try_from(at).ok());
            let Some(at) = at else {
                let expected = format!("one from {last} to the end of {} bytes", self.joined.len());
                return Err(Fault::new(format!("offset {offset}"), expected));
            };
            out.push(at);
            last = offset;
        }
        Ok(out)
    }
}

/// Decodes all values.
fn all_ints(mut values: ValueStream<'_>) -> Result<Vec<i32>, Box<Fault>> {
    values.require_ints()?;
    let mut all = Vec::new();
    values.ints(usize::MAX, &mut all)?;
    Ok(all)
}
