//! Lines and fields separated by white space, as in PQR and XYZ files.

use std::ops::Range;

use super::atoms::{Atom, Columns, Structure, Tables};
use super::contents::Kind;
use super::error::StructureError;
use super::growing::GrowingColumns;
use super::number;
use super::read::{MAX_COORDINATE, Reading};
use super::source::SourceFields;
use super::text::Fault;

/// Maximum number of readable fields of a line. Lines of PQR have at most 11, those of extended XYZ about 30.
pub(super) const MAX_FIELDS: usize = 32;

/// Lines between two checks of the cancellation flag: a few milliseconds.
pub(super) const LINES_PER_CHECK: usize = 1 << 14;

/// All lines of a text as byte ranges, without line endings (LF, CR LF or CR).
#[derive(Debug)]
pub(super) struct TextLines<'a> {
    text: &'a [u8],
    at: usize,
}

impl<'a> TextLines<'a> {
    pub(super) fn new(text: &'a [u8]) -> Self {
        Self { text, at: 0 }
    }
}

impl Iterator for TextLines<'_> {
    type Item = Range<usize>;

    fn next(&mut self) -> Option<Range<usize>> {
        let rest = self.text.get(self.at..).filter(|rest| !rest.is_empty())?;
        let len = memchr::memchr2(b'\n', b'\r', rest).unwrap_or(rest.len());
        let start = self.at;
        let ending = if rest[len..].starts_with(b"\r\n") { 2 } else { 1 };
        self.at = start + len + ending;
        Some(start..start + len)
    }
}

/// Fields of a line.
#[derive(Debug)]
pub(super) struct Fields<'a> {
    text: &'a [u8],
    line: Range<usize>,
    /// Byte ranges of the first fields; empty and at the end of the line for missing fields.
    ranges: [(usize, usize); MAX_FIELDS],
    len: usize,
}

impl<'a> Fields<'a> {
    /// Splits a line of `text`.
    pub(super) fn split(text: &'a [u8], line: Range<usize>) -> Self {
        let mut fields = Self { text, ranges: [(line.end, line.end); MAX_FIELDS], len: 0, line };
        let mut at = fields.line.start;
        loop {
            while at < fields.line.end && text[at] <= b' ' {
                at += 1;
            }
            if at >= fields.line.end {
                return fields;
            }
            let start = at;
            while at < fields.line.end && text[at] > b' ' {
                at += 1;
            }
            if let Some(range) = fields.ranges.get_mut(fields.len) {
                *range = (start, at);
            }
            fields.len += 1;
        }
    }

    /// Returns the range of the line.
    pub(super) fn line(&self) -> Range<usize> {
        self.line.clone()
    }

    /// Returns the number of fields, including those beyond [`MAX_FIELDS`].
    pub(super) fn len(&self) -> usize {
        self.len
    }

    /// Returns the byte range of field `i`, which is empty if the line has fewer fields.
    pub(super) fn range(&self, i: usize) -> (usize, usize) {
        self.ranges.get(i).copied().unwrap_or((self.line.end, self.line.end))
    }

    /// Returns field `i`; empty if the line has fewer fields.
    pub(super) fn get(&self, i: usize) -> &'a [u8] {
        let (start, end) = self.range(i);
        &self.text[start..end]
    }

    /// Parses field `i` as a number.
    pub(super) fn real(&self, i: usize) -> Option<f64> {
        let (start, end) = self.range(i);
        if start == end { None } else { number::real(self.text, start, end) }
    }

    /// Parses a position in three fields, Å.
    pub(super) fn position(&self, first: usize) -> Result<[f64; 3], Box<Fault>> {
        let mut position = [0.0; 3];
        for (k, axis) in ["x", "y", "z"].into_iter().enumerate() {
            let value = self.real(first + k).filter(|value| value.abs() <= MAX_COORDINATE);
            position[k] = value.ok_or_else(|| {
                self.fault(first + k, format!("the {axis} coordinate in Å, within ±{MAX_COORDINATE}"))
            })?;
        }
        Ok(position)
    }

    /// Creates a fault about field `i`, or about the end of the line if there is no such field.
    #[cold]
    #[expect(clippy::unnecessary_box_returns, reason = "a boxed fault keeps results small")]
    pub(super) fn fault(&self, i: usize, expected: impl Into<String>) -> Box<Fault> {
        match self.range(i) {
            (start, end) if start == end => Fault::words(self.line.end, "the end of the line", expected),
            (start, end) => Fault::token(self.text, start, end, expected),
        }
    }
}

