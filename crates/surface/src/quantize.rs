//! Vertices in 12 bytes instead of 24: positions as 16-bit integers times a step, normals as 8-bit ones.
//!
//! The step is a power of two, so multiplying by it and dividing by it are exact in single precision. A position is
//! rounded once, and every implementation that rounds to nearest, ties to even, gets the same integers, including
//! WGSL's `round`. A step that used all 16 bits would be as little as half as large, but its division would differ
//! between devices.

/// Largest absolute value of an integer of a position. The range is symmetric because positions are relative to the
/// centre.
const POSITION_MAX: f32 = 32_767.0;
/// Marker of a coordinate that is out of range or not finite. Both the largest integer plus one and the lowest minus
/// one wrap around to it.
pub const BEYOND: i16 = i16::MIN;
/// Largest integer of a normal.
const NORMAL_MAX: f32 = 127.0;
/// Largest squared length of a normal, in units of 1/127, that glTF's validator accepts: 0.674 % too long.
const NORMAL_MAX_SQUARE: i32 = 16_347;
/// Exponent of the smallest step, 1.5e-5 Å: 32,767 of them are half an ångström, less than any atom's radius.
const MIN_EXPONENT: i32 = -16;

/// Distance between two neighbouring values of a quantized coordinate: a power of two, Å.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Step {
    exponent: i32,
}

impl Step {
    /// Returns the smallest step whose 32,767 multiples reach `extent`, Å.
    #[must_use]
    pub fn covering(extent: f64) -> Self {
        let reaches = |exponent: &i32| f64::from(POSITION_MAX) * 2.0_f64.powi(*exponent) >= extent;
        let exponent = (MIN_EXPONENT..=f32::MAX_EXP - 16).find(reaches);
        // Larger extents are rejected when the mesh's bounds are checked.
        Self { exponent: exponent.unwrap_or(MIN_EXPONENT) }
    }

    /// Length of the step, Å. A decoded coordinate differs from the computed one by at most half of it.
    #[must_use]
    pub fn length(self) -> f32 {
        2.0_f32.powi(self.exponent)
    }

    /// Number of steps per Å: also a power of two.
    #[must_use]
    pub fn per_angstrom(self) -> f32 {
        2.0_f32.powi(-self.exponent)
    }

    /// Returns the largest coordinate that can be stored, Å.
    #[must_use]
    pub fn reach(self) -> f32 {
        POSITION_MAX * self.length()
    }

    /// Returns true if all of `bounds` can be stored: lowest and highest relative position, Å.
    #[must_use]
    pub fn holds(self, bounds: &[[f32; 3]; 2]) -> bool {
        let half = 0.5 * self.length();
        bounds.as_flattened().iter().all(|v| v.abs() < self.reach() + half)
    }

    /// Rounds a position relative to the mesh's centre, Å, to the nearest multiples of the step, ties to even. The
    /// position is the single-precision number that `interpolate` writes (spacings from the centre times the spacing,
    /// rounded once). A coordinate that [`Self::holds`] rejects becomes [`BEYOND`].
    #[inline]
    #[must_use]
    pub fn position(self, position: [f32; 3]) -> [i16; 3] {
        let inverse = self.per_angstrom();
        position.map(|v| nearest(v * inverse, POSITION_MAX + 1.0))
    }

    /// Returns the exact position that the integers represent, Å.
    #[inline]
    #[must_use]
    pub fn decoded(self, position: [i16; 3]) -> [f32; 3] {
        let length = self.length();
        position.map(|v| f32::from(v) * length)
    }
}

/// Rounds a unit normal to the nearest multiples of 1/127, ties to even.
///
/// Near one direction, (66.5, 75.5, 77.5) and its mirror images, all three components are rounded up by half a unit,
/// and the vector slightly exceeds the accepted length. Its largest component is rounded down there.
#[inline]
#[must_use]
pub fn normal(normal: [f32; 3]) -> [i8; 3] {
    let mut rounded = normal.map(|v| nearest(v * NORMAL_MAX, NORMAL_MAX));
    if square(rounded) > NORMAL_MAX_SQUARE {
        shorten(&mut rounded);
    }
    // The low byte is the number: it lies within ±127.
    rounded.map(|v| i8::from_le_bytes([v.to_le_bytes()[0]]))
}

#[inline]
fn square(normal: [i16; 3]) -> i32 {
    normal.iter().map(|&v| i32::from(v) * i32::from(v)).sum()
}

/// Moves the largest component, the first of equals, one towards zero.
#[cold]
fn shorten(normal: &mut [i16; 3]) {
    let largest = (1..3).fold(0, |k, other| if normal[other].abs() > normal[k].abs() { other } else { k });
    normal[largest] -= normal[largest].signum();
}

/// Returns the low 16 bits of the integer nearest to `v`, ties to even, within ±`max`, which is 2¹⁵ at most; NaN
/// becomes `max`.
///
/// Adding 1.5 · 2²³ rounds to an integer, which is then in the low bits. Every processor has this addition for whole
/// vectors, but not every one has a rounding instruction.
#[inline]
fn nearest(v: f32, max: f32) -> i16 {
    const INTEGERS: f32 = 12_582_912.0;
    let v = if v < max { v } else { max };
    let v = if v > -max { v } else { -max };
    let [low, high, ..] = (v + INTEGERS).to_bits().to_le_bytes();
    i16::from_le_bytes([low, high])
}

