//! Storage options of a file besides its format: packing of vertices, normals, and units of coordinates.

use molmesh_surface::named;

use super::{Format, Packing};

/// Value of the parameter `normals`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Normals {
    /// One normal per vertex, from the gradient of the density.
    #[default]
    Smooth,
    /// No vertex normals. STL keeps the normals of its triangles and MSMS those of its vertices, which are part of the
    /// format.
    None,
}

named!(Normals, Smooth => "smooth", None => "none");

/// Value of the parameter `units`: length of one unit in a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Units {
    /// 1e-10 m, as in structure files.
    #[default]
    Angstrom,
    /// 10 Å.
    Nanometer,
    /// 1e10 Å: the unit of glTF.
    Meter,
}

named!(Units, Angstrom => "angstrom", Nanometer => "nanometer", Meter => "meter");

impl Units {
    /// Length of the unit, Å.
    #[must_use]
    pub const fn length(self) -> f64 {
        match self {
            Self::Angstrom => 1.0,
            Self::Nanometer => 10.0,
            Self::Meter => 1e10,
        }
    }

    /// Scale factor from Å to this unit.
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
    /// Returns true if the format can hold coordinates in `units`. In metres a molecule is very small, and programs
    /// that merge vertices within a fixed distance would merge all of them. Therefore only formats with a node that
    /// scales the mesh support metres. Readers of MSMS files expect ångström.
    #[must_use]
    pub const fn holds_units(self, units: Units) -> bool {
        match (self, units) {
            (Self::Glb | Self::Gltf, _) | (_, Units::Angstrom) => true,
            // A picture has no coordinates.
            (format, Units::Nanometer) => !matches!(format, Self::Vert | Self::Face | Self::Png),
            (_, Units::Meter) => false,
        }
    }
}

/// Storage of a mesh in a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Storage {
    /// Packing of a vertex.
    pub packing: Packing,
    /// Normals of the vertices.
    pub normals: Normals,
    /// Length unit.
    pub units: Units,
}

impl From<Packing> for Storage {
    fn from(packing: Packing) -> Self {
        Self { packing, ..Self::default() }
    }
}

impl Storage {
    /// Stride of normals in a glTF, bytes; `None` without normals.
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
