//! Configuration of the service: defaults, then a TOML file, then `MOLMESH__SECTION__KEY`, then flags.
//!
//! One small struct per concern. Every key says its unit and why its default is what it is; keys end in their
//! unit (`_ms`, `_bytes`). A key that does not exist is refused, whichever layer it comes from.

mod archive;
mod devices;
mod error;
mod jobs;
mod limits;
mod load;
mod log;
mod server;
mod store;
mod telemetry;
mod template;

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

pub use archive::ArchiveConfig;
pub use devices::DevicesConfig;
pub use error::ConfigError;
pub use jobs::JobsConfig;
pub use limits::LimitsConfig;
pub use load::{Source, load, load_process};
pub use log::{LogConfig, LogFormat};
pub use server::ServerConfig;
pub use store::{Secret, StoreConfig};
pub use telemetry::{CollectorUrl, Ratio, SecretHeaders, TelemetryConfig};
pub use template::{ProxyUrl, Template, Templates};

/// The whole configuration.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// Addresses, connections and their timeouts.
    pub server: ServerConfig,
    /// What one request may cost.
    pub limits: LimitsConfig,
    /// The worker pool.
    pub jobs: JobsConfig,
    /// GPUs.
    pub devices: DevicesConfig,
    /// Structures by PDB id.
    pub archive: ArchiveConfig,
    /// What the service keeps.
    pub store: StoreConfig,
    /// Logs.
    pub log: LogConfig,
    /// Traces.
    pub telemetry: TelemetryConfig,
}

impl Config {
    /// The folder in which structures are looked up by PDB id.
    #[must_use]
    pub fn archive_dir(&self) -> PathBuf {
        self.archive.dir.clone().unwrap_or_else(|| self.server.data_dir.join("archive"))
    }

    /// The folder of copies of what a remote archive has sent.
    #[must_use]
    pub fn archive_cache_dir(&self) -> PathBuf {
        self.server.data_dir.join("cache").join("archive")
    }
}
