//! Components of the boundary that enclose a point.

use rayon::prelude::*;
use rustc_hash::FxHashMap;

use super::components::Components;
use super::radius;
use crate::control::Control;
use crate::error::SurfaceError;
use crate::lattice::to_i32;
use crate::vector::sub;

/// Spheres between two checks of the cancellation flag: a few milliseconds.
const PER_CHECK: usize = 1 << 16;

/// Part of a ray within a sphere: distances from its origin, and the number of the sphere.
type Interval = ([f64; 2], u32);

impl Components<'_> {
    /// Returns the components that enclose each of `points`, ascending. If a point lies on a component, that component
    /// may or may not be returned.
    ///
    /// A ray leaves a component as often as it enters it, and once more if it starts inside.
    ///
    /// # Errors
    /// [`SurfaceError::Memory`], [`SurfaceError::Cancelled`].
    pub(crate) fn around(&self, points: &[[f64; 3]], control: &Control<'_>) -> Result<Vec<Vec<u32>>, SurfaceError> {
        // Rays in the direction of x, by square column. A sphere reaches into four columns at most.
        let side = 2.001 * self.atoms.iter().map(radius).fold(0.0, f64::max) + 1.0;
        let column = |c: f64| to_i32((c / side).floor());
        let mut columns: FxHashMap<[i32; 2], Vec<u32>> = FxHashMap::default();
        for (ray, point) in (0..).zip(points) {
            columns.entry([column(point[1]), column(point[2])]).or_default().push(ray);
        }
        let mut intervals: Vec<Vec<Interval>> = vec![Vec::new(); points.len()];
        for (some, first) in self.atoms.chunks(PER_CHECK).zip((0..).step_by(PER_CHECK)) {
            control.check()?;
            for (atom, sphere) in some.iter().zip(first..) {
                let r = radius(atom);
                let [low, high] = [-r, r].map(|r| [1, 2].map(|k| column(atom.position(k) + r)));
                let near = (low[0]..=high[0]).flat_map(|y| (low[1]..=high[1]).map(move |z| [y, z]));
                for &ray in near.filter_map(|near| columns.get(&near)).flatten() {
                    let to = sub(atom.centre(), points[ray as usize]);
                    let square = r * r - to[1] * to[1] - to[2] * to[2];
                    let end = to[0] + square.max(0.0).sqrt();
                    if square > 0.0 && end > 0.0 {
                        control.memory.grow(2 * size_of::<Interval>() as u64)?;
                        intervals[ray as usize].push(([2.0 * to[0] - end, end], sphere));
                    }
                }
            }
        }
        let around = |(point, intervals): (&[f64; 3], &mut Vec<Interval>)| {
            control.check()?;
            intervals.sort_unstable_by(|a, b| a.0[0].total_cmp(&b.0[0]));
            Ok(self.odd(*point, intervals))
        };
        points.par_iter().zip(&mut intervals).map(around).collect()
    }

    /// Returns the components that a ray from `point` crosses an odd number of times, ascending. `intervals` are sorted
    /// by their start.
    fn odd(&self, point: [f64; 3], intervals: &[Interval]) -> Vec<u32> {
        let mut odd: Vec<u32> = Vec::new();
        let mut cross = |at: f64, sphere: u32| {
            let atom = &self.atoms[sphere as usize];
            let to = sub(point, atom.centre());
            let n = [to[0] + at, to[1], to[2]].map(|c| c / radius(atom));
            let Some(component) = self.at(sphere, n) else { return };
            match odd.binary_search(&component) {
                Ok(i) => drop(odd.remove(i)),
                Err(i) => odd.insert(i, component),
            }
        };
        let mut last: Option<(f64, u32)> = None;
        for &([start, end], sphere) in intervals {
            if last.is_none_or(|(last, _)| start > last) {
                if let Some((end, sphere)) = last {
                    cross(end, sphere);
                }
                if start > 0.0 {
                    cross(start, sphere);
                }
            }
            if last.is_none_or(|(last, _)| end > last) {
                last = Some((end, sphere));
            }
        }
        if let Some((end, sphere)) = last {
            cross(end, sphere);
        }
        odd
    }
}
