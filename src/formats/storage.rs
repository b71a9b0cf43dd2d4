//! What a caller may choose about a file besides its format: how vertices are stored, whether normals are, in which units
//! coordinates are.

use super::{Format, Packing};

/// What the parameter `normals` asks for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Normals {
    /// A normal per vertex, of the density's gradient.
    #[default]
    Smooth,
    /// No vertex normals. STL's are those of its triangles and belong to the format.
    None,
}

impl Normals {
    /// Every way.
    pub const ALL: [Self; 2] = [Self::Smooth, Self::None];

    /// Its name as a parameter.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Smooth => "smooth",
            Self::None => "none",
        }
    }
}

/// What the parameter `units` asks for: the length that 1 stands for in a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Units {
    /// 1e-10 m, as in structure files.
    #[default]
    Angstrom,
    /// 10 Å.
    Nanometer,
    /// 1e10 Å: what glTF says that its units are.
    Meter,
}

impl Units {
    /// Every unit.
    pub const ALL: [Self; 3] = [Self::Angstrom, Self::Nanometer, Self::Meter];

    /// Its name as a parameter, and in files.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Angstrom => "angstrom",
            Self::Nanometer => "nanometer",
            Self::Meter => "meter",
        }
    }

    /// Its length, Å.
    #[must_use]
    pub const fn length(self) -> f64 {
        match self {
            Self::Angstrom => 1.0,
            Self::Nanometer => 10.0,
            Self::Meter => 1e10,
        }
    }

    /// What a length in Å is multiplied by to be one in this unit.
    #[must_use]
    pub const fn scale(self) -> f64 {
        match self {
            Self::Angstrom => 1.0,
            Self::Nanometer => 0.1,
            Self::Meter => 1e-10,
        }
    }
}

impl Format {
    /// Whether it can hold coordinates in `units`. In metres a molecule is so small that programs which weld vertices nearer
    /// than some fixed distance make one of all of them: only formats with a node, which scales for itself, hold that.
    #[must_use]
    pub const fn holds_units(self, units: Units) -> bool {
        match (self, units) {
            (Self::Glb | Self::Gltf, _) | (_, Units::Angstrom) => true,
            // A picture has no coordinates.
            (format, Units::Nanometer) => !format.is_picture(),
            (_, Units::Meter) => false,
        }
    }
}

/// How a file stores a mesh.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Storage {
    /// The bytes of a vertex.
    pub packing: Packing,
    /// Whether vertices have normals.
    pub normals: Normals,
    /// What 1 stands for.
    pub units: Units,
}

impl From<Packing> for Storage {
    fn from(packing: Packing) -> Self {
        Self { packing, ..Self::default() }
    }
}

impl Storage {
    /// Bytes from one normal to the next in a glTF; none without normals.
    pub(super) const fn normal_bytes(self) -> Option<u64> {
        match self.normals {
            Normals::Smooth => Some(self.packing.normal_bytes()),
            Normals::None => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lengths_and_scales_are_each_others_inverse() {
        for units in Units::ALL {
            assert!((units.length() * units.scale() - 1.0).abs() < 1e-15, "{units:?}");
        }
        assert!(Units::ALL.is_sorted_by(|a, b| a.length() < b.length()));
    }
}
