//! Maps: values of one property, such as a density or an electrostatic potential, at the points of a regular grid.
//!
//! CCP4/MRC and `OpenDX` files are read, plain or compressed with gzip or zstd. The content decides the format.

mod ccp4;
mod dx;
mod error;

use std::fmt;

pub use error::MapError;
use molmesh_surface::{Control, Exceeded, Limit, MemoryMeter as _, OutOfMemory, Reservation, named};

use super::decoder;

/// Values that are read between two checks of the cancellation flag: about a millisecond.
const VALUES_PER_CHECK: usize = 1 << 14;

/// Limits of reading a map, checked before memory is allocated.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MapLimits {
    /// Points of the grid.
    pub max_points: u64,
    /// Bytes after decompression.
    pub max_inflated_bytes: u64,
}

impl Default for MapLimits {
    fn default() -> Self {
        Self { max_points: 64 << 20, max_inflated_bytes: 4 << 30 }
    }
}

/// File format of a map.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MapFormat {
    /// CCP4 or MRC.
    Ccp4,
    /// `OpenDX` scalar field.
    Dx,
}

named!(MapFormat, Ccp4 => "ccp4", Dx => "dx");

/// Values at the points of a regular grid. Its axes may be oblique.
pub struct Map {
    format: MapFormat,
    /// Number of points along each axis, at least 2.
    size: [usize; 3],
    /// Distance between the values of neighbouring points along each axis.
    strides: [usize; 3],
    values: Vec<f32>,
    /// Rows of the matrix that converts a position in Å to a grid position, with the offset in the last column.
    to_grid: [[f64; 4]; 3],
    /// Memory of the values.
    _memory: Reservation,
}

impl fmt::Debug for Map {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Map").field("format", &self.format).field("size", &self.size).finish_non_exhaustive()
    }
}

impl Map {
    /// Returns the format of the file.
    #[must_use]
    pub const fn format(&self) -> MapFormat {
        self.format
    }

    /// Returns the number of points along each axis of the file.
    #[must_use]
    pub const fn size(&self) -> [usize; 3] {
        self.size
    }

    /// Returns the value at a position in Å, interpolated linearly along the three axes of the grid. `None` outside the
    /// grid, and next to a point whose value is not a finite number.
    #[must_use]
    pub fn at(&self, [x, y, z]: [f64; 3]) -> Option<f64> {
        let (mut first, mut parts) = (0, [0.0; 3]);
        for (k, [a, b, c, offset]) in self.to_grid.into_iter().enumerate() {
            let coordinate = a * x + b * y + c * z + offset;
            let last = self.size[k] - 1;
            if !(0.0..=last as f64).contains(&coordinate) {
                return None;
            }
            #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "within the grid")]
            let cell = (coordinate as usize).min(last - 1);
            parts[k] = coordinate - cell as f64;
            first += cell * self.strides[k];
        }
        let [sx, sy, sz] = self.strides;
        let between = |a: f64, b: f64, part: f64| a + part * (b - a);
        let value = |offset: usize| f64::from(self.values[first + offset]);
        let along_x = |offset: usize| between(value(offset), value(offset + sx), parts[0]);
        let along_xy = |offset: usize| between(along_x(offset), along_x(offset + sy), parts[1]);
        Some(between(along_xy(0), along_xy(sz), parts[2])).filter(|value| value.is_finite())
    }

    /// Returns the lowest and highest coordinates of the corners, Å.
    #[must_use]
    pub fn bounds(&self) -> [[f64; 3]; 2] {
        let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
        // A grid position p belongs to the position B·(p − t).
        let basis = inverse(self.to_grid.map(|[a, b, c, _]| [a, b, c])).unwrap_or_default();
        for corner in 0..8 {
            let p: [f64; 3] = std::array::from_fn(|k| {
                let end = if corner >> k & 1 == 1 { self.size[k] - 1 } else { 0 };
                end as f64 - self.to_grid[k][3]
            });
            for (k, [a, b, c]) in basis.into_iter().enumerate() {
                let coordinate = a * p[0] + b * p[1] + c * p[2];
                (low[k], high[k]) = (low[k].min(coordinate), high[k].max(coordinate));
            }
        }
        [low, high]
    }
}

