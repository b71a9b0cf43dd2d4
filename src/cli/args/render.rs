//! Flags of `molmesh render`.

use std::path::PathBuf;

use clap::Args as ClapArgs;

use super::{BatchArgs, EXIT_CODES, JobArgs, PictureArgs};

const RENDER_EXAMPLES: &str = "\
Examples:
  molmesh render 4pti.pdb -o 4pti.png
  molmesh render 1gbt.cif.gz -o - --width 256 --height 256 --background white > thumbnail.png
  molmesh render 4pti.pdb -o 4pti.png --surface ses --style gouraud --view front --azimuth 30
  molmesh render structures/ -o pictures/ --jobs 4";

// `molmesh render`.
#[derive(Debug, ClapArgs)]
#[command(after_help = format!("{RENDER_EXAMPLES}\n\n{EXIT_CODES}"), allow_negative_numbers = true)]
pub(crate) struct RenderArgs {
    /// Structure files: PDB, mmCIF, BinaryCIF, PQR or XYZ, optionally compressed with gzip or zstd; `-` is stdin. A
    /// folder stands for the structure files in it and in its subfolders
    #[arg(required_unless_present = "list", value_name = "INPUT")]
    pub(crate) inputs: Vec<PathBuf>,
    /// PNG file; `-` is stdout. For several inputs: folder, in which each file has the name of its input
    #[arg(short, long)]
    pub(crate) output: PathBuf,
    #[command(flatten)]
    pub(crate) picture: PictureArgs,
    #[command(flatten)]
    pub(crate) job: JobArgs,
    #[command(flatten)]
    pub(crate) batch: BatchArgs,
}
