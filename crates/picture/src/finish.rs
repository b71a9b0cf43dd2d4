//! Shading of layers: ambient occlusion and outline from the neighbourhood of each pixel, then colour, background and
//! alpha.

use molmesh_surface::{Control, SurfaceError};
use rayon::prelude::*;

use super::camera::Camera;
use super::layers::{FULL, Layers, NOTHING};
use super::light::{self, Levels};
use super::{Background, Image, PictureParams, Style};

/// Directions from a pixel in a quarter of the circle, at equal angles.
const QUARTER: [[f64; 2]; 4] = {
    const C: f64 = 0.923_879_532_511_286_7;
    const S: f64 = 0.382_683_432_365_089_8;
    const H: f64 = std::f64::consts::FRAC_1_SQRT_2;
    [[1., 0.], [C, S], [H, H], [S, C]]
};
/// Radii of the rings of neighbours, relative to the radius. Rings use the even and the odd directions in
/// turn.
const RINGS: [f64; 6] = [0.06, 0.13, 0.24, 0.4, 0.65, 1.0];
/// Radius of ambient occlusion: at least that of a pocket in Å, and at least a fraction of the shorter side.
const RADIUS: f64 = 6.0;
const RADIUS_SHARE: f64 = 0.07;
/// Sine above the tangent plane below which a neighbour does not occlude, so that convex surfaces are not darkened.
pub const OCCLUSION_BIAS: f32 = 0.12;
/// Factor of the mean occlusion.
pub const OCCLUSION_STRENGTH: f32 = 2.8;
/// Minimum light after occlusion.
pub const MIN_LIGHT: f32 = 0.25;
/// Step in depth at which an outline begins, in Å plus pixels, and the factor at which it has full strength.
const STEP: f32 = 1.2;
const STEP_PIXELS: f32 = 2.5;
const STEP_FULL: f32 = 3.0;
/// Share of the light that an outline removes.
pub const LINE_STRENGTH: f32 = 0.6;
/// Pixels of the shorter side per pixel of line width.
const LINE_SIDE: u32 = 700;

/// Neighbour of a pixel: offset in pixels and in Å.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tap {
    /// Columns to the right.
    pub dx: i32,
    /// Rows downwards.
    pub dy: i32,
    /// Å to the right.
    pub right: f32,
    /// Å upwards.
    pub up: f32,
}

/// Parameters of shading.
#[derive(Debug, Clone, PartialEq)]
pub struct Finish {
    /// Neighbours that may occlude a pixel; empty without ambient occlusion.
    pub taps: Vec<Tap>,
    /// Inverse square of the distance at which occlusion is halved, Å⁻².
    pub falloff: f32,
    /// Distance in pixels of the neighbours that are compared for outlines; 0 without outlines.
    pub line_width: i32,
    /// Steps in depth at which an outline begins and at which it has full strength, Å.
    pub steps: [f32; 2],
    /// Colour in full light of a surface without colours of its own, linear.
    pub color: [f32; 3],
    /// Colour of the background, linear and premultiplied, and its alpha.
    pub background: [f32; 4],
}

impl Finish {
    /// Returns the parameters for a picture.
    #[must_use]
    #[expect(clippy::cast_possible_truncation, reason = "small numbers; shading uses single precision")]
    pub fn new(params: &PictureParams, camera: &Camera) -> Self {
        let side = params.width.min(params.height);
        let radius = RADIUS.max(RADIUS_SHARE * f64::from(side) * camera.pixel());
        let shaded = params.style == Style::Surface;
        let line = i32::try_from((side + LINE_SIDE / 2) / LINE_SIDE).unwrap_or(1).max(1);
        let step = STEP + STEP_PIXELS * line as f32 * camera.pixel() as f32;
        let Background([r, g, b, a]) = params.background;
        let alpha = f32::from(a) / 255.0;
        let [r, g, b] = [r, g, b].map(|level| light::linear(level) as f32 * alpha);
        Self {
            taps: if shaded { taps(radius / camera.pixel(), camera.pixel()) } else { Vec::new() },
            falloff: (1.0 / (radius * radius)) as f32 * 4.0,
            line_width: if shaded { line } else { 0 },
            steps: [step, step * STEP_FULL],
            color: light::COLOR.map(|level| light::linear(level) as f32),
            background: [r, g, b, alpha],
        }
    }
}