#[cfg(test)]
#[expect(clippy::float_cmp, reason = "rounded numbers and powers of two are exact")]
mod tests {
    use super::*;

    #[test]
    fn steps_are_the_smallest_powers_of_two_that_reach() {
        for (extent, length) in [
            (0.0, 1.525_878_906_25e-5),
            (0.499, 1.525_878_906_25e-5),
            (0.5, 3.051_757_812_5e-5),
            (31.999, 0.000_976_562_5),
            (32_767.0 / 1024.0, 0.000_976_562_5),
            (32.0, 0.001_953_125),
            (150.0, 0.007_812_5),
            (1e5, 4.0),
        ] {
            let step = Step::covering(extent);
            assert_eq!(f64::from(step.length()), length, "{extent}");
            assert!(f64::from(step.reach()) >= extent);
        }
        for value in [f64::NAN, f64::INFINITY] {
            assert!(!Step::covering(value).holds(&[[0.0; 3], [1.0; 3]]), "{value} is not covered, and is rejected");
        }
    }

    #[test]
    fn outermost_coordinates_fit_and_larger_ones_do_not() {
        let step = Step::covering(20.0);
        let reach = step.reach();
        assert_eq!(step.position([reach, -reach, 0.0]), [32_767, -32_767, 0]);
        assert!(step.holds(&[[-reach; 3], [reach; 3]]));
        assert!(!step.holds(&[[-reach; 3], [reach + step.length(), 0.0, 0.0]]));
        assert!(!step.holds(&[[0.0, -reach - step.length(), 0.0], [0.0; 3]]));
        let (inside, half) = (reach + 0.49 * step.length(), reach + 0.5 * step.length());
        assert!(step.holds(&[[-inside; 3], [inside; 3]]));
        assert_eq!(step.position([inside, -inside, -0.0]), [32_767, -32_767, 0]);
        // `holds` rejects exactly the coordinates that are marked.
        for beyond in [half, -half, reach + step.length(), f32::MAX, f32::INFINITY, f32::NEG_INFINITY, -1e9] {
            assert!(!step.holds(&[[beyond, 0.0, 0.0]; 2]), "{beyond}");
            assert_eq!(step.position([beyond, 0.0, beyond]), [BEYOND, 0, BEYOND], "{beyond}");
        }
        assert_eq!(step.position([f32::NAN; 3]), [BEYOND; 3]);
        assert!(!step.holds(&[step.decoded([BEYOND, 0, 0]), [0.0; 3]]), "a marked coordinate is rejected when decoded");
        assert_eq!(step.decoded([32_767, -32_767, 1]), [reach, -reach, step.length()]);
    }

    #[test]
    fn rounding_is_to_the_nearest_ties_to_even() {
        for i in -80_000_i32..80_000 {
            #[expect(clippy::cast_precision_loss, reason = "small integers are exact")]
            let v = i as f32 * 0.125;
            let expected = v.clamp(-127.0, 127.0).round_ties_even();
            assert_eq!(f32::from(nearest(v, NORMAL_MAX)), expected, "{v}");
            assert_eq!(f32::from(nearest(v, POSITION_MAX + 1.0)), v.round_ties_even(), "{v}");
        }
        assert_eq!((nearest(0.5, 127.0), nearest(1.5, 127.0), nearest(-2.5, 127.0)), (0, 2, -2));
        assert_eq!(normal([f32::NAN, 0.0, f32::NEG_INFINITY]), [126, 0, -127], "not a normal");
    }

    /// Checks every integer vector to which some unit vector is rounded.
    #[test]
    fn every_quantized_normal_is_a_unit_vector_to_the_validator() {
        const TOLERANCE: f64 = 0.006_74;
        let off = |q: [i16; 3]| (f64::from(square(q)).sqrt() / 127.0 - 1.0).abs();
        let (mut worst, mut shortened) = (0.0_f64, Vec::new());
        for q in (0..=127).flat_map(|a| (a..=127).flat_map(move |b| (b..=127).map(move |c| [a, b, c]))) {
            let length = |shift: f64| q.map(|v| (f64::from(v) + shift).max(0.0).powi(2)).iter().sum::<f64>().sqrt();
            // Normals are of length 1 to a few parts in 1e7.
            if length(-0.5) > 127.0 * 1.000_001 || length(0.5) < 127.0 * 0.999_999 {
                continue;
            }
            let mut kept = q;
            if square(q) > NORMAL_MAX_SQUARE {
                assert!(off(q) > TOLERANCE);
                shorten(&mut kept);
                shortened.push((q, kept));
            }
            worst = worst.max(off(kept));
        }
        assert!(worst < TOLERANCE, "{worst}");
        assert_eq!(shortened, [([67, 76, 78], [67, 76, 77])]);
        let length = (66.5_f32 * 66.5 + 75.5 * 75.5 + 77.5 * 77.5).sqrt();
        assert_eq!(normal([-66.5, 77.5, 75.5].map(|v| v / length)), [-67, 77, 76]);
        assert_eq!((normal([1.0, 0.0, 0.0]), normal([0.0, -1.0, 0.0])), ([127, 0, 0], [0, -127, 0]));
    }
}
