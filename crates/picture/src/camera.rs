//! Camera: directions, scale and offset of a picture, from the mesh and the view.

use molmesh_surface::vector::{dot, joined_bounds};
use rayon::prelude::*;

use super::axes;
use super::{PictureParams, View};

/// Number of vertices per task.
const CHUNK: usize = 1 << 14;
/// Margin on each side, as a share of the picture.
const MARGIN: f64 = 0.04;

/// Orthographic view.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    /// Unit vectors in mesh coordinates: right, up, towards the viewer.
    pub axes: [[f32; 3]; 3],
    /// Offsets of the projections of a position, Å. They move the centre of the mesh to the centre of the picture and
    /// the nearest point to depth 0.
    pub shift: [f32; 3],
    /// Pixels per Å.
    pub scale: f32,
    /// Depth of the farthest point, Å.
    pub reach: f32,
    /// Half of the width and of the height, pixels.
    pub middle: [f32; 2],
}

impl Camera {
    /// Creates the view in which the mesh fills the picture.
    #[must_use]
    pub fn new(positions: &[[f32; 3]], triangles: &[[u32; 3]], params: &PictureParams) -> Self {
        let wide = rotated(directions(positions, triangles, params.view), params.azimuth, params.elevation);
        #[expect(clippy::cast_possible_truncation, reason = "components of unit vectors")]
        let axes = wide.map(|axis| axis.map(|c| c as f32));
        let [low, high] = bounds(positions, &axes);
        let size: [f64; 2] = std::array::from_fn(|k| f64::from(high[k]) - f64::from(low[k]));
        let pixels = [params.width, params.height].map(f64::from);
        let usable = 1.0 - 2.0 * MARGIN;
        // A mesh without extent is treated as one of 1 Å.
        let fits = |k: usize| pixels[k] * usable / if size[k] > 0.0 { size[k] } else { 1.0 };
        #[expect(clippy::cast_possible_truncation, reason = "16,384 pixels at most, over the extent of a mesh")]
        let (scale, middle) = (fits(0).min(fits(1)) as f32, pixels.map(|n| (n / 2.0) as f32));
        let shift = [-0.5 * (low[0] + high[0]), -0.5 * (low[1] + high[1]), high[2]];
        Self { axes, shift, scale, reach: high[2] - low[2], middle }
    }

    /// Width of a pixel, Å.
    #[must_use]
    pub fn pixel(&self) -> f64 {
        1.0 / f64::from(self.scale)
    }

    /// Projects a position: column and row in pixels from the upper left corner, and depth in Å behind the nearest
    /// point.
    #[inline]
    #[must_use]
    pub fn project(&self, position: [f32; 3]) -> [f32; 3] {
        let [right, up, toward] = self.axes.map(|axis| dot(axis, position));
        [
            (right + self.shift[0]) * self.scale + self.middle[0],
            self.middle[1] - (up + self.shift[1]) * self.scale,
            self.shift[2] - toward,
        ]
    }

    /// Transforms a direction to view space: right, up, towards.
    #[inline]
    #[must_use]
    pub fn turn(&self, direction: [f32; 3]) -> [f32; 3] {
        self.axes.map(|axis| dot(axis, direction))
    }
}

/// Axes of a named view: right, up, towards the viewer.
fn directions(positions: &[[f32; 3]], triangles: &[[u32; 3]], view: View) -> [[f64; 3]; 3] {
    const X: [f64; 3] = [1.0, 0.0, 0.0];
    const Y: [f64; 3] = [0.0, 1.0, 0.0];
    const Z: [f64; 3] = [0.0, 0.0, 1.0];
    let minus = |axis: [f64; 3]| axis.map(|c| -c);
    match view {
        View::Principal => axes::principal(positions, triangles),
        View::Front => [X, Y, Z],
        View::Back => [minus(X), Y, minus(Z)],
        View::Left => [Z, Y, minus(X)],
        View::Right => [minus(Z), Y, X],
        View::Top => [X, minus(Z), Y],
        View::Bottom => [X, Z, minus(Y)],
    }
}