/// Neighbours within `radius` pixels of `pixel` Å each.
#[expect(clippy::cast_possible_truncation, reason = "pixels of a picture")]
fn taps(radius: f64, pixel: f64) -> Vec<Tap> {
    let (mut around, mut quarter) = (Vec::new(), QUARTER);
    for _ in 0..4 {
        around.extend(quarter);
        quarter = quarter.map(|[x, y]| [-y, x]);
    }
    let mut taps = Vec::new();
    for (ring, part) in RINGS.iter().enumerate() {
        for [x, y] in around.iter().skip(ring % 2).step_by(2) {
            let [dx, dy] = [x, y].map(|c| (c * part * radius).round() as i32);
            if (dx, dy) != (0, 0) {
                let [right, up] = [f64::from(dx), -f64::from(dy)].map(|c| (c * pixel) as f32);
                taps.push(Tap { dx, dy, right, up });
            }
        }
    }
    taps
}

/// Shades `layers`.
///
/// # Errors
/// [`SurfaceError::Cancelled`].
pub(super) fn finish(
    layers: &Layers,
    shading: &Finish,
    params: &PictureParams,
    control: &Control<'_>,
) -> Result<Image, SurfaceError> {
    let levels = Levels::get();
    let mut pixels = vec![[0; 4]; layers.width * layers.height];
    let rows = pixels.par_chunks_mut(layers.width.max(1)).enumerate();
    rows.try_for_each_init(PixelRow::default, |row, (y, out)| {
        control.check()?;
        row.shade(layers, shading, y);
        for (x, pixel) in out.iter_mut().enumerate() {
            *pixel = color(layers, shading, levels, row.open.get(x).copied(), x, y);
        }
        Ok::<_, SurfaceError>(())
    })?;
    Ok(Image { width: params.width, height: params.height, pixels })
}

/// Colour of a pixel; `open` is the share of the light that is not occluded, if occlusion is enabled.
fn color(layers: &Layers, shading: &Finish, levels: &Levels, open: Option<f32>, x: usize, y: usize) -> [u8; 4] {
    let at = y * layers.width + x;
    let share = layers.facing[at].share();
    let mut light = layers.light[at];
    if share > 0.0 {
        if let Some(open) = open {
            light *= open;
        }
        if shading.line_width > 0 {
            light *= 1.0 - LINE_STRENGTH * outline(layers, shading, x, y);
        }
    }
    let alpha = share + shading.background[3] * (1.0 - share);
    if alpha <= 0.0 {
        return [0; 4];
    }
    let surface = if layers.is_colored { layers.color[at].map(|c| f32::from(c) / FULL) } else { shading.color };
    let level = |k: usize| {
        let premultiplied = surface[k] * light * share + shading.background[k] * (1.0 - share);
        levels.of(premultiplied / alpha)
    };
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0 to 255")]
    let alpha = (alpha.min(1.0) * 255.0 + 0.5) as u8;
    [level(0), level(1), level(2), alpha]
}

/// Row of pixels in columns, so that several pixels are computed at once.
#[derive(Default)]
struct PixelRow {
    normal: [Vec<f32>; 3],
    /// Share of the light that is not occluded, 0 to 1; empty without ambient occlusion.
    open: Vec<f32>,
}

