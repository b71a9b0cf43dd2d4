//! Names that parameters of a fixed set accept.

use molmesh_formats::{Compress, Normals, Units};
use molmesh_picture::{Style, View};
use molmesh_structure::{Context, Split};

use crate::Cavities;
use crate::color::{ColorBlend, Palette};

pub(super) const SPLITS: &[&str] =
    &[Split::None.name(), Split::Chain.name(), Split::Entity.name(), Split::ResidueGroup.name()];
pub(super) const CONTEXTS: &[&str] = &[Context::Selection.name(), Context::Whole.name()];
pub(super) const CAVITIES: &[&str] = &[Cavities::Keep.name(), Cavities::Drop.name(), Cavities::Only.name()];
pub(super) const FORMATS: &[&str] = &["glb", "gltf", "ply", "ply-text", "stl", "obj", "vtp", "vert", "face", "png"];
pub(super) const VIEWS: &[&str] = &view_names(View::ALL);
pub(super) const STYLES: &[&str] = &[Style::Surface.name(), Style::Gouraud.name()];
pub(super) const COMPRESS: &[&str] = &[Compress::None.name(), Compress::Quantize.name(), Compress::Meshopt.name()];
pub(super) const NORMALS: &[&str] = &[Normals::Smooth.name(), Normals::None.name()];
pub(super) const UNITS: &[&str] = &[Units::Angstrom.name(), Units::Nanometer.name(), Units::Meter.name()];
pub(super) const BLENDS: &[&str] = &[ColorBlend::Nearest.name(), ColorBlend::Smooth.name()];
pub(super) const PALETTES: &[&str] =
    &[Palette::Viridis.name(), Palette::Cividis.name(), Palette::BlueWhiteRed.name(), Palette::RedWhiteBlue.name()];

const fn view_names(all: [View; 7]) -> [&'static str; 7] {
    let [a, b, c, d, e, f, g] = all;
    [a.name(), b.name(), c.name(), d.name(), e.name(), f.name(), g.name()]
}
