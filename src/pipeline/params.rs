//! The parameters of a job as people write them: one table of names, documentation and ranges, shared by the
//! query of the HTTP service, `/v1/capabilities` and the command line.
//!
//! Pairs of names and values come in, a validated [`Job`] goes out. It knows neither HTTP nor flags.

use std::fmt::Write as _;
use std::str::FromStr;

use thiserror::Error;

use super::Job;
use super::nearest::nearest;
use crate::formats::Format;
use crate::structure::Selection;
use crate::structure::select::KIND_NAMES;
use crate::surface::params::{MAX_RESOLUTION, MIN_RESOLUTION};
use crate::surface::{Kernel, PaperParams, Preset, Proof, SurfaceError, SurfaceOptions, SurfaceParams};

/// What values a parameter takes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Domain {
    /// A number within bounds, both included, in a unit (empty: none).
    Number {
        /// Lowest value.
        min: f64,
        /// Highest value.
        max: f64,
        /// Unit, such as `Å`.
        unit: &'static str,
    },
    /// A whole number of 32 bits.
    Integer,
    /// `true` or `false`.
    Flag,
    /// One of these words.
    Choice(&'static [&'static str]),
    /// Words of this set, separated by commas.
    Set(&'static [&'static str]),
    /// Free text.
    Text {
        /// What is expected, in words.
        expected: &'static str,
    },
}

impl Domain {
    /// What is expected, in words.
    #[must_use]
    pub fn expected(&self) -> String {
        match self {
            Self::Number { min, max, unit: "" } => format!("a number from {min} to {max}"),
            Self::Number { min, max, unit } => format!("a number from {min} to {max} {unit}"),
            Self::Integer => "a whole number".to_owned(),
            Self::Flag => "true or false".to_owned(),
            Self::Choice(words) => format!("one of {}", words.join(", ")),
            Self::Set(words) => format!("one or more of {}, separated by commas", words.join(", ")),
            Self::Text { expected } => (*expected).to_owned(),
        }
    }
}

/// One parameter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Parameter {
    /// Its name in queries and, with dashes for underscores, on the command line.
    pub name: &'static str,
    /// What values it takes.
    pub domain: Domain,
    /// The value that is used when it is absent, in words.
    pub default: &'static str,
    /// What it does, one sentence.
    pub doc: &'static str,
}

const fn number(
    name: &'static str,
    [min, max]: [f64; 2],
    unit: &'static str,
    default: &'static str,
    doc: &'static str,
) -> Parameter {
    Parameter { name, domain: Domain::Number { min, max, unit }, default, doc }
}

const KERNELS: &[&str] = &names(Kernel::ALL);
const PRESETS: &[&str] = &preset_names(Preset::ALL);
const FORMATS: &[&str] = &["glb", "gltf", "ply", "stl", "obj"];
const PROOFS: &[&str] = &[Proof::Checksum.name(), Proof::Exact.name()];

const fn names(all: &[Kernel]) -> [&'static str; 3] {
    [all[0].name(), all[1].name(), all[2].name()]
}

const fn preset_names(all: &[Preset]) -> [&'static str; 6] {
    [all[0].name(), all[1].name(), all[2].name(), all[3].name(), all[4].name(), all[5].name()]
}

