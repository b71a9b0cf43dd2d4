//! Exposed arcs of the circle in which two spheres intersect.
//!
//! Angles are compared by a piecewise rational function of the direction, so only square roots are computed: results
//! are the same on every system.

/// Direction in the plane of a circle: a unit vector, and a number from 0 to 4 that increases with its angle.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Direction {
    x: f64,
    y: f64,
    order: f64,
    /// Number of the cap whose edge crosses the circle here; [`NO_CAP`] at both ends of the whole circle.
    cap: u32,
}

const NO_CAP: u32 = u32::MAX;

impl Direction {
    const FIRST: Self = Self { x: 1.0, y: 0.0, order: 0.0, cap: NO_CAP };
    const LAST: Self = Self { order: 4.0, ..Self::FIRST };

    fn new(x: f64, y: f64, cap: u32) -> Self {
        let along = y / (x.abs() + y.abs());
        let order = match (x < 0.0, y < 0.0) {
            (false, false) => along,
            (true, _) => 2.0 - along,
            (false, true) => 4.0 + along,
        };
        Self { x, y, order, cap }
    }
}

/// Closed range of directions, counter-clockwise.
type Range = (Direction, Direction);

/// Exposed arc of a circle: the directions within an angle φ of its middle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Exposed {
    /// Unit vector to the middle of the arc.
    pub(super) middle: [f64; 2],
    /// Cosine and sine of φ; φ is from 0 to π.
    pub(super) half: [f64; 2],
    /// Numbers of the caps that cover the circle before the first and after the last direction, counter-clockwise;
    /// `None` for a whole circle.
    pub(super) end_caps: Option<[u32; 2]>,
}

/// Part of a circle that no cap covers. Caps are subtracted one by one; points on the edge of a cap remain.
#[derive(Debug, Default)]
pub(super) struct Uncovered {
    ranges: Vec<Range>,
    next: Vec<Range>,
}

impl Uncovered {
    /// Starts with the whole circle.
    pub(super) fn reset(&mut self) {
        self.ranges.clear();
        self.ranges.push((Direction::FIRST, Direction::LAST));
    }

    /// Returns true if the whole circle is covered.
    pub(super) fn is_empty(&self) -> bool {
        self.ranges.is_empty()
    }

    /// Returns the number of uncovered parts.
    pub(super) fn len(&self) -> usize {
        self.ranges.len()
    }

    /// Subtracts the directions n with n·(p, q) > `bound`, which the cap of number `cap` covers.
    pub(super) fn cover(&mut self, [p, q]: [f64; 2], bound: f64, cap: u32) {
        let length = (p * p + q * q).sqrt();
        if bound >= length {
            return;
        }
        if bound <= -length {
            self.ranges.clear();
            return;
        }
        let (p, q, cos) = (p / length, q / length, bound / length);
        let sin = (1.0 - cos * cos).max(0.0).sqrt();
        let from = Direction::new(p * cos + q * sin, q * cos - p * sin, cap);
        let to = Direction::new(p * cos - q * sin, q * cos + p * sin, cap);
        let Self { ranges, next } = self;
        next.clear();
        // A cap that contains direction 0 covers the directions before `to` and those after `from`.
        let wraps = from.order > to.order;
        for &(start, end) in &*ranges {
            if wraps {
                let (start, end) = (
                    if to.order >= start.order { to } else { start },
                    if from.order <= end.order { from } else { end },
                );
                if start.order <= end.order {
                    next.push((start, end));
                }
            } else if to.order <= start.order || from.order >= end.order {
                next.push((start, end));
            } else {
                if from.order >= start.order {
                    next.push((start, from));
                }
                if to.order <= end.order {
                    next.push((to, end));
                }
            }
        }
        std::mem::swap(ranges, next);
    }

    /// Calls `each` for every exposed arc.
    pub(super) fn arcs(&self, mut each: impl FnMut(Exposed)) {
        let (Some(&(first_start, first_end)), Some(&(last_start, last_end))) =
            (self.ranges.first(), self.ranges.last())
        else {
            return;
        };
        let continues = first_start == Direction::FIRST && last_end == Direction::LAST;
        if self.ranges.len() == 1 && continues {
            each(Exposed { middle: [1.0, 0.0], half: [-1.0, 0.0], end_caps: None });
            return;
        }
        let mut own = &self.ranges[..];
        if continues {
            own = &own[1..own.len() - 1];
            each(exposed(last_start, first_end, first_end.order + 4.0 - last_start.order));
        }
        for &(start, end) in own {
            each(exposed(start, end, end.order - start.order));
        }
    }
}

