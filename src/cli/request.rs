//! Turns flags into a request. Names and values are those of an HTTP query and have the same parser.

use std::path::Path;
use std::str::FromStr as _;

use molmesh::formats::Format;
use molmesh::pipeline::params::areas::AreasRequest;
use molmesh::pipeline::params::{self, ParamError, Request};
use molmesh::pipeline::{JobLimits, Options, tileset};
use molmesh::structure::read::DISTANCES_PER_PAIR;

use super::args::{AreasArgs, AtomArgs, CommonLimitArgs, JobArgs, LimitArgs, MeshArgs, RenderArgs, TilesetArgs};
use super::backend::{self, BackendRequest};
use super::error::CliError;
use super::output::is_stdio;

/// Parameters of `mesh`.
pub(super) struct ParsedMesh {
    pub(super) mesh: Request,
    /// Parameters of `--areas`.
    pub(super) areas: Option<AreasRequest>,
    /// Parameters of `--picture`.
    pub(super) picture: Option<Options>,
}

/// Parses the flags of `mesh`. Without `--format`, the format is that of the file extension of the output, or GLB in a
/// folder.
pub(super) fn parse_mesh(args: &MeshArgs, is_folder: bool) -> Result<ParsedMesh, CliError> {
    let format = match &args.format {
        Some(name) => mesh_format(name)?,
        None if is_folder => Format::default(),
        None => format_of(&args.output)?,
    };
    let mesh = parse(&args.file.0, &args.job, format)?;
    let areas = args.areas.as_deref().map(|level| areas_of_mesh(&args.job, level)).transpose()?;
    let picture = if args.picture {
        // As `molmesh render` parses them.
        Some(parse(&args.picture_options.0, &args.job, Format::Png)?.options)
    } else if let Some((name, _)) = args.picture_options.0.first() {
        return Err(CliError::usage(format!("`--{name}` needs `--picture`")));
    } else {
        None
    };
    if mesh.options.tile.is_some() && (areas.is_some() || picture.is_some()) {
        return Err(CliError::usage("`--areas` and `--picture` need a whole structure; leave out `--tile`"));
    }
    Ok(ParsedMesh { mesh, areas, picture })
}

/// Returns the areas of the surface of a mesh, in a table with rows of `level`.
fn areas_of_mesh(args: &JobArgs, level: &str) -> Result<AreasRequest, CliError> {
    let mut exact = Vec::new();
    if !args.surface.0.iter().any(|(name, _)| name == "exact") {
        exact.push(("exact".to_owned(), "true".to_owned()));
    }
    let Request { options, .. } = parse(&exact, args, Format::Glb).map_err(|error| match error {
        CliError::Usage { message, .. } => CliError::usage_with_hint(message, "`--areas` needs exact areas"),
        error => error,
    })?;
    let surface = options.params.surface.name().to_owned();
    let by = [("surface".to_owned(), surface), (params::areas::BY.to_owned(), level.to_owned())];
    Ok(AreasRequest { options, ..params::areas::parse(&by)? })
}

/// Parses the name of a mesh format.
fn mesh_format(name: &str) -> Result<Format, CliError> {
    match Format::from_str(name) {
        Ok(format) if format.is_picture() => {
            let message = format!("{format} is a picture, not a mesh");
            Err(CliError::usage_with_hint(message, "molmesh render writes pictures"))
        }
        Ok(format) => Ok(format),
        Err(_unknown) => {
            let expected = Format::MESHES.map(Format::name).join(", ");
            Err(ParamError::bad_value("format", name, format!("one of {expected}")).into())
        }
    }
}

/// Returns the format of an output by its file extension; GLB on stdout.
fn format_of(output: &Path) -> Result<Format, CliError> {
    let unknown = |why: &str| {
        let message = format!("cannot determine the format of `{}`: {why}", output.display());
        let formats = Format::MESHES.map(Format::name).join(", ");
        CliError::usage_with_hint(message, format!("name the format with --format: {formats}"))
    };
    match output.extension().map(|extension| extension.to_string_lossy()) {
        Some(extension) if extension.parse::<Format>().is_ok() => mesh_format(&extension),
        Some(extension) => Err(unknown(&format!("`{extension}` is not a mesh format"))),
        None if is_stdio(output) => Ok(Format::default()),
        None => Err(unknown("it has no extension")),
    }
}

/// Parses the flags of `tileset`.
pub(super) fn parse_tileset(args: &TilesetArgs) -> Result<Request, CliError> {
    let request = params::parse_tileset(&mut pairs(&[], &args.job))?;
    if args.scratch.is_some() {
        tileset::check_stream(&request.options, args.inputs.len())?;
        if request.strict {
            return Err(CliError::usage("`--check` reads the whole file; leave it out with `--scratch`"));
        }
    } else if args.inputs.len() > 1 {
        let hint = "name a folder for an index of their atoms with --scratch";
        return Err(CliError::usage_with_hint("several files cannot be read into memory", hint));
    }
    Ok(request)
}

/// Parses the flags of `areas`.
pub(super) fn parse_areas(args: &AreasArgs) -> Result<AreasRequest, CliError> {
    let surface = ("surface".to_owned(), args.surface.clone());
    Ok(params::areas::parse(&[&[surface][..], &args.area.0, &args.model.0, &atom_pairs(&args.atoms)].concat())?)
}