/// Atoms that are being read, with the limits of the read.
pub(super) struct Rows<'a> {
    reading: &'a Reading<'a>,
    columns: GrowingColumns,
    pub(super) tables: Tables,
    expected: usize,
    n_lines: usize,
}

impl<'a> Rows<'a> {
    /// Creates an empty list for about `expected` atoms.
    pub(super) fn new(reading: &'a Reading<'a>, expected: usize) -> Self {
        Self { reading, columns: GrowingColumns::default(), tables: Tables::default(), expected, n_lines: 0 }
    }

    /// Returns the columns of the atoms.
    pub(super) fn columns_mut(&mut self) -> &mut Columns {
        &mut self.columns.columns
    }

    /// Returns the number of atoms.
    pub(super) fn len(&self) -> usize {
        self.columns.columns.len()
    }

    /// Counts a line, and fails if the caller cancelled.
    pub(super) fn count_line(&mut self) -> Result<(), StructureError> {
        self.n_lines += 1;
        if self.n_lines.is_multiple_of(LINES_PER_CHECK) { self.reading.check() } else { Ok(()) }
    }

    /// Returns an atom of a polymer without residue and chain, with occupancy 1 and B-factor 0.
    pub(super) fn atom(&mut self, position: [f64; 3], element: u8, name: u32, model: i32) -> Atom {
        Atom {
            position,
            element,
            name,
            residue: self.tables.residue.intern(b"", 0, 0),
            chain: self.tables.chain.intern(b"", 0, 0),
            label_chain: 0,
            residue_number: 0,
            insertion_code: 0,
            altloc: 0,
            occupancy: 1.0,
            b_factor: 0.0,
            model,
            hetero: false,
            kind: Kind::Polymer,
        }
    }

    /// Adds an atom.
    ///
    /// # Errors
    /// Returns the errors of [`GrowingColumns::reserve_chunk`].
    pub(super) fn push(&mut self, atom: &Atom) -> Result<(), StructureError> {
        self.columns.reserve_chunk(&self.tables, self.reading, self.expected)?;
        self.columns.push(atom);
        Ok(())
    }

    /// Returns the finished structure.
    pub(super) fn finish(self, source: SourceFields) -> Result<Structure, StructureError> {
        self.columns.finish(self.tables, source, self.reading)
    }
}

#[cfg(test)]
#[allow(clippy::pedantic, clippy::unwrap_used, reason = "tests fail by panicking")]
mod tests {
    use super::*;

    #[test]
    fn lines_end_in_three_ways_and_blank_ones_count() {
        let text = b"a\n\nb\r\n\r\nc\rd";
        let lines: Vec<&[u8]> = TextLines::new(text).map(|line| &text[line]).collect();
        assert_eq!(lines, [&b"a"[..], b"", b"b", b"", b"c", b"d"]);
        assert_eq!(TextLines::new(b"").count(), 0);
    }

    #[test]
    fn fields_are_separated_by_any_white_space() {
        let text = b"x\n  C\t1.5  -2 \nx";
        let fields = Fields::split(text, 2..13);
        assert_eq!((fields.len(), fields.get(0), fields.get(2), fields.get(3)), (3, &b"C"[..], &b"-2"[..], &b""[..]));
        assert_eq!((fields.real(1), fields.real(0), fields.real(3)), (Some(1.5), None, None));
        let fault = fields.position(1).unwrap_err().locate(text).to_string();
        assert_eq!(
            fault,
            "line 2, column 12: found the end of the line, expected the z coordinate in Å, within ±100000"
        );
        let many = b"1 ".repeat(100);
        assert_eq!(Fields::split(&many, 0..many.len()).len(), 100);
    }
}
