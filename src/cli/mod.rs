//! Command line: flags, commands, summaries, error messages and exit codes.
//!
//! A command starts only what it needs: `mesh` has no async runtime and no log.

mod areas;
mod args;
mod backend;
mod banner;
mod batch;
mod config;
mod doctor;
mod error;
mod healthcheck;
mod interrupt;
mod job;
mod key;
mod mesh;
mod output;
mod page;
mod panics;
mod progress;
mod render;
mod report;
mod request;
mod serve;
mod setup;
mod shell;
mod sign;
mod style;
mod summary;
mod survey;
mod tileset;

use std::io::{self, Write};

use clap::error::{ContextKind, ContextValue, ErrorKind};
use clap::{CommandFactory as _, Parser as _};

use args::{Args, Command};
use error::{CliError, code};
use style::Style;

/// Runs the command in the arguments of the process. Returns the exit code.
pub(crate) fn main() -> i32 {
    let status = run();
    // `leave` does not flush standard output.
    if io::stdout().flush().is_err() && status == code::OK { code::OUTPUT } else { status }
}

fn run() -> i32 {
    let args = match Args::try_parse() {
        Ok(args) => args,
        Err(error) => return usage(error),
    };
    let result = match args.command {
        Command::Mesh(args) => panics::contained(|| mesh::run(&args)),
        Command::Render(args) => panics::contained(|| render::run(&args)),
        Command::Tileset(args) => panics::contained(|| tileset::run(&args)),
        Command::Areas(args) => panics::contained(|| areas::run(&args)),
        Command::Serve(args) => serve::run(&args),
        Command::Doctor(args) => doctor::run(&args),
        Command::Config(command) => config::run(&command),
        Command::Healthcheck(args) => healthcheck::run(&args),
        Command::Key(command) => key::run(&command),
        Command::Sign(args) => sign::run(&args),
        Command::Completions(args) => shell::completions(&args),
        Command::Man(args) => shell::man(&args),
        Command::Version => version(),
    };
    match result {
        Ok(()) => code::OK,
        Err(error) => {
            error.print(Style::stderr());
            error.code()
        }
    }
}

/// Ends the process without freeing memory, which would take longer than writing a large mesh. Runs no exit handlers:
/// those of NVIDIA's driver caused occasional segmentation faults after an orderly stop.
pub(crate) fn leave(status: i32) -> ! {
    #[cfg(unix)]
    signal_hook::low_level::exit(status);
    #[cfg(not(unix))]
    std::process::exit(status);
}

/// Prints help to stdout and usage errors to stderr. Returns the exit code.
fn usage(error: clap::Error) -> i32 {
    let error = with_owners(error);
    let text = error.render().to_string();
    let (written, code) = match error.kind() {
        ErrorKind::DisplayHelp | ErrorKind::DisplayVersion => (io::stdout().write_all(text.as_bytes()), code::OK),
        ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand => (io::stderr().write_all(text.as_bytes()), code::USAGE),
        _ => {
            let text = text.strip_prefix("error: ").unwrap_or(&text);
            (write!(io::stderr(), "molmesh: {text}"), code::USAGE)
        }
    };
    // A closed stream is ignored.
    drop(written);
    code
}

/// Names the commands that have an option, if the given command does not have it.
fn with_owners(mut error: clap::Error) -> clap::Error {
    if error.kind() != ErrorKind::UnknownArgument {
        return error;
    }
    let Some(ContextValue::String(given)) = error.get(ContextKind::InvalidArg) else { return error };
    let option = given.split('=').next().unwrap_or_default().to_owned();
    let mut all = Args::command();
    all.build();
    let has = |command: &&clap::Command| {
        command.get_arguments().any(|known| known.get_long().is_some_and(|long| option == format!("--{long}")))
    };
    let owners: Vec<_> =
        all.get_subcommands().filter(has).map(|command| format!("`molmesh {}`", command.get_name())).collect();
    if !owners.is_empty() {
        let tip = format!("'{option}' is an option of {}", owners.join(", "));
        error.remove(ContextKind::SuggestedArg);
        error.remove(ContextKind::Usage);
        error.insert(ContextKind::Suggested, ContextValue::StyledStrs(vec![tip.into()]));
    }
    error
}

/// `molmesh version`.
fn version() -> Result<(), CliError> {
    let gpu = if cfg!(feature = "gpu") { "" } else { " (without GPU support)" };
    print(&format!("molmesh {}{gpu}\n", env!("CARGO_PKG_VERSION")))
}

/// Prints `text` to stdout and flushes it.
fn print(text: &str) -> Result<(), CliError> {
    let mut out = io::stdout().lock();
    out.write_all(text.as_bytes())
        .and_then(|()| out.flush())
        .map_err(|source| CliError::Output { name: "stdout".to_owned(), source })
}
