//! Parser of job parameters: converts pairs of names and values to a validated [`Job`].
//!
//! The query of the HTTP service, `/v1/capabilities` and the command line use one table of names, descriptions and
//! ranges. The module depends on neither HTTP nor flags.

mod table;
mod values;

use std::fmt::Write as _;

use thiserror::Error;

pub use table::{Domain, Parameter, TABLE, usual_range};
use values::ParsedValues;

use super::nearest::nearest;
use super::{Job, Spacing};
use crate::formats::{Compress, Format, Normals, Units};
use crate::picture::PictureParams;
use crate::structure::{BadExpression, Selection, Split};
use crate::surface::{PaperParams, SurfaceError, SurfaceParams};

/// Errors of parsing parameters.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum ParamError {
    /// No parameter has this name.
    #[error("unknown parameter `{name}`{}", nearest.map_or(String::new(), |n| format!("; did you mean `{n}`?")))]
    Unknown {
        /// The given name, at most 64 characters.
        name: String,
        /// The most similar known name, if there is one.
        nearest: Option<&'static str>,
    },
    /// A parameter is given twice.
    #[error("parameter `{name}` is given more than once")]
    Repeated {
        /// Its name.
        name: &'static str,
    },
    /// The value is invalid for the parameter.
    #[error("parameter `{name}`: {value} is not allowed; expected {expected}")]
    BadValue {
        /// Its name.
        name: &'static str,
        /// The given value.
        value: String,
        /// Description of valid values.
        expected: String,
    },
    /// The value is an invalid expression.
    #[error("parameter `{name}`, {error}")]
    BadExpression {
        /// Name of the parameter.
        name: &'static str,
        /// The given expression.
        text: String,
        /// Position and expectation.
        error: BadExpression,
    },
}

/// Parsed parameters.
#[derive(Debug, Clone, Default)]
pub struct Request {
    /// The job.
    pub job: Job,
    /// Format, if given.
    pub format: Option<Format>,
    /// True if strict validation of the file is requested.
    pub strict: bool,
}

/// Parses parameters.
///
/// # Errors
/// Returns a [`ParamError`] for the first parameter that is unknown, repeated, malformed, out of range, or in conflict
/// with another one.
pub fn parse<N: AsRef<str>, V: AsRef<str>>(pairs: impl IntoIterator<Item = (N, V)>) -> Result<Request, ParamError> {
    let mut seen = [false; TABLE.len()];
    let mut values = ParsedValues::default();
    let mut spacing = None;
    for (name, value) in pairs {
        let (name, value) = (name.as_ref(), value.as_ref());
        let Some(index) = TABLE.iter().position(|p| p.name == name) else {
            return Err(unknown(name));
        };
        let parameter = &TABLE[index];
        if std::mem::replace(&mut seen[index], true) {
            return Err(ParamError::Repeated { name: parameter.name });
        }
        if value.len() > MAX_VALUE_BYTES {
            return Err(parameter.bad_value(value, format!("at most {MAX_VALUE_BYTES} bytes")));
        }
        // A default value conflicts with no other parameter, because clients may send all defaults. An explicit format
        // still overrides `Accept`.
        if parameter.name != "format" && parameter.is_default(value) {
            continue;
        }
        values.set(parameter, value)?;
        if SPACINGS.contains(&parameter.name)
            && let Some(other) = spacing.replace(parameter.name)
        {
            return Err(contradiction(parameter.name, value, other));
        }
    }
    let color = values.coloring()?;
    values.divide_models()?;
    let ParsedValues { options, selection, mut request, .. } = values;
    request.job = Job { selection, params: SurfaceParams::new(&options)?, color, ..request.job };
    if let Some(format) = request.format {
        set_format(&mut request.job, format)?;
    }
    Ok(request)
}

/// Maximum length of the value of a parameter, bytes: enough for the names of 1,000 chains. Job records contain values.
pub const MAX_VALUE_BYTES: usize = 4096;

/// Parameters of a picture.
pub(crate) const PICTURES: [&str; 7] = ["width", "height", "view", "azimuth", "elevation", "background", "style"];

/// Parameters that set the grid spacing and exclude each other.
pub(crate) const SPACINGS: [&str; 3] = ["resolution", "detail", "max_triangles"];

fn contradiction(name: &'static str, value: &str, other: &str) -> ParamError {
    ParamError::BadValue {
        name,
        value: format!("`{}`", value.chars().take(64).collect::<String>()),
        expected: format!("no value beside `{other}`: only one of {} sets the grid spacing", SPACINGS.join(", ")),
    }
}

