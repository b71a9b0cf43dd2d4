//! Reader of CCP4 and MRC maps.
//!
//! Format: CCP4 `maplib`, and Cheng et al., J. Struct. Biol. 192, 146–150 (2015) (MRC2014). Words of the header have 4
//! bytes and count from 1.

use molmesh_surface::Control;

use super::{
    Map, MapError, MapFormat, MapLimits, VALUES_PER_CHECK, allocate, check, inverse, malformed, number_of_points,
};

/// Length of the header, bytes.
const HEADER: usize = 1024;
/// Text `MAP ` in word 53.
const MAGIC: &[u8] = b"MAP ";
const MAGIC_AT: usize = 208;

/// Returns true if the bytes begin with the header of a CCP4 or MRC map.
pub(super) fn is_ccp4(bytes: &[u8]) -> bool {
    bytes.get(MAGIC_AT..).is_some_and(|rest| rest.starts_with(MAGIC))
}

/// Header in the byte order of the file.
struct Header<'a> {
    bytes: &'a [u8],
    little: bool,
}

impl Header<'_> {
    fn word(&self, n: usize) -> [u8; 4] {
        let bytes = self.bytes.get(4 * (n - 1)..).and_then(<[u8]>::first_chunk).copied().unwrap_or_default();
        if self.little { bytes } else { [bytes[3], bytes[2], bytes[1], bytes[0]] }
    }

    fn int(&self, n: usize) -> i32 {
        i32::from_le_bytes(self.word(n))
    }

    fn float(&self, n: usize) -> f64 {
        f64::from(f32::from_le_bytes(self.word(n)))
    }

    /// Returns three consecutive integers.
    fn ints(&self, n: usize) -> [i32; 3] {
        [self.int(n), self.int(n + 1), self.int(n + 2)]
    }

    /// Returns three consecutive floats.
    fn floats(&self, n: usize) -> [f64; 3] {
        [self.float(n), self.float(n + 1), self.float(n + 2)]
    }

    /// Returns true if mode and axes are valid in this byte order.
    fn is_plausible(&self) -> bool {
        Mode::of(self.int(4)).is_some() && self.axes().is_some()
    }

    /// Returns the crystallographic axis, 0 to 2, of the columns, rows and sections. Some programs leave the axes out.
    fn axes(&self) -> Option<[usize; 3]> {
        match self.ints(17) {
            [0, 0, 0] => Some([0, 1, 2]),
            axes => {
                let mut sorted = axes;
                sorted.sort_unstable();
                (sorted == [1, 2, 3]).then(|| axes.map(|axis| usize::try_from(axis - 1).unwrap_or(0)))
            }
        }
    }
}

/// Type of the values.
#[derive(Clone, Copy)]
enum Mode {
    Int8,
    Int16,
    Float32,
    Uint16,
    Float16,
}

impl Mode {
    const fn of(number: i32) -> Option<Self> {
        Some(match number {
            0 => Self::Int8,
            1 => Self::Int16,
            2 => Self::Float32,
            6 => Self::Uint16,
            12 => Self::Float16,
            _ => return None,
        })
    }

    const fn bytes(self) -> usize {
        match self {
            Self::Int8 => 1,
            Self::Float32 => 4,
            Self::Int16 | Self::Uint16 | Self::Float16 => 2,
        }
    }
}

/// Reads a map.
pub(super) fn read(bytes: &[u8], limits: &MapLimits, control: &Control<'_>) -> Result<Map, MapError> {
    if bytes.len() < HEADER {
        return Err(malformed("header", format!("{} bytes", bytes.len()), format!("{HEADER} bytes")));
    }
    let header = |little| Header { bytes, little };
    // Machine stamps are often wrong, so the order in which the header makes sense decides.
    let declares_big = bytes[212] == 0x11;
    let (first, second) = (header(!declares_big), header(declares_big));
    let header = if !first.is_plausible() && second.is_plausible() { second } else { first };
    let mode = header.int(4);
    let expected = "0, 1, 2, 6 or 12 (integers of 8 or 16 bits, floats of 32 or 16 bits)";
    let mode = Mode::of(mode).ok_or_else(|| malformed("mode (word 4, byte 12)", mode.to_string(), expected))?;
    let location = "numbers of columns, rows and sections (words 1 to 3, byte 0)";
    let side = |n: i32| usize::try_from(n).map_err(|_negative| malformed(location, n.to_string(), "positive numbers"));
    let [columns, rows, sections] = header.ints(1);
    let size = [side(columns)?, side(rows)?, side(sections)?];
    let n = number_of_points(size, location, limits)?;
    let to_grid = to_grid(&header)?;
    let extended = header.int(24);
    let location = "length of the extended header (word 24, byte 92)";
    let extended = usize::try_from(extended)
        .map_err(|_negative| malformed(location, extended.to_string(), "0 or a positive number"))?;
    let expected = (HEADER as u64).saturating_add(extended as u64).saturating_add((n * mode.bytes()) as u64);
    let data = HEADER.checked_add(extended).and_then(|start| bytes.get(start..)?.get(..n * mode.bytes()));
    let data = data.ok_or_else(|| {
        malformed("end of the file", format!("{} bytes", bytes.len()), format!("{expected} bytes for these points"))
    })?;
    let (mut values, memory) = allocate(n, control)?;
    for piece in data.chunks(VALUES_PER_CHECK * mode.bytes()) {
        check(control)?;
        append(&mut values, piece, mode, header.little);
    }
    let strides = [1, size[0], size[0] * size[1]];
    Ok(Map { format: MapFormat::Ccp4, size, strides, values, to_grid, _memory: memory })
}

