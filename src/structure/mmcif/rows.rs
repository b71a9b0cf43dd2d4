//! The rows of the `atom_site` loop, as fast as memory allows and as slowly as the grammar needs.
//!
//! Almost every row is plain tokens between blanks. [`Edges`] finds these; rows that hold anything the grammar treats
//! specially (comments, text fields, quoted blanks, a possible end of the loop) go through the tokenizer one at a time.
//! Long loops of one line per row are read by several threads: each fills its own rows of the columns, and whenever
//! anything is out of the ordinary the whole stretch is read again in order, so results and errors are the same.

use std::sync::atomic::{AtomicBool, Ordering};

use rayon::prelude::*;

use super::super::atoms::{Atom, Columns, Slices, Tables};
use super::super::cif::{Kind, Tokenizer, bare_kind};
use super::super::scan::Edges;
use super::super::text::Fault;
use super::Stop;
use super::atom_site::{AtomSite, Layout, Row};

/// Bytes scanned at a time: short after a special row, as what was scanned beyond it is scanned again.
const MIN_WINDOW: usize = 1 << 10;
const MAX_WINDOW: usize = 16 << 10;
/// A stretch worth sharing among threads, and the share of one.
const PARALLEL_BYTES: usize = 2 << 20;
const CHUNK_BYTES: usize = 512 << 10;

pub(super) struct Rows<'a> {
    text: &'a [u8],
    site: AtomSite,
    columns: Columns,
    max_rows: usize,
}

/// Where atoms go; `false` if there is no room.
trait Sink {
    fn put(&mut self, atom: &Atom) -> bool;
}

struct Limited<'c> {
    columns: &'c mut Columns,
    max_rows: usize,
}

impl Sink for Limited<'_> {
    #[inline]
    fn put(&mut self, atom: &Atom) -> bool {
        if self.columns.len() >= self.max_rows {
            return false;
        }
        self.columns.push(atom);
        true
    }
}

impl Sink for Slices<'_> {
    #[inline]
    fn put(&mut self, atom: &Atom) -> bool {
        Slices::put(self, atom)
    }
}

impl<'a> Rows<'a> {
    pub(super) fn new(text: &'a [u8], layout: Layout, max_rows: usize) -> Self {
        Self { text, site: AtomSite::new(layout), columns: Columns::default(), max_rows }
    }

    pub(super) fn into_parts(self) -> (Columns, Tables) {
        (self.columns, self.site.tables)
    }

    /// Reads rows from the first value on; returns where the loop ends.
    pub(super) fn read(&mut self, first: usize) -> Result<usize, Stop> {
        let end = plain_stretch(self.text, first);
        let mut at = first;
        if end - first >= PARALLEL_BYTES && rayon::current_num_threads() > 1 && self.read_parallel(first, end) {
            at = end;
        } else {
            let lines = memchr::memchr_iter(b'\n', &self.text[first..end]).count();
            self.columns.reserve((lines + 1).min(self.max_rows));
        }
        let mut scanner = Scanner::new(self.text);
        loop {
            let mut sink = Limited { columns: &mut self.columns, max_rows: self.max_rows };
            at = scanner.rows(&mut self.site, &mut sink, at, self.text.len(), &AtomicBool::new(false))?;
            match self.special_row(at)? {
                Some(next) => at = next,
                None => return Ok(at),
            }
        }
    }

    /// Reads a row of values by the full grammar; `None` at the end of the loop.
    fn special_row(&mut self, at: usize) -> Result<Option<usize>, Stop> {
        let mut tokens = Tokenizer { text: self.text, at };
        let width = self.site.layout.width;
        let mut values = Vec::new();
        for i in 0..width {
            let token = tokens.next()?;
            if token.kind != Kind::Value {
                if i == 0 {
                    return Ok(None);
                }
                let expected = format!("value {} of the {width} in a row of atom_site", i + 1);
                return Err(match token.kind {
                    Kind::End => Fault::words(token.start, "the end of the file", expected).into(),
                    _ => Fault::token(self.text, token.start, token.end, expected).into(),
                });
            }
            values.push((token.start, token.end));
        }
        self.single(&values)?;
        Ok(Some(tokens.at))
    }

    /// One row whose values were found elsewhere.
    pub(super) fn single(&mut self, values: &[(usize, usize)]) -> Result<(), Stop> {
        let Some(&(base, _)) = values.first() else { return Ok(()) };
        let mut offsets = Vec::with_capacity(2 * values.len());
        for &(start, end) in values {
            let near = |at: usize| {
                u32::try_from(at - base).map_err(|_| Fault::words(at, "a value", "a row of less than 4 GiB"))
            };
            offsets.extend([near(start)?, near(end)?]);
        }
        let atom = self.site.atom(&Row { text: self.text, base, offsets: &offsets })?;
        let mut sink = Limited { columns: &mut self.columns, max_rows: self.max_rows };
        if sink.put(&atom) { Ok(()) } else { Err(Stop::TooMany) }
    }