/// Sets the format of a job, for a format that was not given as a parameter. A picture format adds picture parameters.
///
/// # Errors
/// Returns [`ParamError::BadValue`] for `compress`, `units`, `normals` or a picture parameter that the format does not
/// support.
pub fn set_format(job: &mut Job, format: Format) -> Result<(), ParamError> {
    let refuse = |name: &'static str, value: &str, instead: &str, holds: &dyn Fn(Format) -> bool| {
        let formats: Vec<_> = Format::ALL.into_iter().filter(|f| holds(*f)).map(Format::name).collect();
        Err(ParamError::BadValue {
            name,
            value: format!("`{value}`"),
            expected: format!("{instead} for {format}, or one of the formats {}", formats.join(", ")),
        })
    };
    if job.compress != Compress::None && !format.holds_quantized() {
        return refuse("compress", job.compress.name(), Compress::None.name(), &|f| f.holds_quantized());
    }
    if !format.holds_units(job.units) {
        let instead: Vec<_> = Units::ALL.into_iter().filter(|u| format.holds_units(*u)).map(Units::name).collect();
        return refuse("units", job.units.name(), &instead.join(", "), &|f| f.holds_units(job.units));
    }
    if job.normals == Normals::None && format.is_picture() {
        return refuse("normals", job.normals.name(), Normals::Smooth.name(), &|f| !f.is_picture());
    }
    if format.is_picture() {
        job.picture.get_or_insert_default();
        return Ok(());
    }
    let Some(picture) = job.picture.take() else { return Ok(()) };
    // The first parameter that differs from its default; a mesh ignores the defaults.
    let (given, plain) = (picture.canonical(), PictureParams::default().canonical());
    let differs = given.split('&').zip(plain.split('&')).find(|(given, plain)| given != plain);
    let Some((name, value)) = differs.and_then(|(given, _)| given.split_once('=')) else { return Ok(()) };
    let name = PICTURES.into_iter().find(|known| *known == name).unwrap_or("format");
    refuse(name, value, "the default", &|f| f.is_picture())
}

/// Returns the error for an unknown name.
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
                Self::BadValue { name: "surface", value: other.to_string(), expected: "valid parameters".to_owned() }
            }
        }
    }
}

/// Returns all parameters of a job as one line of text, which is equal for equal jobs only. It is part of the content
/// key.
#[must_use]
pub fn canonical(job: &Job) -> String {
    // Destructured, so that the compiler requires every new field here.
    let Job { selection, params, split, spacing, validation, compress, normals, units, color, map, picture } = job;
    let Selection { model, chains, atoms, altloc, assembly } = selection;
    let SurfaceParams {
        surface,
        probe,
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
    // Contains only the parameter that sets the spacing: the other two have their defaults.
    let spacing = match spacing {
        Spacing::Given => format!("resolution={resolution}"),
        Spacing::Detail(level) => format!("detail={level}"),
        Spacing::MaxTriangles(most) => format!("max_triangles={most}"),
    };
    let mut text = format!(
        "surface={surface}&probe={probe}&{spacing}&isovalue={isovalue}&smoothness={smoothness}\
         &radius_scale={radius_scale}&radius_offset={radius_offset}&cutoff_tolerance={cutoff_tolerance}\
         &preset={preset}&atom_ids={atom_ids}&model={model:?}&chains={chains:?}&select={:?}&altloc={altloc:?}\
         &assembly={assembly:?}&validation={}&compress={}&normals={}&units={}",
        atoms.to_string(),
        validation.name(),
        compress.name(),
        normals.name(),
        units.name()
    );
    if *split != Split::None {
        text.push_str("&split=");
        text.push_str(split.name());
    }
    let paper = match paper {
        None => Ok(()),
        Some(PaperParams::Gaussian { a, b } | PaperParams::SoftObject { a, b }) => {
            write!(text, "&paper_a={a}&paper_b={b}")
        }
        Some(PaperParams::InverseSquare { c, b }) => write!(text, "&paper_c={c}&paper_b={b}"),
    };
    if let Some(color) = color {
        text.push('&');
        text.push_str(&color.canonical());
    }
    if let Some(map) = map {
        text.push_str("&map=");
        text.push_str(map.digest());
    }
    if let Some(picture) = picture {
        text.push('&');
        text.push_str(&picture.canonical());
    }
    debug_assert!(paper.is_ok(), "writing to a string does not fail");
    text
}
