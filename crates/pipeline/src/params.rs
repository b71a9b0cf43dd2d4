//! Parser of job parameters: converts pairs of names and values to a complete, validated [`Request`].
//!
//! The query of the HTTP service, `/v1/capabilities` and the command line use one table of names, descriptions and
//! ranges. The module depends on neither HTTP nor flags.

pub mod areas;
mod canonical;
mod domain;
mod table;
mod values;

use thiserror::Error;

pub use canonical::canonical;
pub use domain::Domain;
use molmesh_formats::tileset::TileAddress;
use molmesh_formats::{Compress, Format, Normals, Units};
use molmesh_picture::PictureParams;
use molmesh_structure::{BadExpression, Context, Selection, Split};
use molmesh_surface::pockets::SPACING as POCKET_SPACING;
use molmesh_surface::{SurfaceError, SurfaceParams, TriangleQuality};
pub use table::{Parameter, TABLE, usual_range};
use values::ParsedValues;

use super::color::{Coloring, Scheme};
use super::nearest::nearest;
use super::{Cavities, Interface, Options, Simplify, tileset};

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

impl ParamError {
    /// Returns the error for `value`, of which it shows at most 64 characters.
    pub fn bad_value(name: &'static str, value: &str, expected: impl Into<String>) -> Self {
        let value = format!("`{}`", value.chars().take(64).collect::<String>());
        Self::BadValue { name, value, expected: expected.into() }
    }

    /// Returns the name of the parameter.
    #[must_use]
    pub fn parameter(&self) -> &str {
        match self {
            Self::Unknown { name, .. } => name,
            Self::Repeated { name } | Self::BadValue { name, .. } | Self::BadExpression { name, .. } => name,
        }
    }
}

/// Parsed parameters.
#[derive(Debug, Clone, Default)]
pub struct Request {
    /// The job.
    pub options: Options,
    /// Format of the file.
    pub format: Format,
    /// True if strict validation of the file is requested.
    pub strict: bool,
}

/// Parses parameters. Without `format`, the file is a PNG if a parameter of pictures has a value that is not its
/// default, otherwise a GLB.
///
/// # Errors
/// Returns a [`ParamError`] for the first parameter that is unknown, repeated, malformed, out of range, or in conflict
/// with another one or with the format.
pub fn parse<N: AsRef<str>, V: AsRef<str>>(pairs: impl IntoIterator<Item = (N, V)>) -> Result<Request, ParamError> {
    let is_picture = |options: &Options| options.picture.is_some_and(|picture| picture != PictureParams::default());
    parse_with(pairs, |options| Ok(if is_picture(options) { Format::Png } else { Format::default() }))
}

/// Parses parameters like [`parse`], with the format that `format` returns for a job without this parameter.
///
/// # Errors
/// Returns the errors of [`parse`] and of `format`.
pub fn parse_with<N: AsRef<str>, V: AsRef<str>, E: From<ParamError>>(
    pairs: impl IntoIterator<Item = (N, V)>,
    format: impl FnOnce(&Options) -> Result<Format, E>,
) -> Result<Request, E> {
    let values = parse_values(pairs)?;
    let format = values.format.map_or_else(|| format(&values.options), Ok)?;
    Ok(request(values, format)?)
}

/// Returns the request for a file of this format.
fn request(ParsedValues { mut options, strict, .. }: ParsedValues, format: Format) -> Result<Request, ParamError> {
    set_format(&mut options, format)?;
    Ok(Request { options, format, strict })
}

/// Parses parameters of a tileset, whose tiles are GLB files, compressed by default. If `compress` is absent, adds it
/// to `pairs`, so that they describe the tiles completely.
///
/// # Errors
/// Returns the errors of [`parse`], and [`ParamError::BadValue`] for a parameter that does not apply to tiles.
pub fn parse_tileset(pairs: &mut Vec<(String, String)>) -> Result<Request, ParamError> {
    if pairs.iter().all(|(name, _)| name != "compress") {
        pairs.push(("compress".to_owned(), Compress::Meshopt.name().to_owned()));
    }
    let values = parse_values(pairs.iter().map(|(name, value)| (name, value)))?;
    check_tiles(&values)?;
    let format = values.format.unwrap_or(Format::Glb);
    request(values, format)
}

