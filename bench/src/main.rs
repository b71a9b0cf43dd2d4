//! `molmesh-bench`: benchmarks of molmesh on GPUs and of its service, and the tables and figures of the 2010 paper on
//! current hardware.

mod commands;
mod device;
mod error;
mod floor;
mod gpu;
mod grid;
mod machine;
mod paper;
mod program_2010;
mod rates;
mod service;
mod stats;
mod structures;
mod substitute;

use std::io::Write as _;
use std::path::Path;
use std::process::ExitCode;

use clap::{Parser, Subcommand};

use error::{Error, Result};

#[derive(Debug, Parser)]
#[command(version, about = "Benchmarks of molmesh")]
struct Args {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Time the stages on GPUs and compare them with lower bounds for each device
    Gpu(Box<gpu::GpuArgs>),
    /// Time whole requests to a service, one client and many, on several backends
    Service(Box<service::ServiceArgs>),
    /// Time whole commands on several backends
    Commands(commands::CommandsArgs),
    /// Measure the tables of Dias, Bora and Gomes (HPDC 2010) on this machine
    Paper(Box<paper::PaperArgs>),
    /// Download the structures of the 2010 paper
    Fetch(paper::fetch::FetchArgs),
    /// Draw the figures of the 2010 paper and update the tables of a Markdown page from stored results
    Figures(paper::redraw::FiguresArgs),
}

fn main() -> ExitCode {
    let done = match Args::parse().command {
        Command::Gpu(args) => gpu::run(&args),
        Command::Service(args) => service::run(&args),
        Command::Commands(args) => commands::run(&args),
        Command::Paper(args) => paper::run(&args),
        Command::Fetch(args) => paper::fetch::run(&args),
        Command::Figures(args) => paper::redraw::run(&args),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            note(&format!("molmesh-bench: {error}"));
            ExitCode::from(error.code())
        }
    }
}

/// Writes `text` to standard output.
fn print(text: &str) -> Result<()> {
    let mut out = std::io::stdout().lock();
    out.write_all(text.as_bytes()).and_then(|()| out.flush()).map_err(Error::file("standard output"))
}

/// Writes results to a file, if one is given.
fn write_json(path: Option<&Path>, results: &serde_json::Value) -> Result<()> {
    path.map_or(Ok(()), |path| std::fs::write(path, format!("{results:#}\n")).map_err(Error::file(path)))
}

/// Writes a line of progress or an error to standard error. Ignores failures, which cannot be reported.
fn note(line: &str) {
    drop(writeln!(std::io::stderr().lock(), "{line}"));
}
