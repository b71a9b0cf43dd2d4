//! The formats by name, file extension and media type.

use std::fmt;
use std::str::FromStr;

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
    /// STL, binary.
    Stl,
    /// Wavefront OBJ.
    Obj,
    /// A picture, PNG.
    Png,
}

/// Error: no format has this name.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("unknown format `{0}`; expected one of glb, gltf, ply, stl, obj, png")]
pub struct UnknownFormat(pub String);

impl Format {
    /// Every format.
    pub const ALL: [Self; 6] = [Self::Glb, Self::Gltf, Self::Ply, Self::Stl, Self::Obj, Self::Png];

    /// Formats that hold a mesh.
    pub const MESHES: [Self; 5] = [Self::Glb, Self::Gltf, Self::Ply, Self::Stl, Self::Obj];

    /// File extension and name, without a dot.
    #[must_use]
    pub const fn extension(self) -> &'static str {
        match self {
            Self::Glb => "glb",
            Self::Gltf => "gltf",
            Self::Ply => "ply",
            Self::Stl => "stl",
            Self::Obj => "obj",
            Self::Png => "png",
        }
    }

    /// Returns true if the format is a picture of a mesh; no encoder writes such a file.
    #[must_use]
    pub const fn is_picture(self) -> bool {
        matches!(self, Self::Png)
    }

    /// Returns true if the format can hold quantized vertices.
    #[must_use]
    pub const fn holds_quantized(self) -> bool {
        matches!(self, Self::Glb | Self::Gltf)
    }

    /// Media type, registered with IANA except that of PLY, for which `application/ply` is common.
    #[must_use]
    pub const fn media_type(self) -> &'static str {
        match self {
            Self::Glb => "model/gltf-binary",
            Self::Gltf => "model/gltf+json",
            Self::Ply => "application/ply",
            Self::Stl => "model/stl",
            Self::Obj => "model/obj",
            Self::Png => "image/png",
        }
    }

    /// Returns the format for a media type, including types that other programs use. Ignores letter case and parameters
    /// (`; charset=…`). Wildcards match no format.
    #[must_use]
    pub fn from_media_type(text: &str) -> Option<Self> {
        let essence = text.split(';').next().unwrap_or_default().trim().to_ascii_lowercase();
        match essence.as_str() {
            "model/gltf-binary" => Some(Self::Glb),
            "model/gltf+json" => Some(Self::Gltf),
            "application/ply" | "application/x-ply" | "model/ply" | "model/x-ply" | "model/vnd.ply" => Some(Self::Ply),
            "model/stl"
            | "model/x.stl-binary"
            | "application/sla"
            | "application/x-stl"
            | "application/vnd.ms-pki.stl" => Some(Self::Stl),
            "model/obj" | "application/x-obj" => Some(Self::Obj),
            "image/png" => Some(Self::Png),
            _ => None,
        }
    }
}

impl fmt::Display for Format {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.extension())
    }
}

impl FromStr for Format {
    type Err = UnknownFormat;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let lower = text.to_ascii_lowercase();
        Self::ALL.into_iter().find(|f| f.extension() == lower).ok_or_else(|| UnknownFormat(text.to_owned()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_format_parses_its_own_name_and_media_type() {
        for format in Format::ALL {
            assert_eq!(format.to_string().to_uppercase().parse(), Ok(format));
            assert_eq!(Format::from_media_type(format.media_type()), Some(format));
        }
        assert_eq!("off".parse::<Format>(), Err(UnknownFormat("off".into())));
    }

    #[test]
    fn media_types_have_aliases_parameters_and_any_case() {
        let cases = [
            ("Model/STL", Some(Format::Stl)),
            ("application/sla", Some(Format::Stl)),
            ("application/vnd.ms-pki.stl ; q=0.5", Some(Format::Stl)),
            ("model/vnd.ply", Some(Format::Ply)),
            (" model/ply", Some(Format::Ply)),
            ("model/obj;charset=utf-8", Some(Format::Obj)),
            ("model/gltf+json", Some(Format::Gltf)),
            ("model/*", None),
            ("*/*", None),
            ("text/plain", None),
            ("IMAGE/png", Some(Format::Png)),
            ("application/json", None),
            ("", None),
        ];
        for (text, expected) in cases {
            assert_eq!(Format::from_media_type(text), expected, "{text}");
        }
    }
}
