//! Layers of a picture: depth, light and normal of every pixel before shading.

/// Number of samples per pixel.
pub(super) const SAMPLES: usize = 4;
/// Depth of pixels without a surface.
pub(super) const NOTHING: f32 = f32::INFINITY;
/// Scale of the components of normals.
pub(super) const UNIT: f32 = 32_767.0;

/// Integer of full intensity in linear colours.
pub(super) const FULL: f32 = 65_535.0;

/// Normal and coverage of a pixel.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Facing {
    /// Normal in view space, in units of 1/32767.
    pub(super) normal: [i16; 3],
    /// Number of covered samples, 0 to [`SAMPLES`].
    pub(super) covered: u16,
}

impl Facing {
    /// Normal in view space.
    #[inline]
    pub(super) fn direction(self) -> [f32; 3] {
        self.normal.map(|c| f32::from(c) * (1.0 / UNIT))
    }

    /// Covered share of the pixel, 0 to 1.
    #[inline]
    pub(super) fn share(self) -> f32 {
        f32::from(self.covered) * (1.0 / SAMPLES as f32)
    }
}

/// Layers in rows from the top.
#[derive(Debug)]
pub(super) struct Layers {
    pub(super) width: usize,
    pub(super) height: usize,
    /// Depth of the nearest sample, Å; [`NOTHING`] without a covered sample.
    pub(super) depth: Vec<f32>,
    /// Mean light of the covered samples, 0 to 1.
    pub(super) light: Vec<f32>,
    pub(super) facing: Vec<Facing>,
    /// True if the surface has colours of its own.
    pub(super) is_colored: bool,
    /// Mean colour of the covered samples, linear, in units of 1/65535; zeros unless `is_colored`.
    pub(super) color: Vec<[u16; 3]>,
}

impl Layers {
    /// Layers without a surface.
    pub(super) fn empty(width: usize, height: usize, is_colored: bool) -> Self {
        let n = width * height;
        Self {
            width,
            height,
            depth: vec![NOTHING; n],
            light: vec![0.0; n],
            facing: vec![Facing::default(); n],
            is_colored,
            // Takes memory only when written: the system provides zeroed pages on the first write.
            color: vec![[0; 3]; n],
        }
    }
}