/// Returns the axes rotated by azimuth and elevation, degrees.
fn rotated([right, up, toward]: [[f64; 3]; 3], azimuth: f64, elevation: f64) -> [[f64; 3]; 3] {
    let mix = |a: [f64; 3], x: f64, b: [f64; 3], y: f64| std::array::from_fn(|k| a[k] * x + b[k] * y);
    let (sin, cos) = azimuth.to_radians().sin_cos();
    let (toward, right): ([f64; 3], [f64; 3]) = (mix(toward, cos, right, sin), mix(right, cos, toward, -sin));
    let (sin, cos) = elevation.to_radians().sin_cos();
    [right, mix(up, cos, toward, -sin), mix(toward, cos, up, sin)]
}

/// Minimum and maximum projection on each axis.
fn bounds(positions: &[[f32; 3]], axes: &[[f32; 3]; 3]) -> [[f32; 3]; 2] {
    let of_chunk = |chunk: &[[f32; 3]]| {
        chunk.iter().fold([[f32::INFINITY; 3], [f32::NEG_INFINITY; 3]], |bounds, position| {
            joined_bounds(bounds, [axes.map(|axis| dot(axis, *position)); 2])
        })
    };
    positions.par_chunks(CHUNK).map(of_chunk).reduce_with(joined_bounds).unwrap_or_default()
}

#[cfg(test)]
#[expect(clippy::float_cmp, reason = "file axes are exact")]
mod tests {
    use molmesh_surface::vector::cross;

    use super::*;

    /// A box of 2 × 4 × 6 Å as eight corners.
    fn corners() -> Vec<[f32; 3]> {
        let mut all = Vec::new();
        for x in [-1.0, 1.0] {
            for y in [-2.0, 2.0] {
                for z in [-3.0, 3.0] {
                    all.push([x, y, z]);
                }
            }
        }
        all
    }

    fn camera(view: View, azimuth: f64, elevation: f64) -> Camera {
        let params = PictureParams { width: 300, height: 200, view, azimuth, elevation, ..PictureParams::default() };
        Camera::new(&corners(), &[], &params)
    }

    #[test]
    fn named_views_have_their_directions() {
        for (view, toward, right) in [
            (View::Front, [0., 0., 1.], [1., 0., 0.]),
            (View::Back, [0., 0., -1.], [-1., 0., 0.]),
            (View::Left, [-1., 0., 0.], [0., 0., 1.]),
            (View::Right, [1., 0., 0.], [0., 0., -1.]),
            (View::Top, [0., 1., 0.], [1., 0., 0.]),
            (View::Bottom, [0., -1., 0.], [1., 0., 0.]),
        ] {
            let camera = camera(view, 0.0, 0.0);
            assert_eq!((camera.axes[2], camera.axes[0]), (toward, right), "{view:?}");
            // The axes are right-handed: the picture is not mirrored.
            let [right, up, toward] = camera.axes;
            assert_eq!(cross(right, up), toward, "{view:?}");
        }
    }

    #[test]
    fn the_mesh_fills_the_picture_and_stays_within() {
        let front = camera(View::Front, 0.0, 0.0);
        // 4 Å of height in 92 % of 200 pixels.
        assert!((front.pixel() - 4.0 / 184.0).abs() < 1e-6, "{front:?}");
        let near = front.project([1.0, 2.0, 3.0]);
        assert!((near[0] - (150.0 + 46.0)).abs() < 1e-3 && (near[1] - 8.0).abs() < 1e-3 && near[2] == 0.0, "{near:?}");
        assert_eq!(front.project([0.0, 0.0, -3.0]), [150.0, 100.0, 6.0]);
        assert_eq!(front.reach, 6.0);
        assert!(Camera::new(&[[1.0; 3]], &[], &PictureParams::default()).scale.is_finite());
    }

    #[test]
    fn a_quarter_turn_leads_to_the_next_view() {
        let close = |a: &Camera, b: &Camera| (0..3).all(|i| (0..3).all(|k| (a.axes[i][k] - b.axes[i][k]).abs() < 1e-6));
        assert!(close(&camera(View::Front, 90.0, 0.0), &camera(View::Right, 0.0, 0.0)));
        assert!(close(&camera(View::Front, -90.0, 0.0), &camera(View::Left, 0.0, 0.0)));
        assert!(close(&camera(View::Front, 0.0, 90.0), &camera(View::Top, 0.0, 0.0)));
        assert!(close(&camera(View::Back, 180.0, -90.0), &camera(View::Bottom, 0.0, 0.0)));
        assert!(!close(&camera(View::Front, 90.0, 0.0), &camera(View::Left, 0.0, 0.0)));
    }
}
