//! Input of the core: spheres as a structure of arrays.

use std::f64::consts::PI;

use rayon::prelude::*;

use super::error::SurfaceError;
use super::kind::SurfaceKind;
use super::lattice::effective_radius;
use super::params::SurfaceParams;

/// Maximum absolute coordinate of a centre, Å. Beyond it, 32-bit vertex coordinates would lose more than a hundredth of
/// an ångström. The columns of structure files do not hold such coordinates.
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
    /// Panics if the columns differ in length, which is a bug of the caller.
    pub fn new(x: Vec<f64>, y: Vec<f64>, z: Vec<f64>, r: Vec<f32>) -> Result<Self, SurfaceError> {
        assert!(x.len() == y.len() && y.len() == z.len() && z.len() == r.len(), "columns of unequal length");
        for (what, column) in [("x", &x), ("y", &y), ("z", &z)] {
            if let Some(index) = first_not(column, |v| v.abs() <= MAX_COORDINATE) {
                let expected = "a finite number within ±100000 Å";
                return Err(SurfaceError::BadSphere { index, what, value: column[index], expected });
            }
        }
        if let Some(index) = first_not(&r, |v| v > 0.0 && v < f32::INFINITY) {
            let expected = "a finite number above 0 Å";
            return Err(SurfaceError::BadSphere { index, what: "radius", value: f64::from(r[index]), expected });
        }
        Ok(Self { x, y, z, r })
    }

    /// Returns the spheres with these indices, in this order.
    ///
    /// # Panics
    /// Panics if an index is out of range.
    #[must_use]
    pub fn subset(&self, rows: &[u32]) -> Self {
        let column = |column: &[f64]| rows.iter().map(|&i| column[i as usize]).collect();
        let r = rows.iter().map(|&i| self.r[i as usize]).collect();
        Self { x: column(&self.x), y: column(&self.y), z: column(&self.z), r }
    }

    /// Returns the number of spheres.
    #[must_use]
    pub fn len(&self) -> usize {
        self.r.len()
    }

    /// Returns true if there are no spheres.
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

    /// Area of the spheres, Å²: an upper bound of that of their surface at an isovalue of 1 or more.
    #[must_use]
    pub fn area(&self, params: &SurfaceParams) -> f64 {
        let probe = if params.surface == SurfaceKind::Sas { params.probe } else { 0.0 };
        let radius = |r: &f32| effective_radius(*r, params) + probe;
        self.r.par_chunks(PART).map(|part| part.iter().map(|r| 4.0 * PI * radius(r).powi(2)).sum::<f64>()).sum()
    }

    /// The smallest and the largest radius, Å.
    #[must_use]
    pub fn radius_range(&self) -> (f32, f32) {
        let parts = self.r.par_chunks(PART).map(|part| range(part, (f32::MAX, 0.0)));
        parts.reduce(|| (f32::MAX, 0.0), |a, b| (a.0.min(b.0), a.1.max(b.1)))
    }

    /// Lowest and highest centre coordinate per axis, Å; `None` without spheres.
    #[must_use]
    pub fn bounds(&self) -> Option<[[f64; 3]; 2]> {
        let bounds = [&self.x, &self.y, &self.z].map(|column| {
            let parts = column.par_chunks(PART).map(|part| range(part, (f64::MAX, f64::MIN)));
            parts.reduce(|| (f64::MAX, f64::MIN), |a, b| (a.0.min(b.0), a.1.max(b.1)))
        });
        (!self.is_empty()).then(|| [bounds.map(|(lo, _)| lo), bounds.map(|(_, hi)| hi)])
    }
}

/// Returns the index of the first value that is not `valid`.
fn first_not<T: Copy>(values: &[T], valid: impl Fn(T) -> bool) -> Option<usize> {
    /// Values that are checked without a branch.
    const BATCH: usize = 256;
    let is_valid = |batch: &[T]| batch.iter().fold(true, |all, &v| all & valid(v));
    let first = BATCH * values.chunks(BATCH).position(|batch| !is_valid(batch))?;
    values[first..].iter().position(|&v| !valid(v)).map(|i| first + i)
}

/// Returns the lowest and highest of `values` and `none`.
fn range<T: Copy + PartialOrd>(values: &[T], none: (T, T)) -> (T, T) {
    // Several lanes: in a single chain, each comparison would wait for the previous one.
    let mut lanes = [none; 8];
    for values in values.chunks(8) {
        for ((lo, hi), &v) in lanes.iter_mut().zip(values) {
            // `min` handles NaN, which spheres do not contain, and takes longer.
            *lo = if v < *lo { v } else { *lo };
            *hi = if v > *hi { v } else { *hi };
        }
    }
    lanes
        .into_iter()
        .fold(none, |all, own| (if own.0 < all.0 { own.0 } else { all.0 }, if own.1 > all.1 { own.1 } else { all.1 }))
}

/// Spheres per task.
const PART: usize = 1 << 13;
