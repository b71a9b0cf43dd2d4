//! Command-line flags. Parameter values stay text here. [`molmesh::pipeline::params`] parses them for the command line
//! and for HTTP, so that both reject a value with the same message.

mod areas;
mod batch;
mod keys;
mod parameters;
mod render;
mod service;
mod shell;
mod tileset;

use std::path::PathBuf;

use clap::{Args as ClapArgs, Parser, Subcommand, ValueEnum};

use molmesh::pipeline::integer::{parse_integer, whole_number};
use molmesh::surface::DeviceChoice;

use super::error::EXIT_CODES;
pub(crate) use areas::AreasArgs;
pub(crate) use batch::BatchArgs;
pub(crate) use keys::{KeyCommand, NewKeyArgs, SignArgs, SigningKeyArgs};
use parameters::{
    AreaArgs, AreaModelArgs, ChainArgs, CheckArgs, ColorArgs, FileArgs, PartArgs, PictureArgs, SurfaceArgs,
};
pub(crate) use render::RenderArgs;
pub(crate) use service::{
    ConfigCommand, ConfigStyle, DoctorArgs, HealthcheckArgs, LogStyle, PrintArgs, ServeArgs, TextOrJson,
};
pub(crate) use shell::{CompletionsArgs, ManArgs};
pub(crate) use tileset::TilesetArgs;

const MESH_EXAMPLES: &str = "\
Examples:
  molmesh mesh 4pti.pdb -o 4pti.glb
  molmesh mesh 1gbt.cif.gz -o - --format ply --resolution 0.3 > 1gbt.ply
  molmesh mesh structures/ -o meshes/ --jobs 4 --skip-existing --summary meshes.jsonl
  curl -sS --fail-with-body http://127.0.0.1:8080/sample.pdb | molmesh mesh - -o 4pti.stl --report json";

/// Watertight molecular-surface meshes from PDB, mmCIF, BinaryCIF, PQR and XYZ files.
#[derive(Debug, Parser)]
#[command(name = "molmesh", version, arg_required_else_help = true)]
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
    /// Mesh the surfaces of structures
    Mesh(Box<MeshArgs>),
    /// Render the surfaces of structures as PNG
    Render(Box<RenderArgs>),
    /// Mesh one structure into the files of a 3D Tiles tileset, for structures that are too large for one file
    Tileset(Box<TilesetArgs>),
    /// Write tables of the exact areas of structures, without a mesh
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
    /// Print the completions of a shell
    Completions(CompletionsArgs),
    /// Print the man page of all commands or of one
    Man(ManArgs),
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
    /// Structure files: PDB, mmCIF, BinaryCIF, PQR or XYZ, optionally compressed with gzip or zstd; `-` is stdin. A
    /// folder stands for the structure files in it and in its subfolders
    #[arg(required_unless_present = "list", value_name = "INPUT")]
    pub(crate) inputs: Vec<PathBuf>,
    /// Mesh file; `-` is stdout. For several inputs: folder, in which each file has the name of its input
    #[arg(short, long)]
    pub(crate) output: PathBuf,
    /// glb, gltf, ply, ply-text, stl, obj, vtp, vert or face [default: by the extension of the output, glb on stdout
    /// and in a folder]
    #[arg(long, value_name = "FORMAT")]
    pub(crate) format: Option<String>,
    #[command(flatten)]
    pub(crate) file: FileArgs,
    /// Write the atoms of the file to a CSV table, one row per index of `--atom-ids`; `-` is stdout
    #[arg(long, value_name = "FILE")]
    pub(crate) atoms: Option<PathBuf>,
    /// Also write the exact areas of each input to a CSV table in the folder, as `molmesh areas` does: atom, residue or
    /// chain [without a value: residue]
    #[arg(long, value_name = "LEVEL", num_args = 0..=1, require_equals = true, default_missing_value = "residue")]
    pub(crate) areas: Option<String>,
    /// Write the areas of all inputs to one CSV table too, with the input in the first column
    #[arg(long, value_name = "FILE", requires = "areas")]
    pub(crate) table: Option<PathBuf>,
    /// Also render each input as a PNG in the folder, as `molmesh render` does
    #[arg(long)]
    pub(crate) picture: bool,
    #[command(flatten)]
    pub(crate) picture_options: PictureArgs,
    #[command(flatten)]
    pub(crate) job: JobArgs,
    #[command(flatten)]
    pub(crate) batch: BatchArgs,
}

// Flags of every job.
#[derive(Debug, ClapArgs)]
pub(crate) struct JobArgs {
    /// Meshing backend
    #[arg(long, value_enum, default_value = "auto")]
    pub(crate) backend: BackendName,
    #[command(flatten)]
    pub(crate) devices: DeviceArgs,
    #[command(flatten)]
    pub(crate) run: RunArgs,
    #[command(flatten)]
    pub(crate) check: CheckArgs,
    #[command(flatten)]
    pub(crate) surface: SurfaceArgs,
    #[command(flatten)]
    pub(crate) color: ColorArgs,
    /// Map for `--color map`: CCP4, MRC or OpenDX, optionally compressed with gzip or zstd
    #[arg(long, value_name = "FILE", help_heading = "Colours")]
    pub(crate) map: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) atoms: AtomArgs,
    #[command(flatten)]
    pub(crate) parts: PartArgs,
    #[command(flatten)]
    pub(crate) limits: LimitArgs,
}

// Threads and messages of a command.
#[derive(Debug, ClapArgs)]
pub(crate) struct RunArgs {
    /// Threads of the computation on the CPU; one per core by default
    #[arg(long, value_name = "N")]
    pub(crate) threads: Option<usize>,
    /// Format of the report
    #[arg(long, value_enum, default_value = "text")]
    pub(crate) report: ReportStyle,
    /// Do not print the summary and the progress bar
    #[arg(short, long)]
    pub(crate) quiet: bool,
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
    #[command(flatten)]
    pub(crate) chains: ChainArgs,
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