/// Returns the arc from `a` to `b`; `span` is the difference of their orders.
fn exposed(a: Direction, b: Direction, span: f64) -> Exposed {
    let dot = a.x * b.x + a.y * b.y;
    // The sum of the ends is inaccurate near half a circle, their difference near an empty arc and a whole circle.
    let [x, y] = if dot < 0.0 {
        [b.y - a.y, a.x - b.x]
    } else if span > 2.0 {
        [-a.x - b.x, -a.y - b.y]
    } else {
        [a.x + b.x, a.y + b.y]
    };
    let scale = (x * x + y * y).sqrt().recip();
    let middle = [x * scale, y * scale];
    let half = [a.x * middle[0] + a.y * middle[1], (a.x * middle[1] - a.y * middle[0]).abs()];
    Exposed { middle, half, end_caps: Some([a.cap, b.cap]) }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the cap of a unit circle with this middle and half-angle, degrees.
    fn cap(middle: f64, half: f64) -> ([f64; 2], f64) {
        let (sin, cos) = middle.to_radians().sin_cos();
        ([cos, sin], half.to_radians().cos())
    }

    /// Returns the middle and half-angle of each exposed arc, degrees. Checks that the caps around it end at its ends.
    fn exposed_by(caps: &[(f64, f64)]) -> Vec<[f64; 2]> {
        let mut left = Uncovered::default();
        left.reset();
        for (&(middle, half), number) in caps.iter().zip(0..) {
            let (direction, bound) = cap(middle, half);
            left.cover(direction.map(|c| 0.7 * c), 0.7 * bound, number);
        }
        let mut arcs = Vec::new();
        left.arcs(|arc| {
            let middle = arc.middle[1].atan2(arc.middle[0]).to_degrees().rem_euclid(360.0);
            let half = arc.half[1].atan2(arc.half[0]).to_degrees();
            assert_eq!(arc.end_caps.is_none(), caps.is_empty());
            for (cap, (ends, side)) in
                arc.end_caps.into_iter().flatten().zip([(middle - half, 1.0), (middle + half, -1.0)])
            {
                let (from, reach) = caps[cap as usize];
                let off = (from + side * reach - ends + 180.0).rem_euclid(360.0) - 180.0;
                assert!(off.abs() < 1e-5, "{caps:?}: cap {cap} at {ends}");
            }
            arcs.push([middle, half]);
        });
        arcs
    }

    #[test]
    fn arcs_are_the_complement_of_the_caps() {
        for (caps, arcs) in [
            (&[][..], &[[0.0, 180.0]][..]),
            (&[(90.0, 30.0)], &[[270.0, 150.0]]),
            (&[(0.0, 30.0)], &[[180.0, 150.0]]),
            (&[(0.0, 90.0)], &[[180.0, 90.0]]),
            (&[(20.0, 179.5)], &[[200.0, 0.5]]),
            (&[(20.0, 0.5)], &[[200.0, 179.5]]),
            (&[(90.0, 30.0), (270.0, 40.0)], &[[5.0, 55.0], [175.0, 55.0]]),
            (&[(10.0, 30.0), (190.0, 140.0)], &[[45.0, 5.0], [335.0, 5.0]]),
            (&[(10.0, 100.0), (200.0, 100.0)], &[]),
            (&[(100.0, 50.0), (110.0, 20.0), (140.0, 30.0)], &[[290.0, 120.0]]),
        ] {
            let found = exposed_by(caps);
            assert_eq!(found.len(), arcs.len(), "{caps:?}: {found:?}");
            for (found, expected) in found.iter().zip(arcs) {
                let off = (found[0] - expected[0] + 180.0).rem_euclid(360.0) - 180.0;
                let full = expected[1] > 179.9;
                assert!((full || off.abs() < 1e-5) && (found[1] - expected[1]).abs() < 1e-5, "{caps:?}: {found:?}");
            }
        }
    }

    #[test]
    #[expect(clippy::float_cmp, reason = "the numbers are exact")]
    fn a_point_between_two_caps_stays() {
        let mut left = Uncovered::default();
        left.reset();
        // Exact numbers: both caps end at (0, 1) and (0, −1).
        left.cover([1.0, 0.0], 0.0, 0);
        left.cover([-1.0, 0.0], 0.0, 1);
        let mut arcs = Vec::new();
        left.arcs(|arc| arcs.push(arc));
        assert_eq!(arcs.len(), 2, "{arcs:?}");
        assert!(arcs.iter().all(|arc| arc.half == [1.0, 0.0] && arc.middle[0] == 0.0), "{arcs:?}");
        left.cover([-1.0, 0.0], -1e-9, 2);
        assert!(left.is_empty());
    }
}
