//! Reader of PDBx/mmCIF: the `atom_site` category of the first data block that has one, entry id, title, entities,
//! assemblies, secondary structure and confidences.
//!
//! Dictionary: PDBx/mmCIF, category `atom_site`. Author names and numbers (`auth_*`) take precedence. The identifiers
//! of the dictionary (`label_*`) are the fallback.

mod row;
mod rows;
mod tags;

use self::rows::TableRows;
use self::tags::has_unread;
pub(super) use self::tags::{is_of_atoms, is_of_spheres};
use super::assembly::Assemblies;
use super::atom_layout::Layout;
use super::atoms::Structure;
use super::categories::Categories;
use super::cif::{self, Token, TokenKind, Tokenizer};
use super::data_blocks::{Passed, UnreadAtoms};
use super::error::StructureError;
use super::kinds::Sequence;
use super::pdb::MAX_TITLE;
use super::read::Reading;
use super::source::{SourceFields, SourceFormat};
use super::text::{Fault, decode, normalize};

/// Values between two checks of the cancellation flag: a few milliseconds.
const VALUES_PER_CHECK: usize = 1 << 16;

/// Reason to stop reading rows.
#[derive(Debug)]
enum StopReason {
    /// Syntax error.
    Fault(Box<Fault>),
    /// Error without a position in the text.
    Error(Box<StructureError>),
}

impl From<StructureError> for StopReason {
    fn from(error: StructureError) -> Self {
        Self::Error(Box::new(error))
    }
}

impl From<Box<Fault>> for StopReason {
    fn from(fault: Box<Fault>) -> Self {
        Self::Fault(fault)
    }
}

pub(super) fn read(text: &[u8], reading: &Reading<'_>) -> Result<Structure, StructureError> {
    let mut reader = Reader::new(text, reading);
    match reader.run() {
        Ok(()) => reader.finish(),
        Err(StopReason::Fault(fault)) => Err(fault.locate(text)),
        Err(StopReason::Error(error)) => Err(*error),
    }
}

/// Reads the assemblies of the last data block of a text, up to the first syntax error.
///
/// # Errors
/// Returns the errors of memory and cancellation.
pub(super) fn assemblies(text: &[u8], reading: &Reading<'_>) -> Result<Assemblies, StructureError> {
    let mut reader = Reader::new(text, reading);
    match reader.run() {
        Err(StopReason::Error(error)) => Err(*error),
        _ => Ok(reader.block.categories.assemblies()),
    }
}

/// Returns the offset of the first value of the `atom_site` loop that [`read`] reads. Returns `None` if the text has no
/// such loop, or ends before it.
pub(super) fn first_row(text: &[u8]) -> Option<usize> {
    let (mut tokens, mut tags, mut in_loop, mut in_frame) = (Tokenizer::new(text), Vec::new(), false, false);
    loop {
        let token = tokens.next().ok()?;
        match token.kind {
            TokenKind::End => return None,
            TokenKind::Loop => {
                tags.clear();
                in_loop = true;
                continue;
            }
            TokenKind::Tag if in_loop => {
                tags.push((token.start, token.end));
                continue;
            }
            // One atom.
            TokenKind::Tag if !in_frame && row::has_prefix(&text[token.start..token.end]) => return None,
            TokenKind::Value if in_loop && !in_frame => {
                let of_atoms = tags.first().is_some_and(|&(start, end)| row::has_prefix(&text[start..end]));
                if of_atoms && row::layout(text, &tags).ok()?.missing().is_none() {
                    return Some(token.start);
                }
            }
            TokenKind::Save => in_frame = token.end - token.start > b"save_".len(),
            _ => {}
        }
        in_loop = false;
    }
}

