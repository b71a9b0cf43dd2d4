//! Ctrl-C: cancels the job, removes the partial file and exits with code 130.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};

use molmesh::surface::CancelToken;

use super::error::CliError;

/// Partial file of a running command. The lock is held during the rename to the final name, so that an interrupt either
/// removes the partial file or comes after the rename.
static STAGED: Mutex<Option<PathBuf>> = Mutex::new(None);

fn staged() -> MutexGuard<'static, Option<PathBuf>> {
    STAGED.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Registers a file that is removed unless [`commit`] renames it.
pub(crate) fn stage(path: &Path) {
    *staged() = Some(path.to_owned());
}

/// Renames the staged file to `target`.
///
/// # Errors
/// Returns the error of the rename. The file stays staged.
pub(crate) fn commit(target: &Path) -> std::io::Result<()> {
    let mut staged = staged();
    if let Some(path) = staged.as_ref() {
        fs::rename(path, target)?;
        *staged = None;
    }
    Ok(())
}

/// Removes the staged file, if there is one.
pub(crate) fn discard() {
    if let Some(path) = staged().take() {
        // The file may be gone already, and an error here must not hide the original one.
        drop(fs::remove_file(path));
    }
}

/// Cancels `token` on SIGINT and SIGTERM. Half a second later (the job may be waiting for stdin) or on a second signal,
/// the process exits. The staged file is removed in all cases.
///
/// # Errors
/// Returns [`CliError::Internal`] if the signals cannot be watched.
#[cfg(unix)]
pub(crate) fn watch(token: &CancelToken) -> Result<(), CliError> {
    use std::time::Duration;

    use signal_hook::consts::{SIGINT, SIGTERM};
    use signal_hook::iterator::Signals;

    use super::error::code;
    use super::style::Style;

    fn give_up() -> ! {
        discard();
        CliError::Interrupted.print(Style::stderr());
        super::leave(code::INTERRUPTED)
    }

    let mut signals = Signals::new([SIGINT, SIGTERM]).map_err(|e| unwatched(&e))?;
    let token = token.clone();
    let watch = move || {
        let mut signals = signals.forever();
        if signals.next().is_some() {
            token.cancel();
            let grace = std::thread::spawn(|| {
                std::thread::sleep(Duration::from_millis(500));
                give_up()
            });
            if signals.next().is_some() {
                give_up()
            }
            drop(grace);
        }
    };
    let thread = std::thread::Builder::new().name("interrupt".to_owned()).spawn(watch);
    thread.map(drop).map_err(|e| unwatched(&e))
}

/// Returns the error for signals that cannot be watched.
#[cfg(unix)]
fn unwatched(error: &std::io::Error) -> CliError {
    CliError::Internal(format!("cannot watch for signals: {error}"))
}

/// Does nothing without signals. The system ends the process and may leave the staged file.
#[cfg(not(unix))]
pub(crate) fn watch(_token: &CancelToken) -> Result<(), CliError> {
    Ok(())
}