/// Parses the flags of `render`.
pub(super) fn parse_render(args: &RenderArgs) -> Result<Request, CliError> {
    parse(&args.picture.0, &args.job, Format::Png)
}

fn parse(own: &[(String, String)], args: &JobArgs, format: Format) -> Result<Request, CliError> {
    params::parse_with(pairs(own, args), |_| Ok(format))
}

/// Returns names and values of the parameters of a job as in a query.
fn pairs(own: &[(String, String)], args: &JobArgs) -> Vec<(String, String)> {
    let JobArgs { check, surface, color, atoms, parts, .. } = args;
    [own, &check.0, &surface.0, &color.0, &atom_pairs(atoms), &parts.0].concat()
}

/// Returns names and values of the atoms as in a query.
fn atom_pairs(atoms: &AtomArgs) -> Vec<(String, String)> {
    // The short flags add to `--select` or to its default.
    let mut select = atoms.select.clone();
    for (flag, class) in [(atoms.ligands, "ligand"), (atoms.waters, "water"), (atoms.hydrogens, "hydrogens")] {
        if flag {
            select = Some(format!("{},{class}", select.as_deref().unwrap_or("polymer")));
        }
    }
    let select = select.map(|select| ("select".to_owned(), select));
    atoms.chains.0.iter().cloned().chain(select).collect()
}

/// Rejects flags of a job that contradict or need each other. `reads_stdin` is true if a structure file or the list of
/// inputs is stdin.
pub(super) fn check(
    args: &JobArgs,
    backend: &BackendRequest<'_>,
    options: &Options,
    reads_stdin: bool,
) -> Result<(), CliError> {
    backend::check(backend)?;
    let map = args.map.as_deref();
    if map.is_some_and(|map| reads_stdin && is_stdio(map)) {
        return Err(CliError::usage("the input and the map cannot both be read from stdin"));
    }
    match (options.color.is_some_and(|color| color.scheme.needs_map()), map) {
        (true, None) => Err(CliError::usage("`--color map` needs `--map FILE`")),
        (false, Some(_)) => Err(CliError::usage("`--map` needs `--color map`")),
        _ => Ok(()),
    }
}

impl From<ParamError> for CliError {
    fn from(error: ParamError) -> Self {
        match &error {
            ParamError::Unknown { .. } | ParamError::Repeated { .. } => Self::Internal(error.to_string()),
            ParamError::BadValue { .. } => Self::usage(error.to_string()),
            ParamError::BadExpression { text, error: bad, .. } => {
                Self::usage(format!("{error}\n{}", with_caret(text, bad.column)))
            }
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

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::super::args::{Args, Command};
    use super::*;
    use molmesh::pipeline::params::Domain;

    fn request(flags: &[&str]) -> Result<Request, CliError> {
        let line = ["molmesh", "mesh", "in.pdb", "-o", "out.glb"].iter().chain(flags);
        let Command::Mesh(args) = Args::try_parse_from(line).unwrap().command else { panic!("not mesh") };
        parse_mesh(&args, false).map(|request| request.mesh)
    }

    fn drawn(flags: &[&str]) -> Result<Request, CliError> {
        let line = ["molmesh", "render", "in.pdb", "-o", "out.png"].iter().chain(flags);
        let Command::Render(args) = Args::try_parse_from(line).unwrap().command else { panic!("not render") };
        parse_render(&args)
    }

    #[test]
    fn short_flags_add_to_the_selection() {
        let selection = |flags: &[&str]| request(flags).unwrap().options.selection;
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
            let example = match parameter.domain {
                Domain::Choice(words) => words.iter().copied().find(|word| !parameter.is_default(word)).unwrap(),
                _ => "2",
            };
            let value = match parameter.name {
                "atom_ids" | "check" | "pockets" => vec![flag.as_str()],
                "tile" => vec![&flag, "1/0/1/0"],
                "pocket_probe" => vec![&flag, "5", "--pockets"],
                "instances" => vec![&flag, "--assembly", "1"],
                "unit" => vec![&flag, "1", "--assembly", "1"],
                "max_triangles" => vec![&flag, "5000"],
                "probe" => vec![&flag, "2", "--surface", "ses"],
                "exact" => vec![&flag, "--surface", "ses"],
                "interface" => vec![&flag, "A,B", "--exact", "--surface", "ses"],
                "select" => vec![&flag, "water"],
                "paper_a" => vec![&flag, "1", "--paper-b", "2"],
                "paper_b" => vec![&flag, "2", "--paper-a", "1"],
                "paper_c" => vec![&flag, "0.5", "--paper-b", "3", "--surface", "inverse-square"],
                "radius_offset" => vec![&flag, "-0.1"],
                "cutoff_tolerance" => vec![&flag, "0.02"],
                "background" => vec![&flag, "#102030"],
                "color" => vec![&flag, "bfactor"],
                "palette" => vec![&flag, example, "--color", "bfactor"],
                "color_blend" => vec![&flag, example, "--color", "chain"],
                "color_offset" => vec![&flag, "2", "--color", "map"],
                "color_range" => vec![&flag, "0,50", "--color", "bfactor"],
                _ => vec![&flag, example],
            };
            let key = |r: &Request| (params::canonical(&r.options), r.format, r.strict);
            let ask = if params::PICTURES.contains(&parameter.name) { drawn } else { request };
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
        assert_eq!(
            params::canonical(&default.options),
            params::canonical(&request(&["--detail", "3"]).unwrap().options)
        );
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
