//! Panics end a command with one line and exit code 1. With `RUST_BACKTRACE`, the usual report is printed as well.

use std::panic::{self, AssertUnwindSafe};
use std::sync::{Mutex, PoisonError};

use molmesh::structure::strict_validator;

use super::error::CliError;

/// Message and location of the last panic.
static LAST: Mutex<Option<String>> = Mutex::new(None);

/// Runs `command` and turns a panic into [`CliError::Internal`].
pub(crate) fn contained(command: impl FnOnce() -> Result<(), CliError>) -> Result<(), CliError> {
    if std::env::var_os("RUST_BACKTRACE").is_none() {
        panic::set_hook(Box::new(|info| {
            let place = info.location().map_or_else(String::new, |l| format!(" ({}:{})", l.file(), l.line()));
            let message = info.payload_as_str().unwrap_or("panic");
            *LAST.lock().unwrap_or_else(PoisonError::into_inner) = Some(format!("{message}{place}"));
        }));
    }
    strict_validator::quiet_panics();
    caught(command)
}

/// Runs `work`, part of a command in [`contained`], and turns a panic into [`CliError::Internal`].
pub(crate) fn caught<T>(work: impl FnOnce() -> Result<T, CliError>) -> Result<T, CliError> {
    panic::catch_unwind(AssertUnwindSafe(work)).unwrap_or_else(|_| {
        let last = LAST.lock().unwrap_or_else(PoisonError::into_inner).take();
        Err(CliError::Internal(last.unwrap_or_else(|| "panic".to_owned())))
    })
}
