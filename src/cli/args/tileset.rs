//! Flags of `molmesh tileset`.

use std::path::PathBuf;

use clap::Args as ClapArgs;

use super::{EXIT_CODES, JobArgs};

const TILESET_EXAMPLES: &str = "\
Examples:
  molmesh tileset 2btv.pdb.gz --assembly 1 --color chain -o 2btv-tiles
  molmesh tileset 4pti.pdb --resolution 0.25 -o 4pti-tiles --report json
  molmesh tileset part-1.cif.gz part-2.cif.gz --scratch /tmp --color chain -o cell-tiles";

// `molmesh tileset`.
#[derive(Debug, ClapArgs)]
#[command(after_help = format!("{TILESET_EXAMPLES}\n\n{EXIT_CODES}"), allow_negative_numbers = true)]
pub(crate) struct TilesetArgs {
    /// Structure file: PDB, mmCIF, BinaryCIF, PQR or XYZ, optionally compressed with gzip or zstd; `-` is stdin.
    /// Several files form one structure, with --scratch
    #[arg(required = true, value_name = "INPUT")]
    pub(crate) inputs: Vec<PathBuf>,
    /// Folder of the tileset, which must not exist or be empty; the file to open is `tileset.json` in it
    #[arg(short, long)]
    pub(crate) output: PathBuf,
    /// Folder for a temporary index of the atoms, for structures larger than memory: 48 bytes per atom and more. mmCIF
    /// and BinaryCIF files are read in blocks, files of other formats one at a time. Raises the limits of atoms to
    /// 4294967295 and of each input to 1TiB, unless they are given
    #[arg(long, value_name = "FOLDER")]
    pub(crate) scratch: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) job: JobArgs,
}
