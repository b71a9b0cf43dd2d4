//! Configuration of the service: defaults, then a TOML file, then `MOLMESH__SECTION__KEY`, then flags.
//!
//! One small struct per concern. Every key says its unit and why its default is what it is; keys end in their
//! unit (`_ms`, `_bytes`). A key that does not exist is refused, whichever layer it comes from.

mod access;
mod archive;
mod devices;
mod error;
mod jobs;
mod limits;
mod load;
mod log;
mod print;
mod proxies;
mod schema;
mod secrets;
mod server;
mod store;
mod telemetry;
mod template;

use std::path::PathBuf;

use schemars::JsonSchema;
use serde::{Deserialize, Deserializer, Serialize};

pub use access::{AccessConfig, Origins};
pub use archive::ArchiveConfig;
pub use devices::DevicesConfig;
pub use error::ConfigError;
pub use jobs::JobsConfig;
pub use limits::LimitsConfig;
pub use load::{Loaded, Source, load, load_process, load_with_sources};
pub use log::{LogConfig, LogFormat};
pub use proxies::{ForwardedHeader, Proxies};
pub use schema::schema;
pub use server::ServerConfig;
pub use store::{Secret, StoreConfig};
pub use telemetry::{CollectorUrl, Ratio, SecretHeaders, TelemetryConfig};
pub use template::{ProxyUrl, Template, Templates};

/// The whole configuration.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
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
    /// Who may ask for what.
    pub access: AccessConfig,
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

/// Words with blanks between them, or a list of them, as one text.
fn words<'de, D: Deserializer<'de>>(deserializer: D) -> Result<String, D::Error> {
    #[derive(Deserialize)]
    #[serde(untagged)]
    enum Written {
        Text(String),
        List(Vec<String>),
    }
    Ok(match Written::deserialize(deserializer)? {
        Written::Text(text) => text,
        Written::List(texts) => texts.join(" "),
    })
}
