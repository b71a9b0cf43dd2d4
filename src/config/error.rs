//! Why a configuration is refused. Every message names the key and the layer that it came from.

use std::path::PathBuf;

use thiserror::Error;

use super::Source;

/// Errors of loading a configuration.
#[derive(Debug, Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("cannot read the configuration file {}: {error}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's words.
        error: std::io::Error,
    },
    /// The file is not TOML.
    #[error("{} is not valid TOML: {reason}", path.display())]
    Syntax {
        /// The file.
        path: PathBuf,
        /// The parser's words, with line and column.
        reason: String,
    },
    /// No key has this name.
    #[error("{source_layer}: unknown key `{key}`{}", nearest.as_ref().map_or(String::new(), |n| format!("; did you mean `{n}`?")))]
    UnknownKey {
        /// The key as `section.key`.
        key: String,
        /// The known key that is nearest, if one is near.
        nearest: Option<String>,
        /// The layer that it came from.
        source_layer: Source,
    },
    /// A secret is given twice.
    #[error("`{}` ({}) and `{}` ({}) exclude each other: give one of them", one.0, one.1, other.0, other.1)]
    Both {
        /// The key and the layer that it came from.
        one: (String, Source),
        /// The key that names its file, and the layer.
        other: (String, Source),
    },
    /// The file of a secret cannot be used.
    #[error("{source_layer}: `{key}`: cannot read {}: {reason}", path.display())]
    SecretFile {
        /// The key as `section.key`.
        key: String,
        /// The file.
        path: PathBuf,
        /// The system's words.
        reason: String,
        /// The layer that it came from.
        source_layer: Source,
    },
    /// A value has the wrong type or is out of range.
    #[error("{source_layer}: `{key}` is {value}; expected {expected}")]
    BadValue {
        /// The key as `section.key`.
        key: String,
        /// The value that was given.
        value: String,
        /// What was expected, in words.
        expected: String,
        /// The layer that it came from.
        source_layer: Source,
    },
}
