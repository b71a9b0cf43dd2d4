//! Flags of the commands of the service.

use std::path::PathBuf;

use clap::{Args as ClapArgs, Subcommand, ValueEnum};

use super::BackendName;

const DOCTOR_CODES: &str = "\
Exit codes:
    0  a service with this configuration would start and be ready; warnings do not count
    1  it would not: an address is taken, the store or the broker cannot be used, job records are
       in quarantine, or the log filter is wrong
    2  bad usage or a bad configuration
    6  no such backend or device on this machine, or it cannot make a mesh";

// `molmesh serve`.
#[derive(Debug, ClapArgs)]
pub(crate) struct ServeArgs {
    /// Address of the service; port 0 selects a free port [default: 127.0.0.1:8080]
    #[arg(long, value_name = "ADDR")]
    pub(crate) listen: Option<String>,
    /// Address of the metrics, or none [default: none]
    #[arg(long, value_name = "ADDR")]
    pub(crate) metrics_listen: Option<String>,
    /// Data folder of the service
    #[arg(long, value_name = "DIR")]
    pub(crate) data_dir: Option<PathBuf>,
    /// Role of this node of a cluster: all, api or worker [default: all]
    #[arg(long, value_name = "ROLE")]
    pub(crate) role: Option<String>,
    /// Folder of structure files, flat or in the `divided` layout of the wwPDB
    #[arg(long, value_name = "DIR")]
    pub(crate) archive: Option<PathBuf>,
    /// Configuration file (TOML)
    #[arg(long, value_name = "FILE", env = "MOLMESH_CONFIG", hide_env_values = true)]
    pub(crate) config: Option<PathBuf>,
    /// Set one value of the configuration, such as `limits.atoms=100000`; may be repeated
    #[arg(long, value_name = "SECTION.KEY=VALUE")]
    pub(crate) set: Vec<String>,
    /// Meshing backend
    #[arg(long, value_enum, default_value = "auto")]
    pub(crate) backend: BackendName,
    /// Devices to use: auto (the best kind of GPU), all, cpu, or a list such as 0,2 or software
    #[arg(long, value_name = "DEVICES")]
    pub(crate) devices: Option<String>,
    /// Log format
    #[arg(long, value_enum)]
    pub(crate) log: Option<LogStyle>,
}

// `molmesh healthcheck`.
#[derive(Debug, ClapArgs)]
pub(crate) struct HealthcheckArgs {
    /// URL to request; without a path, /readyz of it
    #[arg(long, default_value = "http://127.0.0.1:8080/readyz")]
    pub(crate) url: String,
    /// Seconds to wait for the response
    #[arg(long, value_name = "SECONDS", default_value_t = 3.0)]
    pub(crate) timeout: f64,
}

/// Values of `--log`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum LogStyle {
    /// Text
    Pretty,
    /// One JSON object per line
    Json,
}

/// Values of `doctor --report`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum TextOrJson {
    /// Text
    Text,
    /// JSON
    Json,
}

// `molmesh doctor`.
#[derive(Debug, ClapArgs)]
#[command(after_help = DOCTOR_CODES)]
pub(crate) struct DoctorArgs {
    /// Format of the report on stdout
    #[arg(long, value_enum, default_value = "text", visible_alias = "format")]
    pub(crate) report: TextOrJson,
    /// Seconds to wait for the store, the broker and the remote archive
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

/// Values of `config print --format`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum ConfigStyle {
    /// Configuration file with the sources in comments
    Toml,
    /// JSON object with `config` and `sources`
    Json,
}

/// `molmesh config print`.
#[derive(Debug, ClapArgs)]
pub(crate) struct PrintArgs {
    /// Output format
    #[arg(long, value_enum, default_value = "toml")]
    pub(crate) format: ConfigStyle,
    #[command(flatten)]
    pub(crate) serve: ServeArgs,
}
