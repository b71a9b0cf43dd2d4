//! Flags of `molmesh areas`.

use std::path::PathBuf;

use clap::Args as ClapArgs;

use super::{AreaArgs, AreaModelArgs, AtomArgs, BatchArgs, CommonLimitArgs, EXIT_CODES, RunArgs};

const AREAS_EXAMPLES: &str = "\
Examples:
  molmesh areas 4pti.pdb --surface sas > 4pti.csv
  molmesh areas 1gbt.cif.gz -o 1gbt.csv --surface ses --by atom
  molmesh areas 2hhb.pdb -o interface.csv --surface sas --interface A/B,C/D --report json
  molmesh areas structures/ -o all.csv --surface sas --by chain --jobs 4";

// `molmesh areas`.
#[derive(Debug, ClapArgs)]
#[command(after_help = format!("{AREAS_EXAMPLES}\n\n{EXIT_CODES}"), allow_negative_numbers = true)]
pub(crate) struct AreasArgs {
    /// Structure files: PDB, mmCIF, BinaryCIF, PQR or XYZ, optionally compressed with gzip or zstd; `-` is stdin. A
    /// folder stands for the structure files in it and in its subfolders
    #[arg(required_unless_present = "list", value_name = "INPUT")]
    pub(crate) inputs: Vec<PathBuf>,
    /// Table in CSV; `-` is stdout. For several inputs: one table with the input in the first column, or a folder with
    /// a table for each
    #[arg(short, long, default_value = "-")]
    pub(crate) output: PathBuf,
    /// Write the areas of all inputs to one CSV table too, if the output is a folder
    #[arg(long, value_name = "FILE")]
    pub(crate) table: Option<PathBuf>,
    /// Surface: vdw (van der Waals), sas (solvent-accessible) or ses (solvent-excluded)
    #[arg(long, value_name = "SURFACE")]
    pub(crate) surface: String,
    #[command(flatten)]
    pub(crate) area: AreaArgs,
    #[command(flatten)]
    pub(crate) run: RunArgs,
    #[command(flatten)]
    pub(crate) model: AreaModelArgs,
    #[command(flatten)]
    pub(crate) atoms: AtomArgs,
    #[command(flatten)]
    pub(crate) limits: CommonLimitArgs,
    #[command(flatten)]
    pub(crate) batch: BatchArgs,
}
