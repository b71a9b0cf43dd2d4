//! The input of the core: spheres as a structure of arrays.

use rayon::prelude::*;

use super::error::SurfaceError;

/// Centres beyond this distance from the origin (Å, per axis) are refused: 32-bit vertex coordinates would
/// lose more than a hundredth of an ångström there, and no structure file's columns reach that far.
pub const MAX_COORDINATE: f64 = 100_000.0;

/// Spheres (atom centres with radii), Å. All columns have the same length.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Spheres {
    x: Vec<f64>,
    y: Vec<f64>,
    z: Vec<f64>,
    r: Vec<f32>,
}

impl Spheres {
    /// Takes ownership of columns of equal length and checks every value once.
    ///
    /// # Errors
    /// [`SurfaceError::BadSphere`] names the first centre that is not finite or lies beyond
    /// [`MAX_COORDINATE`], or the first radius that is not positive and finite.
    ///
    /// # Panics
    /// If the columns differ in length: that is the caller's mistake, not the input's.
    pub fn new(x: Vec<f64>, y: Vec<f64>, z: Vec<f64>, r: Vec<f32>) -> Result<Self, SurfaceError> {
        assert!(x.len() == y.len() && y.len() == z.len() && z.len() == r.len(), "columns of unequal length");
        for (what, column) in [("x", &x), ("y", &y), ("z", &z)] {
            if let Some(index) = column.iter().position(|v| !v.is_finite() || v.abs() > MAX_COORDINATE) {
                let expected = "a finite number within ±100000 Å";
                return Err(SurfaceError::BadSphere { index, what, value: column[index], expected });
            }
        }
        if let Some(index) = r.iter().position(|v| !v.is_finite() || *v <= 0.0) {
            let expected = "a finite number above 0 Å";
            return Err(SurfaceError::BadSphere { index, what: "radius", value: f64::from(r[index]), expected });
        }
        Ok(Self { x, y, z, r })
    }

    /// How many spheres there are.
    #[must_use]
    pub fn len(&self) -> usize {
        self.r.len()
    }

    /// Whether there are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.r.is_empty()
    }

    /// Centre of sphere `i`, Å.
    #[must_use]
    pub fn centre(&self, i: usize) -> [f64; 3] {
        [self.x[i], self.y[i], self.z[i]]
    }

    /// Radius of sphere `i`, Å.
    #[must_use]
    pub fn radius(&self, i: usize) -> f32 {
        self.r[i]
    }

    /// All radii, Å.
    #[must_use]
    pub fn radii(&self) -> &[f32] {
        &self.r
    }

    /// Lowest and highest centre coordinate per axis, Å; `None` when there are no spheres.
    #[must_use]
    pub fn bounds(&self) -> Option<[[f64; 3]; 2]> {
        // Plain comparisons: no coordinate is NaN, which `f64::min` would look for.
        let wider = |(lo, hi): (f64, f64), (low, high): (f64, f64)| {
            (if low < lo { low } else { lo }, if high > hi { high } else { hi })
        };
        let none = (f64::MAX, f64::MIN);
        let part = |part: &[f64]| part.iter().fold(none, |all, &v| wider(all, (v, v)));
        let fold = |column: &[f64]| column.par_chunks(1 << 16).map(part).reduce(|| none, wider);
        let ([x, y, z], false) = ([&self.x, &self.y, &self.z].map(|c| fold(c)), self.is_empty()) else {
            return None;
        };
        Some([[x.0, y.0, z.0], [x.1, y.1, z.1]])
    }
}
