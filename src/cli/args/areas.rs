//! Flags of `molmesh areas`.

use std::path::PathBuf;

use clap::Args as ClapArgs;

use super::{AtomArgs, CommonLimitArgs, EXIT_CODES, ReportStyle};

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
    #[arg(long, value_name = "SURFACE", required = true)]
    pub(crate) surface: Option<String>,
    /// Rows of the table: atom, residue or chain [default: residue]
    #[arg(long, value_name = "LEVEL")]
    pub(crate) by: Option<String>,
    /// Radius of the probe in Å, for `--surface sas` and `ses` [default: 1.4]
    #[arg(long, value_name = "Å")]
    pub(crate) probe: Option<String>,
    /// Factor of all radii [default: 1]
    #[arg(long, value_name = "FACTOR")]
    pub(crate) radius_scale: Option<String>,
    /// Length added to all scaled radii, in Å [default: 0]
    #[arg(long, value_name = "Å")]
    pub(crate) radius_offset: Option<String>,
    /// Surface area buried between two sets of chains, half the sum over both sides; a slash joins chains of a side:
    /// H/L,A
    #[arg(long, value_name = "A,B")]
    pub(crate) interface: Option<String>,
    /// Threads of the computation; one per core by default
    #[arg(long, value_name = "N")]
    pub(crate) threads: Option<usize>,
    /// Format of the report
    #[arg(long, value_enum, default_value = "text")]
    pub(crate) report: ReportStyle,
    /// Do not print the summary
    #[arg(short, long)]
    pub(crate) quiet: bool,
    /// Model number [default: the first]
    #[arg(long, value_name = "N", help_heading = "Atoms")]
    pub(crate) model: Option<String>,
    #[command(flatten)]
    pub(crate) atoms: AtomArgs,
    #[command(flatten)]
    pub(crate) limits: CommonLimitArgs,
}
