//! Configuration of the service: defaults, then a TOML file, then `MOLMESH__SECTION__KEY`, then flags.
//!
//! One struct per section. The documentation of every key states its unit and the reason for its default; keys end in
//! their unit (`_ms`, `_bytes`). Unknown keys are rejected in every layer. Skipped fields have no key: they are fixed
//! in a service, and only tests change them.

/// Declares the struct of a section, with the default of each key beside it: `key: Type = default;`.
macro_rules! section {
    (
        $(#[$attribute:meta])* $section:ident;
        $($(#[$key_attribute:meta])* $key:ident: $type:ty = $default:expr;)+
    ) => {
        $(#[$attribute])*
        #[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize, schemars::JsonSchema)]
        #[serde(deny_unknown_fields, default)]
        pub struct $section {
            $($(#[$key_attribute])* pub $key: $type,)+
        }

        impl Default for $section {
            fn default() -> Self {
                Self { $($key: $default,)+ }
            }
        }
    };
}

mod access;
mod archive;
mod broker;
mod devices;
mod error;
mod hosts;
mod jobs;
mod limits;
mod list;
mod load;
mod log;
mod memory;
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
use serde::{Deserialize, Serialize};

pub use access::{AccessConfig, Origins};
pub use archive::ArchiveConfig;
pub use broker::BrokerConfig;
pub use devices::{DevicesConfig, JOBS_PER_DEVICE};
pub use error::ConfigError;
pub use hosts::Hosts;
pub use jobs::JobsConfig;
pub use limits::LimitsConfig;
pub use load::{ConfigSource, Loaded, load, load_process};
pub use log::{LogConfig, LogFormat};
pub use memory::{AvailableMemory, OwnedMemory};
pub use proxies::Proxies;
pub use schema::schema;
pub use server::{Role, ServerConfig};
pub use store::{Secret, StoreConfig};
pub use telemetry::{SecretHeaders, TelemetryConfig};
pub use template::{Template, Templates};

/// Complete configuration.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// Addresses, connections and their timeouts.
    pub server: ServerConfig,
    /// Limits of a request.
    pub limits: LimitsConfig,
    /// Worker pool.
    pub jobs: JobsConfig,
    /// Dispatch of asynchronous jobs.
    pub broker: BrokerConfig,
    /// GPUs.
    pub devices: DevicesConfig,
    /// Structures by PDB id.
    pub archive: ArchiveConfig,
    /// Store of inputs, results and jobs.
    pub store: StoreConfig,
    /// Keys, quotas and signed URLs.
    pub access: AccessConfig,
    /// Log.
    pub log: LogConfig,
    /// Traces.
    pub telemetry: TelemetryConfig,
}

impl Config {
    /// Returns the folder of structures by PDB id.
    #[must_use]
    pub fn archive_dir(&self) -> PathBuf {
        self.archive.dir.clone().unwrap_or_else(|| self.server.data_dir.join("archive"))
    }

    /// Returns the folder of copies from the remote archive.
    pub(crate) fn archive_cache_dir(&self) -> PathBuf {
        self.server.data_dir.join("cache").join("archive")
    }
}
