//! Parameters of `…/atoms`: `positions`, and those of a mesh that select its atoms.

use crate::pipeline::params::{self, ParamError};
use crate::structure::Selection;

/// Name of the parameter that requests positions.
pub(super) const POSITIONS: &str = "positions";
/// Names of the parameters.
pub(super) const NAMES: [&str; 6] = [POSITIONS, "model", "chains", "select", "altloc", "assembly"];

/// Selection of atoms that are listed with their positions.
pub(super) struct Positions {
    pub(super) selection: Selection,
    /// Canonical text of the parameters, equal for equal lists only.
    pub(super) canonical: String,
}

/// Parses the parameters. Returns `None` if no positions are requested.
///
/// # Errors
/// Returns a [`ParamError`], including if atoms are selected without positions.
pub(super) fn parse(pairs: &[(String, String)]) -> Result<Option<Positions>, ParamError> {
    params::check_names(pairs, &NAMES)?;
    let (own, mesh_pairs): (Vec<_>, Vec<_>) = pairs.iter().partition(|(name, _)| name == POSITIONS);
    let job = params::parse(mesh_pairs.iter().map(|(name, value)| (name, value)))?.options;
    let positions = match &own[..] {
        [] => false,
        [(_, value)] => match value.as_str() {
            "true" => true,
            "false" => false,
            other => return Err(ParamError::bad_value(POSITIONS, other, "true or false")),
        },
        _ => return Err(ParamError::Repeated { name: POSITIONS }),
    };
    if positions {
        let canonical = format!("{POSITIONS}&{}", params::canonical(&job));
        return Ok(Some(Positions { selection: job.selection, canonical }));
    }
    if job.selection != Selection::default() {
        let expected = "true, which the parameters that select atoms need";
        return Err(ParamError::bad_value(POSITIONS, "false", expected));
    }
    Ok(None)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parsed(pairs: &[(&str, &str)]) -> Result<Option<Positions>, ParamError> {
        let pairs: Vec<_> = pairs.iter().map(|(n, v)| ((*n).to_owned(), (*v).to_owned())).collect();
        parse(&pairs)
    }

    #[test]
    fn a_selection_needs_positions() {
        assert!(parsed(&[]).unwrap().is_none());
        assert!(parsed(&[("positions", "false"), ("assembly", "asymmetric-unit")]).unwrap().is_none());
        let found = parsed(&[("select", "ligand"), ("positions", "true")]).unwrap().unwrap();
        let other = parsed(&[("positions", "true")]).unwrap().unwrap();
        assert_ne!(found.canonical, other.canonical);
        assert_ne!(found.selection, other.selection);
        for (pairs, name) in [
            (&[("select", "ligand")][..], "positions"),
            (&[("positions", "1")], "positions"),
            (&[("positions", "true"), ("select", "ligands and")], "select"),
            (&[("positions", "true"), ("positions", "true")], "positions"),
            (&[("positions", "true"), ("resolution", "1")], "resolution"),
        ] {
            let error = parsed(pairs).err().unwrap();
            assert_eq!(error.parameter(), name, "{error}");
        }
    }
}
