//! Turns flags into a request. Names and values are those of an HTTP query and have the same parser.

use molmesh::formats::Format;
use molmesh::pipeline::params::areas::AreasRequest;
use molmesh::pipeline::params::{self, ParamError, Request};
use molmesh::pipeline::tileset;
use molmesh::pipeline::{Job, JobLimits};
use molmesh::structure::read::DISTANCES_PER_PAIR;

use super::args::{
    AreasArgs, AtomArgs, CommonLimitArgs, JobArgs, LimitArgs, MeshArgs, PictureArgs, RenderArgs, TilesetArgs,
};
use super::error::CliError;

/// Parses the flags of `mesh`.
pub(super) fn parse_mesh(args: &MeshArgs) -> Result<Request, CliError> {
    let own = [
        ("format", &args.format),
        ("tile", &args.tile),
        ("compress", &args.compress),
        ("normals", &args.normals),
        ("units", &args.units),
    ];
    parse(&own, &args.job)
}

/// Parses the flags of `tileset`.
pub(super) fn parse_tileset(args: &TilesetArgs) -> Result<Request, CliError> {
    let compress = Some("meshopt".to_owned());
    let request = parse(&[("compress", &compress)], &args.job)?;
    tileset::check(&request.job).map_err(|error| refusal(&error))?;
    if args.scratch.is_some() {
        tileset::check_stream(&request.job, args.inputs.len()).map_err(|error| refusal(&error))?;
        if request.strict {
            return Err(CliError::usage("`--check` reads the whole file; leave it out with `--scratch`"));
        }
    } else if args.inputs.len() > 1 {
        let hint = "name a folder for an index of their atoms with --scratch".to_owned();
        return Err(CliError::Usage {
            message: "several files cannot be read into memory".to_owned(),
            hint: Some(hint),
        });
    }
    Ok(request)
}

/// Parses the flags of `areas`.
pub(super) fn parse_areas(args: &AreasArgs) -> Result<AreasRequest, CliError> {
    let mut pairs = given(&[
        ("surface", &args.surface),
        ("by", &args.by),
        ("probe", &args.probe),
        ("radius_scale", &args.radius_scale),
        ("radius_offset", &args.radius_offset),
        ("interface", &args.interface),
        ("model", &args.model),
    ]);
    pairs.extend(atom_pairs(&args.atoms));
    let pairs: Vec<_> = pairs.into_iter().map(|(name, value)| (name.to_owned(), value)).collect();
    params::areas::parse(&pairs).map_err(|error| refusal(&error))
}

/// Parses the flags of `render`.
pub(super) fn parse_render(args: &RenderArgs) -> Result<Request, CliError> {
    let PictureArgs { width, height, view, azimuth, elevation, background, style } = &args.picture;
    let own = [
        ("width", width),
        ("height", height),
        ("view", view),
        ("azimuth", azimuth),
        ("elevation", elevation),
        ("background", background),
        ("style", style),
    ];
    let mut request = parse(&own, &args.job)?;
    set_format(&mut request.job, Format::Png)?;
    Ok(request)
}

