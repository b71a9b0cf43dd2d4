//! Colour schemes and their names.

use std::fmt;
use std::str::FromStr;

use super::palette::{Palette, Rgb};
use super::vertex::VertexProperty;

/// Description of the valid values of the parameter `color`.
pub const EXPECTED: &str = "none, uniform:#RRGGBB, element, chain, entity, residue, secondary-structure, bfactor, \
                            occupancy, plddt, hydrophobicity, hydrophobicity:wimley-white, charge, curvature, \
                            radial, depth, pocket, map";

/// Hydrophobicity scale.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Hydrophobicity {
    /// Kyte and Doolittle 1982.
    KyteDoolittle,
    /// Wimley and White 1996.
    WimleyWhite,
}

/// Colour scheme: assigns a colour to every atom or every vertex.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scheme {
    /// One colour, `0xRRGGBB`.
    Uniform(Rgb),
    /// Colour of the element.
    Element,
    /// Colour of the author chain.
    Chain,
    /// Colour of the entity: chains of the same molecule have the same colour.
    Entity,
    /// Colour of the residue name.
    Residue,
    /// Secondary structure of the residue in the file.
    SecondaryStructure,
    /// B-factor.
    BFactor,
    /// Occupancy.
    Occupancy,
    /// Confidence of a predicted structure, from `ma_qa_metric_local` or the B-factor column.
    Plddt,
    /// Hydrophobicity of the residue.
    Hydrophobicity(Hydrophobicity),
    /// Formal charge of the residue at pH 7.
    Charge,
    /// Property of the vertex.
    Vertex(VertexProperty),
}

/// Schemes by name, except [`Scheme::Uniform`].
const NAMED: [(&str, Scheme); 16] = [
    ("element", Scheme::Element),
    ("chain", Scheme::Chain),
    ("entity", Scheme::Entity),
    ("residue", Scheme::Residue),
    ("secondary-structure", Scheme::SecondaryStructure),
    ("bfactor", Scheme::BFactor),
    ("occupancy", Scheme::Occupancy),
    ("plddt", Scheme::Plddt),
    ("hydrophobicity", Scheme::Hydrophobicity(Hydrophobicity::KyteDoolittle)),
    ("hydrophobicity:wimley-white", Scheme::Hydrophobicity(Hydrophobicity::WimleyWhite)),
    ("charge", Scheme::Charge),
    ("curvature", Scheme::Vertex(VertexProperty::Curvature)),
    ("radial", Scheme::Vertex(VertexProperty::Radial)),
    ("depth", Scheme::Vertex(VertexProperty::Depth)),
    ("pocket", Scheme::Vertex(VertexProperty::Pocket)),
    ("map", Scheme::Vertex(VertexProperty::Map)),
];

impl Scheme {
    /// Lists the names of the numeric schemes.
    pub(in super::super) fn with_numbers() -> String {
        let named = NAMED.iter().filter(|(_, scheme)| scheme.palette().is_some());
        named.map(|(name, _)| *name).collect::<Vec<_>>().join(", ")
    }

    /// Returns true if the scheme needs a map beside the structure.
    #[must_use]
    pub const fn needs_map(self) -> bool {
        matches!(self, Self::Vertex(VertexProperty::Map))
    }

    /// Returns true if the scheme needs a search for pockets.
    #[must_use]
    pub const fn needs_pockets(self) -> bool {
        matches!(self, Self::Vertex(VertexProperty::Pocket))
    }

    /// Returns the default palette of a numeric scheme; `None` for other schemes.
    #[must_use]
    pub const fn palette(self) -> Option<Palette> {
        match self {
            Self::BFactor | Self::Occupancy | Self::Vertex(VertexProperty::Radial | VertexProperty::Depth) => {
                Some(Palette::Viridis)
            }
            Self::Hydrophobicity(_) | Self::Vertex(VertexProperty::Curvature) => Some(Palette::BlueWhiteRed),
            Self::Charge | Self::Vertex(VertexProperty::Map) => Some(Palette::RedWhiteBlue),
            _ => None,
        }
    }

    /// Returns the default range of a numeric scheme; `None` if the values determine it, and for other schemes.
    #[must_use]
    pub(super) const fn range(self) -> Option<[f64; 2]> {
        match self {
            Self::Hydrophobicity(Hydrophobicity::KyteDoolittle) => Some([-4.5, 4.5]),
            Self::Hydrophobicity(Hydrophobicity::WimleyWhite) => Some([-2.02, 2.02]),
            Self::Charge => Some([-1.0, 1.0]),
            Self::Vertex(VertexProperty::Curvature) => Some([-0.5, 0.5]),
            _ => None,
        }
    }
}

impl FromStr for Scheme {
    type Err = ();

    fn from_str(text: &str) -> Result<Self, ()> {
        if let Some(color) = text.strip_prefix("uniform:") {
            let digits = color.strip_prefix('#').unwrap_or(color);
            let is_color = digits.len() == 6 && digits.bytes().all(|c| c.is_ascii_hexdigit());
            return Rgb::from_str_radix(digits, 16).ok().filter(|_| is_color).map(Self::Uniform).ok_or(());
        }
        NAMED.iter().find(|(name, _)| *name == text).map(|(_, scheme)| *scheme).ok_or(())
    }
}

impl fmt::Display for Scheme {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Uniform(color) => write!(f, "uniform:#{color:06x}"),
            scheme => NAMED.iter().find(|(_, known)| known == scheme).map_or(Ok(()), |(name, _)| f.write_str(name)),
        }
    }
}

#[cfg(test)]
#[expect(clippy::unreadable_literal, reason = "colours are written as in style sheets")]
mod tests {
    use super::*;

    #[test]
    fn every_scheme_parses_its_own_name_and_is_documented() {
        for (name, scheme) in NAMED {
            assert_eq!((name.parse(), scheme.to_string().as_str()), (Ok(scheme), name));
            assert!(EXPECTED.split(", ").any(|word| word == name), "{name}");
        }
        for text in ["uniform:#0a0B0c", "uniform:0a0b0c"] {
            let scheme: Scheme = text.parse().unwrap();
            assert_eq!((scheme, scheme.to_string().as_str()), (Scheme::Uniform(0x0a0b0c), "uniform:#0a0b0c"));
        }
        for bad in ["", "Chain", "chains", "uniform", "uniform:", "uniform:#fff", "uniform:+fffff", "uniform:#ffffffff"]
        {
            assert_eq!(bad.parse::<Scheme>(), Err(()), "{bad}");
        }
    }
}
