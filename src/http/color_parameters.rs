//! Parameters of `…/colors`: those of a mesh that affect the colours, with `scheme` instead of `color`.

use crate::pipeline::color::Scheme;
use crate::pipeline::params::{self, ParamError};
use crate::pipeline::{Coloring, Options, color};

/// Names of the parameters.
pub(super) const NAMES: [&str; 9] =
    ["scheme", "palette", "color_range", "model", "chains", "select", "altloc", "assembly", "context"];

/// Parses the parameters.
///
/// # Errors
/// Returns a [`ParamError`], including if there is no scheme or a parameter applies to meshes only.
pub(super) fn parse(pairs: &[(String, String)]) -> Result<(Options, Coloring), ParamError> {
    params::check_names(pairs, &NAMES)?;
    let renamed = pairs.iter().map(|(name, value)| (if name == "scheme" { "color" } else { name }, value));
    let options = params::parse(renamed).map_err(rename_color)?.options;
    let is_named = pairs.iter().any(|(name, _)| name == "scheme");
    let missing = || bad_scheme(if is_named { "none" } else { "no value" }.to_owned());
    let coloring = options.color.ok_or_else(missing)?;
    if matches!(coloring.scheme, Scheme::Vertex(_)) {
        return Err(bad_scheme(format!("`{}`", coloring.scheme)));
    }
    Ok((options, coloring))
}

/// Replaces `color` by `scheme` in an error.
fn rename_color(error: ParamError) -> ParamError {
    match error {
        ParamError::BadValue { name: "color", value, .. } => bad_scheme(value),
        ParamError::Repeated { name: "color" } => ParamError::Repeated { name: "scheme" },
        other => other,
    }
}

fn bad_scheme(value: String) -> ParamError {
    ParamError::BadValue { name: "scheme", value, expected: expected() }
}

/// Returns the description of the valid values of `scheme`.
pub(super) fn expected() -> String {
    let of_atoms = |name: &&str| !matches!(name.parse(), Ok(Scheme::Vertex(_))) && *name != "none";
    color::EXPECTED.split(", ").filter(of_atoms).collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parsed(pairs: &[(&str, &str)]) -> Result<(Options, Coloring), ParamError> {
        let pairs: Vec<_> = pairs.iter().map(|(n, v)| ((*n).to_owned(), (*v).to_owned())).collect();
        parse(&pairs)
    }

    #[test]
    fn parameters_are_those_of_a_mesh_with_scheme_instead_of_color() {
        assert_eq!(parsed(&[("scheme", "bfactor"), ("chains", "A")]).unwrap().1.scheme, color::Scheme::BFactor);
        let (options, _) = parsed(&[("scheme", "bfactor"), ("assembly", "1"), ("context", "whole")]).unwrap();
        assert_eq!(options.selection.assembly.as_deref(), Some("1"));
        for (pairs, name) in [
            (&[][..], "scheme"),
            (&[("scheme", "none")], "scheme"),
            (&[("scheme", "chains")], "scheme"),
            (&[("scheme", "curvature")], "scheme"),
            (&[("scheme", "chain"), ("palette", "viridis")], "palette"),
        ] {
            let Err(ParamError::BadValue { name: found, expected, .. }) = parsed(pairs) else { panic!("{pairs:?}") };
            assert_eq!(found, name);
            assert!(name != "scheme" || expected.starts_with("uniform:#RRGGBB, element"), "{expected}");
        }
        let twice = parsed(&[("scheme", "chain"), ("scheme", "chain")]);
        assert_eq!(twice.unwrap_err(), ParamError::Repeated { name: "scheme" });
        for (name, similar) in [("color", None), ("resolution", None), ("schema", Some("scheme"))] {
            let Err(ParamError::Unknown { nearest, .. }) = parsed(&[(name, "chain")]) else { panic!("{name}") };
            assert!(similar.is_none() || nearest == similar, "{name}: {nearest:?}");
        }
    }
}
