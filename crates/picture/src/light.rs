//! Light and colour: Lambert's law and the sRGB transfer function.

use std::sync::LazyLock;

use molmesh_surface::vector::dot;

/// Direction of the light in view space (right, up, towards), a unit vector.
pub const LIGHT: [f32; 3] = [-2.0 / 7.0, 3.0 / 7.0, 6.0 / 7.0];
/// Ambient light.
pub const AMBIENT: f32 = 0.15;
/// Diffuse light from [`LIGHT`].
pub const DIFFUSE: f32 = 0.85;
/// Colour in full light of a surface without colours of its own, sRGB.
pub const COLOR: [u8; 3] = [0xb4, 0xd2, 0xf0];
/// Number of steps of the sRGB table. At the dark end, where the function is steepest, a step is less than half a
/// level.
const STEPS: usize = 1 << 13;

/// Light reflected by a surface with this unit normal, 0 to 1.
#[inline]
#[must_use]
pub fn lambert(normal: [f32; 3]) -> f32 {
    AMBIENT + DIFFUSE * dot(normal, LIGHT).max(0.0)
}

/// Converts an sRGB level to linear light, 0 to 1 (IEC 61966-2-1).
#[must_use]
pub fn linear(level: u8) -> f64 {
    let value = f64::from(level) / 255.0;
    if value <= 0.040_45 { value / 12.92 } else { ((value + 0.055) / 1.055).powf(2.4) }
}

/// Returns the linear light of each sRGB level, 0 to 1.
#[must_use]
pub fn linear_levels() -> &'static [f32; 256] {
    #[expect(clippy::cast_possible_truncation, reason = "0 to 255, and 0 to 1")]
    static TABLE: LazyLock<[f32; 256]> = LazyLock::new(|| std::array::from_fn(|level| linear(level as u8) as f32));
    &TABLE
}

/// Converts linear light to an sRGB level, not rounded, 0 to 255.
#[must_use]
pub fn srgb(light: f64) -> f64 {
    let value = if light <= 0.003_130_8 { light * 12.92 } else { 1.055 * light.powf(1.0 / 2.4) - 0.055 };
    255.0 * value.clamp(0.0, 1.0)
}

/// Table of [`srgb`].
#[derive(Debug)]
pub struct Levels(Vec<u8>);

impl Levels {
    /// Returns the table.
    #[must_use]
    pub fn get() -> &'static Self {
        static TABLE: LazyLock<Levels> = LazyLock::new(|| {
            #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0 to 255")]
            let level = |step: usize| srgb(step as f64 / STEPS as f64).round() as u8;
            Levels((0..=STEPS).map(level).collect())
        });
        &TABLE
    }

    /// Level of linear light, which is clamped to 0 to 1.
    #[inline]
    #[must_use]
    pub fn of(&self, light: f32) -> u8 {
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the table")]
        let step = (light.clamp(0.0, 1.0) * STEPS as f32 + 0.5) as usize;
        self.0.get(step).copied().unwrap_or(u8::MAX)
    }

    /// Returns the levels by step, for devices.
    #[must_use]
    pub fn table(&self) -> &[u8] {
        &self.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn levels_are_those_of_the_standard() {
        let levels = Levels::get();
        for level in 0..=255_u8 {
            #[expect(clippy::cast_possible_truncation, reason = "0 to 1")]
            let light = linear(level) as f32;
            assert!(levels.of(light).abs_diff(level) <= 1, "{level}: {}", levels.of(light));
            assert!((srgb(linear(level)) - f64::from(level)).abs() < 1e-6);
        }
        // From the standard's own tables: 18 % grey, and the knee.
        assert_eq!(levels.of(0.18), 118);
        assert_eq!([levels.of(-1.0), levels.of(0.0), levels.of(1.0), levels.of(9.0)], [0, 0, 255, 255]);
    }

    #[test]
    fn light_falls_off_with_the_cosine() {
        assert!((lambert(LIGHT) - 1.0).abs() < 1e-6);
        assert!((lambert(LIGHT.map(|c| -c)) - AMBIENT).abs() < 1e-6);
        // At right angles to the light.
        assert!((lambert([0.0, 2.0, -1.0]) - AMBIENT).abs() < 1e-6);
        // 60° off: half of it.
        let half = [LIGHT[0] * 0.5, LIGHT[1] * 0.5, LIGHT[2] * 0.5];
        assert!((lambert(half) - (AMBIENT + 0.5 * DIFFUSE)).abs() < 1e-6);
    }
}
