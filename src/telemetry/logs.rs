//! The log subscriber and the panic hook.

use tracing_subscriber::EnvFilter;
use tracing_subscriber::util::SubscriberInitExt as _;

use super::TelemetryError;
use crate::config::{LogConfig, LogFormat};

/// Whether logs could be set up so.
///
/// # Errors
/// [`TelemetryError::Filter`].
pub fn check_logs(config: &LogConfig) -> Result<(), TelemetryError> {
    filter(config).map(|_filter| ())
}

fn filter(config: &LogConfig) -> Result<EnvFilter, TelemetryError> {
    EnvFilter::try_new(&config.filter)
        .map_err(|e| TelemetryError::Filter { filter: config.filter.clone(), reason: e.to_string() })
}

/// Sends logs to standard error and panics to the log.
///
/// # Errors
/// [`TelemetryError`].
pub fn init_logs(config: &LogConfig) -> Result<(), TelemetryError> {
    let filter = filter(config)?;
    let builder = tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr);
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
