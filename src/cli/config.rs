//! `molmesh config`: prints the configuration and its schema. Also maps flags to configuration keys for all commands.

use std::path::Path;

use clap::ValueEnum as _;

use molmesh::config::{self, Loaded};
use molmesh::pipeline::params::ParamError;

use super::args::{ConfigCommand, ConfigStyle, LogStyle, PrintArgs, ServeArgs};
use super::error::CliError;
use super::report::json_text;

/// Runs the command.
pub(super) fn run(command: &ConfigCommand) -> Result<(), CliError> {
    match command {
        ConfigCommand::Print(args) => super::print(&print(args)?),
        ConfigCommand::Schema => super::print(&json_text(&config::schema())),
    }
}

fn print(args: &PrintArgs) -> Result<String, CliError> {
    let loaded = load(&args.serve)?;
    let backend = args.serve.backend.to_possible_value().map(|value| value.get_name().to_owned()).unwrap_or_default();
    let warnings = &loaded.warnings;
    Ok(match args.format {
        ConfigStyle::Toml => {
            let warnings = warnings.iter().map(|warning| ["# Warning: ", warning, "\n"].concat()).collect::<String>();
            format!(
                "# Effective configuration of molmesh {}, with the source of each value.\n\
                 # Not part of this file: --backend {backend}\n{warnings}\n{}",
                env!("CARGO_PKG_VERSION"),
                loaded.to_toml()
            )
        }
        ConfigStyle::Json => {
            let mut document = loaded.to_json();
            document["backend"] = backend.into();
            document["warnings"] = warnings.clone().into();
            json_text(&document)
        }
    })
}

/// Loads the configuration: defaults, file, environment, `--set`, named flags. Later sources override earlier ones.
pub(super) fn load(args: &ServeArgs) -> Result<Loaded, CliError> {
    let path = |p: &std::path::PathBuf| p.to_string_lossy().into_owned();
    let log = args.log.map(|style| match style {
        LogStyle::Pretty => "pretty".to_owned(),
        LogStyle::Json => "json".to_owned(),
    });
    let named = [
        ("server.listen", args.listen.clone()),
        ("server.metrics_listen", args.metrics_listen.clone()),
        ("server.data_dir", args.data_dir.as_ref().map(path)),
        ("server.role", args.role.clone()),
        ("devices.use", args.devices.clone()),
        ("archive.dir", args.archive.as_ref().map(path)),
        ("log.format", log),
    ];
    let named = named.into_iter().filter_map(|(key, value)| Some((key.to_owned(), value?)));
    load_with(args.config.as_deref(), &args.set, named)
}

/// Loads the configuration from a file, the environment, `--set` and `named` pairs of key and value.
pub(super) fn load_with(
    file: Option<&Path>,
    set: &[String],
    named: impl IntoIterator<Item = (String, String)>,
) -> Result<Loaded, CliError> {
    let mut flags = Vec::new();
    for set in set {
        let bad = || ParamError::bad_value("set", set, "section.key=value");
        let (key, value) = set.split_once('=').ok_or_else(bad)?;
        flags.push((key.to_owned(), value.to_owned()));
    }
    flags.extend(named);
    config::load_process(file, &flags).map_err(|e| CliError::usage(e.to_string()))
}
