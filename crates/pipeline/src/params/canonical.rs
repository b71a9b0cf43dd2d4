//! Canonical text of the parameters of a job.

use molmesh_structure::{Context, Selection, Split};
use molmesh_surface::{PaperParams, SurfaceParams, TriangleQuality};

use crate::{Coloring, Options, PictureParams, Spacing};

/// Returns all parameters of a job as one line of text, which is equal for equal jobs only. It is part of the content
/// key. A new parameter is written only if it differs from its default, so that the keys of other jobs stay the same.
#[must_use]
pub fn canonical(options: &Options) -> String {
    // Destructured, so that the compiler requires every new field here.
    let Options {
        selection,
        params,
        split,
        cavities,
        pockets,
        simplify,
        quality,
        tile,
        spacing,
        validation,
        compress,
        normals,
        units,
        color,
        map,
        picture,
        exact,
        interface,
    } = options;
    let Selection { model, chains, atoms, altloc, assembly, context, instances, unit } = selection;
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
        paper: paper_params,
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
    let paper = |paper: &PaperParams| match paper {
        PaperParams::Gaussian { a, b } | PaperParams::SoftObject { a, b } => format!("paper_a={a}&paper_b={b}"),
        PaperParams::InverseSquare { c, b } => format!("paper_c={c}&paper_b={b}"),
    };
    let optional = [
        (*split != Split::None).then(|| format!("split={}", split.name())),
        cavities.map(|cavities| format!("cavities={}", cavities.name())),
        pockets.map(|probe| format!("pockets={probe}")),
        simplify.map(|wanted| format!("simplify={}", wanted.error)),
        simplify.and_then(|wanted| wanted.max_triangles).map(|limit| format!("max_triangles={limit}")),
        (*quality != TriangleQuality::Standard).then(|| format!("quality={}", quality.name())),
        tile.map(|tile| format!("tile={}", tile.path())),
        exact.then(|| "exact=true".to_owned()),
        // Quotes the names, which may contain `&`.
        interface.as_ref().map(|interface| format!("interface={:?}", interface.sides)),
        instances.then(|| "instances=true".to_owned()),
        unit.map(|unit| format!("unit={unit}")),
        (*context != Context::Selection).then(|| format!("context={}", context.name())),
        paper_params.as_ref().map(paper),
        color.as_ref().map(Coloring::canonical),
        map.as_ref().map(|map| format!("map={}", map.digest())),
        picture.as_ref().map(PictureParams::canonical),
    ];
    for parameters in optional.into_iter().flatten() {
        text.push('&');
        text.push_str(&parameters);
    }
    text
}
