//! Value of the parameter `color_blend`.

/// Transition between the colours of neighbouring vertices.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ColorBlend {
    /// Sharp borders: every vertex has the colour of its nearest atom.
    #[default]
    Nearest,
    /// Colours averaged along the surface over about 1 Å.
    Smooth,
}

impl ColorBlend {
    /// All values.
    pub const ALL: [Self; 2] = [Self::Nearest, Self::Smooth];

    /// Returns the value of the parameter.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Nearest => "nearest",
            Self::Smooth => "smooth",
        }
    }
}