/// Values of a data block that have been read so far.
#[derive(Debug, Default)]
struct TextBlock {
    name: Option<String>,
    entry: Option<String>,
    title: Option<String>,
    categories: Categories,
    in_frame: bool,
    /// True if the block has a category of the dictionary of predicted models.
    predicted: bool,
    /// Tags and values of an `atom_site` without a loop, as in files with one atom: byte ranges.
    tags: Vec<(usize, usize)>,
    values: Vec<(usize, usize)>,
}

struct Reader<'a> {
    text: &'a [u8],
    tokens: Tokenizer<'a>,
    reading: &'a Reading<'a>,
    block: TextBlock,
    rows: Option<TableRows<'a>>,
    /// True in the data blocks after the one with the atoms.
    is_past: bool,
    /// Atoms that are not read.
    unread: UnreadAtoms,
    /// Name and number of atoms of a data block that is not read.
    unread_block: (Option<String>, u64),
    passed: Passed,
}

impl<'a> Reader<'a> {
    fn new(text: &'a [u8], reading: &'a Reading<'a>) -> Self {
        let (tokens, block, passed) = (Tokenizer::new(text), TextBlock::default(), Passed::default());
        let (unread, unread_block) = (UnreadAtoms::default(), (None, 0));
        Self { text, tokens, reading, block, rows: None, is_past: false, unread, unread_block, passed }
    }

    fn run(&mut self) -> Result<(), StopReason> {
        let mut token = self.tokens.next()?;
        loop {
            self.reading.check()?;
            match token.kind {
                TokenKind::End | TokenKind::Data => {
                    self.end_block()?;
                    if self.rows.is_some() {
                        return self.rest_of_file(token);
                    }
                    if token.kind == TokenKind::End {
                        return Ok(());
                    }
                    self.begin_block(&token);
                }
                TokenKind::Save => self.block.in_frame = token.end - token.start > b"save_".len(),
                TokenKind::Reserved => {}
                TokenKind::Tag => self.item(&token)?,
                TokenKind::Loop => {
                    token = self.category()?;
                    if self.rows.is_some() {
                        return self.rest_of_file(token);
                    }
                    continue;
                }
                TokenKind::Value => {
                    let expected = "a data block, loop_, or a tag that begins with _";
                    return Err(token.fault(self.text, expected).into());
                }
            }
            token = self.tokens.next()?;
        }
    }

    fn begin_block(&mut self, token: &Token) {
        let name = &self.text[token.start + b"data_".len()..token.end];
        self.block = TextBlock { name: normalize(name, 80), ..TextBlock::default() };
        self.passed.block();
        self.unread = UnreadAtoms::default();
    }

    /// Reads a tag and its value.
    fn item(&mut self, tag: &Token) -> Result<(), StopReason> {
        let value = self.tokens.next()?;
        if value.kind != TokenKind::Value {
            let expected = format!("a value of {}", decode(&self.text[tag.start..tag.end.min(tag.start + 80)]));
            return Err(value.fault(self.text, expected).into());
        }
        self.note_category(tag);
        let name = &self.text[tag.start..tag.end];
        if self.is_past {
            // One atom.
            let is_atom = !self.block.in_frame && name.eq_ignore_ascii_case(b"_atom_site.Cartn_x");
            self.unread_block.1 += u64::from(is_atom);
        } else if !self.block.in_frame && row::has_prefix(name) {
            self.block.tags.push((tag.start, tag.end));
            self.block.values.push((value.start, value.end));
        } else {
            self.note_value(name, &value);
            if let Some(item_ix) = self.described_item(tag) {
                self.describe(item_ix, &value)?;
            }
        }
        Ok(())
    }

    /// Returns the index of an item that describes entities or assemblies.
    fn described_item(&self, tag: &Token) -> Option<usize> {
        if self.block.in_frame || self.is_past {
            return None;
        }
        Categories::find(&self.text[tag.start + 1..tag.end])
    }

    /// Stores a value that describes entities or assemblies.
    fn describe(&mut self, item_ix: usize, value: &Token) -> Result<(), StructureError> {
        let (start, end, _) = cif::unquote(self.text, value.start, value.end);
        self.block.categories.add(item_ix, &self.text[start..end], self.reading)
    }

