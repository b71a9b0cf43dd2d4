//! Rasterizer of one tile: the nearest triangle at four samples of every pixel.

use molmesh_surface::vector::{add, length, unit};
use molmesh_surface::{Control, Mesh, SurfaceError, Vertices};

use super::PictureError;
use super::bins::{Bins, PARTS, TILE_HEIGHT, TILE_WIDTH, Tiles, corner, twice_area};
use super::camera::Camera;
use super::layers::{FULL, Facing, NOTHING, SAMPLES, UNIT};
use super::light::{lambert, linear_levels};

/// Positions of the samples within a pixel, in subpixels: the standard pattern of graphics devices.
const PATTERN: [[i32; 2]; SAMPLES] = [[96, 32], [224, 96], [32, 160], [160, 224]];
/// Number of samples of a tile.
const N: usize = TILE_WIDTH * TILE_HEIGHT * SAMPLES;

/// Columns of a mesh that are drawn.
#[derive(Clone, Copy)]
pub struct MeshColumns<'a> {
    /// Positions of the vertices, Å.
    pub positions: &'a [[f32; 3]],
    /// Unit normals of the vertices.
    pub normals: &'a [[f32; 3]],
    /// Vertices of each triangle, counter-clockwise from outside.
    pub triangles: &'a [[u32; 3]],
    /// sRGB colours, if the mesh has colours of its own.
    pub colors: Option<&'a [[u8; 4]]>,
}

impl<'a> MeshColumns<'a> {
    /// Returns the columns of `mesh`.
    ///
    /// # Errors
    /// [`PictureError::Quantized`].
    pub fn of(mesh: &'a Mesh) -> Result<Self, PictureError> {
        match mesh.vertices() {
            Vertices::Single { positions, normals } => {
                Ok(Self { positions, normals, triangles: &mesh.triangles, colors: mesh.colors.as_deref() })
            }
            Vertices::Quantized { .. } => Err(PictureError::Quantized),
        }
    }
}

/// Row of tiles of the layers.
pub(super) struct Band<'a> {
    /// First row of pixels.
    pub(super) top: usize,
    pub(super) width: usize,
    pub(super) depth: &'a mut [f32],
    pub(super) light: &'a mut [f32],
    pub(super) facing: &'a mut [Facing],
    pub(super) color: &'a mut [[u16; 3]],
}

/// Samples of a tile.
pub(super) struct Samples {
    depth: Vec<f32>,
    light: Vec<f32>,
    normal: Vec<[f32; 3]>,
    /// Linear colour, if the mesh has colours of its own.
    color: Vec<[f32; 3]>,
}

impl Default for Samples {
    fn default() -> Self {
        let zeros = || vec![[0.0; 3]; N];
        Self { depth: vec![NOTHING; N], light: vec![0.0; N], normal: zeros(), color: zeros() }
    }
}

/// Front-facing triangle.
struct Facet {
    /// Vertices in reverse order, so that edge functions are positive inside.
    vertices: [u32; 3],
    corners: [[i32; 2]; 3],
    /// Depth of each corner, divided by twice the area.
    depths: [f32; 3],
    /// Inverse of twice the area.
    share: f32,
}

/// Edge function: positive inside the triangle, 0 on the edge.
struct EdgeFunction {
    /// Increments per column and per row.
    column: i64,
    row: i64,
    /// Values at the samples of the current pixel.
    at: [i64; SAMPLES],
}

impl EdgeFunction {
    /// Edge from `p` to `q`, at the pixel in column `x` of row `y`.
    fn new(p: [i32; 2], q: [i32; 2], x: i64, y: i64) -> Self {
        let ([px, py], [qx, qy]) = (p.map(i64::from), q.map(i64::from));
        let (column, row, parts) = (py - qy, qx - px, i64::from(PARTS));
        let at =
            PATTERN.map(|[dx, dy]| column * (x * parts + i64::from(dx) - px) + row * (y * parts + i64::from(dy) - py));
        Self { column: column * parts, row: row * parts, at }
    }

    #[inline]
    fn step(&mut self, by: i64) {
        self.at = self.at.map(|value| value + by);
    }
}

impl Facet {
    fn new(mesh: MeshColumns<'_>, triangle: u32, camera: &Camera) -> Self {
        let [a, c, b] = mesh.triangles[triangle as usize];
        let vertices = [a, b, c];
        let projected = vertices.map(|v| camera.project(mesh.positions[v as usize]));
        let corners = projected.map(corner);
        let share = 1.0 / twice_area(corners) as f32;
        Self { vertices, corners, depths: projected.map(|place| place[2] * share), share }
    }

    /// Light, normal and linear colour of each corner, divided by twice the area.
    fn shades(&self, mesh: MeshColumns<'_>, camera: &Camera) -> [[f32; 7]; 3] {
        let levels = linear_levels();
        self.vertices.map(|v| {
            let [x, y, z] = camera.turn(mesh.normals[v as usize]);
            let [r, g, b, _] = mesh.colors.map_or([0; 4], |colors| colors[v as usize]);
            let [r, g, b] = [r, g, b].map(|level| levels[usize::from(level)]);
            [lambert([x, y, z]), x, y, z, r, g, b].map(|value| value * self.share)
        })
    }

