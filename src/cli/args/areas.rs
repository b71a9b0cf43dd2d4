//! Flags of `molmesh areas`.

use std::path::PathBuf;

use clap::Args as ClapArgs;

use super::{AreaArgs, AreaModelArgs, AtomArgs, CommonLimitArgs, EXIT_CODES, ReportStyle};

const AREAS_EXAMPLES: &str = "\
Examples:
  molmesh areas 4pti.pdb --surface sas > 4pti.csv
  molmesh areas 1gbt.cif.gz -o 1gbt.csv --surface ses --by atom
  molmesh areas 2hhb.pdb -o interface.csv --surface sas --interface A/B,C/D --report json";

// `molmesh areas`.
#[derive(Debug, ClapArgs)]
#[command(after_help = format!("{AREAS_EXAMPLES}\n\n{EXIT_CODES}"), allow_negative_numbers = true)]
pub(crate) struct AreasArgs {
    /// Structure file: PDB, mmCIF, BinaryCIF, PQR or XYZ, optionally compressed with gzip or zstd; `-` is stdin
    pub(crate) input: PathBuf,
    /// Table in CSV; `-` is stdout
    #[arg(short, long, default_value = "-")]
    pub(crate) output: PathBuf,
    /// Surface: vdw (van der Waals), sas (solvent-accessible) or ses (solvent-excluded)
    #[arg(long, value_name = "SURFACE")]
    pub(crate) surface: String,
    #[command(flatten)]
    pub(crate) area: AreaArgs,
    /// Threads of the computation; one per core by default
    #[arg(long, value_name = "N")]
    pub(crate) threads: Option<usize>,
    /// Format of the report
    #[arg(long, value_enum, default_value = "text")]
    pub(crate) report: ReportStyle,
    /// Do not print the summary
    #[arg(short, long)]
    pub(crate) quiet: bool,
    #[command(flatten)]
    pub(crate) model: AreaModelArgs,
    #[command(flatten)]
    pub(crate) atoms: AtomArgs,
    #[command(flatten)]
    pub(crate) limits: CommonLimitArgs,
}