/// Reads a map. Adds memory to the meter of `control` before it is allocated, until the map is dropped.
///
/// # Errors
/// Returns a [`MapError`]. Never panics on any input.
pub fn read(bytes: &[u8], limits: &MapLimits, control: &Control<'_>) -> Result<Map, MapError> {
    check(control)?;
    let memory = Reservation::new(&control.memory);
    let bytes = decoder::inflate(bytes, limits.max_inflated_bytes, &memory, control, &|_| Ok(()))?;
    if ccp4::is_ccp4(&bytes) {
        ccp4::read(&bytes, limits, control)
    } else if dx::is_dx(&bytes) {
        dx::read(&bytes, limits, control)
    } else {
        Err(MapError::UnknownFormat { found: shown(bytes.get(..8.min(bytes.len())).unwrap_or_default()) })
    }
}

fn check(control: &Control<'_>) -> Result<(), MapError> {
    if control.cancel.is_cancelled() { Err(MapError::Cancelled) } else { Ok(()) }
}

/// Checks the number of points of a grid and returns it.
fn number_of_points(size: [usize; 3], location: &str, limits: &MapLimits) -> Result<usize, MapError> {
    let points = size.iter().try_fold(1_u64, |points, side| points.checked_mul(*side as u64)).unwrap_or(u64::MAX);
    if size.iter().any(|side| *side < 2) {
        let [x, y, z] = size;
        return Err(malformed(location, format!("{x} × {y} × {z} points"), "at least 2 points along each axis"));
    }
    let fitting = usize::try_from(points).ok().filter(|_| points <= limits.max_points);
    let error = || Exceeded { actual: Some(points), ..Exceeded::new(Limit::MapPoints, limits.max_points) };
    fitting.ok_or_else(|| error().error())
}

/// Allocates a list of `n` values, whose memory is reserved first.
fn allocate(n: usize, control: &Control<'_>) -> Result<(Vec<f32>, Reservation), MapError> {
    let bytes = (size_of::<f32>() * n) as u64;
    let memory = Reservation::new(&control.memory);
    memory.grow(bytes)?;
    let mut values = Vec::new();
    values.try_reserve_exact(n).map_err(|_refused| OutOfMemory::System { needed: bytes })?;
    Ok((values, memory))
}

/// Returns the inverse of a matrix; `None` if it has none.
fn inverse(m: [[f64; 3]; 3]) -> Option<[[f64; 3]; 3]> {
    let minor = |i: usize, j: usize| {
        let [a, b] = [(i + 1) % 3, (i + 2) % 3];
        let [c, d] = [(j + 1) % 3, (j + 2) % 3];
        m[a][c] * m[b][d] - m[a][d] * m[b][c]
    };
    let determinant: f64 = (0..3).map(|j| m[0][j] * minor(0, j)).sum();
    let inverse: [[f64; 3]; 3] = std::array::from_fn(|i| std::array::from_fn(|j| minor(j, i) / determinant));
    inverse.as_flattened().iter().all(|v| v.is_finite()).then_some(inverse)
}

fn malformed(location: impl Into<String>, found: impl Into<String>, expected: impl Into<String>) -> MapError {
    MapError::Malformed { location: location.into(), found: found.into(), expected: expected.into() }
}

/// Returns the beginning of a text for a message, without control characters.
fn shown(bytes: &[u8]) -> String {
    let text: String = String::from_utf8_lossy(bytes).chars().take(40).collect();
    let text: String = text.chars().map(|c| if c.is_control() { '\u{FFFD}' } else { c }).collect();
    if text.is_empty() { "nothing".to_owned() } else { format!("`{text}`") }
}

#[cfg(test)]
mod tests;