/// Appends values to a list that has the capacity for them.
fn append(values: &mut Vec<f32>, bytes: &[u8], mode: Mode, little: bool) {
    let pair = |b: &[u8; 2]| if little { u16::from_le_bytes(*b) } else { u16::from_be_bytes(*b) };
    let (pairs, words) = (bytes.as_chunks().0, bytes.as_chunks().0);
    match mode {
        Mode::Int8 => values.extend(bytes.iter().map(|b| f32::from(b.cast_signed()))),
        Mode::Int16 => values.extend(pairs.iter().map(|b| f32::from(pair(b).cast_signed()))),
        Mode::Uint16 => values.extend(pairs.iter().map(|b| f32::from(pair(b)))),
        Mode::Float16 => values.extend(pairs.iter().map(|b| of_half(pair(b)))),
        Mode::Float32 => {
            values.extend(words.iter().map(|b| if little { f32::from_le_bytes(*b) } else { f32::from_be_bytes(*b) }));
        }
    }
}

/// Converts a number of IEEE 754 binary16.
fn of_half(bits: u16) -> f32 {
    let (exponent, fraction) = (i32::from(bits >> 10 & 31), f32::from(bits & 1023));
    let size = match exponent {
        0 => fraction * 2_f32.powi(-24),
        31 if fraction == 0.0 => f32::INFINITY,
        31 => f32::NAN,
        _ => (1024.0 + fraction) * 2_f32.powi(exponent - 25),
    };
    if bits >> 15 == 1 { -size } else { size }
}

/// Returns the conversion of positions in Å to positions on the grid of the file.
///
/// The axes of the cell are those of the PDB: a along x, b in the plane of x and y. A position of the origin (words 50
/// to 52) replaces the first column, row and section (words 5 to 7).
fn to_grid(header: &Header<'_>) -> Result<[[f64; 4]; 3], MapError> {
    if header.int(25) == 1 {
        let expected = "0: skew transformations are not supported";
        return Err(malformed("skew flag (word 25, byte 96)", "1", expected));
    }
    let axes = header.axes().ok_or_else(|| {
        let [a, b, c] = header.ints(17);
        malformed("axes (words 17 to 19, byte 64)", format!("{a}, {b}, {c}"), "1, 2 and 3 in any order")
    })?;
    let intervals = header.ints(8);
    if intervals.iter().any(|n| *n <= 0) {
        let [x, y, z] = intervals;
        let location = "intervals of the cell (words 8 to 10, byte 28)";
        return Err(malformed(location, format!("{x}, {y}, {z}"), "positive numbers"));
    }
    let (lengths, angles) = (header.floats(11), header.floats(14));
    let bad_cell = || {
        let ([a, b, c], [alpha, beta, gamma]) = (lengths, angles);
        let found = format!("{a}, {b}, {c} Å and {alpha}, {beta}, {gamma}°");
        malformed("cell (words 11 to 16, byte 40)", found, "positive lengths and the angles of a cell")
    };
    let valid = lengths.iter().all(|v| *v > 0.0 && v.is_finite()) && angles.iter().all(|v| *v > 0.0 && *v < 180.0);
    let [a, b, c] = lengths;
    let [cos_alpha, cos_beta, cos_gamma] = angles.map(|angle| angle.to_radians().cos());
    let sin_gamma = angles[2].to_radians().sin();
    let across = (cos_alpha - cos_beta * cos_gamma) / sin_gamma;
    let height = (1.0 - cos_beta * cos_beta - across * across).sqrt();
    let cell = [[a, b * cos_gamma, c * cos_beta], [0.0, b * sin_gamma, c * across], [0.0, 0.0, c * height]];
    let fraction = inverse(cell).filter(|_| valid && height > 1e-6).ok_or_else(bad_cell)?;
    let origin = header.floats(50);
    if origin.iter().any(|v| !v.is_finite()) {
        return Err(malformed("origin (words 50 to 52, byte 196)", format!("{origin:?}"), "three finite numbers"));
    }
    let (starts, is_moved) = (header.ints(5), origin.iter().any(|v| v.abs() > 0.0));
    Ok(std::array::from_fn(|k| {
        let row = fraction[axes[k]].map(|v| v * f64::from(intervals[axes[k]]));
        let first: f64 = if is_moved { row.iter().zip(origin).map(|(a, b)| a * b).sum() } else { f64::from(starts[k]) };
        [row[0], row[1], row[2], -first]
    }))
}