/// Every parameter, in documentation order. The bounds repeat those of [`SurfaceParams::new`]; a test says that
/// the two agree.
pub const TABLE: &[Parameter] = &[
    Parameter {
        name: "preset",
        domain: Domain::Choice(PRESETS),
        default: "default",
        doc: "A named pair of smoothness and isovalue for the gaussian kernel.",
    },
    Parameter {
        name: "kernel",
        domain: Domain::Choice(KERNELS),
        default: "gaussian",
        doc: "The density that one atom contributes, as a function of distance.",
    },
    number("resolution", [MIN_RESOLUTION, MAX_RESOLUTION], "Å", "0.5", "Spacing of the grid."),
    number(
        "isovalue",
        [1e-3, 1e6],
        "",
        "1, or the preset's",
        "Level of the density that is the surface; at 1 an isolated atom's surface lies at its radius.",
    ),
    number(
        "smoothness",
        [0.1, 50.0],
        "",
        "1.25, or the preset's",
        "How fast the gaussian kernel falls off: small is smooth, large hugs the atoms.",
    ),
    number("radius_scale", [0.1, 10.0], "", "1", "Van der Waals radii are multiplied by this first."),
    number("radius_offset", [-5.0, 10.0], "Å", "0", "Then this is added to the radii."),
    number(
        "cutoff_tolerance",
        [1e-6, 0.2],
        "",
        "0.01",
        "Where the gaussian kernel is cut off, as a fraction of its value at the radius.",
    ),
    number(
        "paper_a",
        [1e-3, 1e6],
        "",
        "absent",
        "Raw constant a of Dias, Bora and Gomes 2010 for every atom, radii unused (gaussian: decay in Å⁻², at most 100; soft-object: height, at least 0.01).",
    ),
    number(
        "paper_b",
        [1e-2, 1e6],
        "",
        "absent",
        "Raw constant b of the same paper (gaussian: height; soft-object and inverse-square: radius of support in Å, 0.1 to 50).",
    ),
    number("paper_c", [1e-6, 1.0], "Å²", "absent", "Raw constant C of the same paper (inverse-square only)."),
    Parameter {
        name: "atom_ids",
        domain: Domain::Flag,
        default: "false",
        doc: "Give every vertex the index of its nearest atom in the file.",
    },
    Parameter {
        name: "model",
        domain: Domain::Integer,
        default: "the first of the file",
        doc: "The model to take, by its number in the file.",
    },
    Parameter {
        name: "chains",
        domain: Domain::Text { expected: "chain names separated by commas" },
        default: "all",
        doc: "The chains to take, by the author's names.",
    },
    Parameter {
        name: "select",
        domain: Domain::Set(&KIND_NAMES),
        default: "polymer",
        doc: "Which atoms to take; hydrogens adds those of whatever else is taken.",
    },
    Parameter {
        name: "altloc",
        domain: Domain::Text { expected: "one character" },
        default: "the best occupied of each residue",
        doc: "The alternative location to take.",
    },
    Parameter {
        name: "proof",
        domain: Domain::Choice(PROOFS),
        default: "checksum",
        doc: "How closedness is proven: by a checksum over edges, or exactly, edge by edge and vertex by vertex.",
    },
    Parameter {
        name: "check",
        domain: Domain::Choice(&["strict"]),
        default: "absent",
        doc: "Refuse a file in which a second, strict reader finds errors.",
    },
    Parameter { name: "format", domain: Domain::Choice(FORMATS), default: "glb", doc: "The mesh file format." },
    Parameter {
        name: "report",
        domain: Domain::Choice(&["json"]),
        default: "absent",
        doc: "Answer with the report in this form instead of the mesh.",
    },
];

/// Why parameters are refused.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum ParamError {
    /// No parameter has this name.
    #[error("unknown parameter `{name}`{}", nearest.map_or(String::new(), |n| format!("; did you mean `{n}`?")))]
    Unknown {
        /// The name that was given, at most 64 characters of it.
        name: String,
        /// The known name that is nearest to it, if one is near.
        nearest: Option<&'static str>,
    },
    /// A parameter is given twice.
    #[error("parameter `{name}` is given more than once")]
    Repeated {
        /// Its name.
        name: &'static str,
    },
    /// A value is not one of the parameter's.
    #[error("parameter `{name}`: {value} is not allowed; expected {expected}")]
    BadValue {
        /// Its name.
        name: &'static str,
        /// The value that was given.
        value: String,
        /// What was expected, in words.
        expected: String,
    },
}

/// What the pairs asked for.
#[derive(Debug, Clone, Default)]
pub struct Request {
    /// The job.
    pub job: Job,
    /// The mesh format, if one was named.
    pub format: Option<Format>,
    /// The report as JSON was asked for.
    pub report: bool,
    /// A strict check of the file was asked for.
    pub strict: bool,
}

/// Reads parameters.
///
/// # Errors
/// [`ParamError`] names the first parameter that is unknown, repeated, malformed, out of range, or does not go
/// with another one.
pub fn parse<N: AsRef<str>, V: AsRef<str>>(pairs: impl IntoIterator<Item = (N, V)>) -> Result<Request, ParamError> {
    let mut seen = [false; TABLE.len()];
    let mut options = SurfaceOptions::default();
    let mut selection = Selection::default();
    let mut request = Request::default();
    for (name, value) in pairs {
        let (name, value) = (name.as_ref(), value.as_ref());
        let Some(index) = TABLE.iter().position(|p| p.name == name) else {
            return Err(unknown(name));
        };
        let parameter = &TABLE[index];
        if std::mem::replace(&mut seen[index], true) {
            return Err(ParamError::Repeated { name: parameter.name });
        }
        set(parameter, value, &mut options, &mut selection, &mut request)?;
    }
    request.job = Job { selection, params: SurfaceParams::new(&options)?, proof: request.job.proof };
    Ok(request)
}

/// The refusal of an unknown name.
#[must_use]
pub fn unknown(name: &str) -> ParamError {
    let nearest = nearest(name, TABLE.iter().map(|p| p.name));
    ParamError::Unknown { name: name.chars().take(64).collect(), nearest }
}

impl From<SurfaceError> for ParamError {
    fn from(error: SurfaceError) -> Self {
        match error {
            SurfaceError::BadParameter { name, value, expected } => Self::BadValue { name, value, expected },
            other => {
                Self::BadValue { name: "kernel", value: other.to_string(), expected: "valid parameters".to_owned() }
            }
        }
    }
}

