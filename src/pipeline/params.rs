//! Parser of job parameters: converts pairs of names and values to a validated [`Job`].
//!
//! The query of the HTTP service, `/v1/capabilities` and the command line use one table of names, descriptions and
//! ranges. The module depends on neither HTTP nor flags.

mod canonical;
mod table;

use std::str::FromStr;

use thiserror::Error;

pub use canonical::canonical;
use table::flag;
pub use table::{Domain, Parameter, TABLE, usual_range};

use super::color::{ColorBlend, Coloring, Palette, Scheme};
use super::nearest::nearest;
use super::spacing::{DETAILS, MAX_TRIANGLE_LIMIT, MIN_TRIANGLE_LIMIT};
use super::{Job, Spacing};
use crate::formats::{Compress, Format, Normals, Units};
use crate::picture::{Background, MAX_SIDE, PictureParams, Style, View};
use crate::structure::{BadExpression, Context, Selection, Split};
use crate::surface::{Preset, SurfaceError, SurfaceKind, SurfaceOptions, SurfaceParams, Validation};

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
    let ParsedValues { options, selection, mut request, .. } = values;
    request.job = Job { selection, params: SurfaceParams::new(&options)?, color, ..request.job };
    check_instances(&request.job)?;
    if let Some(format) = request.format {
        set_format(&mut request.job, format)?;
    }
    Ok(request)
}

