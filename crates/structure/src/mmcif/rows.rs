//! Reader of the rows of the `atom_site` loop: a fast path for plain rows, and the full grammar for all others.
//!
//! Almost all rows are plain tokens separated by blanks, which [`Edges`] finds. Rows with comments, text fields, quoted
//! blanks or a possible end of the loop go through the tokenizer one at a time. A loop with one line per row is read in
//! pieces, each into its own rows of the columns. If a piece holds anything else, the whole loop is read again in
//! order, so that results and errors are the same.

use std::sync::atomic::{AtomicBool, Ordering};

use super::super::atom_layout::Layout;
use super::super::atom_site::{self, AtomSite};
use super::super::atoms::{Atom, Columns, Tables};
use super::super::cif::{TokenKind, Tokenizer, bare_kind};
use super::super::error::StructureError;
use super::super::growing::GrowingColumns;
use super::super::pieces;
use super::super::read::Reading;
use super::super::scan::Edges;
use super::super::text::Fault;
use super::super::warnings::Warnings;
use super::StopReason;
use super::row::TextRow;

/// Bytes scanned at a time. The window is short after a special row, because the bytes after it are scanned again.
const MIN_WINDOW: usize = 1 << 8;
const MAX_WINDOW: usize = 16 << 10;
/// Bytes between two charges of the memory of texts.
const BYTES_PER_CHARGE: usize = 1 << 20;

/// Reader of the rows of an `atom_site` loop, with the atoms read so far.
pub(super) struct TableRows<'a> {
    text: &'a [u8],
    site: AtomSite<Box<Fault>>,
    columns: GrowingColumns,
    reading: &'a Reading<'a>,
    /// Number of rows that the text holds, if each has a line.
    expected: usize,
}

impl<'a> TableRows<'a> {
    pub(super) fn new(text: &'a [u8], layout: Layout, reading: &'a Reading<'a>) -> Self {
        let (site, columns) = (AtomSite::new(layout), GrowingColumns::default());
        Self { text, site, columns, reading, expected: 1 }
    }

    /// Returns the columns of the atoms, the tables of texts, and the warnings.
    pub(super) fn into_parts(self) -> (Columns, Tables, Warnings<Box<Fault>>) {
        (self.columns.columns, self.site.tables, self.site.warnings)
    }

    /// Reads all rows, from the first value at offset `first` on. Returns the offset of the end of the loop.
    pub(super) fn read(&mut self, first: usize) -> Result<usize, StopReason> {
        let mut at = if let Some(end) = self.read_plain(first)? {
            end
        } else {
            // The system allocates memory only when it is first written to.
            self.expected = memchr::memchr_iter(b'\n', &self.text[first..]).count() + 1;
            first
        };
        let mut scanner = Scanner::new(self.text);
        loop {
            self.reading.check()?;
            let (columns, reading) = (&mut self.columns, self.reading);
            let (space, put) = (columns.space(), |atom: &Atom| columns.push(atom));
            at = scanner.rows(&mut self.site, space, put, at, self.text.len(), &|| reading.check().is_err())?;
            match self.special_row(at)? {
                Some(next) => at = next,
                None => return Ok(at),
            }
        }
    }

    /// Reads a row by the full grammar. Returns `None` at the end of the loop.
    fn special_row(&mut self, at: usize) -> Result<Option<usize>, StopReason> {
        let mut tokens = Tokenizer { text: self.text, at };
        let width = self.site.layout.width;
        let mut values = Vec::new();
        for i in 0..width {
            let token = tokens.next()?;
            if token.kind != TokenKind::Value {
                if i == 0 {
                    return Ok(None);
                }
                let expected = format!("value {} of the {width} in a row of atom_site", i + 1);
                return Err(token.fault(self.text, expected).into());
            }
            values.push((token.start, token.end));
        }
        self.single(&values)?;
        Ok(Some(tokens.at))
    }

    /// Reads one row, given by the ranges of its values in the text.
    pub(super) fn single(&mut self, values: &[(usize, usize)]) -> Result<(), StopReason> {
        let Some(&(base, _)) = values.first() else { return Ok(()) };
        let mut offsets = Vec::with_capacity(2 * values.len());
        for &(start, end) in values {
            let (Ok(from), Ok(to)) = (u32::try_from(start - base), u32::try_from(end - base)) else {
                return Err(Fault::words(start, "a value", "a row of less than 4 GiB").into());
            };
            offsets.extend([from, to]);
        }
        let atom = self.site.atom(&TextRow::<true> { text: self.text, base, offsets: &offsets })?;
        self.columns.reserve_chunk(&self.site.tables, self.reading, self.expected)?;
        self.columns.push(&atom);
        Ok(())
    }

