//! Parameters of a table of exact areas: `by`, and those of a mesh that affect its exact areas.

use molmesh_surface::SurfaceKind;

use super::ParamError;
use crate::{AreaLevel, Options};

/// Name of the parameter that selects the rows.
pub const BY: &str = "by";
/// Values of `surface`.
pub const SURFACES: [SurfaceKind; 3] = [SurfaceKind::Vdw, SurfaceKind::Sas, SurfaceKind::Ses];
/// Parameters whose description differs from that of a mesh.
pub const REDEFINED: [&str; 2] = ["surface", "interface"];
/// Names of the parameters.
pub const NAMES: [&str; 11] = [
    BY,
    "surface",
    "probe",
    "radius_scale",
    "radius_offset",
    "model",
    "chains",
    "select",
    "altloc",
    "assembly",
    "interface",
];

/// Areas that a request asks for.
#[derive(Debug, Clone)]
pub struct AreasRequest {
    /// Job with exact areas, whose parameters of the mesh have no effect.
    pub options: Options,
    /// Rows of the table.
    pub level: AreaLevel,
    /// Canonical text of the parameters, equal for equal tables only.
    pub canonical: String,
}

/// Parses the parameters.
///
/// # Errors
/// Returns a [`ParamError`], including if no surface with exact areas is named.
pub fn parse(pairs: &[(String, String)]) -> Result<AreasRequest, ParamError> {
    super::check_names(pairs, &NAMES)?;
    let surface = value_of(pairs, "surface").unwrap_or("no value");
    if !SURFACES.iter().any(|kind| kind.name() == surface) {
        let expected = format!("{}, which have exact areas", SURFACES.map(SurfaceKind::name).join(", "));
        return Err(ParamError::bad_value("surface", surface, expected));
    }
    check_one_model(pairs)?;
    let (own, mesh_pairs): (Vec<_>, Vec<_>) = pairs.iter().partition(|(name, _)| name == BY);
    let mesh_pairs = mesh_pairs.iter().map(|(name, value)| (name.as_str(), value.as_str()));
    let options = super::parse(mesh_pairs.chain([("exact", "true")]))?.options;
    let level = match &own[..] {
        [] => AreaLevel::default(),
        [(_, value)] => {
            AreaLevel::named(value).ok_or_else(|| ParamError::bad_value(BY, value, AreaLevel::NAMES.join(", ")))?
        }
        _ => return Err(ParamError::Repeated { name: BY }),
    };
    let canonical = format!("{BY}={}&{}", level.name(), super::canonical(&options));
    Ok(AreasRequest { options, level, canonical })
}

/// Rejects `model=all`.
///
/// # Errors
/// Returns [`ParamError::BadValue`].
pub fn check_one_model(pairs: &[(String, String)]) -> Result<(), ParamError> {
    if value_of(pairs, "model").is_some_and(|model| model.trim() == "all") {
        return Err(ParamError::bad_value("model", "all", "the number of one model"));
    }
    Ok(())
}

fn value_of<'a>(pairs: &'a [(String, String)], name: &str) -> Option<&'a str> {
    pairs.iter().find(|(other, _)| other == name).map(|(_, value)| value.as_str())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parsed(pairs: &[(&str, &str)]) -> Result<AreasRequest, ParamError> {
        let pairs: Vec<_> = pairs.iter().map(|(n, v)| ((*n).to_owned(), (*v).to_owned())).collect();
        parse(&pairs)
    }

    #[test]
    fn a_surface_with_exact_areas_is_needed() {
        let found = parsed(&[("surface", "sas"), ("by", "chain"), ("interface", "A/B,C")]).unwrap();
        assert_eq!(found.level, AreaLevel::Chain);
        assert_ne!(found.canonical, parsed(&[("surface", "sas"), ("by", "chain")]).unwrap().canonical);
        for (pairs, name) in [
            (&[][..], "surface"),
            (&[("surface", "gaussian")], "surface"),
            (&[("surface", "sas"), ("by", "model")], "by"),
            (&[("surface", "sas"), ("by", "atom"), ("by", "atom")], "by"),
            (&[("surface", "sas"), ("model", "all")], "model"),
            (&[("surface", "sas"), ("interface", "A")], "interface"),
            (&[("surface", "sas"), ("interface", "A,A/B")], "interface"),
            (&[("surface", "sas"), ("resolution", "1")], "resolution"),
        ] {
            let error = parsed(pairs).err().unwrap();
            assert_eq!(error.parameter(), name, "{error}");
        }
    }
}