/// Rejects instances without an assembly, and with a surface that is divided or joined otherwise.
fn check_instances(job: &Job) -> Result<(), ParamError> {
    let Selection { assembly, context, instances, .. } = &job.selection;
    let expected = match (assembly, context, job.split) {
        (None, ..) => "false for the asymmetric unit, or a value of assembly".to_owned(),
        (_, Context::Whole, _) => format!("false with context={}, which makes one surface", context.name()),
        (.., split) if split != Split::None => format!("false with split={}", split.name()),
        _ => return Ok(()),
    };
    if !instances {
        return Ok(());
    }
    Err(ParamError::BadValue { name: "instances", value: "`true`".to_owned(), expected })
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
/// Returns [`ParamError::BadValue`] for `compress`, `units`, `normals`, `instances` or a picture parameter that the
/// format does not support.
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
    if job.selection.instances && !format.holds_instances() {
        return refuse("instances", "true", "false", &|f| f.holds_instances());
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

/// Values of the parameters that are parsed so far.
#[derive(Default)]
struct ParsedValues {
    options: SurfaceOptions,
    selection: Selection,
    scheme: Option<Scheme>,
    palette: Option<Palette>,
    color_range: Option<[f64; 2]>,
    color_blend: ColorBlend,
    request: Request,
}

impl ParsedValues {
    /// Combines `color`, `palette`, `color_range` and `color_blend`.
    fn coloring(&self) -> Result<Option<Coloring>, ParamError> {
        let Self { scheme, palette, color_range: range, color_blend: blend, .. } = *self;
        let has_numbers = scheme.is_some_and(|scheme| scheme.palette().is_some());
        let unused = match (palette, range) {
            (Some(palette), _) => Some(("palette", palette.name().to_owned())),
            (_, Some([low, high])) => Some(("color_range", format!("{low},{high}"))),
            _ => None,
        };
        if let Some((name, value)) = unused.filter(|_| !has_numbers) {
            let shown = scheme.map_or("none".to_owned(), |scheme| scheme.to_string());
            let expected =
                format!("no value with color={shown}, or a scheme with numbers: color={}", Scheme::with_numbers());
            return Err(ParamError::BadValue { name, value: format!("`{value}`"), expected });
        }
        if blend == ColorBlend::Smooth && scheme.is_none() {
            let expected = format!("{} without colours, or a value of color", ColorBlend::Nearest.name());
            return Err(ParamError::BadValue { name: "color_blend", value: format!("`{}`", blend.name()), expected });
        }
        Ok(scheme.map(|scheme| Coloring { scheme, palette, range, blend }))
    }

    /// Returns the picture parameters of the job. The first call creates them.
    fn picture(&mut self) -> &mut PictureParams {
        self.request.job.picture.get_or_insert_default()
    }

    /// Parses the value of one parameter.
    fn set(&mut self, parameter: &Parameter, text: &str) -> Result<(), ParamError> {
        let bad = || parameter.invalid(text);
        // The core checks ranges, because they may depend on the surface.
        let number = || text.trim().parse::<f64>().ok().filter(|v| v.is_finite()).map(Some).ok_or_else(bad);
        let side = || whole(text).and_then(|n| u32::try_from(n).ok()).filter(|n| (1..=MAX_SIDE).contains(n));
        let angle = || {
            let Domain::Number { min, max, .. } = parameter.domain else { return None };
            text.trim().parse::<f64>().ok().filter(|angle| (min..=max).contains(angle))
        };
        match parameter.name {
            "preset" => self.options.preset = Some(Preset::from_str(text).ok().ok_or_else(bad)?),
            "surface" => self.options.surface = Some(SurfaceKind::from_str(text).ok().ok_or_else(bad)?),
            "probe" => self.options.probe = number()?,
            "resolution" => self.options.resolution = number()?,
            "detail" => {
                let level = whole(text).filter(|level| *level < DETAILS.len() as u64);
                self.request.job.spacing = Spacing::Detail(level.and_then(|l| u8::try_from(l).ok()).ok_or_else(bad)?);
            }
            "max_triangles" => {
                let most = whole(text)
                    .filter(|most| (u64::from(MIN_TRIANGLE_LIMIT)..=u64::from(MAX_TRIANGLE_LIMIT)).contains(most));
                self.request.job.spacing = Spacing::MaxTriangles(most.ok_or_else(bad)?);
            }
            "isovalue" => self.options.isovalue = number()?,
            "smoothness" => self.options.smoothness = number()?,
            "radius_scale" => self.options.radius_scale = number()?,
            "radius_offset" => self.options.radius_offset = number()?,
            "cutoff_tolerance" => self.options.cutoff_tolerance = number()?,
            "paper_a" => self.options.paper_a = number()?,
            "paper_b" => self.options.paper_b = number()?,
            "paper_c" => self.options.paper_c = number()?,
            "atom_ids" => self.options.atom_ids = flag(text).ok_or_else(bad)?,
            "color" if text == "none" => self.scheme = None,
            "color" => self.scheme = Some(text.parse().ok().ok_or_else(bad)?),
            "palette" => self.palette = Some(named(&Palette::ALL, Palette::name, text).ok_or_else(bad)?),
            "color_blend" => self.color_blend = named(&ColorBlend::ALL, ColorBlend::name, text).ok_or_else(bad)?,
            "color_range" => self.color_range = Some(range(text).ok_or_else(bad)?),
            "model" => self.selection.model = Some(text.trim().parse().ok().ok_or_else(bad)?),
            "chains" => {
                self.selection.chains = Some(list(text).ok_or_else(bad)?.into_iter().map(str::to_owned).collect());
            }
            "select" => {
                let bad = |error| ParamError::BadExpression { name: "select", text: text.to_owned(), error };
                self.selection.atoms = text.parse().map_err(bad)?;
            }
            "assembly" => {
                let id = Some(text.trim()).filter(|id| !id.is_empty() && !id.chars().any(char::is_control));
                let id = id.ok_or_else(bad)?;
                self.selection.assembly = (id != parameter.default).then(|| id.to_owned());
            }
            "instances" => self.selection.instances = flag(text).ok_or_else(bad)?,
            "context" => self.selection.context = named(&Context::ALL, Context::name, text).ok_or_else(bad)?,
            "split" => self.request.job.split = named(&Split::ALL, Split::name, text).ok_or_else(bad)?,
            "altloc" => self.selection.altloc = Some(one_char(text).ok_or_else(bad)?),
            "validation" => self.request.job.validation = Validation::from_str(text).ok().ok_or_else(bad)?,
            "check" => self.request.strict = (text == "strict").then_some(true).ok_or_else(bad)?,
            "format" => self.request.format = Some(Format::from_str(text).ok().ok_or_else(bad)?),
            "compress" => self.request.job.compress = named(&Compress::ALL, Compress::name, text).ok_or_else(bad)?,
            "normals" => self.request.job.normals = named(&Normals::ALL, Normals::name, text).ok_or_else(bad)?,
            "units" => self.request.job.units = named(&Units::ALL, Units::name, text).ok_or_else(bad)?,
            "width" => self.picture().width = side().ok_or_else(bad)?,
            "height" => self.picture().height = side().ok_or_else(bad)?,
            "view" => self.picture().view = named(&View::ALL, View::name, text).ok_or_else(bad)?,
            "azimuth" => self.picture().azimuth = angle().ok_or_else(bad)?,
            "elevation" => self.picture().elevation = angle().ok_or_else(bad)?,
            "background" => self.picture().background = text.parse::<Background>().ok().ok_or_else(bad)?,
            "style" => self.picture().style = named(&Style::ALL, Style::name, text).ok_or_else(bad)?,
            _ => return Err(unknown(parameter.name)),
        }
        Ok(())
    }
}

/// Returns the value with this name.
fn named<T: Copy>(all: &[T], name: impl Fn(T) -> &'static str, text: &str) -> Option<T> {
    all.iter().copied().find(|value| name(*value) == text)
}

fn whole(text: &str) -> Option<u64> {
    text.trim().parse().ok()
}

/// Splits a list at commas. Rejects empty items and control characters.
fn list(text: &str) -> Option<Vec<&str>> {
    let words: Vec<&str> = text.split(',').map(str::trim).collect();
    words.iter().all(|w| !w.is_empty() && !w.chars().any(char::is_control)).then_some(words)
}

/// Parses two numbers, the lower one first.
fn range(text: &str) -> Option<[f64; 2]> {
    let (low, high) = text.split_once(',')?;
    let [low, high] = [low, high].map(|end| end.trim().parse::<f64>().ok().filter(|end| end.is_finite()));
    // Adding 0 turns −0 into 0, so both have one canonical form.
    Some([low? + 0.0, high? + 0.0]).filter(|[low, high]| low < high)
}

fn one_char(text: &str) -> Option<char> {
    let mut chars = text.chars();
    chars.next().filter(|c| chars.next().is_none() && !c.is_control())
}