    /// Range of pixels along an axis that may have covered samples, within a tile of `n` pixels from `from` on.
    fn span(&self, axis: usize, from: i64, n: i64) -> std::ops::Range<i64> {
        let [a, b, c] = self.corners.map(|c| c[axis].div_euclid(PARTS));
        i64::from(a.min(b).min(c)).max(from)..(i64::from(a.max(b).max(c)) + 1).min(from + n)
    }

    /// Draws the samples that are nearer than the present ones.
    fn draw(
        &self,
        mesh: MeshColumns<'_>,
        camera: &Camera,
        [left, top]: [i64; 2],
        [width, height]: [i64; 2],
        samples: &mut Samples,
    ) {
        let (rows, columns) = (self.span(1, top, height), self.span(0, left, width));
        let [a, b, c] = self.corners;
        let mut edges = [[b, c], [c, a], [a, b]].map(|[p, q]| EdgeFunction::new(p, q, columns.start, rows.start));
        // Most triangles are small and many are hidden, so normals are loaded with the first visible sample.
        let mut shades = None;
        for y in rows {
            for x in columns.clone() {
                #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "within the tile")]
                let pixel = (y - top) as usize * TILE_WIDTH + (x - left) as usize;
                for s in 0..SAMPLES {
                    let inside = [edges[0].at[s], edges[1].at[s], edges[2].at[s]];
                    // A sample on a common edge belongs to both triangles; the first keeps it.
                    if inside[0] | inside[1] | inside[2] < 0 {
                        continue;
                    }
                    let [u, v, w] = inside.map(|e| e as f32);
                    let depth = u * self.depths[0] + v * self.depths[1] + w * self.depths[2];
                    let i = pixel * SAMPLES + s;
                    if depth >= samples.depth[i] {
                        continue;
                    }
                    let [a, b, c] = shades.get_or_insert_with(|| self.shades(mesh, camera));
                    let value = |k: usize| u * a[k] + v * b[k] + w * c[k];
                    samples.depth[i] = depth;
                    samples.light[i] = value(0);
                    samples.normal[i] = [value(1), value(2), value(3)];
                    if mesh.colors.is_some() {
                        samples.color[i] = [value(4), value(5), value(6)];
                    }
                }
                for edge in &mut edges {
                    edge.step(edge.column);
                }
            }
            let back = columns.end - columns.start;
            for edge in &mut edges {
                edge.step(edge.row - back * edge.column);
            }
        }
    }
}

/// Number of triangles that are drawn between two checks of the cancellation flag. A large triangle fills its tile.
const TRIANGLES_PER_CHECK: usize = 1 << 10;

/// Draws `mesh` in a row of tiles.
///
/// # Errors
/// [`SurfaceError::Cancelled`].
pub(super) fn fill(
    mesh: MeshColumns<'_>,
    camera: &Camera,
    bins: &Bins,
    tiles: Tiles,
    band: &mut Band<'_>,
    samples: &mut Samples,
    control: &Control<'_>,
) -> Result<(), SurfaceError> {
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
        for (n, triangle) in triangles.enumerate() {
            control.check_every(n, TRIANGLES_PER_CHECK)?;
            Facet::new(mesh, triangle, camera).draw(mesh, camera, corner, size, samples);
        }
        for y in 0..height {
            for x in 0..width {
                let (pixel, at) = (y * TILE_WIDTH + x, y * band.width + left + x);
                (band.depth[at], band.light[at], band.facing[at]) = resolve(samples, pixel);
                if mesh.colors.is_some() {
                    band.color[at] = mean_color(samples, pixel);
                }
            }
        }
    }
    Ok(())
}

/// Returns the mean colour of the covered samples of a pixel.
fn mean_color(samples: &Samples, pixel: usize) -> [u16; 3] {
    let (mut sum, mut covered) = ([0.0_f32; 3], 0.0_f32);
    for i in (pixel * SAMPLES..(pixel + 1) * SAMPLES).filter(|i| samples.depth[*i] < NOTHING) {
        sum = add(sum, samples.color[i]);
        covered += 1.0;
    }
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "float-to-int casts saturate")]
    sum.map(|sum| (sum / covered.max(1.0) * FULL + 0.5) as u16)
}

/// Resolves the samples of a pixel.
fn resolve(samples: &Samples, pixel: usize) -> (f32, f32, Facing) {
    let of_pixel = pixel * SAMPLES..(pixel + 1) * SAMPLES;
    let (mut nearest, mut light, mut normal, mut covered) = (NOTHING, 0.0, [0.0_f32; 3], 0_u16);
    for i in of_pixel.filter(|i| samples.depth[*i] < NOTHING) {
        nearest = nearest.min(samples.depth[i]);
        light += samples.light[i];
        normal = add(normal, samples.normal[i]);
        covered += 1;
    }
    if covered == 0 {
        return (NOTHING, 0.0, Facing::default());
    }
    // Opposite normals cancel. The normal of the pixel then points to the viewer.
    let unit = if length(normal) > 0.0 { unit(normal) } else { [0.0, 0.0, 1.0] };
    #[expect(clippy::cast_possible_truncation, reason = "components of a unit vector")]
    let normal = unit.map(|c| (c * UNIT + 0.5_f32.copysign(c)) as i16);
    (nearest, light / f32::from(covered), Facing { normal, covered })
}
