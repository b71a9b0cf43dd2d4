//! The rows of the `atom_site` loop, as fast as memory allows and as slowly as the grammar needs.
//!
//! Almost every row is plain tokens between blanks. [`Edges`] finds these; rows that hold anything the grammar treats
//! specially (comments, text fields, quoted blanks, a possible end of the loop) go through the tokenizer one at a time.
//! Long loops of one line per row are read by several threads: each fills its own rows of the columns, and whenever
//! anything is out of the ordinary the whole stretch is read again in order, so results and errors are the same.

use std::sync::atomic::{AtomicBool, Ordering};

use rayon::prelude::*;

use super::super::atom_site::{AtomSite, Layout};
use super::super::atoms::{Atom, Columns, Slices, Tables};
use super::super::cif::{Kind, Tokenizer, bare_kind};
use super::super::scan::Edges;
use super::super::text::Fault;
use super::super::warnings::Warnings;
use super::Stop;
use super::row::Row;

/// Bytes scanned at a time: short after a special row, as what was scanned beyond it is scanned again.
const MIN_WINDOW: usize = 1 << 8;
const MAX_WINDOW: usize = 16 << 10;
/// A stretch worth sharing among threads, and the share of one.
const PARALLEL_BYTES: usize = 2 << 20;
const CHUNK_BYTES: usize = 512 << 10;

pub(super) struct Rows<'a> {
    text: &'a [u8],
    site: AtomSite<Box<Fault>>,
    columns: Columns,
    limit: usize,
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
        Self { text, site: AtomSite::new(layout), columns: Columns::default(), limit: max_rows }
    }

    pub(super) fn into_parts(self) -> (Columns, Tables, Warnings<Box<Fault>>) {
        (self.columns, self.site.tables, self.site.warnings)
    }

    /// Returns true if some row is a HETATM record.
    pub(super) fn has_hetero(&self) -> bool {
        self.columns.hetero.contains(&true)
    }

    /// Reads rows from the first value on; returns where the loop ends.
    pub(super) fn read(&mut self, first: usize) -> Result<usize, Stop> {
        let large = self.text.len() - first >= PARALLEL_BYTES && rayon::current_num_threads() > 1;
        let parallel = if large { self.read_parallel(first) } else { None };
        let mut at = parallel.unwrap_or_else(|| {
            self.columns.reserve(estimate(&self.text[first..]).min(self.limit));
            first
        });
        let mut scanner = Scanner::new(self.text);
        loop {
            let mut sink = Limited { columns: &mut self.columns, max_rows: self.limit };
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
            let (Ok(from), Ok(to)) = (u32::try_from(start - base), u32::try_from(end - base)) else {
                return Err(Fault::words(start, "a value", "a row of less than 4 GiB").into());
            };
            offsets.extend([from, to]);
        }
        let atom = self.site.atom(&Row::<true> { text: self.text, base, offsets: &offsets })?;
        let mut sink = Limited { columns: &mut self.columns, max_rows: self.limit };
        if sink.put(&atom) { Ok(()) } else { Err(Stop::TooMany) }
    }

    /// Reads rows from `first` on by several threads, and returns where they stop; `None`, with nothing changed, if what
    /// they read is not one plain row to a line.
    fn read_parallel(&mut self, first: usize) -> Option<usize> {
        let text = self.text;
        let stretches = stretches(text, first)?;
        let n_rows: usize = stretches.iter().map(|s| s.lines).sum();
        let end = stretches.last()?.to;
        if n_rows > self.limit {
            return None;
        }
        let mut columns = Columns::zeroed(n_rows);
        let mut rest = columns.slices();
        let mut parts = Vec::with_capacity(stretches.len());
        for stretch in stretches {
            let (slices, others) = rest.split(stretch.lines);
            parts.push((stretch, slices, AtomSite::new(self.site.layout)));
            rest = others;
        }
        let failed = AtomicBool::new(false);
        parts.par_iter_mut().for_each_init(
            || Scanner::new(text),
            |scanner, (stretch, slices, site)| {
                let done = scanner.rows(site, slices, stretch.from, stretch.to, &failed);
                let whole =
                    done.is_ok_and(|done| text[done..stretch.to].iter().all(|&b| b <= b' ')) && slices.is_full();
                if !whole {
                    failed.store(true, Ordering::Relaxed);
                }
            },
        );
        if failed.into_inner() {
            return None;
        }
        let (mut tables, mut warnings) = (Tables::default(), Warnings::default());
        for (_, mut slices, site) in parts {
            slices.adopt(&site.tables, &mut tables);
            warnings.append(site.warnings);
        }
        self.columns = columns;
        self.site.tables = tables;
        self.site.warnings = warnings;
        Some(end)
    }
}

/// About as many rows as lines: what three samples suggest, and a little more. Too many cost nothing, as memory that is
/// not touched is not there; too few make the columns grow.
fn estimate(rest: &[u8]) -> usize {
    const SAMPLE: usize = 64 << 10;
    if rest.len() <= 4 * SAMPLE {
        return memchr::memchr_iter(b'\n', rest).count() + 1;
    }
    let starts = [0, rest.len() / 2, rest.len() - SAMPLE];
    let lines: usize = starts.iter().map(|&s| memchr::memchr_iter(b'\n', &rest[s..s + SAMPLE]).count()).sum();
    (lines + 1) * (rest.len() / (3 * SAMPLE) + 1) / 16 * 17
}