fn parse(own: &[(&'static str, &Option<String>)], args: &JobArgs) -> Result<Request, CliError> {
    params::parse(pairs(own, args)).map_err(|error| refusal(&error))
}

/// Sets the format of a job. Fails if the format cannot hold what the flags request.
pub(super) fn set_format(job: &mut Job, format: Format) -> Result<(), CliError> {
    params::set_format(job, format).map_err(|error| refusal(&error))
}

fn refusal(error: &ParamError) -> CliError {
    match error {
        ParamError::Unknown { .. } | ParamError::Repeated { .. } => CliError::Internal(error.to_string()),
        ParamError::BadValue { .. } => CliError::Usage { message: error.to_string(), hint: None },
        ParamError::BadExpression { text, error: bad, .. } => {
            CliError::Usage { message: format!("{error}\n{}", with_caret(text, bad.column)), hint: None }
        }
    }
}

/// Returns the text around a column (from 1), and a second line with a caret below that column.
fn with_caret(text: &str, column: usize) -> String {
    const BEFORE: usize = 60;
    let skipped = (column - 1).saturating_sub(BEFORE);
    let part: String = text.chars().skip(skipped).take(BEFORE + 20).collect();
    format!("    {part}\n    {:>1$}", '^', column - skipped)
}

/// Returns the default limits, changed by the flags.
pub(super) fn limits(args: &LimitArgs) -> JobLimits {
    let mut limits = common_limits(&args.common);
    set(&mut limits.read.max_parts, args.max_parts);
    set(&mut limits.map.max_inflated_bytes, args.common.max_input_bytes);
    set(&mut limits.map.max_points, args.max_map_points);
    set(&mut limits.surface.max_grid_points, args.max_grid_points);
    set(&mut limits.surface.max_mesh_bytes, args.max_mesh_bytes);
    limits
}

/// Returns the default limits, changed by the flags for the input.
pub(super) fn common_limits(args: &CommonLimitArgs) -> JobLimits {
    let mut limits = JobLimits::default();
    set(&mut limits.read.max_atoms, args.max_atoms);
    set(&mut limits.read.max_duplicates, args.max_duplicates);
    set(&mut limits.read.max_copies, args.max_copies);
    set(&mut limits.read.max_inflated_bytes, args.max_input_bytes);
    set(&mut limits.surface.max_candidates, args.max_candidates);
    set(&mut limits.read.max_distances, args.max_candidates.map(|pairs| pairs.saturating_mul(DISTANCES_PER_PAIR)));
    limits
}

fn set(limit: &mut u64, flag: Option<u64>) {
    *limit = flag.unwrap_or(*limit);
}

/// Returns the limits of a structure that is read as a stream, changed by the flags. Its atoms are not in memory.
pub(super) fn limits_of_stream(args: &LimitArgs) -> JobLimits {
    let mut limits = limits(args);
    limits.read.max_atoms = args.common.max_atoms.unwrap_or_else(|| u32::MAX.into());
    limits.read.max_inflated_bytes = args.common.max_input_bytes.unwrap_or(1 << 40);
    limits
}

/// Returns names and values as in a query.
fn pairs(own: &[(&'static str, &Option<String>)], args: &JobArgs) -> Vec<(&'static str, String)> {
    let (surface, atoms) = (&args.surface, &args.selection);
    let job_pairs = [
        ("surface", &surface.surface),
        ("probe", &surface.probe),
        ("preset", &surface.preset),
        ("resolution", &surface.resolution),
        ("detail", &surface.detail),
        ("max_triangles", &surface.max_triangles),
        ("isovalue", &surface.isovalue),
        ("smoothness", &surface.smoothness),
        ("radius_scale", &surface.radius_scale),
        ("radius_offset", &surface.radius_offset),
        ("cutoff_tolerance", &surface.cutoff_tolerance),
        ("paper_a", &surface.paper_a),
        ("paper_b", &surface.paper_b),
        ("paper_c", &surface.paper_c),
        ("color", &args.color.color),
        ("palette", &args.color.palette),
        ("color_range", &args.color.color_range),
        ("color_blend", &args.color.color_blend),
        ("color_offset", &args.color.color_offset),
        ("model", &atoms.model),
        ("unit", &atoms.unit),
        ("context", &atoms.context),
        ("split", &atoms.split),
        ("cavities", &surface.cavities),
        ("pocket_probe", &surface.pocket_probe),
        ("simplify", &surface.simplify),
        ("quality", &surface.quality),
        ("validation", &args.validation),
        ("interface", &surface.interface),
    ];
    let mut pairs = given(&[own, &job_pairs].concat());
    if surface.atom_ids {
        pairs.push(("atom_ids", "true".to_owned()));
    }
    if surface.exact {
        pairs.push(("exact", "true".to_owned()));
    }
    if surface.pockets {
        pairs.push(("pockets", "true".to_owned()));
    }
    if atoms.instances {
        pairs.push(("instances", "true".to_owned()));
    }
    if args.check {
        pairs.push(("check", "strict".to_owned()));
    }
    pairs.extend(atom_pairs(&atoms.atoms));
    pairs
}

/// Returns names and values of the atoms as in a query.
fn atom_pairs(atoms: &AtomArgs) -> Vec<(&'static str, String)> {
    // The short flags add to `--select` or to its default.
    let mut select = atoms.select.clone();
    for (flag, class) in [(atoms.ligands, "ligand"), (atoms.waters, "water"), (atoms.hydrogens, "hydrogens")] {
        if flag {
            select = Some(format!("{},{class}", select.as_deref().unwrap_or("polymer")));
        }
    }
    given(&[("chains", &atoms.chains), ("altloc", &atoms.altloc), ("assembly", &atoms.assembly), ("select", &select)])
}

/// Returns the parameters that have a value.
fn given(flags: &[(&'static str, &Option<String>)]) -> Vec<(&'static str, String)> {
    flags.iter().filter_map(|(name, value)| Some((*name, value.as_ref()?.clone()))).collect()
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::super::args::{Args, Command};
    use super::*;

    fn request(flags: &[&str]) -> Result<Request, CliError> {
        let line = ["molmesh", "mesh", "in.pdb", "-o", "out.glb"].iter().chain(flags);
        let Command::Mesh(args) = Args::try_parse_from(line).unwrap().command else { panic!("not mesh") };
        parse_mesh(&args)
    }

    fn drawn(flags: &[&str]) -> Result<Request, CliError> {
        let line = ["molmesh", "render", "in.pdb", "-o", "out.png"].iter().chain(flags);
        let Command::Render(args) = Args::try_parse_from(line).unwrap().command else { panic!("not render") };
        parse_render(&args)
    }

    #[test]
    fn short_flags_add_to_the_selection() {
        let selection = |flags: &[&str]| request(flags).unwrap().job.selection;
        let plain = selection(&[]);
        assert_eq!(plain.atoms.to_string(), "polymer");
        let more = selection(&["--ligands", "--hydrogens"]);
        assert_eq!(more.atoms.to_string(), "polymer or ligand,hydrogens");
        let water = selection(&["--select", "ligand", "--waters"]);
        assert_eq!(water.atoms.to_string(), "ligand or water");
        assert_eq!(selection(&["--select", "chain A", "--waters"]), selection(&["--select", "water or chain A"]));
    }

    #[test]
    fn every_parameter_has_a_flag() {
        for parameter in params::TABLE {
            let flag = format!("--{}", parameter.name.replace('_', "-"));
            let value = match parameter.name {
                "atom_ids" | "check" | "pockets" => vec![flag.as_str()],
                "validation" => vec![&flag, "exact"],
                "quality" => vec![&flag, "high"],
                "cavities" => vec![&flag, "drop"],
                "tile" => vec![&flag, "1/0/1/0"],
                "pocket_probe" => vec![&flag, "5", "--pockets"],
                "compress" => vec![&flag, "quantize"],
                "normals" => vec![&flag, "none"],
                "units" => vec![&flag, "nanometer"],
                "instances" => vec![&flag, "--assembly", "1"],
                "unit" => vec![&flag, "1", "--assembly", "1"],
                "context" => vec![&flag, "whole"],
                "split" => vec![&flag, "chain"],
                "max_triangles" => vec![&flag, "5000"],
                "surface" => vec![&flag, "soft-object"],
                "probe" => vec![&flag, "2", "--surface", "ses"],
                "exact" => vec![&flag, "--surface", "ses"],
                "interface" => vec![&flag, "A,B", "--exact", "--surface", "ses"],
                "preset" => vec![&flag, "blinn"],
                "select" => vec![&flag, "water"],
                "format" => vec![&flag, "ply"],
                "paper_a" => vec![&flag, "1", "--paper-b", "2"],
                "paper_b" => vec![&flag, "2", "--paper-a", "1"],
                "paper_c" => vec![&flag, "0.5", "--paper-b", "3", "--surface", "inverse-square"],
                "radius_offset" => vec![&flag, "-0.1"],
                "cutoff_tolerance" => vec![&flag, "0.02"],
                "view" => vec![&flag, "top"],
                "background" => vec![&flag, "#102030"],
                "style" => vec![&flag, "gouraud"],
                "color" => vec![&flag, "bfactor"],
                "palette" => vec![&flag, "cividis", "--color", "bfactor"],
                "color_blend" => vec![&flag, "smooth", "--color", "chain"],
                "color_offset" => vec![&flag, "2", "--color", "map"],
                "color_range" => vec![&flag, "0,50", "--color", "bfactor"],
                _ => vec![&flag, "2"],
            };
            let key = |r: &Request| (params::canonical(&r.job), r.format, r.strict);
            let pictures = parameter.doc.contains("picture") && parameter.name != "format";
            let ask = if pictures { drawn } else { request };
            let changed = ask(&value).unwrap_or_else(|e| panic!("{value:?}: {e}"));
            assert_ne!(key(&changed), key(&ask(&[]).unwrap()), "{flag} changes nothing");
            // A parameter that changes the mesh changes the picture.
            if !["format", "compress", "normals", "units", "instances", "tile"].contains(&parameter.name) {
                assert_ne!(key(&drawn(&value).unwrap()), key(&drawn(&[]).unwrap()), "{flag} changes no picture");
            }
        }
    }

    #[test]
    fn rejects_bad_values() {
        let both = request(&["--detail", "3", "--resolution", "0.6"]).unwrap_err();
        let message = both.to_string();
        let default = request(&["--detail", "3", "--resolution", "0.5"]).unwrap();
        assert_eq!(params::canonical(&default.job), params::canonical(&request(&["--detail", "3"]).unwrap().job));
        assert!(both.code() == 2 && message.contains("`detail`") && message.contains("`resolution`"), "{message}");
        for flags in [&["--instances"][..], &["--instances", "--assembly", "1", "--context", "whole"]] {
            let message = request(flags).unwrap_err().to_string();
            assert!(message.contains("`instances`") && message.contains("expected false"), "{message}");
        }
        for flags in [["--detail", "7"], ["--max-triangles", "7"], ["--normals", "flat"], ["--units", "inch"]] {
            assert_eq!(request(&flags).unwrap_err().code(), 2, "{flags:?}");
        }
        for flags in [
            ["--width", "0"],
            ["--height", "16385"],
            ["--view", "inside"],
            ["--azimuth", "361"],
            ["--elevation", "nan"],
            ["--background", "plaid"],
            ["--style", "cubist"],
        ] {
            assert_eq!(drawn(&flags).unwrap_err().code(), 2, "{flags:?}");
        }
        for flags in [
            ["--resolution", "0"],
            ["--resolution", "nan"],
            ["--surface", "x"],
            ["--chains", ",,"],
            ["--split", "atom"],
            ["--context", "all"],
        ] {
            assert_eq!(request(&flags).unwrap_err().code(), 2, "{flags:?}");
        }
    }
}
