//! Binning of the front-facing triangles by screen tile.

use molmesh_surface::groups::Groups;
use molmesh_surface::{Control, SurfaceError};
use rayon::prelude::*;

use super::camera::Camera;

/// Width of a tile in pixels.
pub(super) const TILE_WIDTH: usize = 64;
/// Height of a tile in pixels.
pub(super) const TILE_HEIGHT: usize = 16;
/// Subpixels per pixel. Rounded coordinates make adjacent triangles share their corners exactly.
pub(super) const PARTS: i32 = 256;
/// Maximum number of tasks. Fixed, so that lists do not depend on the number of threads.
const MAX_CHUNKS: usize = 64;
/// Minimum number of triangles per task.
const MIN_CHUNK: usize = 1 << 12;

/// Corner of a triangle: column and row in subpixels.
pub(super) type Corner = [i32; 2];

/// Twice the area of a triangle in square subpixels, positive if its corners are clockwise on the screen.
#[inline]
pub(super) fn twice_area([a, b, c]: [Corner; 3]) -> i64 {
    let [ab, ac] = [b, c].map(|p| [i64::from(p[0]) - i64::from(a[0]), i64::from(p[1]) - i64::from(a[1])]);
    ab[0] * ac[1] - ab[1] * ac[0]
}

/// Addend 1.5·2⁵², which leaves the nearest integer in the last bits of a sum. The addition is several times as fast as
/// `round`, which is a function call for processors without a rounding instruction.
const ROUNDING: f64 = 6_755_399_441_055_744.0;

/// Corner at a position in pixels.
#[inline]
pub(super) fn corner(position: [f32; 3]) -> Corner {
    #[expect(clippy::cast_possible_truncation, reason = "the last bits hold the integer")]
    let round = |parts: f64| ((parts + ROUNDING).to_bits() as u32).cast_signed();
    [position[0], position[1]].map(|c| round(f64::from(c) * f64::from(PARTS)))
}

/// Tiles of a picture.
#[derive(Debug, Clone, Copy)]
pub(super) struct Tiles {
    pub(super) across: usize,
    pub(super) down: usize,
}

impl Tiles {
    pub(super) fn of(width: usize, height: usize) -> Self {
        Self { across: width.div_ceil(TILE_WIDTH), down: height.div_ceil(TILE_HEIGHT) }
    }
}

/// Front-facing triangles of each task by tile, ascending.
pub(super) struct Bins(Vec<Groups>);

impl Bins {
    /// Sorts triangles into tiles.
    ///
    /// # Errors
    /// [`SurfaceError::Cancelled`].
    pub(super) fn new(
        positions: &[[f32; 3]],
        triangles: &[[u32; 3]],
        camera: &Camera,
        tiles: Tiles,
        control: &Control<'_>,
    ) -> Result<Self, SurfaceError> {
        let chunk = triangles.len().div_ceil(MAX_CHUNKS).max(MIN_CHUNK);
        let of_chunk = |(n, part): (usize, &[[u32; 3]])| {
            control.check()?;
            Ok(bin(positions, part, n * chunk, camera, tiles))
        };
        triangles.par_chunks(chunk).enumerate().map(of_chunk).collect::<Result<_, _>>().map(Self)
    }

    /// Returns the triangles of a tile.
    pub(super) fn of(&self, tile: usize) -> impl Iterator<Item = u32> {
        self.0.iter().flat_map(move |chunk| chunk.get(tile)).copied()
    }
}

fn bin(positions: &[[f32; 3]], part: &[[u32; 3]], first: usize, camera: &Camera, tiles: Tiles) -> Groups {
    let mut pairs: Vec<(u32, u32)> = Vec::with_capacity(part.len());
    for (n, triangle) in part.iter().enumerate() {
        let corners = triangle.map(|v| corner(camera.project(positions[v as usize])));
        // Rows count downwards, so counter-clockwise triangles have a negative area on the screen.
        if twice_area(corners) >= 0 {
            continue;
        }
        let span = |axis: usize, size: usize, n: usize| {
            let low = corners.iter().map(|c| c[axis]).min().unwrap_or_default();
            let high = corners.iter().map(|c| c[axis]).max().unwrap_or_default();
            // A corner on a pixel boundary adds the next pixel, which has no sample there.
            let tile = |at: i32| usize::try_from(at.max(0) / PARTS).unwrap_or(0) / size;
            (high >= 0).then(|| (tile(low), tile(high).min(n - 1)))
        };
        let columns = span(0, TILE_WIDTH, tiles.across);
        let rows = span(1, TILE_HEIGHT, tiles.down);
        let (Some((left, right)), Some((top, bottom))) = (columns, rows) else { continue };
        for row in top..=bottom {
            for column in left..=right {
                let tile = row * tiles.across + column;
                #[expect(clippy::cast_possible_truncation, reason = "meshes have less than 2³² triangles")]
                pairs.push((tile as u32, (first + n) as u32));
            }
        }
    }
    Groups::new(tiles.across * tiles.down, pairs.iter().map(|(tile, triangle)| (*tile as usize, *triangle)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn corners_are_rounded_and_areas_are_signed() {
        for (pixels, parts) in
            [(0.0, 0), (1.0, 256), (-1.0, -256), (16_384.0, 1 << 22), (0.3, 77), (-0.3, -77), (100.75, 25_792)]
        {
            assert_eq!(corner([pixels, -pixels, 0.0]), [parts, -parts], "{pixels}");
        }
        assert_eq!(twice_area([[0, 0], [4, 0], [0, 2]]), 8);
        assert_eq!(twice_area([[0, 0], [0, 2], [4, 0]]), -8);
    }
}
