//! The flags. Values of parameters stay text here: [`molmesh::pipeline::params`] reads them, for the command line
//! and HTTP alike, so that both refuse them with the same words.

#[cfg(feature = "server")]
mod keys;
mod render;
#[cfg(feature = "server")]
mod service;

use std::path::PathBuf;

use clap::{Args as ClapArgs, Parser, Subcommand, ValueEnum};

use molmesh::surface::DeviceChoice;

use super::error::EXIT_CODES;
#[cfg(feature = "server")]
pub(crate) use keys::{KeyCommand, NewKeyArgs, SignArgs, SigningKeyArgs};
pub(crate) use render::{PictureArgs, RenderArgs};
#[cfg(feature = "server")]
pub(crate) use service::{
    ConfigCommand, ConfigStyle, DoctorArgs, DoctorStyle, HealthcheckArgs, LogStyle, PrintArgs, ServeArgs,
};

const MESH_EXAMPLES: &str = "\
Examples:
  molmesh mesh 4pti.pdb -o 4pti.glb
  molmesh mesh 1gbt.cif.gz -o - --format ply --resolution 0.3 > 1gbt.ply
  curl -s http://127.0.0.1:8080/sample.pdb | molmesh mesh - -o 4pti.stl --report json";

/// Molecules in, proven surface meshes out.
#[derive(Debug, Parser)]
#[command(name = "molmesh", version, arg_required_else_help = true, disable_help_subcommand = true)]
#[command(max_term_width = 100, after_help = EXIT_CODES)]
pub(crate) struct Args {
    #[command(subcommand)]
    pub(crate) command: Command,
}

/// What to do.
#[derive(Debug, Subcommand)]
// The flags of the command at hand are described, not those of the others: that took longer than reading a small structure.
// What a command is for is said here alone, then: a docstring of the type of its flags, or of a part of them, would replace it.
#[command(defer = true)]
pub(crate) enum Command {
    /// Mesh the surface of one structure
    Mesh(Box<MeshArgs>),
    /// Draw the surface of one structure as a PNG
    Render(Box<RenderArgs>),
    /// Serve meshes over HTTP
    #[cfg(feature = "server")]
    Serve(Box<ServeArgs>),
    /// Say what this machine has, what of it is used, and whether a service would start and be ready
    #[cfg(feature = "server")]
    Doctor(Box<DoctorArgs>),
    /// Print the configuration of the service, or describe it
    #[cfg(feature = "server")]
    #[command(subcommand)]
    Config(ConfigCommand),
    /// Ask a running service whether it is ready; exit code 0 if so
    #[cfg(feature = "server")]
    Healthcheck(HealthcheckArgs),
    /// Make keys for the service
    #[cfg(feature = "server")]
    #[command(subcommand)]
    Key(KeyCommand),
    /// Sign an address of the service, so that it opens without a key until it expires
    #[cfg(feature = "server")]
    Sign(SignArgs),
    /// Print the version
    Version,
}

/// Which backend runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum BackendName {
    /// A service takes a GPU if one can be used, else the CPU; a command takes the one estimated to finish first
    Auto,
    /// Every core, with the widest vectors that the processor has
    Cpu,
    /// Plain, sequential, brute force: what the others are compared with
    Reference,
    /// The GPU or nothing
    Gpu,
}

/// How the report is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum ReportStyle {
    /// A summary on stderr
    Text,
    /// JSON on stdout (on stderr when the file goes to stdout)
    Json,
}

// `molmesh mesh`.
#[derive(Debug, ClapArgs)]
#[command(after_help = format!("{MESH_EXAMPLES}\n\n{EXIT_CODES}"), allow_negative_numbers = true)]
pub(crate) struct MeshArgs {
    /// Structure file, PDB, mmCIF or BinaryCIF, plain or compressed with gzip or zstd; `-` is stdin
    pub(crate) input: PathBuf,
    /// Mesh file; `-` is stdout
    #[arg(short, long)]
    pub(crate) output: PathBuf,
    /// glb, gltf, ply, stl or obj; by default what the output's extension says, glb on stdout
    #[arg(long, value_name = "FORMAT")]
    pub(crate) format: Option<String>,
    /// How glb and gltf store vertices: none, or quantize (12 bytes instead of 24: 16-bit positions, 8-bit normals)
    /// [default: none]
    #[arg(long, value_name = "HOW")]
    pub(crate) compress: Option<String>,
    /// Whether vertices have normals: smooth, or none (smaller files, flat shading) [default: smooth]
    #[arg(long, value_name = "HOW")]
    pub(crate) normals: Option<String>,
    /// What 1 stands for in the mesh file: angstrom, nanometer, or meter (glb and gltf only) [default: angstrom]
    #[arg(long, value_name = "UNITS")]
    pub(crate) units: Option<String>,
    #[command(flatten)]
    pub(crate) job: JobArgs,
}

// What every job has, whatever becomes of its mesh.
#[derive(Debug, ClapArgs)]
pub(crate) struct JobArgs {
    /// What runs the meshing
    #[arg(long, value_enum, default_value = "auto")]
    pub(crate) backend: BackendName,
    #[command(flatten)]
    pub(crate) devices: DeviceArgs,
    /// Threads of the CPU backend; one per core by default
    #[arg(long, value_name = "N")]
    pub(crate) threads: Option<usize>,
    /// How the report is written
    #[arg(long, value_enum, default_value = "text")]
    pub(crate) report: ReportStyle,
    /// No summary and no progress bar
    #[arg(short, long)]
    pub(crate) quiet: bool,
    /// Refuse a file in which a second, strict reader finds errors, and report what else it finds
    #[arg(long)]
    pub(crate) check: bool,
    /// Check that the mesh is watertight: checksum (of its edges, fast) or exact (edge by edge) [default: checksum]
    #[arg(long, value_name = "METHOD")]
    pub(crate) validation: Option<String>,
    #[command(flatten)]
    pub(crate) surface: SurfaceArgs,
    #[command(flatten)]
    pub(crate) selection: SelectionArgs,
    #[command(flatten)]
    pub(crate) limits: LimitArgs,
}

