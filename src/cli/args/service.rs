//! The flags of the commands around the service.

use std::net::SocketAddr;
use std::path::PathBuf;

use clap::{Args as ClapArgs, Subcommand, ValueEnum};

use super::BackendName;

const DOCTOR_CODES: &str = "\
Exit codes:
    0  a service with this configuration would start and be ready; warnings do not count
    1  it would not: an address is taken, the store cannot be used, or the log filter is wrong
    2  bad usage or a bad configuration
    6  no such backend or device on this machine, or it cannot make a mesh";

// `molmesh serve`.
#[derive(Debug, ClapArgs)]
pub(crate) struct ServeArgs {
    /// Address of the service; port 0 takes a free one [default: 127.0.0.1:8080]
    #[arg(long, value_name = "ADDR")]
    pub(crate) listen: Option<SocketAddr>,
    /// Address of the metrics; none by default
    #[arg(long, value_name = "ADDR")]
    pub(crate) metrics_listen: Option<SocketAddr>,
    /// Where the service keeps its data
    #[arg(long, value_name = "DIR")]
    pub(crate) data_dir: Option<PathBuf>,
    /// Folder of structure files, flat or in the `divided` layout of the wwPDB
    #[arg(long, value_name = "DIR")]
    pub(crate) archive: Option<PathBuf>,
    /// Configuration file (TOML)
    #[arg(long, value_name = "FILE", env = "MOLMESH_CONFIG", hide_env_values = true)]
    pub(crate) config: Option<PathBuf>,
    /// Set one value of the configuration, such as `limits.atoms=100000`; may be repeated
    #[arg(long, value_name = "SECTION.KEY=VALUE")]
    pub(crate) set: Vec<String>,
    /// What runs the meshing
    #[arg(long, value_enum, default_value = "auto")]
    pub(crate) backend: BackendName,
    /// Which devices may be used: auto (the best kind of GPU), all, cpu, or a list such as 0,2 or software
    #[arg(long, value_name = "WHICH")]
    pub(crate) devices: Option<String>,
    /// How to log
    #[arg(long, value_enum)]
    pub(crate) log: Option<LogStyle>,
}

// `molmesh healthcheck`.
#[derive(Debug, ClapArgs)]
pub(crate) struct HealthcheckArgs {
    /// What to ask
    #[arg(long, default_value = "http://127.0.0.1:8080/readyz")]
    pub(crate) url: String,
    /// Seconds to wait for the answer
    #[arg(long, value_name = "SECONDS", default_value_t = 3.0)]
    pub(crate) timeout: f64,
}

/// How the service logs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum LogStyle {
    /// For people
    Pretty,
    /// One JSON object a line
    Json,
}

/// How `doctor` reports.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum DoctorStyle {
    /// A page for people
    Text,
    /// JSON for programs
    Json,
}

// `molmesh doctor`.
#[derive(Debug, ClapArgs)]
#[command(after_help = DOCTOR_CODES)]
pub(crate) struct DoctorArgs {
    /// How the report is written, on stdout
    #[arg(long, value_enum, default_value = "text", visible_alias = "format")]
    pub(crate) report: DoctorStyle,
    /// Seconds for an answer of the store, and of the remote archive
    #[arg(long, value_name = "SECONDS", default_value_t = 5.0)]
    pub(crate) timeout: f64,
    #[command(flatten)]
    pub(crate) serve: ServeArgs,
}

// `molmesh config`.
#[derive(Debug, Subcommand)]
pub(crate) enum ConfigCommand {
    /// Print the effective configuration, each value with its source; secrets are not shown
    Print(Box<PrintArgs>),
    /// Print the JSON Schema of the configuration file
    Schema,
}

/// How the configuration is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum ConfigStyle {
    /// A configuration file, sources in comments
    Toml,
    /// `config` and `sources`
    Json,
}

/// `molmesh config print`.
#[derive(Debug, ClapArgs)]
pub(crate) struct PrintArgs {
    /// How it is written
    #[arg(long, value_enum, default_value = "toml")]
    pub(crate) format: ConfigStyle,
    #[command(flatten)]
    pub(crate) serve: ServeArgs,
}
