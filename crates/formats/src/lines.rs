//! Lines of text formats: numbers with fixed decimals, written in blocks.

use std::io::{self, Write};

use molmesh_surface::Mesh;

use super::Units;
use super::block::BLOCK_BYTES;
use super::check::Summary;
use super::error::FormatError;

/// Decimals of a component of a normal.
pub(super) const NORMAL_DECIMALS: Decimals = Decimals::Four;

/// Largest coordinate, in the file's units.
const MAX_COORDINATE: f64 = 1e9;

/// Capacity for the longest line, a vertex of a PLY: three coordinates of 17 characters, three components of a normal
/// of 7, four levels of a colour of 3 and an atom index of 10, with blanks and a line feed.
const LINE_BYTES: usize = 112;

/// Number of decimals.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Decimals {
    Four,
    Five,
}

impl Decimals {
    /// Returns the decimals of a coordinate: a tenth of the precision of structure files, in any unit.
    pub(super) const fn of(units: Units) -> Self {
        match units {
            Units::Angstrom => Self::Four,
            Units::Nanometer | Units::Meter => Self::Five,
        }
    }

    /// Returns the unit of the last decimal.
    pub(super) fn precision(self) -> String {
        format!("{:.*}", self.count(), 1.0 / f64::from(self.power()))
    }

    /// Returns the length of the longest number whose absolute value is at most `largest`.
    pub(super) fn longest(self, largest: f64) -> u64 {
        // Adds 1 because rounding up can add a digit.
        format!("-{:.*}", self.count(), largest + 1.0).len() as u64
    }

    const fn count(self) -> usize {
        match self {
            Self::Four => 4,
            Self::Five => 5,
        }
    }

    /// Returns ten to the power of the number of decimals.
    const fn power(self) -> u32 {
        match self {
            Self::Four => 10_000,
            Self::Five => 100_000,
        }
    }
}

/// Returns the largest absolute value of a coordinate, in the file's units.
///
/// # Errors
/// Returns [`FormatError::CoordinateTooLarge`] if a line cannot hold it.
pub(super) fn largest_coordinate(mesh: &Mesh, units: Units, summary: &Summary) -> Result<f64, FormatError> {
    let mut extreme = 0.0_f64;
    for row in summary.bounds {
        for (relative, centre) in row.into_iter().zip(mesh.centre) {
            let value = (centre + f64::from(relative)) * units.scale();
            if value.abs() > MAX_COORDINATE {
                return Err(FormatError::CoordinateTooLarge { value, limit: MAX_COORDINATE });
            }
            extreme = extreme.max(value.abs());
        }
    }
    Ok(extreme)
}

/// Lines collected into blocks; each block is written with one call.
pub(super) struct LineWriter<'a> {
    out: &'a mut dyn Write,
    block: Vec<u8>,
    used: usize,
}

impl<'a> LineWriter<'a> {
    pub(super) fn new(out: &'a mut dyn Write, len_bound: u64) -> Self {
        // A small mesh needs a small block; the current line always fits.
        let small = usize::try_from(len_bound).unwrap_or(usize::MAX).saturating_add(LINE_BYTES);
        Self { out, block: vec![0; small.min(BLOCK_BYTES)], used: 0 }
    }

    pub(super) fn push(&mut self, make: impl FnOnce(&mut Line<'_>)) -> io::Result<()> {
        if self.used + LINE_BYTES > self.block.len() {
            self.flush()?;
        }
        let mut line = Line { bytes: &mut self.block[self.used..self.used + LINE_BYTES], used: 0 };
        make(&mut line);
        self.used += line.used;
        Ok(())
    }

    /// Writes a text of any length.
    pub(super) fn text(&mut self, text: &str) -> io::Result<()> {
        self.flush()?;
        self.out.write_all(text.as_bytes())
    }

    pub(super) fn flush(&mut self) -> io::Result<()> {
        self.out.write_all(&self.block[..self.used])?;
        self.used = 0;
        Ok(())
    }
}

/// Line to which fields are appended.
pub(super) struct Line<'a> {
    bytes: &'a mut [u8],
    used: usize,
}

