//! Values of the parameters of one request.

use std::num::NonZeroU32;
use std::str::FromStr;

use molmesh_formats::tileset::TileAddress;
use molmesh_formats::{Compress, Format, Normals, Units};
use molmesh_picture::{Background, MAX_SIDE, PictureParams, Style, View};
use molmesh_structure::{Context, ModelChoice, Split};
use molmesh_surface::{DEFAULT_POCKET_PROBE, Preset, SurfaceKind, SurfaceOptions, TriangleQuality, Validation};

use super::table::flag;
use super::{Domain, ParamError, Parameter, unknown};
use crate::color::{ColorBlend, Coloring, Palette, Scheme};
use crate::spacing::{DETAILS, MAX_TRIANGLE_LIMIT, MIN_TRIANGLE_LIMIT};
use crate::{Cavities, Options, Simplify, Spacing};

/// Default of `color_offset`: the radius of a water molecule, Å.
const DEFAULT_COLOR_OFFSET: f64 = 1.4;

/// Value of `model` for all models.
const ALL_MODELS: &str = "all";

/// Values of the parameters that are parsed so far.
#[derive(Default)]
pub(super) struct ParsedValues {
    pub(super) surface: SurfaceOptions,
    scheme: Option<Scheme>,
    palette: Option<Palette>,
    color_range: Option<[f64; 2]>,
    color_blend: ColorBlend,
    color_offset: Option<f64>,
    pockets: bool,
    pocket_probe: Option<f64>,
    max_triangles: Option<u64>,
    /// First parameter that does not apply to tiles, with its value.
    pub(super) unfit_for_tiles: Option<(&'static str, String)>,
    pub(super) options: Options,
    pub(super) format: Option<Format>,
    pub(super) strict: bool,
}

impl ParsedValues {
    /// Combines `color`, `palette`, `color_range`, `color_blend` and `color_offset`.
    pub(super) fn coloring(&self) -> Result<Option<Coloring>, ParamError> {
        let Self { scheme, palette, color_range: range, color_blend: blend, color_offset, .. } = *self;
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
        if let Some(offset) = color_offset.filter(|_| !scheme.is_some_and(Scheme::needs_map)) {
            let expected = "no value without color=map".to_owned();
            return Err(ParamError::BadValue { name: "color_offset", value: format!("`{offset}`"), expected });
        }
        let offset = color_offset.unwrap_or(DEFAULT_COLOR_OFFSET);
        Ok(scheme.map(|scheme| Coloring { scheme, palette, range, blend, offset }))
    }

    /// Returns the radius of the large probe, Å, if the job lists pockets, colours them or makes parts of them.
    pub(super) fn pockets(&self) -> Result<Option<f64>, ParamError> {
        let needed = self.scheme.is_some_and(Scheme::needs_pockets) || self.options.split == Split::Pocket;
        if self.pockets || needed {
            return Ok(Some(self.pocket_probe.unwrap_or(DEFAULT_POCKET_PROBE)));
        }
        let unused = |probe: f64| {
            ParamError::bad_value(
                "pocket_probe",
                &probe.to_string(),
                "no value without pockets=true, color=pocket or split=pocket",
            )
        };
        self.pocket_probe.map_or(Ok(None), |probe| Err(unused(probe)))
    }