    /// Reads `first..end` by several threads; `false`, with nothing changed, if that stretch is not one plain row to
    /// a line.
    fn read_parallel(&mut self, first: usize, end: usize) -> bool {
        let chunks = chunks(self.text, first, end);
        let text = self.text;
        let lines: Vec<usize> =
            chunks.par_iter().map(|&(from, to)| memchr::memchr_iter(b'\n', &text[from..to]).count()).collect();
        let n_rows: usize = lines.iter().sum();
        if n_rows > self.max_rows {
            return false;
        }
        let mut columns = Columns::zeroed(n_rows);
        let mut rest = columns.slices();
        let mut parts = Vec::with_capacity(chunks.len());
        for (&chunk, &n) in chunks.iter().zip(&lines) {
            let (slices, others) = rest.split(n);
            parts.push((chunk, slices, AtomSite::new(self.site.layout)));
            rest = others;
        }
        let failed = AtomicBool::new(false);
        parts.par_iter_mut().for_each(|((from, to), slices, site)| {
            let end = Scanner::new(text).rows(site, slices, *from, *to, &failed);
            let whole = end.is_ok_and(|end| text[end..*to].iter().all(|&b| b <= b' ')) && slices.is_full();
            if !whole {
                failed.store(true, Ordering::Relaxed);
            }
        });
        if failed.into_inner() {
            return false;
        }
        let mut tables = Tables::default();
        for (_, mut slices, site) in parts {
            slices.adopt(site.tables, &mut tables);
        }
        self.columns = columns;
        self.site.tables = tables;
        true
    }
}

/// The end of the stretch from `first` on in which no row holds an underscore, and hence no tag and no reserved word:
/// the line start before the next one, without the comments and blank lines before that.
fn plain_stretch(text: &[u8], first: usize) -> usize {
    let rest = &text[first..];
    let mut end = memchr::memchr(b'_', rest).unwrap_or(rest.len());
    loop {
        // Up to the start of the line.
        end = memchr::memrchr(b'\n', &rest[..end]).map_or(0, |i| i + 1);
        if end == 0 {
            return first;
        }
        let line = memchr::memrchr(b'\n', &rest[..end - 1]).map_or(0, |i| i + 1);
        if !matches!(rest[line..end].trim_ascii_start().first(), None | Some(b'#')) {
            return first + end;
        }
        end -= 1;
    }
}

/// Stretches of whole lines.
fn chunks(text: &[u8], first: usize, end: usize) -> Vec<(usize, usize)> {
    let mut chunks = Vec::new();
    let mut from = first;
    while from < end {
        let goal = (from + CHUNK_BYTES).min(end);
        let to = memchr::memchr(b'\n', &text[goal - 1..end]).map_or(end, |i| goal + i);
        chunks.push((from, to));
        from = to;
    }
    chunks
}

/// Reads plain rows.
struct Scanner<'a> {
    text: &'a [u8],
    edges: Edges,
    window: usize,
    /// The next underscore from the row at hand on.
    underscore: usize,
}

/// What the first byte of a token says: 1 for quotes, 2 for what the tokenizer has to look at.
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
        Self { text, edges: Edges::default(), window: MAX_WINDOW, underscore: 0 }
    }

    /// Reads rows from `at` to `end` into `sink`; returns the end of the last row before one that is not plain, not
    /// whole, or not there.
    fn rows(
        &mut self,
        site: &mut AtomSite,
        sink: &mut impl Sink,
        mut at: usize,
        end: usize,
        stop: &AtomicBool,
    ) -> Result<usize, Stop> {
        let per_row = 2 * site.layout.width;
        let mut edges = std::mem::take(&mut self.edges);
        let result = loop {
            let to = at.saturating_add(self.window).min(end);
            edges.scan(&self.text[at..to], to == self.text.len());
            let mut done = at;
            let mut plain = true;
            for offsets in edges.offsets().chunks_exact(per_row) {
                let row = Row { text: self.text, base: at, offsets };
                if !self.is_plain(&row) {
                    plain = false;
                    break;
                }
                let atom = site.atom(&row)?;
                if !sink.put(&atom) {
                    return Err(Stop::TooMany);
                }
                done = at + offsets[per_row - 1] as usize;
            }
            if !plain {
                self.window = MIN_WINDOW;
                break done;
            }
            if to == end || (done == at && self.window == MAX_WINDOW) || stop.load(Ordering::Relaxed) {
                break done;
            }
            self.window = (2 * self.window).min(MAX_WINDOW);
            at = done;
        };
        self.edges = edges;
        Ok(result)
    }

    /// Whether each token of the row is one value by itself.
    #[inline]
    fn is_plain(&mut self, row: &Row<'_>) -> bool {
        let base = row.base;
        let (starts, _) = row.offsets.as_chunks::<2>();
        let special = starts.iter().fold(0, |sum, edge| sum | SPECIAL[usize::from(self.text[base + edge[0] as usize])]);
        if special != 0 && !self.quotes_match(row) {
            return false;
        }
        let end = base + row.offsets[row.offsets.len() - 1] as usize;
        self.underscore >= end || self.no_words(row, end)
    }

    fn quotes_match(&self, row: &Row<'_>) -> bool {
        row.offsets.as_chunks::<2>().0.iter().all(|edge| {
            let token = &self.text[row.base + edge[0] as usize..row.base + edge[1] as usize];
            match token[0] {
                quote @ (b'\'' | b'"') => token.len() > 1 && token[token.len() - 1] == quote,
                b'#' | b';' => false,
                _ => true,
            }
        })
    }

    /// Whether a row without special characters, but with underscores, has no tag and no reserved word.
    fn no_words(&mut self, row: &Row<'_>, end: usize) -> bool {
        let from = row.base + row.offsets[0] as usize;
        if self.underscore < from {
            let rest = &self.text[from..];
            self.underscore = from + memchr::memchr(b'_', rest).unwrap_or(rest.len());
            if self.underscore >= end {
                return true;
            }
        }
        row.offsets
            .as_chunks::<2>()
            .0
            .iter()
            .all(|edge| bare_kind(&self.text[row.base + edge[0] as usize..row.base + edge[1] as usize]) == Kind::Value)
    }
}
