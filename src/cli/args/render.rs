//! Flags of `molmesh render`.

use std::path::PathBuf;

use clap::Args as ClapArgs;

use super::{EXIT_CODES, JobArgs, PictureArgs};

const RENDER_EXAMPLES: &str = "\
Examples:
  molmesh render 4pti.pdb -o 4pti.png
  molmesh render 1gbt.cif.gz -o - --width 256 --height 256 --background white > thumbnail.png
  molmesh render 4pti.pdb -o 4pti.png --surface ses --style gouraud --view front --azimuth 30";

// `molmesh render`.
#[derive(Debug, ClapArgs)]
#[command(after_help = format!("{RENDER_EXAMPLES}\n\n{EXIT_CODES}"), allow_negative_numbers = true)]
pub(crate) struct RenderArgs {
    /// Structure file: PDB, mmCIF, BinaryCIF, PQR or XYZ, optionally compressed with gzip or zstd; `-` is stdin
    pub(crate) input: PathBuf,
    /// PNG file; `-` is stdout
    #[arg(short, long)]
    pub(crate) output: PathBuf,
    #[command(flatten)]
    pub(crate) picture: PictureArgs,
    #[command(flatten)]
    pub(crate) job: JobArgs,
}