    /// Reads rows from `first` on in pieces, and returns the end of what it read. Returns `None`, and changes nothing,
    /// if the text does not have one plain row per line.
    ///
    /// # Errors
    /// Returns the errors of cancellation and memory.
    fn read_plain(&mut self, first: usize) -> Result<Option<usize>, StructureError> {
        let (text, reading) = (self.text, self.reading);
        let stretches = stretches(text, first, reading.n_pieces(text.len() - first));
        let n_rows: usize = stretches.iter().map(|s| s.lines).sum();
        let Some(end) = stretches.last().map(|last| last.to) else { return Ok(None) };
        if n_rows > reading.limits.max_rows() {
            return Ok(None);
        }
        let memory = reading.reserve(Columns::bytes(n_rows))?;
        let mut columns = Columns::zeroed(n_rows);
        let mut rest = columns.slices();
        let mut parts = Vec::with_capacity(stretches.len());
        for stretch in stretches {
            let (slices, others) = rest.split(stretch.lines);
            parts.push((stretch, (slices, AtomSite::new(self.site.layout))));
            rest = others;
        }
        let failed = AtomicBool::new(false);
        let read = pieces::map(&mut parts, |(stretch, (slices, site))| {
            let stop = || failed.load(Ordering::Relaxed) || reading.check().is_err();
            let (mut scanner, mut at, mut text_bytes) = (Scanner::new(text), stretch.from, 0);
            let mut whole = false;
            while !stop() {
                let to = stretch.to.min(at + BYTES_PER_CHARGE);
                let space = slices.space();
                let done = scanner.rows(site, space, |atom| _ = slices.put(atom), at, to, &stop).unwrap_or(at);
                reading.hold_texts(site.tables.bytes() - text_bytes)?;
                text_bytes = site.tables.bytes();
                if to == stretch.to || done == at {
                    whole = slices.space() == 0 && text[done..stretch.to].iter().all(|&b| b <= b' ');
                    break;
                }
                at = done;
            }
            failed.fetch_or(!whole, Ordering::Relaxed);
            Ok(())
        });
        reading.check()?;
        read.into_iter().collect::<Result<(), StructureError>>()?;
        if failed.into_inner() {
            return Ok(None);
        }
        (self.site.tables, self.site.warnings) = atom_site::join(parts.into_iter().map(|(_, part)| part).collect());
        reading.keep(self.site.tables.bytes())?;
        memory.keep();
        self.columns = GrowingColumns::filled(columns, &self.site.tables);
        Ok(Some(end))
    }
}

/// Whole lines of a piece.
#[derive(Debug, Clone, Copy)]
struct Stretch {
    from: usize,
    to: usize,
    lines: usize,
}

/// Divides the text from `first` on into at most `n` stretches, up to the first underscore. Rows without underscores
/// contain neither tags nor reserved words. Leaves out comments and blank lines before the end.
fn stretches(text: &[u8], first: usize, n: usize) -> Vec<Stretch> {
    let mut found = pieces::map(&mut pieces::cut(text, first, n), |piece| {
        let chunk = &text[piece.clone()];
        let underscore = memchr::memchr(b'_', chunk);
        // The text may end with comments or within its last line, which the general path reads.
        let until = underscore.or((piece.end == text.len()).then_some(chunk.len()));
        let to = piece.start + until.map_or(chunk.len(), |i| whole_rows(&chunk[..i]));
        let lines = memchr::memchr_iter(b'\n', &text[piece.start..to]).count();
        (Stretch { from: piece.start, to, lines }, underscore.is_some())
    });
    if let Some(last) = found.iter().position(|(_, underscore)| *underscore) {
        found.truncate(last + 1);
    }
    found.into_iter().map(|(stretch, _)| stretch).filter(|s| s.lines > 0).collect()
}

/// Returns the length of `chunk` up to the end of its last row. A tag or the end of the text must follow `chunk`.
fn whole_rows(chunk: &[u8]) -> usize {
    let mut end = memchr::memrchr(b'\n', chunk).map_or(0, |i| i + 1);
    while end > 0 {
        let line = memchr::memrchr(b'\n', &chunk[..end - 1]).map_or(0, |i| i + 1);
        if !matches!(chunk[line..end].trim_ascii_start().first(), None | Some(b'#')) {
            break;
        }
        end = line;
    }
    end
}

/// Reader of plain rows.
struct Scanner<'a> {
    text: &'a [u8],
    edges: Edges,
    window: usize,
}

/// Classes of first bytes of tokens: 1 for quotes, 2 for tokens that need the tokenizer.
const SPECIAL: [u8; 256] = {
    let mut table = [0; 256];
    table[b'\'' as usize] = 1;
    table[b'"' as usize] = 1;
    table[b'#' as usize] = 2;
    table[b';' as usize] = 2;
    table
};

impl<'a> Scanner<'a> {
    fn new(text: &'a [u8]) -> Self {
        Self { text, edges: Edges::default(), window: MAX_WINDOW }
    }

