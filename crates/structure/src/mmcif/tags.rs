//! Tags of atoms and spheres that are counted and not read.

use super::super::data_blocks::SPHERES;
use super::row;

/// Returns true if a tag belongs to the category of atoms.
pub(in super::super) fn is_of_atoms(tag: &[u8]) -> bool {
    row::has_prefix(tag)
}

/// Returns true if a tag, without its underscore, belongs to the category of spheres.
pub(in super::super) fn is_of_spheres(tag: &[u8]) -> bool {
    let category = tag.get(..SPHERES.len()).filter(|_| tag.get(SPHERES.len()) == Some(&b'.'));
    category.is_some_and(|category| category.eq_ignore_ascii_case(SPHERES.as_bytes()))
}

/// Returns true if a text may begin a data block or contain spheres. Few texts have an underscore outside tags.
pub(super) fn has_unread(text: &[u8]) -> bool {
    let ends_in = |text: &[u8], word: &[u8]| {
        text.len().checked_sub(word.len()).is_some_and(|start| text[start..].eq_ignore_ascii_case(word))
    };
    memchr::memchr_iter(b'_', text).any(|at| ends_in(&text[..at], b"data") || is_of_spheres(&text[at + 1..]))
}
