//! Outputs of a batch, from its parameters: those of a mesh, `outputs` instead of `format`, and `by` for areas.

use std::collections::HashSet;

use super::problem::Problem;
use super::state::App;
use crate::formats::Format;
use crate::pipeline::AreaLevel;
use crate::pipeline::params::areas::{self, AreasRequest};
use crate::pipeline::params::{self, ParamError, Request, TABLE};

/// Parameter that names the outputs.
pub(super) const OUTPUTS: &str = "outputs";
/// Output with the table of areas, and the extension of its file.
pub(super) const AREAS: &str = "areas";
pub(super) const AREAS_EXTENSION: &str = "csv";
/// Parameters of mesh files, which a picture beside them does not have.
const MESH_FILES: [&str; 3] = ["compress", "normals", "units"];

/// Output that is computed by a job for each file.
#[derive(Debug, Clone)]
pub(super) struct JobOutput {
    /// Parameters that apply to it.
    pub(super) pairs: Vec<(String, String)>,
    pub(super) request: Request,
}

/// Outputs of each file.
#[derive(Debug, Clone)]
pub(super) struct BatchPlan {
    /// Meshes and pictures.
    pub(super) jobs: Vec<JobOutput>,
    /// Table of areas.
    pub(super) areas: Option<AreasRequest>,
}

impl BatchPlan {
    /// Parses the parameters of a batch. A parameter applies to the outputs that have it.
    pub(super) fn parse(pairs: &[(String, String)]) -> Result<Self, ParamError> {
        let (outputs, pairs): (Vec<_>, Vec<_>) = pairs.iter().cloned().partition(|(name, _)| name == OUTPUTS);
        let outputs = match &outputs[..] {
            [] => Format::default().name(),
            [(_, value)] => value,
            _ => return Err(ParamError::Repeated { name: OUTPUTS }),
        };
        if let Some((_, value)) = pairs.iter().find(|(name, _)| name == "format") {
            return Err(ParamError::bad_value("format", value, "no value: `outputs` names the formats of a batch"));
        }
        let (mut formats, mut has_areas) = (Vec::new(), false);
        for name in outputs.split(',').map(str::trim) {
            let format = Format::ALL.into_iter().find(|format| format.name() == name);
            let is_repeated = match format {
                Some(format) => formats.contains(&format),
                None => has_areas || name != AREAS,
            };
            if is_repeated {
                return Err(ParamError::bad_value(OUTPUTS, name, expected()));
            }
            formats.extend(format);
            has_areas |= format.is_none();
        }
        let is_used = |name: &str| match name {
            areas::BY => has_areas,
            name => !formats.is_empty() || areas::NAMES.contains(&name),
        };
        let (pairs, unused): (Vec<_>, Vec<_>) = pairs.into_iter().partition(|(name, _)| is_used(name));
        check_unused(&unused)?;
        let has_both = formats.iter().any(|format| format.is_picture()) && !formats.iter().all(|f| f.is_picture());
        let job = |format: Format| {
            let others: &[&str] = if format.is_picture() { &MESH_FILES } else { &params::PICTURES };
            let applies = |name: &str| !(name == areas::BY || has_both && others.contains(&name));
            let pairs: Vec<_> = pairs.iter().filter(|(name, _)| applies(name)).cloned().collect();
            let parsed = params::parse_with(pairs.iter().map(|(n, v)| (n, v)), |_| Ok::<_, ParamError>(format));
            parsed.map(|request| JobOutput { pairs, request })
        };
        let jobs = formats.iter().map(|format| job(*format)).collect::<Result<Vec<_>, _>>()?;
        let applies_to_areas = |(name, _): &&(String, String)| areas::NAMES.contains(&name.as_str());
        let area_pairs: Vec<_> = pairs.iter().filter(applies_to_areas).cloned().collect();
        let areas = has_areas.then(|| areas::parse(&area_pairs)).transpose()?;
        Ok(Self { jobs, areas })
    }

    /// Rejects options that are invalid regardless of the files.
    pub(super) fn check(&self, app: &App) -> Result<(), Problem> {
        self.jobs.iter().try_for_each(|output| app.check_options(&output.request.options))
    }

    /// Returns the names of the outputs.
    pub(super) fn names(&self) -> Vec<&'static str> {
        self.formats_and(AREAS)
    }

    /// Returns the extensions of the files of the outputs.
    pub(super) fn extensions(&self) -> Vec<&'static str> {
        self.formats_and(AREAS_EXTENSION)
    }

    fn formats_and(&self, areas: &'static str) -> Vec<&'static str> {
        let formats = self.jobs.iter().map(|output| output.request.format.name());
        formats.chain(self.areas.is_some().then_some(areas)).collect()
    }
}