/// Parses parameters and checks them, apart from the format.
fn parse_values<N: AsRef<str>, V: AsRef<str>>(
    pairs: impl IntoIterator<Item = (N, V)>,
) -> Result<ParsedValues, ParamError> {
    let mut seen = [false; TABLE.len()];
    let mut values = ParsedValues::default();
    let mut spacings: Vec<(&'static str, String)> = Vec::new();
    for (name, value) in pairs {
        let (name, value) = (name.as_ref(), value.as_ref());
        let Some(index) = TABLE.iter().position(|p| p.name == name) else {
            return Err(unknown(name, TABLE.iter().map(|p| p.name)));
        };
        let parameter = &TABLE[index];
        if std::mem::replace(&mut seen[index], true) {
            return Err(ParamError::Repeated { name: parameter.name });
        }
        if value.len() > MAX_VALUE_BYTES {
            return Err(ParamError::bad_value(parameter.name, value, format!("at most {MAX_VALUE_BYTES} bytes")));
        }
        // A default value conflicts with no other parameter, because clients may send all defaults. An explicit format
        // still overrides `Accept`.
        if parameter.name != "format" && parameter.is_default(value) {
            continue;
        }
        values.set(parameter, value)?;
        if tileset::NOT_APPLICABLE.contains(&parameter.name) {
            values.unfit_for_tiles.get_or_insert((parameter.name, value.to_owned()));
        }
        if SPACINGS.contains(&parameter.name) {
            spacings.push((parameter.name, value.to_owned()));
        }
    }
    values.limit_triangles(&mut spacings);
    if let [(other, _), (name, value), ..] = &spacings[..] {
        return Err(contradiction(name, value, other));
    }
    values.options.color = values.coloring()?;
    values.options.pockets = values.pockets()?;
    values.divide_models()?;
    values.options.params = SurfaceParams::new(&values.surface)?;
    let options = &values.options;
    check_instances(options)?;
    check_cavities(options)?;
    check_pockets(options)?;
    check_exact(options)?;
    check_simplify(options)?;
    if options.tile.is_some() {
        check_tiles(&values)?;
    }
    Ok(values)
}

/// Rejects parameters that do not apply to tiles.
fn check_tiles(values: &ParsedValues) -> Result<(), ParamError> {
    let Options { color, split, .. } = &values.options;
    let (name, value, expected) = match (color, &values.unfit_for_tiles) {
        (Some(Coloring { scheme: scheme @ Scheme::Vertex(_), .. }), _) => {
            ("color", &scheme.to_string(), "a scheme that colours atoms")
        }
        (_, Some((name, value))) => (*name, value, "no value, or the default,"),
        _ if *split == Split::Model => ("model", &"all".to_owned(), "one model"),
        _ => return Ok(()),
    };
    let expected = format!("{expected} for a tileset, whose tiles are computed independently");
    Err(ParamError::bad_value(name, value, expected))
}

/// Rejects a unit without an assembly, and instances without one, with one unit, or with a surface that is divided or
/// joined otherwise.
fn check_instances(options: &Options) -> Result<(), ParamError> {
    let Selection { assembly, context, instances, unit, .. } = &options.selection;
    let unfit = match (assembly, context) {
        (None, _) => Some("no value without assembly".to_owned()),
        (_, Context::Whole) => Some(format!("no value with context={}", context.name())),
        _ => None,
    };
    if let (Some(unfit), Some(unit)) = (unfit, unit) {
        return Err(ParamError::BadValue { name: "unit", value: format!("`{unit}`"), expected: unfit });
    }
    let expected = match (assembly, context, options.split) {
        _ if unit.is_some() => "false with a value of unit".to_owned(),
        _ if options.tile.is_some_and(|tile| tile != TileAddress::ROOT) => {
            "false for a tile below the root: it belongs to one unit".to_owned()
        }
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

/// Rejects cavities of a surface that is divided or repeated: they are found for all selected atoms together. Exact
/// measures include the walls that `drop` and `only` remove from the mesh.
fn check_cavities(options: &Options) -> Result<(), ParamError> {
    let Some(cavities) = options.cavities else { return Ok(()) };
    let expected = match divided_by(options.split, &options.selection) {
        Some(divided) => format!("no value with {divided}"),
        None if options.exact && cavities != Cavities::Keep => "keep, or no value, with exact=true".to_owned(),
        None => return Ok(()),
    };
    Err(ParamError::BadValue { name: "cavities", value: format!("`{}`", cavities.name()), expected })
}

/// Rejects pockets of a surface that is divided or repeated: they are found for all selected atoms together. The large
/// probe must be larger than the other one.
fn check_pockets(options: &Options) -> Result<(), ParamError> {
    let Some(large) = options.pockets else { return Ok(()) };
    let splits = options.split == Split::Pocket;
    let split = if splits { Split::None } else { options.split };
    if let Some(divided) = divided_by(split, &options.selection) {
        let coloured = options.color.is_some_and(|color| color.scheme.needs_pockets());
        let (name, value, otherwise) = match (splits, coloured) {
            (true, _) => ("split", "pocket", "another value"),
            (false, true) => ("color", "pocket", "another value"),
            (false, false) => ("pockets", "true", "false"),
        };
        return Err(ParamError::bad_value(name, value, format!("{otherwise} with {divided}")));
    }
    let probe = options.params.probe;
    if probe < POCKET_SPACING {
        let expected = format!("at least {POCKET_SPACING} Å with pockets, the spacing of their grid");
        return Err(ParamError::bad_value("probe", &probe.to_string(), expected));
    }
    if large <= probe {
        let expected = format!("a radius above that of the probe, {probe} Å");
        return Err(ParamError::bad_value("pocket_probe", &large.to_string(), expected));
    }
    Ok(())
}

/// Returns the parameter that divides or repeats the surface, with its value.
fn divided_by(split: Split, Selection { context, instances, .. }: &Selection) -> Option<String> {
    match (split, context) {
        (split, _) if split != Split::None => Some(split.parameter()),
        (_, Context::Whole) => Some(format!("context={}", context.name())),
        _ => instances.then(|| "instances=true".to_owned()),
    }
}

/// Rejects the simplification of improved triangles, and of one surface that is divided into parts: vertices on borders
/// are stored once per part, so the check for common edges would not find those of two parts.
fn check_simplify(options: &Options) -> Result<(), ParamError> {
    let Some(Simplify { error, .. }) = options.simplify else { return Ok(()) };
    let expected = match (options.split, options.selection.context) {
        _ if options.quality == TriangleQuality::High => "no value with quality=high, whose triangles it would replace",
        (Split::Pocket, _) => "no value with split=pocket, which divides one surface",
        (split, Context::Whole) if split != Split::None => {
            "no value with split and context=whole, which divide one surface"
        }
        _ => return Ok(()),
    };
    Err(ParamError::bad_value("simplify", &error.to_string(), expected))
}

/// Rejects exact areas of a surface that has none, or that is divided or cut.
fn check_exact(options: &Options) -> Result<(), ParamError> {
    let Options { params, selection, split, exact, interface, .. } = options;
    if !exact {
        let refuse = |interface: &Interface| {
            Err(ParamError::bad_value("interface", &interface.to_string(), "exact=true beside it"))
        };
        return interface.as_ref().map_or(Ok(()), refuse);
    }
    let expected = if params.surface.kernel().is_some() {
        format!("false with surface={}: only vdw, sas and ses have exact areas", params.surface)
    } else if selection.context == Context::Whole || selection.instances || *split != Split::None {
        "false with context=whole, instances, split or model=all, which divide or repeat the surface".to_owned()
    } else {
        return Ok(());
    };
    Err(ParamError::bad_value("exact", "true", expected))
}

/// Maximum length of the value of a parameter, bytes: enough for the names of 1,000 chains. Job records contain values.
pub const MAX_VALUE_BYTES: usize = 4096;

/// Parameters of a picture.
pub const PICTURES: [&str; 7] = ["width", "height", "view", "azimuth", "elevation", "background", "style"];

/// Parameters that set the grid spacing and exclude each other. With `simplify`, `max_triangles` does not set it.
pub const SPACINGS: [&str; 3] = ["resolution", "detail", "max_triangles"];

fn contradiction(name: &'static str, value: &str, other: &str) -> ParamError {
    let all = SPACINGS.join(", ");
    ParamError::bad_value(name, value, format!("no value beside `{other}`: only one of {all} sets the grid spacing"))
}

/// Sets the format of a job, and rejects parameters that it does not support. A picture format adds picture parameters,
/// a format with the nearest atom of each vertex sets `atom_ids`.
fn set_format(options: &mut Options, format: Format) -> Result<(), ParamError> {
    let refuse = |name: &'static str, value: &str, instead: &str, holds: &dyn Fn(Format) -> bool| {
        let formats: Vec<_> = Format::ALL.into_iter().filter(|f| holds(*f)).map(Format::name).collect();
        Err(ParamError::BadValue {
            name,
            value: format!("`{value}`"),
            expected: format!("{instead} for {format}, or one of the formats {}", formats.join(", ")),
        })
    };
    if !options.compress.is_held_by(format) {
        let instead: Vec<_> = Compress::ALL.into_iter().filter(|c| c.is_held_by(format)).map(Compress::name).collect();
        return refuse("compress", options.compress.name(), &instead.join(", "), &|f| options.compress.is_held_by(f));
    }
    if !format.holds_units(options.units) {
        let instead: Vec<_> = Units::ALL.into_iter().filter(|u| format.holds_units(*u)).map(Units::name).collect();
        return refuse("units", options.units.name(), &instead.join(", "), &|f| f.holds_units(options.units));
    }
    if options.selection.instances && !format.holds_instances() {
        return refuse("instances", "true", "false", &|f| f.holds_instances());
    }
    if options.normals == Normals::None && format.is_picture() {
        return refuse("normals", options.normals.name(), Normals::Smooth.name(), &|f| !f.is_picture());
    }
    options.params.atom_ids |= format.needs_atom_ids();
    if let Some(tile) = options.tile.filter(|_| format.is_picture()) {
        return refuse("tile", &tile.path(), "no value", &|f| !f.is_picture());
    }
    if format.is_picture() {
        options.picture.get_or_insert_default();
        return Ok(());
    }
    let Some(picture) = options.picture.take() else { return Ok(()) };
    // The first parameter that differs from its default; a mesh ignores the defaults.
    let (given, plain) = (picture.canonical(), PictureParams::default().canonical());
    let differs = given.split('&').zip(plain.split('&')).find(|(given, plain)| given != plain);
    let Some((name, value)) = differs.and_then(|(given, _)| given.split_once('=')) else { return Ok(()) };
    let name = PICTURES.into_iter().find(|known| *known == name).unwrap_or("format");
    refuse(name, value, "the default", &|f| f.is_picture())
}

/// Returns the error for a name that is not among `known`.
pub fn unknown(name: &str, known: impl IntoIterator<Item = &'static str>) -> ParamError {
    ParamError::Unknown { name: name.chars().take(64).collect(), nearest: nearest(name, known) }
}

/// Checks that all parameters are among `known`.
///
/// # Errors
/// Returns [`ParamError::Unknown`] for the first one that is not.
pub fn check_names(pairs: &[(String, String)], known: &'static [&'static str]) -> Result<(), ParamError> {
    let bad = pairs.iter().find(|(name, _)| !known.contains(&name.as_str()));
    bad.map_or(Ok(()), |(name, _)| Err(unknown(name, known.iter().copied())))
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_request_has_the_format_of_its_parameters() {
        let parsed = |pairs: &[(&str, &str)]| parse(pairs.iter().copied()).unwrap();
        assert_eq!(parsed(&[("color", "chain")]).format, Format::Glb);
        assert_eq!(parsed(&[("background", "transparent")]).format, Format::Glb);
        let picture = parsed(&[("width", "40")]);
        assert_eq!((picture.format, picture.options.picture.map(|picture| picture.width)), (Format::Png, Some(40)));
        let stl = |pairs: &[(&'static str, &'static str)]| {
            parse_with(pairs.iter().copied(), |_| Ok::<_, ParamError>(Format::Stl))
        };
        assert_eq!(stl(&[]).unwrap().format, Format::Stl);
        assert_eq!(stl(&[("format", "vert")]).unwrap().format, Format::Vert);
        assert!(stl(&[("format", "vert")]).unwrap().options.params.atom_ids);
        assert_eq!(stl(&[("width", "40")]).unwrap_err().parameter(), "width");
    }
}
