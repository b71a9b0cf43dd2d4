//! Storage of glTF vertices in 12 bytes instead of 24. [`surface::quantize`](molmesh_surface::quantize) rounds them.

use molmesh_surface::{Mesh, named};

use super::Format;
pub use molmesh_surface::quantize::{Step, normal};

/// Value of the parameter `compress`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Compress {
    /// Vertices as floats.
    #[default]
    None,
    /// Vertices as small integers: see [`Packing::Quantized`].
    Quantize,
    /// Quantized vertices, and indices, in compressed pieces: see [`Pieces`](super::Pieces).
    Meshopt,
}

named!(Compress, None => "none", Quantize => "quantize", Meshopt => "meshopt");

impl Compress {
    /// Returns true if files of `format` can be stored this way.
    #[must_use]
    pub const fn is_held_by(self, format: Format) -> bool {
        match self {
            Self::None => true,
            Self::Quantize => format.holds_quantized(),
            Self::Meshopt => matches!(format, Format::Glb),
        }
    }

    /// Returns the approximate size of a compressed vertex with its triangles, colour and atom index, bytes; 0 without
    /// compression.
    #[must_use]
    pub const fn compressed_vertex_bytes(self) -> u64 {
        match self {
            Self::None | Self::Quantize => 0,
            // Measured: 9 to 11 in proteins with grid spacings of 0.25 to 2 Å.
            Self::Meshopt => 10,
        }
    }
}

/// Storage of glTF vertices.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Packing {
    /// Positions and normals as 32-bit floats: 24 bytes.
    #[default]
    Full,
    /// Positions as 16-bit integers, normals as 8-bit ones (`KHR_mesh_quantization`): 12 bytes.
    Quantized(Step),
}

impl Packing {
    /// Returns the packing of the vertices of `mesh` in memory.
    #[must_use]
    pub fn of(mesh: &Mesh) -> Self {
        mesh.quantized.as_ref().map_or(Self::Full, |quantized| Self::Quantized(quantized.step))
    }

    /// Returns the step of quantized vertices; `None` for floats.
    #[must_use]
    pub const fn step(self) -> Option<Step> {
        match self {
            Self::Full => None,
            Self::Quantized(step) => Some(step),
        }
    }

    /// Stride of positions, bytes. glTF requires multiples of four: two zero bytes follow three 16-bit integers.
    pub(super) const fn position_bytes(self) -> u64 {
        match self {
            Self::Full => 12,
            Self::Quantized(_) => 8,
        }
    }

    /// Stride of normals, bytes. A zero byte follows three 8-bit integers.
    pub(super) const fn normal_bytes(self) -> u64 {
        match self {
            Self::Full => 12,
            Self::Quantized(_) => 4,
        }
    }

    /// Stride of colours, bytes: four floats, because some programs read 16-bit integers as other colours, or four
    /// 16-bit integers.
    pub(super) const fn color_bytes(self) -> u64 {
        match self {
            Self::Full => 16,
            Self::Quantized(_) => 8,
        }
    }
}