/// Checks parameters that no output has. As for a single mesh, defaults are accepted, because clients may send all of
/// them.
fn check_unused(pairs: &[(String, String)]) -> Result<(), ParamError> {
    let mut seen = HashSet::new();
    for (name, value) in pairs {
        let (name, is_default, needed) = if name == areas::BY {
            (areas::BY, value == AreaLevel::default().name(), AREAS)
        } else if let Some(parameter) = TABLE.iter().find(|parameter| parameter.name == name) {
            (parameter.name, parameter.is_default(value), "a format")
        } else {
            return Err(params::unknown(name, areas::NAMES));
        };
        if !seen.insert(name) {
            return Err(ParamError::Repeated { name });
        }
        if !is_default {
            return Err(ParamError::bad_value(name, value, format!("the default, or {needed} in `{OUTPUTS}`")));
        }
    }
    Ok(())
}

/// Describes the values of `outputs`.
pub(super) fn expected() -> String {
    format!("one or more of {AREAS}, {}, each once, separated by commas", Format::ALL.map(Format::name).join(", "))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parsed(pairs: &[(&str, &str)]) -> Result<BatchPlan, ParamError> {
        let pairs: Vec<_> = pairs.iter().map(|(n, v)| ((*n).to_owned(), (*v).to_owned())).collect();
        BatchPlan::parse(&pairs)
    }

    #[test]
    fn parameters_apply_to_the_outputs_that_have_them() {
        let all = [
            ("outputs", "ply, png,areas"),
            ("surface", "ses"),
            ("width", "40"),
            ("units", "nanometer"),
            ("by", "atom"),
        ];
        let plan = parsed(&all).unwrap();
        assert_eq!(plan.names(), ["ply", "png", "areas"]);
        let names = |output: &JobOutput| output.pairs.iter().map(|(name, _)| name.clone()).collect::<Vec<_>>();
        assert_eq!([names(&plan.jobs[0]), names(&plan.jobs[1])], [["surface", "units"], ["surface", "width"]]);
        assert_eq!(parsed(&[]).unwrap().names(), ["glb"]);
        for (pairs, name) in [
            (&[("format", "glb")][..], "format"),
            (&[("outputs", "glb,glb")], "outputs"),
            (&[("outputs", "areas,areas")], "outputs"),
            (&[("outputs", "")], "outputs"),
            (&[("outputs", "glb"), ("outputs", "png")], "outputs"),
            (&[("outputs", "glb"), ("width", "40")], "width"),
            (&[("outputs", "glb"), ("by", "atom")], "by"),
            (&[("outputs", "areas")], "surface"),
            (&[("outputs", "areas"), ("surface", "sas"), ("resolution", "1")], "resolution"),
            (&[("outputs", "glb,areas"), ("surface", "sas"), ("resolutoin", "1")], "resolutoin"),
            (&[("outputs", "glb"), ("by", "residue"), ("by", "residue")], "by"),
        ] {
            assert_eq!(parsed(pairs).unwrap_err().parameter(), name, "{pairs:?}");
        }
    }

    #[test]
    fn a_parameter_that_no_output_has_may_have_its_default() {
        for (outputs, name, default, other, needed) in [
            ("glb", "by", "residue", "chain", "areas"),
            ("areas", "width", "512", "40", "a format"),
            ("areas", "atom_ids", "false", "true", "a format"),
            ("glb", "width", "512", "40", "png"),
            ("png", "units", "angstrom", "nanometer", "glb"),
        ] {
            let plan = |value| parsed(&[("outputs", outputs), ("surface", "sas"), (name, value)]);
            assert_eq!(plan(default).unwrap().names(), [outputs]);
            let error = plan(other).unwrap_err().to_string();
            assert!(error.contains(&format!("`{name}`: `{other}` is not allowed; expected ")), "{error}");
            assert!(error.contains(needed), "{error}");
        }
        let error = parsed(&[("outputs", "areas"), ("surface", "sas"), ("prob", "1")]).unwrap_err();
        assert_eq!(error.to_string(), "unknown parameter `prob`; did you mean `probe`?");
        let plan = parsed(&[("outputs", "png,areas"), ("surface", "sas")]).unwrap();
        assert_eq!(plan.extensions(), ["png", "csv"]);
    }
}
