//! From layers to pixels: what a pixel's neighbourhood does to its light, then colour, background and alpha.

use rayon::prelude::*;

use super::camera::Camera;
use super::layers::{Layers, NOTHING};
use super::light::{self, Levels};
use super::{Background, Image, PictureParams, Style};

/// Sixteen directions around a pixel, a sixteenth of a turn apart.
const AROUND: [[f64; 2]; 16] = {
    const C: f64 = 0.923_879_532_511_286_7;
    const S: f64 = 0.382_683_432_365_089_8;
    const H: f64 = std::f64::consts::FRAC_1_SQRT_2;
    [
        [1., 0.],
        [C, S],
        [H, H],
        [S, C],
        [0., 1.],
        [-S, C],
        [-H, H],
        [-C, S],
        [-1., 0.],
        [-C, -S],
        [-H, -H],
        [-S, -C],
        [0., -1.],
        [S, -C],
        [H, -H],
        [C, -S],
    ]
};
/// Rings of neighbours, as parts of the radius. Each takes every other direction, in turn.
const RINGS: [f64; 6] = [0.06, 0.13, 0.24, 0.4, 0.65, 1.0];
/// Radius of what may shade a pixel: at least that of a pocket, Å, and so much of the picture's shorter side.
const RADIUS: f64 = 6.0;
const RADIUS_SHARE: f64 = 0.07;
/// Sine above the tangent plane below which a neighbour shades nothing: roundness is no pocket.
const BIAS: f32 = 0.12;
/// How dark it gets.
const STRENGTH: f32 = 2.8;
/// Least light that shading leaves.
const DARKEST: f32 = 0.25;
/// A step in depth becomes a line from here on, Å and pixels, and is one at so many times that.
const STEP: f32 = 1.2;
const STEP_PIXELS: f32 = 2.5;
const STEP_FULL: f32 = 3.0;
/// What a line takes of the light.
const LINE: f32 = 0.6;
/// Pixels of the picture's shorter side per pixel of a line's width.
const LINE_SIDE: u32 = 700;

/// A neighbour: how far it is in pixels, and in Å (right, up).
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

/// The numbers that shading is made with.
#[derive(Debug, Clone, PartialEq)]
pub struct Finish {
    /// Neighbours that may shade a pixel; none where nothing is shaded so.
    pub taps: Vec<Tap>,
    /// Square of the distance at which a neighbour shades half, Å⁻².
    pub falloff: f32,
    /// [`BIAS`].
    pub bias: f32,
    /// What the mean of the neighbours is multiplied by.
    pub strength: f32,
    /// Least light that shading leaves.
    pub darkest: f32,
    /// Columns and rows to the neighbours that make a line; 0 without lines.
    pub line: i32,
    /// Step in depth at which a line begins, and at which it is one, Å.
    pub steps: [f32; 2],
    /// What a line takes of the light.
    pub ink: f32,
    /// The surface's colour in full light, linear.
    pub color: [f32; 3],
    /// The background's colour, linear and premultiplied, and its alpha.
    pub behind: [f32; 4],
}

impl Finish {
    /// The numbers of a picture.
    #[must_use]
    #[expect(clippy::cast_possible_truncation, reason = "small numbers; single precision is what shading has")]
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
            bias: BIAS,
            strength: STRENGTH,
            darkest: DARKEST,
            line: if shaded { line } else { 0 },
            steps: [step, step * STEP_FULL],
            ink: LINE,
            color: light::COLOR.map(|level| light::linear(level) as f32),
            behind: [r, g, b, alpha],
        }
    }
}

/// The neighbours within `radius` pixels of `pixel` Å each.
#[expect(clippy::cast_possible_truncation, reason = "pixels of a picture")]
fn taps(radius: f64, pixel: f64) -> Vec<Tap> {
    let mut taps = Vec::new();
    for (ring, part) in RINGS.iter().enumerate() {
        for [x, y] in AROUND.iter().skip(ring % 2).step_by(2) {
            let [dx, dy] = [x, y].map(|c| (c * part * radius).round() as i32);
            if (dx, dy) != (0, 0) {
                let [right, up] = [f64::from(dx), -f64::from(dy)].map(|c| (c * pixel) as f32);
                taps.push(Tap { dx, dy, right, up });
            }
        }
    }
    taps
}

/// The picture of `layers`.
pub(super) fn finish(layers: &Layers, numbers: &Finish, params: &PictureParams) -> Image {
    let levels = Levels::get();
    let mut pixels = vec![[0; 4]; layers.width * layers.height];
    pixels.par_chunks_mut(layers.width.max(1)).enumerate().for_each_init(Row::default, |row, (y, out)| {
        row.shade(layers, numbers, y);
        for (x, pixel) in out.iter_mut().enumerate() {
            *pixel = color(layers, numbers, levels, row.open.get(x).copied(), x, y);
        }
    });
    Image { width: params.width, height: params.height, pixels }
}

