//! Flags of `molmesh render`.

use std::path::PathBuf;

use clap::Args as ClapArgs;

use super::{EXIT_CODES, JobArgs};

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

// Picture parameters.
#[derive(Debug, ClapArgs)]
#[command(next_help_heading = "Picture")]
pub(crate) struct PictureArgs {
    /// Width in pixels [default: 512]
    #[arg(long, value_name = "PIXELS")]
    pub(crate) width: Option<String>,
    /// Height in pixels [default: 512]
    #[arg(long, value_name = "PIXELS")]
    pub(crate) height: Option<String>,
    /// View: principal (the longest axis is horizontal, the shortest points at the viewer), or front, back, left,
    /// right, top, bottom along the axes of the file [default: principal]
    #[arg(long, value_name = "VIEW")]
    pub(crate) view: Option<String>,
    /// Rotation of the viewer to the right, in degrees [default: 0]
    #[arg(long, value_name = "DEGREES")]
    pub(crate) azimuth: Option<String>,
    /// Rotation of the viewer upwards after that, in degrees [default: 0]
    #[arg(long, value_name = "DEGREES")]
    pub(crate) elevation: Option<String>,
    /// Background: transparent, white, black, RRGGBB or RRGGBBAA [default: transparent]
    #[arg(long, value_name = "COLOR")]
    pub(crate) background: Option<String>,
    /// Shading: surface (with ambient occlusion and a soft outline), or gouraud [default: surface]
    #[arg(long, value_name = "STYLE")]
    pub(crate) style: Option<String>,
}
