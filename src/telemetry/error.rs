//! Error of setting up logs, metrics and traces.

use thiserror::Error;

/// Error of setting up logs, metrics or traces.
#[derive(Debug, Error)]
pub enum TelemetryError {
    /// The log filter cannot be read.
    #[error("log.filter `{filter}` is not valid: {reason}")]
    Filter {
        /// Filter.
        filter: String,
        /// Message of the parser.
        reason: String,
    },
    /// A part of the telemetry cannot be installed, such as a second logger in one process.
    #[error("{what} cannot be installed: {reason}")]
    Install {
        /// `the log`, `the metrics recorder` or `the trace exporter`.
        what: &'static str,
        /// Message of the library.
        reason: String,
    },
}