/// One pixel; `open` is how much light its neighbours let through, where that is asked.
fn color(layers: &Layers, numbers: &Finish, levels: &Levels, open: Option<f32>, x: usize, y: usize) -> [u8; 4] {
    let at = y * layers.width + x;
    let share = layers.facing[at].share();
    let mut light = layers.light[at];
    if share > 0.0 {
        if let Some(open) = open {
            light *= open;
        }
        if numbers.line > 0 {
            light *= 1.0 - numbers.ink * line(layers, numbers, x, y);
        }
    }
    let alpha = share + numbers.behind[3] * (1.0 - share);
    if alpha <= 0.0 {
        return [0; 4];
    }
    let level = |k: usize| {
        let premultiplied = numbers.color[k] * light * share + numbers.behind[k] * (1.0 - share);
        levels.of(premultiplied / alpha)
    };
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0 to 255")]
    let alpha = (alpha.min(1.0) * 255.0 + 0.5) as u8;
    [level(0), level(1), level(2), alpha]
}

/// A row of pixels on its way: a column for each number, so that several pixels are computed at once.
#[derive(Default)]
struct Row {
    normal: [Vec<f32>; 3],
    /// How much light reaches a pixel past its neighbours, 0 to 1; empty where nothing is shaded so.
    open: Vec<f32>,
}

impl Row {
    /// Finds out how much light reaches the pixels of row `y`: each neighbour that rises above a pixel's tangent plane takes its
    /// part, the more the steeper and the nearer it is.
    fn shade(&mut self, layers: &Layers, numbers: &Finish, y: usize) {
        self.open.clear();
        if numbers.taps.is_empty() {
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
        for tap in &numbers.taps {
            let Some(there) = y.checked_add_signed(tap.dy as isize).filter(|y| *y < layers.height) else { continue };
            // The columns whose neighbour is in the picture.
            let shift = tap.dx.unsigned_abs() as usize;
            let (from, to) =
                if tap.dx < 0 { (first.max(shift), end) } else { (first, end.min(width.saturating_sub(shift))) };
            if from >= to {
                continue;
            }
            let begin = if tap.dx < 0 { from - shift } else { from + shift };
            let other = &layers.depth[row(there)][begin..begin + to - from];
            let normal = self.normal.each_ref().map(|column| &column[from..to]);
            taken(&mut self.open[from..to], &depth[from..to], other, normal, *tap, [numbers.bias, numbers.falloff]);
        }
        let scale = numbers.strength / numbers.taps.len() as f32;
        self.open.iter_mut().for_each(|shade| *shade = (1.0 - *shade * scale).max(numbers.darkest));
    }
}

/// Adds what the neighbours at `tap` take of the light. All slices have one length.
fn taken(
    shade: &mut [f32],
    depth: &[f32],
    other: &[f32],
    [right, up, toward]: [&[f32]; 3],
    tap: Tap,
    [bias, falloff]: [f32; 2],
) {
    let n = shade.len();
    let (depth, other, right, up, toward) = (&depth[..n], &other[..n], &right[..n], &up[..n], &toward[..n]);
    let flat = tap.right * tap.right + tap.up * tap.up;
    for i in 0..n {
        let rise = depth[i] - other[i];
        let square = flat + rise * rise;
        let sine = (right[i] * tap.right + up[i] * tap.up + toward[i] * rise) / square.sqrt() - bias;
        // Where nothing is seen, here or there, the sine is no number, and nothing is taken.
        shade[i] += if sine > 0.0 { sine / (1.0 + square * falloff) } else { 0.0 };
    }
}

/// The pixel that lies so far from (x, y), if it is in the picture.
#[inline]
fn neighbour(layers: &Layers, x: usize, y: usize, dx: i32, dy: i32) -> Option<usize> {
    let x = x.checked_add_signed(dx as isize).filter(|x| *x < layers.width)?;
    let y = y.checked_add_signed(dy as isize).filter(|y| *y < layers.height)?;
    Some(y * layers.width + x)
}

/// How much of a line a pixel is, 0 to 1: on the near side of a step in depth, and at the rim.
fn line(layers: &Layers, numbers: &Finish, x: usize, y: usize) -> f32 {
    let depth = layers.depth[y * layers.width + x];
    let n = numbers.line;
    let (mut step, mut rim) = (0.0_f32, 0.0_f32);
    for (dx, dy) in [(n, 0), (0, n), (n, n), (n, -n)] {
        let ends = [(dx, dy), (-dx, -dy)].map(|(dx, dy)| neighbour(layers, x, y, dx, dy));
        let mut sum = 0.0;
        let mut whole = true;
        for end in ends {
            // The picture's border is no rim.
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
    let [from, to] = numbers.steps;
    let part = ((step - from) / (to - from)).clamp(0.0, 1.0);
    (part * part * (3.0 - 2.0 * part)).max(rim)
}
