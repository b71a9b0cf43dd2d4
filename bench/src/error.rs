//! The errors of the program, and its exit codes.

use std::fmt::Display;
use std::io;
use std::path::{Path, PathBuf};

/// The result of everything that can fail here.
pub(crate) type Result<T> = std::result::Result<T, Error>;

/// An error, for the person who runs the benchmark.
#[derive(Debug, thiserror::Error)]
pub(crate) enum Error {
    /// An argument that cannot be used.
    #[error("{0}")]
    Usage(String),
    /// A file or folder that cannot be read or written.
    #[error("{}: {source}", path.display())]
    File {
        /// Its path.
        path: PathBuf,
        /// The cause.
        source: io::Error,
    },
    /// No GPU that can be measured.
    #[error("no GPU can be used: {0}")]
    NoDevice(String),
    /// A measurement that failed.
    #[error("{0}")]
    Failed(String),
}

impl Error {
    /// Wraps the error of a module of molmesh.
    pub(crate) fn failed(error: impl Display) -> Self {
        Self::Failed(error.to_string())
    }

    /// Returns the conversion of I/O errors at `path`.
    pub(crate) fn file(path: impl AsRef<Path>) -> impl FnOnce(io::Error) -> Self {
        let path = path.as_ref().to_owned();
        move |source| Self::File { path, source }
    }

    /// The exit code: 2 for arguments, as clap has it, and 1 for everything else.
    pub(crate) const fn code(&self) -> u8 {
        match self {
            Self::Usage(_) => 2,
            _ => 1,
        }
    }
}
