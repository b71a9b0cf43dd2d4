//! Command-line flags. Parameter values stay text here. [`molmesh::pipeline::params`] parses them for the command line
//! and for HTTP, so that both reject a value with the same message.

mod areas;
mod keys;
mod render;
mod service;
mod tileset;

use std::path::PathBuf;

use clap::{Args as ClapArgs, Parser, Subcommand, ValueEnum};

use molmesh::pipeline::integer::{parse_integer, whole_number};
use molmesh::surface::DeviceChoice;

use super::error::EXIT_CODES;
pub(crate) use areas::AreasArgs;
pub(crate) use keys::{KeyCommand, NewKeyArgs, SignArgs, SigningKeyArgs};
pub(crate) use render::{PictureArgs, RenderArgs};
pub(crate) use service::{
    ConfigCommand, ConfigStyle, DoctorArgs, HealthcheckArgs, LogStyle, PrintArgs, ServeArgs, TextOrJson,
};
pub(crate) use tileset::TilesetArgs;

const MESH_EXAMPLES: &str = "\
Examples:
  molmesh mesh 4pti.pdb -o 4pti.glb
  molmesh mesh 1gbt.cif.gz -o - --format ply --resolution 0.3 > 1gbt.ply
  curl -sS --fail-with-body http://127.0.0.1:8080/sample.pdb | molmesh mesh - -o 4pti.stl --report json";

/// Watertight molecular-surface meshes from PDB, mmCIF, BinaryCIF, PQR and XYZ files.
#[derive(Debug, Parser)]
#[command(name = "molmesh", version, arg_required_else_help = true, disable_help_subcommand = true)]
#[command(max_term_width = 100, after_help = EXIT_CODES)]
pub(crate) struct Args {
    #[command(subcommand)]
    pub(crate) command: Command,
}

/// Commands.
#[derive(Debug, Subcommand)]
// `defer` builds the flags of the chosen command only; building all takes longer than reading a small structure.
// A docstring on a struct of flags would replace the description of its command, so those structs have plain comments.
#[command(defer = true)]
pub(crate) enum Command {
    /// Mesh the surface of one structure
    Mesh(Box<MeshArgs>),
    /// Render the surface of one structure as a PNG
    Render(Box<RenderArgs>),
    /// Mesh one structure into the files of a 3D Tiles tileset, for structures that are too large for one file
    Tileset(Box<TilesetArgs>),
    /// Write a table of the exact areas of one structure, without a mesh
    Areas(Box<AreasArgs>),
    /// Serve meshes over HTTP
    Serve(Box<ServeArgs>),
    /// List devices, show which are used, and check that a service would start and be ready
    Doctor(Box<DoctorArgs>),
    /// Print the configuration of the service or its schema
    #[command(subcommand)]
    Config(ConfigCommand),
    /// Check that a running service is ready; exit code 0 if it is
    Healthcheck(HealthcheckArgs),
    /// Create keys for the service
    #[command(subcommand)]
    Key(KeyCommand),
    /// Sign a URL of the service, which then works without a key until it expires
    Sign(SignArgs),
    /// Print the version
    Version,
}

/// Values of `--backend`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum BackendName {
    /// A GPU for jobs that are large enough; the CPU for others, and if no GPU can be used
    Auto,
    /// All cores, with the widest vector instructions of the processor
    Cpu,
    /// Sequential brute force, for comparison
    Reference,
    /// The GPU, without a fallback
    Gpu,
}

/// Values of `--report`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum ReportStyle {
    /// A summary on stderr
    Text,
    /// JSON on stdout (on stderr if the file is written to stdout)
    Json,
}

// `molmesh mesh`.
#[derive(Debug, ClapArgs)]
#[command(after_help = format!("{MESH_EXAMPLES}\n\n{EXIT_CODES}"), allow_negative_numbers = true)]
pub(crate) struct MeshArgs {
    /// Structure file: PDB, mmCIF, BinaryCIF, PQR or XYZ, optionally compressed with gzip or zstd; `-` is stdin
    pub(crate) input: PathBuf,
    /// Mesh file; `-` is stdout
    #[arg(short, long)]
    pub(crate) output: PathBuf,
    /// glb, gltf, ply, ply-text, stl, obj, vtp, vert or face [default: by the extension of the output, glb on stdout]
    #[arg(long, value_name = "FORMAT")]
    pub(crate) format: Option<String>,
    /// Tile of the tileset of the structure to mesh, instead of the whole structure
    #[arg(long, value_name = "LEVEL/X/Y/Z")]
    pub(crate) tile: Option<String>,
    /// Storage of glb and gltf: none, quantize (12 bytes per vertex instead of 24: 16-bit positions, 8-bit normals), or
    /// meshopt (glb only: quantized and compressed to about a fifth) [default: none]
    #[arg(long, value_name = "METHOD")]
    pub(crate) compress: Option<String>,
    /// Vertex normals: smooth, or none (smaller files, flat shading) [default: smooth]
    #[arg(long, value_name = "NORMALS")]
    pub(crate) normals: Option<String>,
    /// Unit of lengths in the mesh file: angstrom, nanometer, or meter (glb and gltf only) [default: angstrom]
    #[arg(long, value_name = "UNIT")]
    pub(crate) units: Option<String>,
    /// Write the atoms of the file to a CSV table, one row per index of `--atom-ids`; `-` is stdout
    #[arg(long, value_name = "FILE")]
    pub(crate) atoms: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) job: JobArgs,
}

