//! Errors of access control. No message contains a secret, the text of a key or a hash.

use std::path::PathBuf;

use thiserror::Error;

/// Error in a key file.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("line {line}: {reason}")]
pub struct KeyFileError {
    /// Line number, from 1.
    pub line: usize,
    /// Cause, and the expected form.
    pub reason: String,
}

/// Errors of creating the access control.
#[derive(Debug, Error)]
pub enum AccessError {
    /// The key file cannot be read.
    #[error("cannot read access.keys_file {}: {error}", path.display())]
    Read {
        /// Key file.
        path: PathBuf,
        /// Error of the system.
        error: std::io::Error,
    },
    /// The key file is invalid.
    #[error("access.keys_file {}, {error}", path.display())]
    Keys {
        /// Key file.
        path: PathBuf,
        /// Line and cause.
        error: KeyFileError,
    },
    /// The signing keys are invalid.
    #[error("access.signing_secret: {0}")]
    Signing(String),
    /// Pages of every origin would be allowed to send credentials.
    #[error("access.cors_credentials excludes access.cors_origins = \"*\"; expected a list of origins")]
    CredentialsForAll,
}