impl PixelRow {
    /// Computes the occlusion of row `y`. Every neighbour above the tangent plane of a pixel occludes it. Neighbours
    /// that are nearer, or higher above the plane, occlude more.
    fn shade(&mut self, layers: &Layers, shading: &Finish, y: usize) {
        self.open.clear();
        if shading.taps.is_empty() {
            return;
        }
        let width = layers.width;
        let row = |y: usize| y * width..(y + 1) * width;
        let facing = &layers.facing[row(y)];
        for (k, column) in self.normal.iter_mut().enumerate() {
            column.clear();
            column.extend(facing.iter().map(|facing| facing.direction()[k]));
        }
        self.open.resize(width, 0.0);
        let first = facing.iter().position(|facing| facing.covered > 0).unwrap_or(width);
        let end = facing.iter().rposition(|facing| facing.covered > 0).map_or(first, |last| last + 1);
        let depth = &layers.depth[row(y)];
        for tap in &shading.taps {
            let Some(there) = y.checked_add_signed(tap.dy as isize).filter(|y| *y < layers.height) else { continue };
            // Columns whose neighbour lies in the picture.
            let shift = tap.dx.unsigned_abs() as usize;
            let (from, to) =
                if tap.dx < 0 { (first.max(shift), end) } else { (first, end.min(width.saturating_sub(shift))) };
            if from >= to {
                continue;
            }
            let begin = if tap.dx < 0 { from - shift } else { from + shift };
            let other = &layers.depth[row(there)][begin..begin + to - from];
            let normal = self.normal.each_ref().map(|column| &column[from..to]);
            add_occlusion(&mut self.open[from..to], &depth[from..to], other, normal, *tap, shading.falloff);
        }
        let scale = OCCLUSION_STRENGTH / shading.taps.len() as f32;
        self.open.iter_mut().for_each(|shade| *shade = (1.0 - *shade * scale).max(MIN_LIGHT));
    }
}

/// Adds the occlusion by the neighbours at `tap`. All slices have the same length.
fn add_occlusion(
    shade: &mut [f32],
    depth: &[f32],
    other: &[f32],
    [right, up, toward]: [&[f32]; 3],
    tap: Tap,
    falloff: f32,
) {
    let n = shade.len();
    let (depth, other, right, up, toward) = (&depth[..n], &other[..n], &right[..n], &up[..n], &toward[..n]);
    let flat = tap.right * tap.right + tap.up * tap.up;
    for i in 0..n {
        let rise = depth[i] - other[i];
        let square = flat + rise * rise;
        let sine = (right[i] * tap.right + up[i] * tap.up + toward[i] * rise) / square.sqrt() - OCCLUSION_BIAS;
        // Without a surface at either pixel the sine is NaN and nothing is added.
        shade[i] += if sine > 0.0 { sine / (1.0 + square * falloff) } else { 0.0 };
    }
}

/// Index of the pixel at offset (dx, dy) from (x, y), if it lies in the picture.
#[inline]
fn neighbour(layers: &Layers, x: usize, y: usize, dx: i32, dy: i32) -> Option<usize> {
    let x = x.checked_add_signed(dx as isize).filter(|x| *x < layers.width)?;
    let y = y.checked_add_signed(dy as isize).filter(|y| *y < layers.height)?;
    Some(y * layers.width + x)
}

/// Strength of the outline at a pixel, 0 to 1: on the near side of a step in depth, and at the silhouette.
fn outline(layers: &Layers, shading: &Finish, x: usize, y: usize) -> f32 {
    let depth = layers.depth[y * layers.width + x];
    let n = shading.line_width;
    let (mut step, mut rim) = (0.0_f32, 0.0_f32);
    for (dx, dy) in [(n, 0), (0, n), (n, n), (n, -n)] {
        let ends = [(dx, dy), (-dx, -dy)].map(|(dx, dy)| neighbour(layers, x, y, dx, dy));
        let mut sum = 0.0;
        let mut whole = true;
        for end in ends {
            // The border of the picture is not a silhouette.
            let Some(end) = end else {
                whole = false;
                continue;
            };
            rim = rim.max(1.0 - layers.facing[end].share());
            if layers.depth[end] < NOTHING { sum += layers.depth[end] } else { whole = false }
        }
        if whole {
            step = step.max(sum - 2.0 * depth);
        }
    }
    let [from, to] = shading.steps;
    let part = ((step - from) / (to - from)).clamp(0.0, 1.0);
    (part * part * (3.0 - 2.0 * part)).max(rim)
}