/// Puts one value where it belongs.
fn set(
    parameter: &Parameter,
    text: &str,
    options: &mut SurfaceOptions,
    selection: &mut Selection,
    request: &mut Request,
) -> Result<(), ParamError> {
    let bad = || ParamError::BadValue {
        name: parameter.name,
        value: format!("`{}`", text.chars().take(64).collect::<String>()),
        expected: parameter.domain.expected(),
    };
    // Whether a number is in range is the core's to say, as the range may hang on the kernel.
    let number = || text.trim().parse::<f64>().ok().filter(|v| v.is_finite()).map(Some).ok_or_else(bad);
    match parameter.name {
        "preset" => options.preset = Some(Preset::from_str(text).ok().ok_or_else(bad)?),
        "kernel" => options.kernel = Some(Kernel::from_str(text).ok().ok_or_else(bad)?),
        "resolution" => options.resolution = number()?,
        "isovalue" => options.isovalue = number()?,
        "smoothness" => options.smoothness = number()?,
        "radius_scale" => options.radius_scale = number()?,
        "radius_offset" => options.radius_offset = number()?,
        "cutoff_tolerance" => options.cutoff_tolerance = number()?,
        "paper_a" => options.paper_a = number()?,
        "paper_b" => options.paper_b = number()?,
        "paper_c" => options.paper_c = number()?,
        "atom_ids" => options.atom_ids = flag(text).ok_or_else(bad)?,
        "model" => selection.model = Some(text.trim().parse().ok().ok_or_else(bad)?),
        "chains" => selection.chains = Some(list(text).ok_or_else(bad)?.into_iter().map(str::to_owned).collect()),
        "select" => selection.set_kinds(text).map_err(|e| ParamError::BadValue {
            name: "select",
            value: format!("`{}`", e.value),
            expected: e.expected,
        })?,
        "altloc" => selection.altloc = Some(one_char(text).ok_or_else(bad)?),
        "proof" => request.job.proof = proof(text).ok_or_else(bad)?,
        "check" => request.strict = (text == "strict").then_some(true).ok_or_else(bad)?,
        "format" => request.format = Some(Format::from_str(text).ok().ok_or_else(bad)?),
        "report" => request.report = (text == "json").then_some(true).ok_or_else(bad)?,
        _ => return Err(unknown(parameter.name)),
    }
    Ok(())
}

fn flag(text: &str) -> Option<bool> {
    match text {
        "true" | "1" => Some(true),
        "false" | "0" => Some(false),
        _ => None,
    }
}

fn proof(text: &str) -> Option<Proof> {
    [Proof::Checksum, Proof::Exact].into_iter().find(|proof| proof.name() == text)
}

/// Words separated by commas, none of them empty.
fn list(text: &str) -> Option<Vec<&str>> {
    let words: Vec<&str> = text.split(',').map(str::trim).collect();
    words.iter().all(|w| !w.is_empty()).then_some(words)
}

fn one_char(text: &str) -> Option<char> {
    let mut chars = text.chars();
    chars.next().filter(|c| chars.next().is_none() && !c.is_control())
}

/// Everything that decides what a mesh looks like, as one line of text: equal for equal jobs, different for
/// different ones. Part of the key under which results are known.
#[must_use]
pub fn canonical(job: &Job) -> String {
    // Destructured, so that a field that is added without a place here does not compile.
    let Job { selection, params, proof } = job;
    let Selection { model, chains, polymer, ligands, waters, hydrogens, altloc } = selection;
    let SurfaceParams {
        kernel,
        resolution,
        isovalue,
        smoothness,
        radius_scale,
        radius_offset,
        cutoff_tolerance,
        preset,
        paper,
        atom_ids,
    } = params;
    let mut text = format!(
        "kernel={kernel}&resolution={resolution}&isovalue={isovalue}&smoothness={smoothness}\
         &radius_scale={radius_scale}&radius_offset={radius_offset}&cutoff_tolerance={cutoff_tolerance}\
         &preset={preset}&atom_ids={atom_ids}&model={model:?}&chains={chains:?}&polymer={polymer}\
         &ligands={ligands}&waters={waters}&hydrogens={hydrogens}&altloc={altloc:?}&proof={}",
        proof.name()
    );
    let paper = match paper {
        None => Ok(()),
        Some(PaperParams::Gaussian { a, b } | PaperParams::SoftObject { a, b }) => {
            write!(text, "&paper_a={a}&paper_b={b}")
        }
        Some(PaperParams::InverseSquare { c, b }) => write!(text, "&paper_c={c}&paper_b={b}"),
    };
    debug_assert!(paper.is_ok(), "writing to a string does not fail");
    text
}