    /// Stores the id or title of the entry.
    fn note_value(&mut self, tag: &[u8], value: &Token) {
        let is_id = tag.eq_ignore_ascii_case(b"_entry.id");
        if self.block.in_frame || self.is_past || !(is_id || tag.eq_ignore_ascii_case(b"_struct.title")) {
            return;
        }
        let (start, end, quoted) = cif::unquote(self.text, value.start, value.end);
        let raw = &self.text[start..end];
        if !quoted && matches!(raw, b"?" | b".") {
            return;
        }
        let (target, max) = if is_id { (&mut self.block.entry, 80) } else { (&mut self.block.title, MAX_TITLE) };
        if target.is_none() {
            *target = normalize(raw, max);
        }
    }

    /// Reads a loop: tags, then rows. Returns the token after it.
    fn category(&mut self) -> Result<Token, StopReason> {
        let mut tags: Vec<Token> = Vec::new();
        let mut token = self.tokens.next()?;
        while token.kind == TokenKind::Tag {
            tags.push(token);
            token = self.tokens.next()?;
        }
        let Some(first) = tags.first() else {
            return Err(token.fault(self.text, "a tag after loop_").into());
        };
        self.note_category(first);
        let has_tag = |name: &[u8]| tags.iter().any(|tag| self.text[tag.start..tag.end].eq_ignore_ascii_case(name));
        self.passed.has_fractions |= has_tag(b"_atom_site_fract_x") && !has_tag(b"_atom_site_Cartn_x");
        let is_atom_site = !self.block.in_frame && row::has_prefix(&self.text[first.start..first.end]);
        if is_atom_site && self.rows.is_none() && token.kind == TokenKind::Value {
            let ranges: Vec<_> = tags.iter().map(|t| (t.start, t.end)).collect();
            if let Some(layout) = self.layout(&ranges)? {
                let mut rows = TableRows::new(self.text, layout, self.reading);
                self.tokens.at = rows.read(token.start)?;
                self.rows = Some(rows);
                return Ok(self.tokens.next()?);
            }
        }
        let items: Vec<Option<usize>> = tags.iter().map(|tag| self.described_item(tag)).collect();
        let describes = items.iter().any(Option::is_some);
        let mut i = 0;
        while token.kind == TokenKind::Value {
            // Uses the first row of a loop over entries or titles.
            if let Some(tag) = tags.get(i) {
                self.note_value(&self.text[tag.start..tag.end], &token);
            }
            if describes && let Some(item_ix) = items[i % items.len()] {
                self.describe(item_ix, &token)?;
            }
            i += 1;
            self.reading.check_every(i, VALUES_PER_CHECK)?;
            token = self.tokens.next()?;
        }
        self.count_unread(&tags, (i / tags.len()) as u64);
        Ok(token)
    }

    /// Counts the rows of a loop with atoms or spheres that are not read.
    fn count_unread(&mut self, tags: &[Token], n_rows: u64) {
        let tag = |token: &Token| &self.text[token.start..token.end];
        let Some(first) = tags.first().map(tag).filter(|_| !self.block.in_frame) else { return };
        if !self.is_past && is_of_spheres(&first[1..]) {
            self.unread.counts.spheres += n_rows;
        } else if self.is_past && row::has_prefix(first) {
            let ranges: Vec<_> = tags.iter().map(|t| (t.start, t.end)).collect();
            let has_coordinates = row::layout(self.text, &ranges).is_ok_and(|layout| layout.missing().is_none());
            self.unread_block.1 += if has_coordinates { n_rows } else { 0 };
        }
    }

    /// Returns the columns of `atom_site`, or `None` if it has no coordinates.
    fn layout(&mut self, tags: &[(usize, usize)]) -> Result<Option<Layout>, StopReason> {
        let layout = row::layout(self.text, tags)?;
        if let Some(missing) = layout.missing() {
            self.passed.lacking(missing);
            return Ok(None);
        }
        Ok(Some(layout))
    }