// Flags of every job.
#[derive(Debug, ClapArgs)]
pub(crate) struct JobArgs {
    /// Meshing backend
    #[arg(long, value_enum, default_value = "auto")]
    pub(crate) backend: BackendName,
    #[command(flatten)]
    pub(crate) devices: DeviceArgs,
    /// Threads of the computation on the CPU; one per core by default
    #[arg(long, value_name = "N")]
    pub(crate) threads: Option<usize>,
    /// Format of the report
    #[arg(long, value_enum, default_value = "text")]
    pub(crate) report: ReportStyle,
    /// Do not print the summary and the progress bar
    #[arg(short, long)]
    pub(crate) quiet: bool,
    /// Reject a file in which the strict validator finds errors, and report its other findings
    #[arg(long)]
    pub(crate) check: bool,
    /// Check that the mesh is watertight: checksum (of its edges, fast) or exact (edge by edge) [default: checksum]
    #[arg(long, value_name = "METHOD")]
    pub(crate) validation: Option<String>,
    #[command(flatten)]
    pub(crate) surface: SurfaceArgs,
    #[command(flatten)]
    pub(crate) color: ColorArgs,
    #[command(flatten)]
    pub(crate) selection: SelectionArgs,
    #[command(flatten)]
    pub(crate) limits: LimitArgs,
}

// Devices.
#[derive(Debug, ClapArgs)]
pub(crate) struct DeviceArgs {
    /// Devices to use: auto (the best kind of GPU), all, cpu, or a list such as 0,2 or software; `molmesh doctor` lists
    /// the numbers
    #[arg(long, value_name = "DEVICES", default_value = "auto")]
    #[arg(env = "MOLMESH__DEVICES__USE", hide_env_values = true)]
    pub(crate) devices: DeviceChoice,
}