/// Builds without the service have no `doctor`.
fn devices_help() -> String {
    let doctor = if cfg!(feature = "server") { "; `molmesh doctor` numbers them" } else { "" };
    format!(
        "Which devices may be used: auto (the best kind of GPU), all, cpu, or a list such as 0,2 or software{doctor}"
    )
}

// Which devices.
#[derive(Debug, ClapArgs)]
pub(crate) struct DeviceArgs {
    /// Which devices may be used
    #[arg(long, help = devices_help(), value_name = "WHICH", default_value = "auto", env = "MOLMESH__DEVICES__USE", hide_env_values = true)]
    pub(crate) devices: DeviceChoice,
}

// Which surface.
#[derive(Debug, ClapArgs)]
#[command(next_help_heading = "Surface")]
pub(crate) struct SurfaceArgs {
    /// Density of an atom: gaussian, soft-object or inverse-square [default: gaussian]
    #[arg(long, value_name = "KERNEL")]
    pub(crate) kernel: Option<String>,
    /// Values for what is not given: default, ses-like, vdw-like, molstar, blinn or quicksurf. `ses-like` approximates
    /// the solvent-excluded surface: -6.5 to +6.0 % off in area and -0.6 to +5.1 % in volume over eight proteins, worse
    /// for small structures (area +13.5 % for a DNA dodecamer)
    #[arg(long, value_name = "PRESET")]
    pub(crate) preset: Option<String>,
    /// Grid spacing in Å [default: 0.5]
    #[arg(long, value_name = "Å")]
    pub(crate) resolution: Option<String>,
    /// Grid spacing by level instead, 0 (2 Å) to 6 (0.25 Å); structures of more than 10,000 atoms get coarser ones
    #[arg(long, value_name = "LEVEL")]
    pub(crate) detail: Option<String>,
    /// Instead of a spacing: the finest one, down to 0.25 Å, whose mesh has at most N triangles
    #[arg(long, value_name = "N")]
    pub(crate) max_triangles: Option<String>,
    /// Level of the density that is the surface [default: 1, an isolated atom's radius]
    #[arg(long, value_name = "LEVEL")]
    pub(crate) isovalue: Option<String>,
    /// How closely the gaussian follows the atoms; higher is less smooth [default: 1.25]
    #[arg(long, value_name = "A")]
    pub(crate) smoothness: Option<String>,
    /// Radii are multiplied by this [default: 1]
    #[arg(long, value_name = "FACTOR")]
    pub(crate) radius_scale: Option<String>,
    /// Then this is added, in Å [default: 0]
    #[arg(long, value_name = "Å")]
    pub(crate) radius_offset: Option<String>,
    /// Where the gaussian is cut off, relative to its value at the radius [default: 0.01]
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
    /// Store the nearest atom of every vertex (`_ATOM` in glTF, `atom` in PLY)
    #[arg(long)]
    pub(crate) atom_ids: bool,
}

// Which atoms.
#[derive(Debug, ClapArgs)]
#[command(next_help_heading = "Atoms")]
pub(crate) struct SelectionArgs {
    /// Comma-separated: polymer, ligand, water, hydrogens, all [default: polymer]
    #[arg(long, value_name = "WHAT")]
    pub(crate) select: Option<String>,
    /// Take ligands too
    #[arg(long)]
    pub(crate) ligands: bool,
    /// Take waters too
    #[arg(long)]
    pub(crate) waters: bool,
    /// Take hydrogens of whatever is taken
    #[arg(long)]
    pub(crate) hydrogens: bool,
    /// Comma-separated chains, by author name [default: all]
    #[arg(long, value_name = "A,B")]
    pub(crate) chains: Option<String>,
    /// Model number [default: the first]
    #[arg(long, value_name = "N")]
    pub(crate) model: Option<String>,
    /// One alternative location instead of the best occupied of each residue
    #[arg(long, value_name = "X")]
    pub(crate) altloc: Option<String>,
}

// What is too much.
#[expect(clippy::struct_field_names, reason = "the fields are named like their flags")]
#[derive(Debug, ClapArgs)]
#[command(next_help_heading = "Limits")]
pub(crate) struct LimitArgs {
    /// Atoms in the file, all models [default: 20000000]
    #[arg(long, value_name = "N")]
    pub(crate) max_atoms: Option<u64>,
    /// Bytes of the input after decompression [default: 4 GiB]
    #[arg(long, value_name = "BYTES")]
    pub(crate) max_input_bytes: Option<u64>,
    /// Grid samples in occupied bricks [default: 4294967296]
    #[arg(long, value_name = "N")]
    pub(crate) max_samples: Option<u64>,
    /// Pairs of an atom and a grid brick within its reach [default: 1073741824]
    #[arg(long, value_name = "N")]
    pub(crate) max_candidates: Option<u64>,
    /// Bytes of vertices and triangles [default: 8 GiB]
    #[arg(long, value_name = "BYTES")]
    pub(crate) max_mesh_bytes: Option<u64>,
}
