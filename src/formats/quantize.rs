//! Vertices in 12 bytes instead of 24, as glTF stores them. The integers are the core's: see
//! [`surface::quantize`](crate::surface::quantize).

use crate::surface::Mesh;
pub use crate::surface::quantize::{Step, normal};

/// What the parameter `compress` asks for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Compress {
    /// Vertices as they are computed.
    #[default]
    None,
    /// Vertices as small integers: see [`Packing::Quantized`].
    Quantize,
}

impl Compress {
    /// Every way.
    pub const ALL: [Self; 2] = [Self::None, Self::Quantize];

    /// Its name as a parameter.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Quantize => "quantize",
        }
    }
}

/// How the vertices of a glTF are stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Packing {
    /// Positions and normals as 32-bit floats: 24 bytes.
    #[default]
    Full,
    /// Positions as 16-bit integers, normals as 8-bit ones (`KHR_mesh_quantization`): 12 bytes.
    Quantized(Step),
}

impl Packing {
    /// How the vertices of `mesh` lie in memory.
    #[must_use]
    pub fn of(mesh: &Mesh) -> Self {
        mesh.quantized.as_ref().map_or(Self::Full, |quantized| Self::Quantized(quantized.step))
    }

    /// The step, if there is one.
    #[must_use]
    pub const fn step(self) -> Option<Step> {
        match self {
            Self::Full => None,
            Self::Quantized(step) => Some(step),
        }
    }

    /// Bytes from one position to the next. glTF wants multiples of four: three 16-bit integers are followed by two zeros.
    pub(super) const fn position_bytes(self) -> u64 {
        match self {
            Self::Full => 12,
            Self::Quantized(_) => 8,
        }
    }

    /// Bytes from one normal to the next. Three 8-bit integers are followed by a zero.
    pub(super) const fn normal_bytes(self) -> u64 {
        match self {
            Self::Full => 12,
            Self::Quantized(_) => 4,
        }
    }
}