// Surface parameters.
#[derive(Debug, ClapArgs)]
#[command(next_help_heading = "Surface")]
pub(crate) struct SurfaceArgs {
    /// Surface: gaussian, soft-object or inverse-square (isosurfaces of densities), vdw (van der Waals), sas
    /// (solvent-accessible) or ses (solvent-excluded) [default: gaussian]
    #[arg(long, value_name = "SURFACE")]
    pub(crate) surface: Option<String>,
    /// Radius of the probe in Å, for `--surface sas` and `ses` [default: 1.4]
    #[arg(long, value_name = "Å")]
    pub(crate) probe: Option<String>,
    /// Values of parameters that are not given: default, ses-like, vdw-like, molstar, blinn or quicksurf. `ses-like`
    /// approximates the solvent-excluded surface: its area is off by -6.2 to +11.9 % and its volume by -0.3 to +6.8 %
    /// on 18 proteins, more for small structures (volume +9 to +15 % for three short DNA helices)
    #[arg(long, value_name = "PRESET")]
    pub(crate) preset: Option<String>,
    /// Grid spacing in Å [default: 0.5]
    #[arg(long, value_name = "Å")]
    pub(crate) resolution: Option<String>,
    /// Level of detail instead of a grid spacing: 0 (2 Å) to 6 (0.25 Å), coarser for more than 10,000 atoms
    #[arg(long, value_name = "LEVEL")]
    pub(crate) detail: Option<String>,
    /// Use the finest grid spacing, down to 0.25 Å, whose mesh has at most N triangles
    #[arg(long, value_name = "N")]
    pub(crate) max_triangles: Option<String>,
    /// Density at the surface [default: 1, the density of an isolated atom at its radius]
    #[arg(long, value_name = "LEVEL")]
    pub(crate) isovalue: Option<String>,
    /// Steepness of the gaussian; a higher value gives a less smooth surface [default: 1.25]
    #[arg(long, value_name = "A")]
    pub(crate) smoothness: Option<String>,
    /// Factor of all radii [default: 1]
    #[arg(long, value_name = "FACTOR")]
    pub(crate) radius_scale: Option<String>,
    /// Length added to all scaled radii, in Å [default: 0]
    #[arg(long, value_name = "Å")]
    pub(crate) radius_offset: Option<String>,
    /// Value at which the gaussian is cut off, relative to its value at the radius [default: 0.01]
    #[arg(long, value_name = "FRACTION")]
    pub(crate) cutoff_tolerance: Option<String>,
    /// Raw parameter a of the 2010 paper (gaussian: decay in Å⁻²; soft object: height)
    #[arg(long, value_name = "A")]
    pub(crate) paper_a: Option<String>,
    /// Raw parameter b of the 2010 paper (gaussian: height; otherwise a radius in Å)
    #[arg(long, value_name = "B")]
    pub(crate) paper_b: Option<String>,
    /// Raw parameter c of the 2010 paper (inverse square: strength in Å²)
    #[arg(long, value_name = "C")]
    pub(crate) paper_c: Option<String>,
    /// Find cavities, closed regions that hold a probe: keep (list them in the report), drop (also remove their walls
    /// from the mesh) or only (keep nothing else)
    #[arg(long, value_name = "MODE")]
    pub(crate) cavities: Option<String>,
    /// Find pockets, regions outside the molecule that the probe can enter and a large probe cannot, and list them in
    /// the report
    #[arg(long)]
    pub(crate) pockets: bool,
    /// Radius of the large probe of the search for pockets, in Å [default: 4]
    #[arg(long, value_name = "Å")]
    pub(crate) pocket_probe: Option<String>,
    /// Simplify the mesh: fewer, larger triangles, with this error in Å
    #[arg(long, value_name = "Å")]
    pub(crate) simplify: Option<String>,
    /// Quality of the triangles: standard, or high (few small angles; takes 10 to 50 times as long as meshing)
    #[arg(long, value_name = "NAME")]
    pub(crate) quality: Option<String>,
    /// Store the nearest atom of every vertex (`_ATOM` in glTF, `atom` in PLY)
    #[arg(long)]
    pub(crate) atom_ids: bool,
    /// Add exact areas and volume to the report, in total and by chain; `--surface vdw`, `sas` and `ses` only
    #[arg(long)]
    pub(crate) exact: bool,
    /// Add the surface area buried between two sets of chains, half the sum over both sides, with `--exact`; a slash
    /// joins chains of a side: H/L,A
    #[arg(long, value_name = "A,B")]
    pub(crate) interface: Option<String>,
}

// Colours.
#[derive(Debug, ClapArgs)]
#[command(next_help_heading = "Colours")]
pub(crate) struct ColorArgs {
    /// Colours of vertices: uniform:#RRGGBB, element, chain, entity, residue, secondary-structure, bfactor, occupancy,
    /// plddt, hydrophobicity (Kyte-Doolittle), hydrophobicity:wimley-white, charge, curvature, radial, depth,
    /// pocket, map or none [default: none]
    #[arg(long, value_name = "SCHEME")]
    pub(crate) color: Option<String>,
    /// Palette of a numeric scheme: viridis, cividis, blue-white-red or red-white-blue [default: depends on the scheme]
    #[arg(long, value_name = "PALETTE")]
    pub(crate) palette: Option<String>,
    /// Values at the ends of the palette [default: depends on the scheme]
    #[arg(long, value_name = "MIN,MAX", allow_hyphen_values = true)]
    pub(crate) color_range: Option<String>,
    /// Transition between colours: nearest (sharp borders) or smooth (averaged over about 1 Å) [default: nearest]
    #[arg(long, value_name = "BLEND")]
    pub(crate) color_blend: Option<String>,
    /// Map for `--color map`: CCP4, MRC or OpenDX, optionally compressed with gzip or zstd
    #[arg(long, value_name = "FILE")]
    pub(crate) map: Option<PathBuf>,
    /// Distance from the surface at which the map is sampled, in Å [default: 1.4]
    #[arg(long, value_name = "Å")]
    pub(crate) color_offset: Option<String>,
}

