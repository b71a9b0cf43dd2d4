//! Log subscriber and panic hook.

use tracing_subscriber::EnvFilter;
use tracing_subscriber::util::SubscriberInitExt as _;

use super::TelemetryError;
use crate::config::{LogConfig, LogFormat};

/// Checks the log configuration.
///
/// # Errors
/// Returns [`TelemetryError::Filter`] if the filter is invalid.
pub fn check_logs(config: &LogConfig) -> Result<(), TelemetryError> {
    filter(config).map(|_filter| ())
}

fn filter(config: &LogConfig) -> Result<EnvFilter, TelemetryError> {
    EnvFilter::try_new(&config.filter)
        .map_err(|e| TelemetryError::Filter { filter: config.filter.clone(), reason: e.to_string() })
}

/// Installs the logger, which writes to standard error, and a panic hook that logs panics.
///
/// # Errors
/// Returns a [`TelemetryError`] if the filter is invalid or another logger is installed.
pub fn init_logs(config: &LogConfig) -> Result<(), TelemetryError> {
    let filter = filter(config)?;
    // A log that cannot be written loses lines. To report this on standard error would panic, because it is the log.
    let builder =
        tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).log_internal_errors(false);
    let installed = match config.format {
        LogFormat::Pretty => {
            builder.with_ansi(std::io::IsTerminal::is_terminal(&std::io::stderr())).finish().try_init()
        }
        LogFormat::Json => builder.json().flatten_event(true).finish().try_init(),
    };
    installed.map_err(|e| TelemetryError::Install { what: "the log", reason: e.to_string() })?;
    std::panic::set_hook(Box::new(|info| {
        let place = info.location().map(ToString::to_string).unwrap_or_default();
        tracing::error!(place, message = info.payload_as_str().unwrap_or("no message"), "panic");
    }));
    Ok(())
}