impl Line<'_> {
    #[inline(always)]
    pub(super) fn put(&mut self, text: &[u8]) {
        copy_short(&mut self.bytes[self.used..self.used + text.len()], text);
        self.used += text.len();
    }

    /// Appends a blank unless the line is empty.
    pub(super) fn separate(&mut self) {
        if self.used > 0 {
            self.put(b" ");
        }
    }

    /// Appends three numbers, separated by blanks.
    pub(super) fn numbers(&mut self, row: [f32; 3], decimals: Decimals) {
        for value in row {
            self.separate();
            self.fixed(value, decimals);
        }
    }

    /// Appends a number with fixed decimals. Rounds ties away from zero and writes no negative zero.
    #[expect(
        clippy::cast_possible_truncation,
        reason = "at most 1e14 by MAX_COORDINATE; the fraction is truncated on purpose"
    )]
    pub(super) fn fixed(&mut self, value: f32, decimals: Decimals) {
        let scaled = f64::from(value) * f64::from(decimals.power());
        let rounded = (scaled + 0.5_f64.copysign(scaled)) as i64;
        if rounded < 0 {
            self.put(b"-");
        }
        let power = u64::from(decimals.power());
        let (whole, fraction) = (rounded.unsigned_abs() / power, rounded.unsigned_abs() % power);
        self.put(itoa::Buffer::new().format(whole).as_bytes());
        let digit = |power: u64| b'0' + (fraction / power % 10) as u8;
        match decimals {
            Decimals::Four => self.put(&[b'.', digit(1000), digit(100), digit(10), digit(1)]),
            Decimals::Five => self.put(&[b'.', digit(10_000), digit(1000), digit(100), digit(10), digit(1)]),
        }
    }
}

/// Copies a short slice.
#[inline(always)]
fn copy_short(to: &mut [u8], from: &[u8]) {
    // Musl's `memcpy` is slower for a few bytes than the rest of the line; glibc's is as fast as this code.
    if !cfg!(target_env = "musl") {
        return to.copy_from_slice(from);
    }
    copy_in_halves(to, from);
}

/// Copies the first and the last bytes, which may overlap.
#[inline(always)]
fn copy_in_halves(to: &mut [u8], from: &[u8]) {
    match from.len() {
        4..=8 => copy_ends::<4>(to, from),
        2..=3 => copy_ends::<2>(to, from),
        1 => copy_ends::<1>(to, from),
        9..=16 => copy_ends::<8>(to, from),
        _ => to.copy_from_slice(from),
    }
}

/// Copies the first and the last `N` bytes.
#[inline(always)]
fn copy_ends<const N: usize>(to: &mut [u8], from: &[u8]) {
    if let (Some(to), Some(from)) = (to.first_chunk_mut::<N>(), from.first_chunk::<N>()) {
        *to = *from;
    }
    if let (Some(to), Some(from)) = (to.last_chunk_mut::<N>(), from.last_chunk::<N>()) {
        *to = *from;
    }
}

/// Returns a line as text.
#[cfg(test)]
pub(super) fn written(make: impl FnOnce(&mut Line<'_>)) -> String {
    let mut bytes = [0; LINE_BYTES];
    let mut line = Line { bytes: &mut bytes, used: 0 };
    make(&mut line);
    let used = line.used;
    String::from_utf8(bytes[..used].to_vec()).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    pub(super) fn fixed(value: f32) -> String {
        text(value, Decimals::Four)
    }

    fn text(value: f32, decimals: Decimals) -> String {
        written(|line| line.fixed(value, decimals))
    }

    #[test]
    fn words_of_every_length_are_copied_whole() {
        let from: Vec<u8> = (1..=40).collect();
        for n in 0..=from.len() {
            let mut to = vec![0; n];
            copy_in_halves(&mut to, &from[..n]);
            assert_eq!(to, from[..n], "{n} bytes");
        }
    }

    #[test]
    fn numbers_have_four_decimals_and_no_negative_zero() {
        let cases = [
            (0.0, "0.0000"),
            (-0.0, "0.0000"),
            (-0.000_01, "0.0000"),
            (-0.000_06, "-0.0001"),
            (0.000_25, "0.0003"),
            (-123.456_78, "-123.4568"),
            (9.999_96, "10.0000"),
            (1e9, "1000000000.0000"),
        ];
        for (value, text) in cases {
            assert_eq!(fixed(value), text, "{value}");
        }
        let five = [(0.000_026, "0.00003"), (-12.345_678, "-12.34568"), (-0.000_001, "0.00000"), (0.5, "0.50000")];
        for (value, expected) in five {
            assert_eq!(text(value, Decimals::Five), expected, "{value}");
        }
    }

    #[test]
    fn numbers_agree_with_the_standard_library() {
        let mut bits = 12_345_u32;
        for _ in 0..20_000 {
            bits = bits.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let value = f32::from(bits.to_be_bytes()[0]) - 128.0 + f32::from_bits(0x3f80_0000 | (bits & 0x7f_ffff));
            let difference = fixed(value).parse::<f64>().unwrap() - format!("{value:.4}").parse::<f64>().unwrap();
            // The standard library rounds exact ties to even, we away from zero.
            assert!(difference.abs() < 1.000_1e-4, "{value}");
            assert!((fixed(value).parse::<f64>().unwrap() - f64::from(value)).abs() <= 0.500_01e-4, "{value}");
        }
    }
}