    /// Ends a data block. An `atom_site` without a loop is one row.
    fn end_block(&mut self) -> Result<(), StopReason> {
        let (tags, values) = (std::mem::take(&mut self.block.tags), std::mem::take(&mut self.block.values));
        if self.rows.is_some() || tags.is_empty() {
            return Ok(());
        }
        if let Some(layout) = self.layout(&tags)? {
            let mut rows = TableRows::new(self.text, layout, self.reading);
            rows.single(&values)?;
            self.rows = Some(rows);
        }
        Ok(())
    }

    /// Reads the title, the assemblies, the helices and strands, the confidences of a predicted model and the entities
    /// after the atoms, and counts the atoms of other data blocks. Ignores syntax errors, because the atoms are
    /// complete.
    fn rest_of_file(&mut self, mut token: Token) -> Result<(), StopReason> {
        let has_unread = has_unread(&self.text[token.start..]);
        let is_wanted = |reader: &Self| {
            let known = &reader.block.categories;
            !reader.is_past
                && (reader.block.title.is_none()
                    || !known.assemblies_are_known()
                    || !known.secondary_is_known()
                    || !known.entities_are_known()
                    || (reader.block.predicted && !known.confidences_are_known()))
        };
        while token.kind != TokenKind::End && (has_unread || is_wanted(self)) {
            self.reading.check()?;
            if token.kind == TokenKind::Data {
                self.end_unread_block();
                self.is_past = true;
                self.block.in_frame = false;
                self.unread_block.0 = normalize(&self.text[token.start + b"data_".len()..token.end], 80);
            }
            let next = match token.kind {
                TokenKind::Tag => self.item(&token).and_then(|()| Ok(self.tokens.next()?)),
                TokenKind::Loop => self.category(),
                TokenKind::Save => {
                    self.block.in_frame = token.end - token.start > b"save_".len();
                    self.tokens.next().map_err(StopReason::from)
                }
                _ => self.tokens.next().map_err(StopReason::from),
            };
            match next {
                Ok(next) => token = next,
                Err(StopReason::Fault(_)) => break,
                Err(error) => return Err(error),
            }
        }
        self.end_unread_block();
        Ok(())
    }

    /// Ends a data block that is not read.
    fn end_unread_block(&mut self) {
        let (name, atoms) = std::mem::take(&mut self.unread_block);
        self.unread.add_block(name.as_deref(), atoms);
    }

    fn note_category(&mut self, tag: &Token) {
        self.block.predicted |= self.text[tag.start..tag.end].starts_with(b"_ma_");
        if self.passed.is_full() {
            return;
        }
        let name = &self.text[tag.start + 1..tag.end.min(tag.start + 80)];
        self.passed.category(decode(name.split(|&b| b == b'.').next().unwrap_or(name)));
    }

    fn finish(self) -> Result<Structure, StructureError> {
        let (columns, tables, warnings) = self.rows.map(TableRows::into_parts).unwrap_or_default();
        if columns.len() == 0 {
            return Err(self.passed.no_atoms("mmCIF", self.block.name));
        }
        let categories = self.block.categories;
        let too_many = categories.warning();
        let warnings = warnings.messages(|fault| fault.locate(self.text));
        self.reading.hold_texts(categories.copy_bytes())?;
        let (annotations, rejected) = categories.annotations();
        let counts = self.unread.counts;
        let source = SourceFields {
            id: self.block.entry.or(self.block.name),
            title: self.block.title,
            sequence: Sequence::of(&categories),
            annotations,
            assemblies: categories.assemblies(),
            unread: counts,
            warnings: warnings.into_iter().chain(too_many).chain(rejected).chain(self.unread.warnings()).collect(),
            ..SourceFields::new(SourceFormat::Mmcif)
        };
        columns.finish(tables, source, self.reading)
    }
}
