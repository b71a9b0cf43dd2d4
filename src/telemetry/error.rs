//! Why logs, metrics or traces cannot be set up.

use thiserror::Error;

/// Why logs, metrics or traces cannot be set up.
#[derive(Debug, Error)]
pub enum TelemetryError {
    /// The log filter cannot be read.
    #[error("log.filter `{filter}` is not valid: {reason}")]
    Filter {
        /// The filter.
        filter: String,
        /// The parser's words.
        reason: String,
    },
    /// Another logger or recorder is installed in this process.
    #[error("{what} cannot be installed: {reason}")]
    Install {
        /// `the log` or `the metrics recorder`.
        what: &'static str,
        /// The library's words.
        reason: String,
    },
}
