//! Flags of several inputs.

use std::path::PathBuf;

use clap::Args as ClapArgs;

// Flags of several inputs.
#[derive(Debug, Clone, ClapArgs)]
#[command(next_help_heading = "Several files")]
pub(crate) struct BatchArgs {
    /// Take more inputs from a file with one path per line; `-` is stdin
    #[arg(long, value_name = "FILE")]
    pub(crate) list: Option<PathBuf>,
    /// Process N files at the same time. They divide the threads, and each needs its own memory [default: 1]
    #[arg(long, value_name = "N")]
    pub(crate) jobs: Option<usize>,
    /// Skip each input whose output files exist, to continue an interrupted run
    #[arg(long)]
    pub(crate) skip_existing: bool,
    /// Write one JSON line per input, in the order of the inputs: the report, or the error. With `--skip-existing`,
    /// lines are added to the file; `-` is stdout
    #[arg(long, value_name = "FILE")]
    pub(crate) summary: Option<PathBuf>,
}

impl BatchArgs {
    /// Returns true if a flag is given.
    pub(crate) fn is_given(&self) -> bool {
        let Self { list, jobs, skip_existing, summary } = self;
        list.is_some() || jobs.is_some() || *skip_existing || summary.is_some()
    }
}
