//! Output formats with their names, file extensions and media types.

use std::str::FromStr;

use molmesh_surface::named;
use thiserror::Error;

/// Format of an output file: a mesh or a picture of one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Format {
    /// glTF 2.0, binary container.
    #[default]
    Glb,
    /// glTF 2.0, JSON with the buffer embedded as a data URI.
    Gltf,
    /// PLY, binary little-endian.
    Ply,
    /// PLY, text.
    PlyText,
    /// STL, binary.
    Stl,
    /// Wavefront OBJ.
    Obj,
    /// VTK XML `PolyData`, appended raw data.
    Vtp,
    /// Vertices of a mesh, MSMS.
    Vert,
    /// Triangles of a mesh, MSMS.
    Face,
    /// A picture, PNG.
    Png,
}

/// Error: no format has this name.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("unknown format `{0}`; expected one of {names}", names = Format::NAMES.join(", "))]
pub struct UnknownFormat(pub String);

named!(Format, Glb => "glb", Gltf => "gltf", Ply => "ply", PlyText => "ply-text", Stl => "stl", Obj => "obj",
    Vtp => "vtp", Vert => "vert", Face => "face", Png => "png");

impl Format {
    /// Formats that hold a mesh.
    pub const MESHES: [Self; 9] =
        [Self::Glb, Self::Gltf, Self::Ply, Self::PlyText, Self::Stl, Self::Obj, Self::Vtp, Self::Vert, Self::Face];

    /// Extension of file names, without a dot.
    #[must_use]
    pub const fn extension(self) -> &'static str {
        match self {
            Self::PlyText => "ply",
            _ => self.name(),
        }
    }

    /// Returns true if the format is a picture of a mesh; no encoder writes such a file.
    #[must_use]
    pub const fn is_picture(self) -> bool {
        matches!(self, Self::Png)
    }

    /// Returns true if files of the format are text.
    #[must_use]
    pub const fn is_text(self) -> bool {
        matches!(self, Self::Gltf | Self::PlyText | Self::Obj | Self::Vert | Self::Face)
    }

    /// Returns true if the format can hold quantized vertices.
    #[must_use]
    pub const fn holds_quantized(self) -> bool {
        matches!(self, Self::Glb | Self::Gltf)
    }

    /// Returns true if the format can hold a colour for each vertex.
    #[must_use]
    pub const fn holds_colors(self) -> bool {
        !matches!(self, Self::Stl | Self::Vert | Self::Face)
    }

    /// Returns true if the format can repeat a mesh.
    #[must_use]
    pub const fn holds_instances(self) -> bool {
        matches!(self, Self::Glb | Self::Gltf)
    }

    /// Returns true if every file of the format contains the nearest atom of each vertex.
    #[must_use]
    pub const fn needs_atom_ids(self) -> bool {
        matches!(self, Self::Vert)
    }

    /// Returns the approximate size of a mesh file, bytes; 0 for pictures, whose size does not depend on the mesh.
    /// `mesh_bytes` is the size of the mesh in memory.
    #[must_use]
    pub const fn estimated_bytes(self, mesh_bytes: u64, n_vertices: u64, n_triangles: u64) -> u64 {
        match self {
            Self::Glb | Self::Ply | Self::Vtp => mesh_bytes,
            // Base64.
            Self::Gltf => mesh_bytes.saturating_mul(4) / 3,
            Self::Stl => n_triangles.saturating_mul(50),
            Self::Obj => n_vertices.saturating_mul(54).saturating_add(n_triangles.saturating_mul(40)),
            Self::PlyText => n_vertices.saturating_mul(50).saturating_add(n_triangles.saturating_mul(20)),
            Self::Vert => n_vertices.saturating_mul(55),
            Self::Face => n_triangles.saturating_mul(22),
            Self::Png => 0,
        }
    }

    /// Media type, registered with IANA except those of PLY, VTP and MSMS: `application/ply` is common, those with
    /// `x-` are specific to molmesh.
    #[must_use]
    pub const fn media_type(self) -> &'static str {
        match self {
            Self::Glb => "model/gltf-binary",
            Self::Gltf => "model/gltf+json",
            Self::Ply => "application/ply",
            Self::PlyText => "model/x-ply-text",
            Self::Stl => "model/stl",
            Self::Obj => "model/obj",
            Self::Vtp => "model/x-vtp",
            Self::Vert => "model/x-msms-vert",
            Self::Face => "model/x-msms-face",
            Self::Png => "image/png",
        }
    }
}

impl FromStr for Format {
    type Err = UnknownFormat;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        Self::named(&text.to_ascii_lowercase()).ok_or_else(|| UnknownFormat(text.to_owned()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_format_parses_its_own_name() {
        for format in Format::ALL {
            assert_eq!(format.to_string().to_uppercase().parse(), Ok(format));
        }
        assert_eq!("off".parse::<Format>(), Err(UnknownFormat("off".into())));
    }
}
