//! What is seen in one tile: the nearest triangle at four samples of every pixel.

use super::bins::{Bins, PARTS, TILE_HEIGHT, TILE_WIDTH, Tiles, corner, twice_area};
use super::camera::{Camera, dot};
use super::layers::{Facing, NOTHING, SAMPLES, UNIT};
use super::light::lambert;

/// Where the samples of a pixel lie, in parts of it: the pattern that graphics devices have.
const PATTERN: [[i32; 2]; SAMPLES] = [[96, 32], [224, 96], [32, 160], [160, 224]];
/// Samples of a tile.
const N: usize = TILE_WIDTH * TILE_HEIGHT * SAMPLES;

/// Positions, normals and triangles of a mesh.
#[derive(Clone, Copy)]
pub(super) struct Shape<'a> {
    pub(super) positions: &'a [[f32; 3]],
    pub(super) normals: &'a [[f32; 3]],
    pub(super) triangles: &'a [[u32; 3]],
}

/// A row of tiles of the layers.
pub(super) struct Band<'a> {
    /// Its first row of pixels.
    pub(super) top: usize,
    pub(super) width: usize,
    pub(super) depth: &'a mut [f32],
    pub(super) light: &'a mut [f32],
    pub(super) facing: &'a mut [Facing],
}

/// The samples of a tile.
pub(super) struct Samples {
    depth: Vec<f32>,
    light: Vec<f32>,
    normal: Vec<[f32; 3]>,
}

impl Default for Samples {
    fn default() -> Self {
        Self { depth: vec![NOTHING; N], light: vec![0.0; N], normal: vec![[0.0; 3]; N] }
    }
}

/// A triangle that faces the viewer, with what is interpolated over it.
struct Facet {
    corners: [[i32; 2]; 3],
    /// Depth, light and normal of each corner, each divided by the triangle's doubled area.
    values: [[f32; 5]; 3],
}

impl Facet {
    fn new(shape: Shape<'_>, triangle: u32, camera: &Camera) -> Self {
        // The other way around, so that the edges' functions are positive inside.
        let [a, c, b] = shape.triangles[triangle as usize];
        let placed = [a, b, c].map(|v| camera.place(shape.positions[v as usize]));
        let corners = placed.map(corner);
        let share = 1.0 / twice_area(corners) as f32;
        let mut values = [[0.0; 5]; 3];
        for ((value, v), place) in values.iter_mut().zip([a, b, c]).zip(placed) {
            let normal = camera.turn(shape.normals[v as usize]);
            *value = [place[2], lambert(normal), normal[0], normal[1], normal[2]].map(|x| x * share);
        }
        Self { corners, values }
    }

    /// First and last pixel of an axis that samples may be covered in, within a tile that begins at `from` and has `n`.
    fn span(&self, axis: usize, from: i64, n: i64) -> std::ops::Range<i64> {
        let along = self.corners.map(|c| i64::from(c[axis]));
        let (low, high) = (along.iter().min(), along.iter().max());
        let parts = i64::from(PARTS);
        let pixel = |at: Option<&i64>| at.copied().unwrap_or_default().div_euclid(parts);
        pixel(low).max(from)..(pixel(high) + 1).min(from + n)
    }

    /// Puts its samples where they are nearer than what is there.
    fn draw(&self, [left, top]: [i64; 2], [width, height]: [i64; 2], samples: &mut Samples) {
        let [a, b, c] = self.corners.map(|c| c.map(i64::from));
        // The function of the edge from `p` to `q`: its step per part of a column and of a row, and its value at (0, 0).
        let edge = |p: [i64; 2], q: [i64; 2]| {
            let (x, y) = (p[1] - q[1], q[0] - p[0]);
            (x, y, -(x * p[0] + y * p[1]))
        };
        let edges = [edge(b, c), edge(c, a), edge(a, b)];
        let parts = i64::from(PARTS);
        for y in self.span(1, top, height) {
            for x in self.span(0, left, width) {
                #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "within the tile")]
                let pixel = (y - top) as usize * TILE_WIDTH + (x - left) as usize;
                for (s, [dx, dy]) in PATTERN.iter().enumerate() {
                    let at = [x * parts + i64::from(*dx), y * parts + i64::from(*dy)];
                    let inside = edges.map(|(x, y, base)| x * at[0] + y * at[1] + base);
                    // Neighbours may both have a sample on their common edge: the first of them keeps it.
                    if inside.iter().any(|e| *e < 0) {
                        continue;
                    }
                    let weights = inside.map(|e| e as f32);
                    let value = |k: usize| {
                        weights[0] * self.values[0][k] + weights[1] * self.values[1][k] + weights[2] * self.values[2][k]
                    };
                    let (i, depth) = (pixel * SAMPLES + s, value(0));
                    if depth < samples.depth[i] {
                        samples.depth[i] = depth;
                        samples.light[i] = value(1);
                        samples.normal[i] = [value(2), value(3), value(4)];
                    }
                }
            }
        }
    }
}

/// Fills a row of tiles: what is seen of `shape` there.
pub(super) fn fill(
    shape: Shape<'_>,
    camera: &Camera,
    bins: &Bins,
    tiles: Tiles,
    band: &mut Band<'_>,
    samples: &mut Samples,
) {
    let height = band.depth.len() / band.width;
    for column in 0..tiles.across {
        let left = column * TILE_WIDTH;
        let width = TILE_WIDTH.min(band.width - left);
        let mut triangles = bins.of(band.top / TILE_HEIGHT * tiles.across + column).peekable();
        if triangles.peek().is_none() {
            continue;
        }
        samples.depth.fill(NOTHING);
        let signed = |n: [usize; 2]| n.map(|n| i64::try_from(n).unwrap_or(i64::MAX));
        let (corner, size) = (signed([left, band.top]), signed([width, height]));
        for triangle in triangles {
            Facet::new(shape, triangle, camera).draw(corner, size, samples);
        }
        for y in 0..height {
            for x in 0..width {
                let (pixel, at) = (y * TILE_WIDTH + x, y * band.width + left + x);
                (band.depth[at], band.light[at], band.facing[at]) = resolve(samples, pixel);
            }
        }
    }
}

/// A pixel from its samples.
fn resolve(samples: &Samples, pixel: usize) -> (f32, f32, Facing) {
    let of_pixel = pixel * SAMPLES..(pixel + 1) * SAMPLES;
    let (mut nearest, mut light, mut normal, mut covered) = (NOTHING, 0.0, [0.0_f32; 3], 0_u16);
    for i in of_pixel.filter(|i| samples.depth[*i] < NOTHING) {
        nearest = nearest.min(samples.depth[i]);
        light += samples.light[i];
        (0..3).for_each(|k| normal[k] += samples.normal[i][k]);
        covered += 1;
    }
    if covered == 0 {
        return (NOTHING, 0.0, Facing::default());
    }
    let length = dot(normal, normal).sqrt();
    // Opposite normals in one pixel cancel: it is seen from the front then.
    let unit = if length > 0.0 { normal.map(|c| c / length) } else { [0.0, 0.0, 1.0] };
    #[expect(clippy::cast_possible_truncation, reason = "components of a unit vector")]
    let normal = unit.map(|c| (c * UNIT).round_ties_even() as i16);
    (nearest, light / f32::from(covered), Facing { normal, covered })
}
