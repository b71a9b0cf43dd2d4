//! Fixed columns of ATOM records.

use super::super::element;
use super::super::number::{self, hybrid36, real};
use super::super::read::MAX_COORDINATE;
use super::super::text::{Fault, trimmed};

/// A line, cut or padded to 80 columns.
pub(super) type Card = [u8; 80];

/// Cuts or pads a line to 80 columns.
pub(super) fn card(line: &[u8]) -> Card {
    let mut padded = [b' '; 80];
    let len = line.len().min(80);
    padded[..len].copy_from_slice(&line[..len]);
    padded
}

/// Columns up to the end of the coordinates.
pub(super) const MIN_COLUMNS: usize = 54;

/// Checks that a line has coordinates.
#[inline]
pub(super) fn check_length(line: &[u8]) -> Result<(), Box<Fault>> {
    if line.len() < MIN_COLUMNS {
        let found = format!("a line of {} columns", line.len());
        return Err(Fault::words(line.len(), found, "coordinates in columns 31 to 54"));
    }
    Ok(())
}

/// Returns true if columns 73-80 contain the entry id and a line number, as in files before 1996: `4PTI  88`, `2HHBA
/// 206`.
pub(super) fn numbered_line(card: &Card) -> bool {
    card[72].is_ascii_digit()
        && card[73..76].iter().all(u8::is_ascii_alphanumeric)
        && card[79].is_ascii_digit()
        && (card[78].is_ascii_digit() || card[78] == b' ')
}

#[inline]
pub(super) fn coordinate(card: &Card, from: usize, axis: &str) -> Result<f64, Box<Fault>> {
    match number(card, from, from + 8) {
        Some(value) if value.abs() <= MAX_COORDINATE => Ok(value),
        _ => Err(Fault::token(card, from, from + 8, format!("the {axis} coordinate in Å, within ±{MAX_COORDINATE}"))),
    }
}

/// Returns the element symbol in columns 77 and 78, or in 78 and 79 if it was shifted by a column; empty if there is
/// none.
#[inline]
fn symbol(card: &Card) -> &[u8] {
    let start = if card[76].is_ascii_alphabetic() { 76 } else { 77 };
    let len = card[start..].iter().take_while(|b| b.is_ascii_alphabetic()).count();
    if len > 2 { &[] } else { &card[start..start + len] }
}

/// Returns the atomic number that a line states, 0 for dummy atoms; `None` if it states none. A line of PDBQT has a
/// charge in columns 67 to 76 and then an atom type, which may begin a column later.
#[inline]
pub(super) fn stated_element(card: &Card) -> Option<u8> {
    if card[76..] == [b' '; 4] || numbered_line(card) {
        return None;
    }
    if card[75].is_ascii_digit() && card[66..76].contains(&b'.') && number(card, 66, 76).is_some() {
        let (from, to) = trimmed(&card[76..80]);
        return (from < to).then(|| element::pdbqt_type(&card[76 + from..76 + to]));
    }
    match symbol(card) {
        b"" => None,
        symbol => element::stated(symbol),
    }
}

/// Returns the range of the segment id in columns 73 to 76; empty if there is none.
#[inline]
pub(super) fn segment(card: &Card) -> (usize, usize) {
    let is_segment = card[72..76] != [b' '; 4] && card[66..72] == [b' '; 6] && !numbered_line(card);
    if is_segment { (72, 76) } else { (72, 72) }
}

/// Parses the number in `card[from..to]`, ignoring surrounding blanks.
#[inline]
pub(super) fn number(card: &Card, from: usize, to: usize) -> Option<f64> {
    let mut start = from;
    while start < to && card[start] == b' ' {
        start += 1;
    }
    real(card, start, to).or_else(|| {
        let (a, b) = trimmed(&card[from..to]);
        real(card, from + a, from + b)
    })
}

/// Parses the residue number in columns 23-26 and the insertion code in column 27. Column 27 may be a fifth digit.
#[inline]
pub(super) fn residue_number(card: &Card) -> Result<(i32, u8), Box<Fault>> {
    let code = card[26];
    if code.is_ascii_digit() {
        let (from, to) = trimmed(&card[22..27]);
        if let Some(number) = number::integer(&card[22 + from..22 + to]) {
            return Ok((number, 0));
        }
    }
    let (from, to) = trimmed(&card[22..26]);
    let text = &card[22 + from..22 + to];
    let number = if from == to { Some(0) } else { hybrid36(text).or_else(|| hexadecimal(text)) };
    let number = number.ok_or_else(|| Fault::token(card, 22, 26, "a residue number, decimal or hybrid-36"))?;
    Ok((number, if code > b' ' { code } else { 0 }))
}

/// Parses four lower-case hexadecimal digits, which VMD writes for numbers above 9999.
fn hexadecimal(text: &[u8]) -> Option<i32> {
    let is_digit = |b: &u8| matches!(b, b'0'..=b'9' | b'a'..=b'f');
    let text = std::str::from_utf8(text).ok().filter(|text| text.len() == 4 && text.bytes().all(|b| is_digit(&b)))?;
    i32::from_str_radix(text, 16).ok()
}

/// Expands tabs to stops every eight columns. Returns the line and the source column of each byte.
pub(super) fn expand_tabs(line: &[u8]) -> (Vec<u8>, Vec<usize>) {
    let (mut out, mut origin) = (Vec::with_capacity(96), Vec::with_capacity(96));
    // Columns beyond 80 are not read, and a tab fills at most eight columns.
    for (i, &b) in line.iter().enumerate().take(96) {
        let columns = if b == b'\t' { 8 - out.len() % 8 } else { 1 };
        out.extend(std::iter::repeat_n(if b == b'\t' { b' ' } else { b }, columns));
        origin.extend(std::iter::repeat_n(i, columns));
    }
    (out, origin)
}
