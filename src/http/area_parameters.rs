//! Parameters of `…/areas`: `by`, and those of a mesh that affect its exact areas.

use crate::pipeline::nearest::nearest;
use crate::pipeline::params::{self, ParamError};
use crate::pipeline::{AreaLevel, Job};

/// Name of the parameter that selects the rows.
pub(super) const BY: &str = "by";
/// Names of the parameters.
pub(super) const NAMES: [&str; 11] = [
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
pub(super) struct Areas {
    pub(super) job: Job,
    pub(super) level: AreaLevel,
    /// Canonical text of the parameters, equal for equal tables only.
    pub(super) canonical: String,
}

/// Parses the parameters.
///
/// # Errors
/// Returns a [`ParamError`], including if no surface with exact areas is named.
pub(super) fn parse(pairs: &[(String, String)]) -> Result<Areas, ParamError> {
    if let Some((name, _)) = pairs.iter().find(|(name, _)| !NAMES.contains(&name.as_str())) {
        let name = name.chars().take(64).collect::<String>();
        return Err(ParamError::Unknown { nearest: nearest(&name, NAMES), name });
    }
    let (own, of_mesh): (Vec<_>, Vec<_>) = pairs.iter().partition(|(name, _)| name == BY);
    let of_mesh = of_mesh.iter().map(|(name, value)| (name.as_str(), value.as_str()));
    let job = params::parse(of_mesh.chain([("exact", "true")])).map_err(|error| rename_exact(pairs, error))?.job;
    let level = match &own[..] {
        [] => AreaLevel::default(),
        [(_, value)] => {
            let named = AreaLevel::ALL.into_iter().find(|level| level.name() == value);
            named.ok_or_else(|| bad(BY, value, &AreaLevel::ALL.map(AreaLevel::name).join(", ")))?
        }
        _ => return Err(ParamError::Repeated { name: BY }),
    };
    let canonical = format!("{BY}={}&{}", level.name(), params::canonical(&job));
    Ok(Areas { job, level, canonical })
}

fn bad(name: &'static str, value: &str, expected: &str) -> ParamError {
    let value = format!("`{}`", value.chars().take(64).collect::<String>());
    ParamError::BadValue { name, value, expected: expected.to_owned() }
}

/// Replaces `exact`, which these requests do not have, in an error by the parameter that causes it.
fn rename_exact(pairs: &[(String, String)], error: ParamError) -> ParamError {
    if !matches!(error, ParamError::BadValue { name: "exact", .. }) {
        return error;
    }
    let surface = pairs.iter().find(|(name, _)| name == "surface").map_or("gaussian", |(_, value)| value);
    match surface {
        "vdw" | "sas" | "ses" => bad("model", "all", "the number of one model"),
        other => bad("surface", other, "vdw, sas or ses, which have exact areas"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parsed(pairs: &[(&str, &str)]) -> Result<Areas, ParamError> {
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
            let found = match &error {
                ParamError::BadValue { name, .. }
                | ParamError::Repeated { name }
                | ParamError::BadExpression { name, .. } => *name,
                ParamError::Unknown { name, .. } => name.as_str(),
            };
            assert_eq!(found, name, "{error}");
        }
    }
}
