//! Columns of a category: values, and the rows without a value.

use std::borrow::Cow;

use super::super::text::decode;
use super::decode::Values;
use super::encoding::{Chain, Strings};
use super::fault::Fault;
use super::msgpack::{Cursor, PackToken};

/// An undecoded column.
#[derive(Debug, Clone, Copy)]
pub(super) struct Raw<'a> {
    pub(super) name: &'a [u8],
    data: Cursor<'a>,
    mask: Option<Cursor<'a>>,
}

/// Texts by row.
#[derive(Debug)]
pub(super) struct Texts<'a> {
    pub(super) joined: Cow<'a, [u8]>,
    /// Start of each text in `joined`, followed by the end of the last one.
    offsets: Vec<u32>,
    /// Text id by row; negative if there is none.
    ids: Vec<i32>,
}

impl Texts<'_> {
    /// Returns the range in `joined` of the text of a row.
    #[inline]
    pub(super) fn range(&self, row: usize) -> Option<(usize, usize)> {
        let id = usize::try_from(self.ids[row]).ok()?;
        Some((self.offsets[id] as usize, self.offsets[id + 1] as usize))
    }
}

/// Decoded values of a column.
#[derive(Debug)]
pub(super) enum Cells<'a> {
    Int(Vec<i32>),
    Real(Vec<f64>),
    Text(Texts<'a>),
}

/// A decoded column.
#[derive(Debug)]
pub(super) struct DecodedColumn<'a> {
    pub(super) cells: Cells<'a>,
    /// By row: true if there is no value.
    mask: Option<Vec<bool>>,
}

impl DecodedColumn<'_> {
    #[inline]
    pub(super) fn is_null(&self, row: usize) -> bool {
        self.mask.as_ref().is_some_and(|mask| mask[row])
    }

    /// Returns the text of a row, or `None` if it has none.
    pub(super) fn text(&self, row: usize) -> Option<&[u8]> {
        let Cells::Text(texts) = &self.cells else { return None };
        let (start, end) = texts.range(row).filter(|_| !self.is_null(row))?;
        Some(&texts.joined[start..end])
    }

    /// Returns the value of a row as text, which is empty if it has none. Numbers are written with all digits.
    pub(super) fn shown(&self, row: usize) -> Cow<'_, [u8]> {
        match &self.cells {
            _ if self.is_null(row) => Cow::Borrowed(b""),
            Cells::Int(values) => Cow::Owned(values[row].to_string().into_bytes()),
            Cells::Real(values) => Cow::Owned(values[row].to_string().into_bytes()),
            Cells::Text(_) => Cow::Borrowed(self.text(row).unwrap_or_default()),
        }
    }

    /// Returns true if some row has no value.
    pub(super) fn has_nulls(&self) -> bool {
        self.mask.is_some() || matches!(&self.cells, Cells::Text(texts) if texts.ids.iter().any(|&id| id < 0))
    }
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
        self.decode(bounds, texts).map_err(|fault| fault.within(decode(self.name)))
    }

    fn decode(&self, bounds: DecodeLimits, texts: bool) -> Result<DecodedColumn<'a>, Box<Fault>> {
        let mask = self.mask.map(|mask| nulls(mask, bounds.rows).map_err(|f| f.within("mask"))).transpose()?.flatten();
        let (data, chain) = encoded(self.data)?;
        if let Some(strings) = chain.strings() {
            let cells = Cells::Text(strings.read(data, bounds).map_err(|f| f.within("StringArray"))?);
            return Ok(DecodedColumn { cells, mask });
        }
        let values = chain.decode(data, max_values(bounds.rows))?;
        whole_column(values.len(), bounds.rows)?;
        let cells = match values {
            Values::Int(values) if texts => Cells::Text(written_out(&values)),
            Values::Int(values) => Cells::Int(values),
            Values::Real(_) if texts => return Err(Fault::new("real numbers", "texts")),
            Values::Real(values) => Cells::Real(values),
        };
        Ok(DecodedColumn { cells, mask })
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
fn encoded(at: Cursor<'_>) -> Result<(&[u8], Chain<'_>), Box<Fault>> {
    let data = at.required("data", Cursor::bytes)?;
    let chain = at.required("encoding", |value| Ok(*value))?;
    Ok((data, Chain::read(chain)?))
}

/// Decodes a mask of rows without a value: 1 is `.`, 2 is `?`. Returns `None` if all rows have a value.
fn nulls(mask: Cursor<'_>, rows: usize) -> Result<Option<Vec<bool>>, Box<Fault>> {
    let (data, chain) = encoded(mask)?;
    let values = chain.decode(data, max_values(rows))?.ints()?;
    whole_column(values.len(), rows)?;
    if let Some(odd) = values.iter().find(|value| !(0..=2).contains(*value)) {
        return Err(Fault::new(odd.to_string(), "0 (a value), 1 (.) or 2 (?)"));
    }
    let nulls: Vec<bool> = values.iter().map(|&value| value != 0).collect();
    Ok(nulls.contains(&true).then_some(nulls))
}

impl<'a> Strings<'a> {
    fn read(&self, data: &'a [u8], bounds: DecodeLimits) -> Result<Texts<'a>, Box<Fault>> {
        let chain = |at, what| Chain::read(at).map_err(|f: Box<Fault>| f.within(what));
        let offset_chain = chain(self.offset_chain, "offsetEncoding")?;
        let offsets = offset_chain.decode(self.offsets, max_values(bounds.texts)).and_then(Values::ints);
        let offsets = offsets.and_then(|o| self.byte_offsets(o)).map_err(|f| f.within("offsets"))?;
        let ids = chain(self.data_chain, "dataEncoding")?.decode(data, max_values(bounds.rows)).and_then(Values::ints);
        let ids = ids.map_err(|f| f.within("data"))?;
        whole_column(ids.len(), bounds.rows)?;
        let n = offsets.len().saturating_sub(1);
        if let Some(&odd) = ids.iter().find(|&&id| usize::try_from(id).map_or(id != -1, |id| id >= n)) {
            return Err(Fault::new(format!("text {odd}"), format!("-1 (none) or one of the {n} that are there")));
        }
        Ok(Texts { joined: Cow::Borrowed(self.joined), offsets, ids })
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

/// Converts integers to texts, one for each run of equal values.
fn written_out(values: &[i32]) -> Texts<'static> {
    let (mut joined, mut offsets, mut ids) = (Vec::new(), vec![0], Vec::with_capacity(values.len()));
    let mut id = -1;
    for (i, value) in values.iter().enumerate() {
        if i == 0 || values[i - 1] != *value {
            joined.extend_from_slice(itoa::Buffer::new().format(*value).as_bytes());
            offsets.push(u32::try_from(joined.len()).unwrap_or(u32::MAX));
            id += 1;
        }
        ids.push(id);
    }
    Texts { joined: Cow::Owned(joined), offsets, ids }
}
