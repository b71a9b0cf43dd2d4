//! Why access cannot be set up. No message holds a secret, a key's text or a hash.

use std::path::PathBuf;

use thiserror::Error;

/// What is wrong with a file of keys.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("line {line}: {what}")]
pub struct KeyFileError {
    /// The line, from 1.
    pub line: usize,
    /// What is wrong there, and what would be right.
    pub what: String,
}

/// Why access cannot be set up.
#[derive(Debug, Error)]
pub enum AccessError {
    /// The file of keys cannot be read.
    #[error("cannot read access.keys_file {}: {error}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's words.
        error: std::io::Error,
    },
    /// The file of keys cannot be used.
    #[error("access.keys_file {}, {error}", path.display())]
    Keys {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        error: KeyFileError,
    },
    /// The keys that sign cannot be used.
    #[error("access.signing_secret: {0}")]
    Signing(String),
    /// Every page would be sent what browsers keep for others.
    #[error("access.cors_credentials cannot go with access.cors_origins = \"*\"; expected a list of origins")]
    CredentialsForAll,
}
