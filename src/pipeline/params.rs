//! The parameters of a job as people write them: one table of names, documentation and ranges, shared by the
//! query of the HTTP service, `/v1/capabilities` and the command line.
//!
//! Pairs of names and values come in, a validated [`Job`] goes out. It knows neither HTTP nor flags.

mod table;

use std::fmt::Write as _;
use std::str::FromStr;

use thiserror::Error;

pub use table::{Domain, Parameter, TABLE};

use super::Job;
use super::nearest::nearest;
use crate::formats::{Compress, Format};
use crate::structure::Selection;
use crate::surface::{Kernel, PaperParams, Preset, Proof, SurfaceError, SurfaceOptions, SurfaceParams};

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
    request.job = Job { selection, params: SurfaceParams::new(&options)?, ..request.job };
    request.format.map_or(Ok(()), |format| suits(&request.job, format))?;
    Ok(request)
}

/// Whether a job's mesh can be had in `format`: for a format that was named elsewhere than in the pairs.
///
/// # Errors
/// [`ParamError::BadValue`] for `compress` where the format has nothing of the kind.
pub fn suits(job: &Job, format: Format) -> Result<(), ParamError> {
    if job.compress == Compress::None || format.holds_quantized() {
        return Ok(());
    }
    let takes: Vec<_> = Format::ALL.into_iter().filter(|f| f.holds_quantized()).map(Format::extension).collect();
    Err(ParamError::BadValue {
        name: "compress",
        value: format!("`{}` with {format}", job.compress.name()),
        expected: format!("{}, or one of the formats {}", Compress::None.name(), takes.join(", ")),
    })
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
        "compress" => request.job.compress = compress(text).ok_or_else(bad)?,
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

fn compress(text: &str) -> Option<Compress> {
    Compress::ALL.into_iter().find(|compress| compress.name() == text)
}

/// Words separated by commas, none of them empty or with control characters.
fn list(text: &str) -> Option<Vec<&str>> {
    let words: Vec<&str> = text.split(',').map(str::trim).collect();
    words.iter().all(|w| !w.is_empty() && !w.chars().any(char::is_control)).then_some(words)
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
    let Job { selection, params, proof, compress } = job;
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
        // Follows from `compress` and the spheres.
        quantize: _,
    } = params;
    let mut text = format!(
        "kernel={kernel}&resolution={resolution}&isovalue={isovalue}&smoothness={smoothness}\
         &radius_scale={radius_scale}&radius_offset={radius_offset}&cutoff_tolerance={cutoff_tolerance}\
         &preset={preset}&atom_ids={atom_ids}&model={model:?}&chains={chains:?}&polymer={polymer}\
         &ligands={ligands}&waters={waters}&hydrogens={hydrogens}&altloc={altloc:?}&proof={}&compress={}",
        proof.name(),
        compress.name()
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