/// Whole lines that one thread reads.
#[derive(Debug, Clone, Copy)]
struct Stretch {
    from: usize,
    to: usize,
    lines: usize,
}

/// Stretches from `first` on in which no row holds an underscore, and hence no tag and no reserved word, without the
/// comments and blank lines before that.
///
/// `None` where lines are as long as chunks.
fn stretches(text: &[u8], first: usize) -> Option<Vec<Stretch>> {
    let line_start = |at: usize| {
        if at == first || at >= text.len() {
            return Some(at.min(text.len()));
        }
        let near = &text[at..text.len().min(at + CHUNK_BYTES)];
        memchr::memchr(b'\n', near).map(|i| at + i + 1)
    };
    let starts: Vec<usize> = (first..text.len()).step_by(CHUNK_BYTES).collect();
    let found: Option<Vec<(Stretch, bool)>> = starts
        .par_iter()
        .map(|&start| {
            let from = line_start(start)?;
            let to = line_start(start + CHUNK_BYTES)?;
            let chunk = &text[from..to];
            let underscore = memchr::memchr(b'_', chunk);
            // The text may end in comments, or within its last line, which then is read in order.
            let until = underscore.or((to == text.len()).then_some(chunk.len()));
            let to = from + until.map_or(chunk.len(), |i| whole_rows(&chunk[..i]));
            let lines = memchr::memchr_iter(b'\n', &text[from..to]).count();
            Some((Stretch { from, to, lines }, underscore.is_some()))
        })
        .collect();
    let mut found = found?;
    if let Some(last) = found.iter().position(|(_, underscore)| *underscore) {
        found.truncate(last + 1);
    }
    Some(found.into_iter().map(|(stretch, _)| stretch).filter(|s| s.lines > 0).collect())
}

/// Length of `chunk`, which a tag or nothing follows, up to the end of the last line that is neither blank nor a comment.
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

/// Reads plain rows.
struct Scanner<'a> {
    text: &'a [u8],
    edges: Edges,
    window: usize,
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
        Self { text, edges: Edges::default(), window: MAX_WINDOW }
    }

    /// Reads rows from `at` to `end` into `sink`; returns the end of the last row before one that is not plain, not
    /// whole, or not there.
    fn rows(
        &mut self,
        site: &mut AtomSite<Box<Fault>>,
        sink: &mut impl Sink,
        mut at: usize,
        end: usize,
        stop: &AtomicBool,
    ) -> Result<usize, Stop> {
        let per_row = 2 * site.layout.width;
        let mut edges = std::mem::take(&mut self.edges);
        let result = loop {
            let to = at.saturating_add(self.window).min(end);
            let window = &self.text[at..to];
            // Tags and reserved words have an underscore; almost no row has one.
            let words = memchr::memchr(b'_', window).is_some();
            edges.scan(window, to == self.text.len());
            let mut done = at;
            let mut plain = true;
            for offsets in edges.offsets().chunks_exact(per_row) {
                let atom = match special(window, offsets) {
                    0 if !words => site.atom(&Row::<false> { text: self.text, base: at, offsets })?,
                    special if special < 2 && values_only(window, offsets, words) => {
                        site.atom(&Row::<true> { text: self.text, base: at, offsets })?
                    }
                    _ => {
                        plain = false;
                        break;
                    }
                };
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
}

/// What the first bytes of a row's tokens say, as in [`SPECIAL`].
#[inline]
fn special(window: &[u8], offsets: &[u32]) -> u8 {
    let (tokens, _) = offsets.as_chunks::<2>();
    tokens.iter().fold(0, |sum, token| sum | SPECIAL[usize::from(window[token[0] as usize])])
}

/// Whether every token of the row is one value by itself: quotes close where the token ends, and nothing is a tag or a
/// reserved word, which is looked for only if the window has `words`, that is, underscores.
fn values_only(window: &[u8], offsets: &[u32], words: bool) -> bool {
    offsets.as_chunks::<2>().0.iter().all(|token| {
        let token = &window[token[0] as usize..token[1] as usize];
        match token[0] {
            quote @ (b'\'' | b'"') => token.len() > 1 && token[token.len() - 1] == quote,
            _ => !words || bare_kind(token) == Kind::Value,
        }
    })
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "tests fail by panicking")]
mod tests {
    use super::*;

    const TAGS: &str = "_atom_site.Cartn_x _atom_site.Cartn_y _atom_site.Cartn_z _atom_site.auth_asym_id\n";

    fn layout(text: &str) -> Layout {
        let tags = text.lines().next().unwrap().split(' ').scan(0, |at, tag| {
            let start = *at;
            *at += tag.len() + 1;
            Some((start, start + tag.len()))
        });
        super::super::row::layout(text.as_bytes(), &tags.collect::<Vec<_>>()).unwrap()
    }

    /// How many rows several threads read of a text with these rows and this end, and where they stop.
    fn parallel(rows: &str, end: &str) -> Option<(usize, usize)> {
        let text = format!("{TAGS}{rows}{end}");
        let mut table = Rows::new(text.as_bytes(), layout(&text), usize::MAX);
        let stop = table.read_parallel(TAGS.len())?;
        Some((table.columns.len(), stop - TAGS.len()))
    }

    #[test]
    fn plain_rows_are_read_by_several_threads_whatever_follows() {
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
