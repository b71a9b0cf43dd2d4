//! Ctrl-C: cancels the job, removes partial files and exits with code 130.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};

use molmesh::surface::CancelToken;

use super::error::CliError;

/// Partial files of a running command. The lock is held during the renames to the final names, so that an interrupt
/// either removes all partial files or comes after the renames.
static STAGED: Mutex<Vec<PathBuf>> = Mutex::new(Vec::new());

fn staged() -> MutexGuard<'static, Vec<PathBuf>> {
    STAGED.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Registers a file, or a folder that may be empty, which is removed unless [`commit`] renames it or [`keep`] keeps it.
pub(crate) fn stage(path: &Path) {
    staged().push(path.to_owned());
}

/// Renames each staged file of `files` to its target, the second path, unless an interrupt has removed it.
///
/// # Errors
/// Returns the number of the file whose rename failed, and the error. This file and the later ones stay staged.
pub(crate) fn commit(files: &[(&Path, &Path)]) -> Result<(), (usize, io::Error)> {
    let mut staged = staged();
    for (number, (path, target)) in files.iter().enumerate() {
        if let Some(place) = staged.iter().position(|known| known == path) {
            fs::rename(path, target).map_err(|error| (number, error))?;
            staged.swap_remove(place);
        }
    }
    Ok(())
}

/// Keeps a staged folder.
pub(crate) fn keep(path: &Path) {
    staged().retain(|known| known != path);
}

/// Removes a staged file, if it is still staged.
pub(crate) fn discard(path: &Path) {
    let mut staged = staged();
    if let Some(place) = staged.iter().position(|known| known == path) {
        remove(&staged.swap_remove(place));
    }
}

/// Removes all staged files.
fn discard_all() {
    staged().drain(..).for_each(|path| remove(&path));
}

fn remove(path: &Path) {
    // The file may be gone already, and an error here must not hide the original one.
    drop(fs::remove_file(path));
    // Only if it is an empty folder.
    drop(fs::remove_dir(path));
}

/// Cancels `token` on SIGINT and SIGTERM. Half a second later (the job may be waiting for stdin) or on a second signal,
/// the process exits. The staged files are removed in all cases.
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
        discard_all();
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
fn unwatched(error: &io::Error) -> CliError {
    CliError::Internal(format!("cannot watch for signals: {error}"))
}

/// Does nothing without signals. The system ends the process and may leave staged files.
#[cfg(not(unix))]
pub(crate) fn watch(_token: &CancelToken) -> Result<(), CliError> {
    Ok(())
}