// Atoms.
#[derive(Debug, ClapArgs)]
#[command(next_help_heading = "Atoms")]
pub(crate) struct AtomArgs {
    /// Atoms to use: an expression such as `polymer,ligand` or `protein and within 5 of (resn HEM)`, made of kinds
    /// (polymer, protein, nucleic, ligand, cofactor, glycan, ion, water, hydrogen, all), chain, resi, resn, name, elem,
    /// within, byres, and, or, not [default: polymer]
    #[arg(long, value_name = "ATOMS")]
    pub(crate) select: Option<String>,
    /// Include ligands, cofactors and glycans
    #[arg(long)]
    pub(crate) ligands: bool,
    /// Include waters
    #[arg(long)]
    pub(crate) waters: bool,
    /// Include hydrogens of the selected residues
    #[arg(long)]
    pub(crate) hydrogens: bool,
    /// Comma-separated chains, by author name [default: all]
    #[arg(long, value_name = "A,B")]
    pub(crate) chains: Option<String>,
    /// Alternative location [default: the one with the highest occupancy in each residue]
    #[arg(long, value_name = "X")]
    pub(crate) altloc: Option<String>,
    /// Id of the biological assembly to build [default: asymmetric-unit, the atoms as they are in the file]
    #[arg(long, value_name = "ID")]
    pub(crate) assembly: Option<String>,
}

// Atoms of a mesh, and its division.
#[derive(Debug, ClapArgs)]
#[command(next_help_heading = "Atoms")]
pub(crate) struct SelectionArgs {
    #[command(flatten)]
    pub(crate) atoms: AtomArgs,
    /// Model number, or all: one part of the mesh per model [default: the first]
    #[arg(long, value_name = "N")]
    pub(crate) model: Option<String>,
    /// Mesh each distinct set of chains of the assembly once and repeat the mesh (glb and gltf only); surfaces of
    /// neighbouring instances are not joined
    #[arg(long)]
    pub(crate) instances: bool,
    /// Mesh one unit of the assembly, where it is in the file; NUMBER counts the parts of a report with --instances
    #[arg(long, value_name = "NUMBER")]
    pub(crate) unit: Option<String>,
    /// Atoms whose surface is made: selection (the selected atoms alone), or whole (all polymer chains and the selected
    /// atoms; only the triangles nearest to selected atoms are kept, and the mesh is open) [default: selection]
    #[arg(long, value_name = "CONTEXT")]
    pub(crate) context: Option<String>,
    /// Divide the mesh into parts: chain (per copy in an assembly), entity, residue-group (polymer, ligand, glycan,
    /// ion, water), pocket or none [default: none]
    #[arg(long, value_name = "RULE")]
    pub(crate) split: Option<String>,
}

// Limits of all commands that read a structure.
#[expect(clippy::struct_field_names, reason = "the fields are named like their flags")]
#[derive(Debug, ClapArgs)]
#[command(next_help_heading = "Limits")]
pub(crate) struct CommonLimitArgs {
    /// Atoms in all models of the file, and in the assembly [default: 20000000]
    #[arg(long, value_name = "N", value_parser = count)]
    pub(crate) max_atoms: Option<u64>,
    /// Atoms of one model, or of the assembly, at exactly the same position [default: 1000]
    #[arg(long, value_name = "N", value_parser = count)]
    pub(crate) max_duplicates: Option<u64>,
    /// Copies of chains in the assembly [default: 10000]
    #[arg(long, value_name = "N", value_parser = count)]
    pub(crate) max_copies: Option<u64>,
    /// Bytes of each input file after decompression, such as 64MiB [default: 4GiB]
    #[arg(long, value_name = "BYTES", value_parser = size)]
    pub(crate) max_input_bytes: Option<u64>,
    /// Pairs of an atom and a brick that its support reaches [default: 1073741824]
    #[arg(long, value_name = "N", value_parser = count)]
    pub(crate) max_candidates: Option<u64>,
}

// Limits.
#[derive(Debug, ClapArgs)]
#[command(next_help_heading = "Limits")]
pub(crate) struct LimitArgs {
    #[command(flatten)]
    pub(crate) common: CommonLimitArgs,
    /// Parts of a mesh with `--split` or `--model all` [default: 1000]
    #[arg(long, value_name = "N", value_parser = count)]
    pub(crate) max_parts: Option<u64>,
    /// Grid points of the map [default: 67108864]
    #[arg(long, value_name = "N", value_parser = count)]
    pub(crate) max_map_points: Option<u64>,
    /// Grid points in occupied bricks [default: 4294967296]
    #[arg(long, value_name = "N", value_parser = count)]
    pub(crate) max_grid_points: Option<u64>,
    /// Bytes of vertices and triangles, such as 64MiB [default: 8GiB]
    #[arg(long, value_name = "BYTES", value_parser = size)]
    pub(crate) max_mesh_bytes: Option<u64>,
}

fn count(text: &str) -> Result<u64, String> {
    parse_integer(text, false).ok_or_else(|| format!("expected {}", whole_number(false)))
}

fn size(text: &str) -> Result<u64, String> {
    parse_integer(text, true).ok_or_else(|| format!("expected {}", whole_number(true)))
}
