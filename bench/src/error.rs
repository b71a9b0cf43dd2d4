//! Errors of the program, and its exit codes.

use std::fmt::Display;
use std::io;
use std::path::{Path, PathBuf};

/// Result with an [`Error`].
pub(crate) type Result<T> = std::result::Result<T, Error>;

/// Error of a benchmark.
#[derive(Debug, thiserror::Error)]
pub(crate) enum Error {
    /// An argument is invalid.
    #[error("{0}")]
    Usage(String),
    /// A file or folder cannot be read or written.
    #[error("{}: {source}", path.display())]
    File {
        /// Path.
        path: PathBuf,
        /// Cause.
        source: io::Error,
    },
    /// No GPU can be used.
    #[error("no GPU can be used: {0}")]
    NoDevice(String),
    /// A measurement failed.
    #[error("{0}")]
    Failed(String),
}

impl Error {
    /// Wraps the error of a module of molmesh.
    pub(crate) fn failed(error: impl Display) -> Self {
        Self::Failed(error.to_string())
    }

    /// Returns a function that converts I/O errors at `path`.
    pub(crate) fn file(path: impl AsRef<Path>) -> impl FnOnce(io::Error) -> Self {
        let path = path.as_ref().to_owned();
        move |source| Self::File { path, source }
    }

    /// Returns the exit code: 2 for arguments, like clap, and 1 for other errors.
    pub(crate) const fn code(&self) -> u8 {
        match self {
            Self::Usage(_) => 2,
            _ => 1,
        }
    }
}
