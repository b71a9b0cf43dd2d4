//! Fixed columns of ATOM records.

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
    if code.is_ascii_digit() && card[22..26].iter().all(|b| b.is_ascii_digit() || *b == b'-') {
        let number = number::integer(&card[22..27]);
        return number.map(|n| (n, 0)).ok_or_else(|| Fault::token(card, 22, 27, "a residue number"));
    }
    let (from, to) = trimmed(&card[22..26]);
    let number = if from == to { Some(0) } else { hybrid36(&card[22 + from..22 + to]) };
    let number = number.ok_or_else(|| Fault::token(card, 22, 26, "a residue number, decimal or hybrid-36"))?;
    Ok((number, if code > b' ' { code } else { 0 }))
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
