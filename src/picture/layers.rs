//! What is seen at every pixel, before it becomes a colour.

/// Samples of a pixel.
pub(super) const SAMPLES: usize = 4;
/// Depth where nothing is seen.
pub(super) const NOTHING: f32 = f32::INFINITY;
/// What a component of a unit normal is multiplied by.
pub(super) const UNIT: f32 = 32_767.0;

/// Which way the surface faces, and how much of the pixel it covers.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Facing {
    /// The normal as the viewer sees it, in units of 1/32767.
    pub(super) normal: [i16; 3],
    /// Samples that are covered, 0 to [`SAMPLES`].
    pub(super) covered: u16,
}

impl Facing {
    /// The normal.
    #[inline]
    pub(super) fn direction(self) -> [f32; 3] {
        self.normal.map(|c| f32::from(c) * (1.0 / UNIT))
    }

    /// How much of the pixel is covered, 0 to 1.
    #[inline]
    pub(super) fn share(self) -> f32 {
        f32::from(self.covered) * (1.0 / SAMPLES as f32)
    }
}

/// The layers of a picture, in rows from the top.
#[derive(Debug)]
pub(super) struct Layers {
    pub(super) width: usize,
    pub(super) height: usize,
    /// Depth of the nearest sample, Å; [`NOTHING`] where none is covered.
    pub(super) depth: Vec<f32>,
    /// Mean light of the covered samples, 0 to 1.
    pub(super) light: Vec<f32>,
    pub(super) facing: Vec<Facing>,
}

impl Layers {
    /// Layers in which nothing is seen.
    pub(super) fn empty(width: usize, height: usize) -> Self {
        let n = width * height;
        Self { width, height, depth: vec![NOTHING; n], light: vec![0.0; n], facing: vec![Facing::default(); n] }
    }
}