    /// Applies `max_triangles`: to the simplification if there is one, otherwise to the choice of the grid spacing.
    /// Removes it from the parameters that set the spacing if it does not.
    pub(super) fn limit_triangles(&mut self, spacings: &mut Vec<(&'static str, String)>) {
        let Some(limit) = self.max_triangles else { return };
        let options = &mut self.options;
        if let Some(wanted) = &mut options.simplify {
            wanted.max_triangles = Some(limit);
            spacings.retain(|(name, _)| *name != "max_triangles");
        } else {
            options.spacing = Spacing::MaxTriangles(limit);
        }
    }

    /// Divides the mesh by model if all models are meshed.
    pub(super) fn divide_models(&mut self) -> Result<(), ParamError> {
        if self.options.selection.model != ModelChoice::All {
            return Ok(());
        }
        let split = &mut self.options.split;
        let other = match (*split, &self.options.selection.assembly, self.options.selection.context) {
            (Split::None, None, Context::Selection) => None,
            (Split::None, None, context) => Some(("context", context.name().to_owned(), Context::Selection.name())),
            (Split::None, Some(id), _) => Some(("assembly", id.clone(), "asymmetric-unit")),
            (rule, ..) => Some(("split", rule.name().to_owned(), Split::None.name())),
        };
        if let Some((name, value, instead)) = other {
            let expected = format!("{instead} with model={ALL_MODELS}, which makes one part of each model");
            return Err(ParamError::bad_value(name, &value, expected));
        }
        *split = Split::Model;
        Ok(())
    }

    /// Returns the picture parameters of the job. The first call creates them.
    fn picture(&mut self) -> &mut PictureParams {
        self.options.picture.get_or_insert_default()
    }

    /// Parses the value of one parameter.
    pub(super) fn set(&mut self, parameter: &Parameter, text: &str) -> Result<(), ParamError> {
        let bad = || parameter.invalid(text);
        // The core checks ranges, because they may depend on the surface.
        let number = || text.trim().parse::<f64>().ok().filter(|v| v.is_finite()).map(Some).ok_or_else(bad);
        let side = || whole(text).and_then(|n| u32::try_from(n).ok()).filter(|n| (1..=MAX_SIDE).contains(n));
        let bounded = || {
            let Domain::Number { min, max, .. } = parameter.domain else { return None };
            text.trim().parse::<f64>().ok().filter(|value| (min..=max).contains(value)).map(|value| value + 0.0)
        };
        let options = &mut self.options;
        match parameter.name {
            "preset" => self.surface.preset = Some(Preset::named(text).ok_or_else(bad)?),
            "surface" => self.surface.surface = Some(SurfaceKind::named(text).ok_or_else(bad)?),
            "probe" => self.surface.probe = number()?,
            "resolution" => self.surface.resolution = number()?,
            "detail" => options.spacing = Spacing::Detail(level(text).ok_or_else(bad)?),
            "max_triangles" => {
                let allowed = u64::from(MIN_TRIANGLE_LIMIT)..=u64::from(MAX_TRIANGLE_LIMIT);
                self.max_triangles = Some(whole(text).filter(|n| allowed.contains(n)).ok_or_else(bad)?);
            }
            "isovalue" => self.surface.isovalue = number()?,
            "smoothness" => self.surface.smoothness = number()?,
            "radius_scale" => self.surface.radius_scale = number()?,
            "radius_offset" => self.surface.radius_offset = number()?,
            "simplify" => options.simplify = Some(Simplify { error: bounded().ok_or_else(bad)?, max_triangles: None }),
            "tile" => options.tile = Some(TileAddress::parse(text).ok_or_else(bad)?),
            "cutoff_tolerance" => self.surface.cutoff_tolerance = number()?,
            "paper_a" => self.surface.paper_a = number()?,
            "paper_b" => self.surface.paper_b = number()?,
            "paper_c" => self.surface.paper_c = number()?,
            "atom_ids" => self.surface.atom_ids = flag(text).ok_or_else(bad)?,
            "exact" => options.exact = flag(text).ok_or_else(bad)?,
            "interface" => options.interface = Some(text.parse().ok().ok_or_else(bad)?),
            "color" if text == "none" => self.scheme = None,
            "color" => self.scheme = Some(text.parse().ok().ok_or_else(bad)?),
            "palette" => self.palette = Some(Palette::named(text).ok_or_else(bad)?),
            "color_blend" => self.color_blend = ColorBlend::named(text).ok_or_else(bad)?,
            "color_offset" => self.color_offset = Some(bounded().ok_or_else(bad)?),
            "color_range" => self.color_range = Some(range(text).ok_or_else(bad)?),
            "model" => {
                options.selection.model = match text.trim() {
                    ALL_MODELS => ModelChoice::All,
                    number => ModelChoice::Number(number.parse().ok().ok_or_else(bad)?),
                };
            }
            "chains" => {
                options.selection.chains = Some(list(text).ok_or_else(bad)?.into_iter().map(str::to_owned).collect());
            }
            "select" => {
                let bad = |error| ParamError::BadExpression { name: "select", text: text.to_owned(), error };
                options.selection.atoms = text.parse().map_err(bad)?;
            }
            "assembly" => {
                let id = Some(text.trim()).filter(|id| !id.is_empty() && !id.chars().any(char::is_control));
                options.selection.assembly =
                    id.map(|id| (id != parameter.default).then(|| id.to_owned())).ok_or_else(bad)?;
            }
            "instances" => options.selection.instances = flag(text).ok_or_else(bad)?,
            "unit" => options.selection.unit = Some(number_of_unit(parameter, text).ok_or_else(bad)?),
            "context" => options.selection.context = Context::named(text).ok_or_else(bad)?,
            "split" => options.split = Split::named(text).ok_or_else(bad)?,
            "cavities" => options.cavities = Some(Cavities::named(text).ok_or_else(bad)?),
            "pockets" => self.pockets = flag(text).ok_or_else(bad)?,
            "pocket_probe" => self.pocket_probe = Some(bounded().ok_or_else(bad)?),
            "altloc" => options.selection.altloc = Some(one_char(text).ok_or_else(bad)?),
            "quality" => options.quality = TriangleQuality::named(text).ok_or_else(bad)?,
            "validation" => options.validation = Validation::named(text).ok_or_else(bad)?,
            "check" => self.strict = (text == "strict").then_some(true).ok_or_else(bad)?,
            "format" => self.format = Some(Format::from_str(text).ok().ok_or_else(bad)?),
            "compress" => options.compress = Compress::named(text).ok_or_else(bad)?,
            "normals" => options.normals = Normals::named(text).ok_or_else(bad)?,
            "units" => options.units = Units::named(text).ok_or_else(bad)?,
            "width" => self.picture().width = side().ok_or_else(bad)?,
            "height" => self.picture().height = side().ok_or_else(bad)?,
            "view" => self.picture().view = View::named(text).ok_or_else(bad)?,
            "azimuth" => self.picture().azimuth = bounded().ok_or_else(bad)?,
            "elevation" => self.picture().elevation = bounded().ok_or_else(bad)?,
            "background" => self.picture().background = text.parse::<Background>().ok().ok_or_else(bad)?,
            "style" => self.picture().style = Style::named(text).ok_or_else(bad)?,
            name => return Err(unknown(name, [])),
        }
        Ok(())
    }
}

fn whole(text: &str) -> Option<u64> {
    text.trim().parse().ok()
}

/// Parses a level of detail.
fn level(text: &str) -> Option<u8> {
    whole(text).filter(|level| *level < DETAILS.len() as u64).and_then(|level| u8::try_from(level).ok())
}

/// Parses the number of a unit.
fn number_of_unit(parameter: &Parameter, text: &str) -> Option<NonZeroU32> {
    let Domain::Integer { max, .. } = parameter.domain else { return None };
    NonZeroU32::new(u32::try_from(whole(text)?).ok()?).filter(|number| i64::from(number.get()) <= max)
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
