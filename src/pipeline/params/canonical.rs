//! Canonical text of the parameters of a job.

use std::fmt::Write as _;

use crate::pipeline::{Job, Spacing};
use crate::structure::{Context, Selection, Split};
use crate::surface::{PaperParams, SurfaceParams};

/// Returns all parameters of a job as one line of text, which is equal for equal jobs only. It is part of the content
/// key.
#[must_use]
pub fn canonical(job: &Job) -> String {
    // Destructured, so that the compiler requires every new field here.
    let Job { selection, params, split, cavities, spacing, validation, compress, normals, units, color, map, picture } =
        job;
    let Selection { model, chains, atoms, altloc, assembly, context, instances } = selection;
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
    if let Some(cavities) = cavities {
        text.push_str("&cavities=");
        text.push_str(cavities.name());
    }
    if *instances {
        text.push_str("&instances=true");
    }
    if *context != Context::Selection {
        text.push_str("&context=");
        text.push_str(context.name());
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
