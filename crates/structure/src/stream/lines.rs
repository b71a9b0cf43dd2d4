//! Lines of the rows of `atom_site` and after them.

use super::super::categories::Categories;
use super::super::cif::{TokenKind, Tokenizer};
use super::super::error::StructureError;
use super::super::mmcif;
use super::not_a_stream;

/// First words of a line after the last row, besides tags.
const WORDS: [&[u8]; 5] = [b"loop_", b"data_", b"save_", b"global_", b"stop_"];

/// Part of a file after its atoms.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
enum Section {
    /// Category that describes assemblies.
    Assemblies,
    /// Other category of the data block with the atoms.
    #[default]
    Other,
    /// Later data block.
    LaterBlock,
}

/// Scanner of the lines after the atoms, up to the end of the file.
#[derive(Default)]
pub(super) struct TagsAfterAtoms {
    in_text_field: bool,
    /// Text before the atoms, and the categories after them that describe assemblies.
    pub(super) assemblies: Vec<u8>,
    section: Section,
    /// True after `loop_`.
    begins_loop: bool,
}

impl TagsAfterAtoms {
    /// Reads a line. Rejects tags that change the atoms, and atoms of other data blocks.
    pub(super) fn add(&mut self, line: &[u8], needs_secondary: bool) -> Result<(), StructureError> {
        let delimits = line.first() == Some(&b';');
        let is_value = self.in_text_field != delimits;
        self.in_text_field = is_value;
        if self.section == Section::Assemblies && (is_value || delimits) {
            self.assemblies.extend_from_slice(if is_value { line } else { b";" });
        }
        if is_value {
            return Ok(());
        }
        // Behind the semicolon that ends a text field.
        let text = &line[usize::from(delimits)..];
        let mut tokens = Tokenizer::new(text);
        let mut end = 0;
        // The other values after the atoms are not read, so faults of theirs do not matter.
        while let Ok(token) = tokens.next() {
            end = token.end;
            let word = &text[token.start..token.end];
            match token.kind {
                TokenKind::End => break,
                TokenKind::Data => self.section = Section::LaterBlock,
                TokenKind::Tag if self.section == Section::LaterBlock && mmcif::is_of_atoms(word) => {
                    return Err(not_a_stream("atoms in several data blocks", "one data block with atoms"));
                }
                TokenKind::Tag if self.section == Section::LaterBlock => {}
                TokenKind::Tag => {
                    check_tag(&word[1..], needs_secondary)?;
                    let is_assembly = Categories::is_assembly(&word[1..]);
                    self.section = if is_assembly { Section::Assemblies } else { Section::Other };
                    if is_assembly && self.begins_loop {
                        self.assemblies.extend_from_slice(b" loop_");
                    }
                }
                TokenKind::Value => {}
                _ if self.section == Section::Assemblies => self.section = Section::Other,
                _ => {}
            }
            self.begins_loop = token.kind == TokenKind::Loop;
            if self.section == Section::Assemblies {
                // No value begins a line, because a semicolon there would begin a text field.
                self.assemblies.push(b' ');
                self.assemblies.extend_from_slice(word);
            }
        }
        if self.section == Section::Assemblies {
            // Text with a fault, at which reading in memory ends as well; otherwise blanks or a comment.
            self.assemblies.extend_from_slice(&text[end..]);
            self.assemblies.push(b'\n');
        }
        Ok(())
    }
}

/// Rejects a tag after the atoms, without its underscore, that changes them.
fn check_tag(tag: &[u8], needs_secondary: bool) -> Result<(), StructureError> {
    if mmcif::is_of_spheres(tag) {
        let found = "spheres of coarse-grained models after the atoms";
        return Err(not_a_stream(found, "these spheres before the atoms"));
    }
    let Some([entities, secondary]) = Categories::find(tag).map(Categories::describes) else { return Ok(()) };
    if entities || (secondary && needs_secondary) {
        let found = format!("`_{}` after the atoms", String::from_utf8_lossy(tag));
        return Err(not_a_stream(&found, "entities, chains, helices and strands before the atoms"));
    }
    Ok(())
}

/// Returns true if a line begins with a word, in any letter case.
fn begins(line: &[u8], word: &[u8]) -> bool {
    line.get(..word.len()).is_some_and(|start| start.eq_ignore_ascii_case(word))
}

/// Returns start and end of the lines that are neither blank nor comments.
pub(super) fn rows(text: &[u8]) -> impl Iterator<Item = (usize, usize)> {
    let mut start = 0;
    let lines = std::iter::from_fn(move || {
        let from = start;
        let rest = text.get(from..).filter(|rest| !rest.is_empty())?;
        start = memchr::memchr(b'\n', rest).map_or(text.len(), |i| from + i + 1);
        Some((from, start))
    });
    lines.filter(|&(start, end)| !matches!(text[start..end].trim_ascii_start().first(), None | Some(b'#')))
}

/// Returns the start of the line after the last row, if the text contains it. This line contains an underscore, which
/// few rows do.
pub(super) fn end_of_rows(text: &[u8]) -> Option<usize> {
    memchr::memchr_iter(b'_', text).find_map(|at| {
        let start = memchr::memrchr(b'\n', &text[..at]).map_or(0, |i| i + 1);
        let line = text[start..].trim_ascii_start();
        (line.starts_with(b"_") || WORDS.iter().any(|word| begins(line, word))).then_some(start)
    })
}