    /// Reads at most `space` rows from `at` to `end` and calls `put` with each. Stops before the first row that is
    /// incomplete or not plain, and returns the end of the row before it.
    fn rows(
        &mut self,
        site: &mut AtomSite<Box<Fault>>,
        mut space: usize,
        mut put: impl FnMut(&Atom),
        mut at: usize,
        end: usize,
        stop: &dyn Fn() -> bool,
    ) -> Result<usize, StopReason> {
        let per_row = 2 * site.layout.width;
        let mut edges = std::mem::take(&mut self.edges);
        let result = loop {
            let to = at.saturating_add(self.window).min(end);
            let window = &self.text[at..to];
            // Tags and reserved words contain an underscore; almost no row does.
            let words = memchr::memchr(b'_', window).is_some();
            edges.scan(window, to == self.text.len());
            let mut done = at;
            let mut plain = true;
            for offsets in edges.offsets().chunks_exact(per_row) {
                // Checked before the row is read: a row that is read twice warns twice.
                if space == 0 {
                    plain = false;
                    break;
                }
                let atom = match special(window, offsets) {
                    0 if !words => site.atom(&TextRow::<false> { text: self.text, base: at, offsets })?,
                    special if special < 2 && values_only(window, offsets, words) => {
                        site.atom(&TextRow::<true> { text: self.text, base: at, offsets })?
                    }
                    _ => {
                        plain = false;
                        break;
                    }
                };
                put(&atom);
                space -= 1;
                done = at + offsets[per_row - 1] as usize;
            }
            if !plain {
                self.window = MIN_WINDOW;
                break done;
            }
            if to == end || (done == at && self.window == MAX_WINDOW) || stop() {
                break done;
            }
            self.window = (2 * self.window).min(MAX_WINDOW);
            at = done;
        };
        self.edges = edges;
        Ok(result)
    }
}

/// Returns the combined classes, as in [`SPECIAL`], of the tokens of a row.
#[inline]
fn special(window: &[u8], offsets: &[u32]) -> u8 {
    let (tokens, _) = offsets.as_chunks::<2>();
    tokens.iter().fold(0, |sum, token| sum | SPECIAL[usize::from(window[token[0] as usize])])
}

/// Returns true if every token of the row is a complete value: quotes close at the end of the token, and no token is a
/// tag or a reserved word. The latter is checked only if the window contains underscores (`words`).
fn values_only(window: &[u8], offsets: &[u32], words: bool) -> bool {
    offsets.as_chunks::<2>().0.iter().all(|token| {
        let token = &window[token[0] as usize..token[1] as usize];
        match token[0] {
            quote @ (b'\'' | b'"') => token.len() > 1 && token[token.len() - 1] == quote,
            _ => !words || bare_kind(token) == TokenKind::Value,
        }
    })
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "tests fail by panicking")]
mod tests {
    use molmesh_surface::Control;

    use super::*;
    use crate::ReadLimits;

    const TAGS: &str = "_atom_site.Cartn_x _atom_site.Cartn_y _atom_site.Cartn_z _atom_site.auth_asym_id\n";

    fn layout(text: &str) -> Layout {
        let tags = text.lines().next().unwrap().split(' ').scan(0, |at, tag| {
            let start = *at;
            *at += tag.len() + 1;
            Some((start, start + tag.len()))
        });
        super::super::row::layout(text.as_bytes(), &tags.collect::<Vec<_>>()).unwrap()
    }

    /// Returns the number of rows that several threads read of a text with this ending, and where they stop.
    fn parallel(rows: &str, end: &str) -> Option<(usize, usize)> {
        let text = format!("{TAGS}{rows}{end}");
        // All rows are equal.
        let limits = ReadLimits { max_duplicates: u64::MAX, ..ReadLimits::default() };
        let control = Control::default();
        let reading = Reading::new(&limits, &control);
        let mut table = TableRows::new(text.as_bytes(), layout(&text), &reading);
        let stop = table.read_plain(TAGS.len()).unwrap()?;
        Some((table.columns.columns.len(), stop - TAGS.len()))
    }

    #[test]
    fn plain_rows_are_read_by_several_threads_with_any_rest() {
        const N: usize = 200_000;
        let rows = "1.0 2.0 3.0 A\n".repeat(N);
        for end in ["", "#\n", "#\nloop_\n_x.y\n1\n", "\n# comment\n\n_x.y 1\n", "4 5 6 B", "4 5 6 'B", "data_y\n"] {
            assert_eq!(parallel(&rows, end), Some((N, rows.len())), "{end}");
        }
        for special in ["4 5 6 'a b'\n", "# comment\n", "\n", "4 5\n6 B\n", ";text\n;\n5 6 7\n", "oops 5 6 B\n"] {
            assert_eq!(parallel(&format!("{rows}{special}{rows}"), ""), None, "{special}");
        }
    }
}
