//! `molmesh completions` and `molmesh man`: texts for shells and `man`, from the declarations of the flags.

use clap::{Command, CommandFactory as _};
use clap_mangen::Man;

use super::args::{Args, CompletionsArgs, ManArgs};
use super::error::CliError;
use super::print;

/// Prints the completions of a shell.
pub(super) fn completions(args: &CompletionsArgs) -> Result<(), CliError> {
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut Args::command(), "molmesh", &mut script);
    print(&String::from_utf8_lossy(&script))
}

/// Prints a man page.
pub(super) fn man(args: &ManArgs) -> Result<(), CliError> {
    let mut all = Args::command();
    all.build();
    let mut command: &Command = &all;
    for name in &args.command {
        let missing = || CliError::usage(format!("there is no command `{}`", args.command.join(" ")));
        command = command.find_subcommand(name).ok_or_else(missing)?;
    }
    let mut page = Vec::new();
    let rendered = Man::new(command.clone()).render(&mut page);
    rendered.map_err(|error| CliError::Internal(error.to_string()))?;
    print(&String::from_utf8_lossy(&page))
}
