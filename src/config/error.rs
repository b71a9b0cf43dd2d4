//! Errors of the configuration. Every message names the key and the layer that set it.

use std::path::PathBuf;

use thiserror::Error;

use super::ConfigSource;

/// Errors of loading a configuration.
#[derive(Debug, Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("cannot read the configuration file {}: {error}", path.display())]
    Read {
        /// Configuration file.
        path: PathBuf,
        /// Error of the system.
        error: std::io::Error,
    },
    /// The file is not TOML.
    #[error("{} is not valid TOML: {reason}", path.display())]
    Syntax {
        /// Configuration file.
        path: PathBuf,
        /// Message of the parser, with line and column.
        reason: String,
    },
    /// The key does not exist.
    #[error("{source_layer}: unknown key `{key}`{}", nearest.as_ref().map_or(String::new(), |n| format!("; did you mean `{n}`?")))]
    UnknownKey {
        /// Key as `section.key`.
        key: String,
        /// Most similar known key, if one is similar.
        nearest: Option<String>,
        /// Layer that set the key.
        source_layer: ConfigSource,
    },
    /// A secret is set directly and by its file.
    #[error("`{}` ({}) and `{}` ({}) exclude each other: set one of them", one.0, one.1, other.0, other.1)]
    Both {
        /// Key and layer of the secret.
        one: (String, ConfigSource),
        /// Key and layer of its file.
        other: (String, ConfigSource),
    },
    /// The file of a secret cannot be read.
    #[error("{source_layer}: `{key}`: cannot read {}: {reason}", path.display())]
    SecretFile {
        /// Key as `section.key`.
        key: String,
        /// File of the secret.
        path: PathBuf,
        /// Cause.
        reason: String,
        /// Layer that set the key.
        source_layer: ConfigSource,
    },
    /// Settings of a cluster contradict each other or are incomplete.
    #[error("{0}")]
    Contradiction(&'static str),
    /// A value has the wrong type or is out of range.
    #[error("{source_layer}: `{key}` is {value}; expected {expected}")]
    BadValue {
        /// Key as `section.key`.
        key: String,
        /// Given value.
        value: String,
        /// Expected form.
        expected: String,
        /// Layer that set the key.
        source_layer: ConfigSource,
    },
}
