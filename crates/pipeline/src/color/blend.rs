//! Value of the parameter `color_blend`.

use molmesh_surface::named;

/// Transition between the colours of neighbouring vertices.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ColorBlend {
    /// Sharp borders: every vertex has the colour of its nearest atom.
    #[default]
    Nearest,
    /// Colours averaged along the surface over about 1 Å.
    Smooth,
}

named!(ColorBlend, Nearest => "nearest", Smooth => "smooth");
