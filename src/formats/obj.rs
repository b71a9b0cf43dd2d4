//! Wavefront OBJ: text, one line per vertex, normal and triangle; indices count from 1. Colours follow the
//! coordinates of a vertex, an extension that most programs read.
//!
//! Coordinates are rounded to 1e-4 Å (five decimals in nanometres), a tenth of the precision of structure files.
//! Vertices closer than that may get equal coordinates; they stay separate vertices, and the surface stays closed.

use std::io::{self, Write};

use super::block::{BLOCK_BYTES, Place};
use super::check::Summary;
use super::error::FormatError;
use super::{Meta, Normals, Storage, Units, text};
use crate::surface::Mesh;

/// Decimals of a normal's component.
const NORMAL_DECIMALS: Decimals = Decimals::Four;

/// Decimals of a colour component.
const COLOR_DECIMALS: Decimals = Decimals::Four;

/// Largest coordinate, in the file's units.
const MAX_COORDINATE: f64 = 1e9;

/// Capacity for the longest line: `f` and three times `4294967296//4294967296` take 71 bytes, `v` and three coordinates
/// of 17 characters and colours of 6 characters 77.
const LINE_BYTES: usize = 80;

/// Decimals of a number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Decimals {
    Four,
    Five,
}

impl Decimals {
    /// Returns the decimals of a coordinate: a tenth of the precision of structure files, in any unit.
    const fn of(units: Units) -> Self {
        match units {
            Units::Angstrom => Self::Four,
            Units::Nanometer | Units::Meter => Self::Five,
        }
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

/// Layout of an OBJ file.
#[derive(Debug)]
pub(super) struct ObjPlan {
    header: String,
    /// Line that begins the group of each part.
    groups: Vec<String>,
    len_bound: u64,
    storage: Storage,
}

impl ObjPlan {
    /// Checks the coordinates and computes the header and the length bound.
    pub(super) fn new(mesh: &Mesh, storage: Storage, summary: &Summary, meta: &Meta) -> Result<Self, FormatError> {
        let (smooth, decimals) = (storage.normals == Normals::Smooth, Decimals::of(storage.units));
        let mut extreme = 0.0_f64;
        for row in summary.bounds {
            for (relative, centre) in row.into_iter().zip(mesh.centre) {
                let value = (centre + f64::from(relative)) * storage.units.scale();
                if value.abs() > MAX_COORDINATE {
                    return Err(FormatError::CoordinateTooLarge { value, limit: MAX_COORDINATE });
                }
                extreme = extreme.max(value.abs());
            }
        }
        let header = header(mesh, storage.units, meta);
        let (n_vertices, n_triangles) = (mesh.positions.len() as u64, mesh.triangles.len() as u64);
        // Adds 1 because rounding up can add a digit.
        let number = |largest: f64, decimals: Decimals| format!("-{:.*}", decimals.count(), largest + 1.0).len() as u64;
        let color = if mesh.colors.is_some() { 3 * " 0.0000".len() as u64 } else { 0 };
        let vertex = "v   \n".len() as u64 + 3 * number(extreme, decimals) + color;
        let normal = if smooth { "vn   \n".len() as u64 + 3 * number(1.0, NORMAL_DECIMALS) } else { 0 };
        let digits = n_vertices.to_string().len() as u64;
        let face = if smooth { "f //  //  //\n".len() as u64 + 6 * digits } else { "f   \n".len() as u64 + 3 * digits };
        let groups: Vec<String> =
            mesh.parts.iter().map(|part| format!("g {}\n", text::word(Some(&part.name)))).collect();
        let of_groups = groups.iter().map(|line| line.len() as u64).sum::<u64>();
        let len_bound = header.len() as u64 + (vertex + normal) * n_vertices + face * n_triangles + of_groups;
        Ok(Self { header, groups, len_bound, storage })
    }

    /// Returns an upper bound of the file's length, bytes.
    pub(super) fn len_bound(&self) -> u64 {
        self.len_bound
    }

    /// Writes the file.
    pub(super) fn write(&self, mesh: &Mesh, out: &mut dyn Write) -> io::Result<()> {
        out.write_all(self.header.as_bytes())?;
        let mut lines = Lines::new(out, self.len_bound);
        let Storage { normals, units, .. } = self.storage;
        let (place, decimals) = (Place { centre: mesh.centre, scale: units.scale() }, Decimals::of(units));
        match mesh.colors.as_deref() {
            None => {
                for &position in &mesh.positions[..] {
                    lines.push(|line| line.vector(b"v", place.absolute(position), decimals))?;
                }
            }
            Some(colors) => {
                for (&position, &color) in mesh.positions.iter().zip(colors) {
                    lines.push(|line| line.colored(place.absolute(position), decimals, color))?;
                }
            }
        }
        let smooth = normals == Normals::Smooth;
        for &normal in mesh.normals.iter().filter(|_| smooth) {
            lines.push(|line| line.vector(b"vn", normal, NORMAL_DECIMALS))?;
        }
        let whole = mesh.parts.is_empty().then_some((None, 0..mesh.triangles.len()));
        let ranges = mesh.parts.iter().map(|part| part.triangles.clone());
        for (group, triangles) in self.groups.iter().map(Some).zip(ranges).chain(whole) {
            if let Some(group) = group.filter(|_| !triangles.is_empty()) {
                lines.flush()?;
                lines.out.write_all(group.as_bytes())?;
            }
            for &triangle in &mesh.triangles[triangles] {
                lines.push(|line| line.face(triangle, smooth))?;
            }
        }
        lines.flush()
    }
}

fn header(mesh: &Mesh, units: Units, meta: &Meta) -> String {
    let precision = format!("{:.*}", Decimals::of(units).count(), 1.0 / f64::from(Decimals::of(units).power()));
    let facts = text::facts(mesh, meta, units, Some(&precision));
    let mut header: String = facts.into_iter().flat_map(|fact| ["# ".to_owned(), fact, "\n".to_owned()]).collect();
    header += "o ";
    header += &text::word(meta.name.as_deref());
    header += "\n";
    header
}

/// Lines collected into blocks; each block is written with one call.
struct Lines<'a> {
    out: &'a mut dyn Write,
    block: Vec<u8>,
    used: usize,
}

impl<'a> Lines<'a> {
    fn new(out: &'a mut dyn Write, len_bound: u64) -> Self {
        // A small mesh needs a small block; the current line always fits.
        let small = usize::try_from(len_bound).unwrap_or(usize::MAX).saturating_add(LINE_BYTES);
        Self { out, block: vec![0; small.min(BLOCK_BYTES)], used: 0 }
    }

    fn push(&mut self, make: impl FnOnce(&mut Line<'_>)) -> io::Result<()> {
        if self.used + LINE_BYTES > self.block.len() {
            self.flush()?;
        }
        let mut line = Line { bytes: &mut self.block[self.used..self.used + LINE_BYTES], used: 0 };
        make(&mut line);
        self.used += line.used;
        Ok(())
    }

    fn flush(&mut self) -> io::Result<()> {
        self.out.write_all(&self.block[..self.used])?;
        self.used = 0;
        Ok(())
    }
}

/// A line under construction.
struct Line<'a> {
    bytes: &'a mut [u8],
    used: usize,
}

impl Line<'_> {
    #[inline(always)]
    fn put(&mut self, text: &[u8]) {
        copy_short(&mut self.bytes[self.used..self.used + text.len()], text);
        self.used += text.len();
    }

    fn vector(&mut self, keyword: &[u8], row: [f32; 3], decimals: Decimals) {
        self.put(keyword);
        for value in row {
            self.put(b" ");
            self.fixed(value, decimals);
        }
        self.put(b"\n");
    }

    /// Appends a vertex with its colour, sRGB from 0 to 1.
    fn colored(&mut self, row: [f32; 3], decimals: Decimals, [r, g, b, _]: [u8; 4]) {
        self.vector(b"v", row, decimals);
        // Replaces the line feed.
        self.used -= 1;
        for level in [r, g, b] {
            self.put(b" ");
            self.fixed(f32::from(level) / 255.0, COLOR_DECIMALS);
        }
        self.put(b"\n");
    }

    /// Appends a triangle. If `smooth`, its vertices have the normals of the same index.
    fn face(&mut self, triangle: [u32; 3], smooth: bool) {
        self.put(b"f");
        let mut digits = itoa::Buffer::new();
        for index in triangle {
            let number = digits.format(u64::from(index) + 1).as_bytes();
            self.put(b" ");
            self.put(number);
            if smooth {
                self.put(b"//");
                self.put(number);
            }
        }
        self.put(b"\n");
    }

    /// Appends a number with fixed decimals, rounded half away from zero, without a negative zero.
    #[expect(
        clippy::cast_possible_truncation,
        reason = "at most 1e14 by MAX_COORDINATE; the fraction is truncated on purpose"
    )]
    fn fixed(&mut self, value: f32, decimals: Decimals) {
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

#[cfg(test)]
mod tests {
    use super::*;

    fn fixed(value: f32) -> String {
        text(value, Decimals::Four)
    }

    fn text(value: f32, decimals: Decimals) -> String {
        let mut bytes = [0; LINE_BYTES];
        let mut line = Line { bytes: &mut bytes, used: 0 };
        line.fixed(value, decimals);
        let used = line.used;
        String::from_utf8(bytes[..used].to_vec()).unwrap()
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

    #[test]
    fn the_longest_lines_fit() {
        let mut bytes = [0; LINE_BYTES];
        let mut line = Line { bytes: &mut bytes, used: 0 };
        line.face([u32::MAX; 3], true);
        assert_eq!(&line.bytes[..line.used], format!("f{}\n", " 4294967296//4294967296".repeat(3)).as_bytes());
        line.used = 0;
        line.vector(b"vn", [-1e9; 3], Decimals::Five);
        assert_eq!(line.used, "vn".len() + 3 * " -1000000000.00000".len() + 1);
        line.used = 0;
        line.colored([-1e9; 3], Decimals::Five, [255, 0, 10, 255]);
        let end = format!("v{} 1.0000 0.0000 0.0392\n", " -1000000000.00000".repeat(3));
        assert_eq!(&line.bytes[..line.used], end.as_bytes());
    }

    #[test]
    fn too_large_coordinates_are_rejected() {
        let mesh = Mesh { centre: [0.0, -2e9, 0.0], positions: vec![[0.0; 3]].into(), ..Mesh::default() };
        let summary = Summary { bounds: [[0.0; 3]; 2], max_atom: None, translucent: false };
        let plan = |storage: Storage| ObjPlan::new(&mesh, storage, &summary, &Meta::default());
        let error = plan(Storage::default()).unwrap_err();
        assert_eq!(error, FormatError::CoordinateTooLarge { value: -2e9, limit: 1e9 });
        assert!(plan(Storage { units: Units::Nanometer, ..Storage::default() }).is_ok());
    }
}
