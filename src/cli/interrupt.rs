//! Ctrl-C: cancels the job, removes the half-written file, exits with 130.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};

use molmesh::surface::CancelToken;

use super::error::CliError;

/// The file that must not outlive a command that did not finish. The lock is held while it gets its final name,
/// so an interrupt either finds it unfinished and removes it, or finds it done.
static STAGED: Mutex<Option<PathBuf>> = Mutex::new(None);

fn staged() -> MutexGuard<'static, Option<PathBuf>> {
    STAGED.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Remembers a file that is to be removed unless [`commit`] gives it its name.
pub(crate) fn stage(path: &Path) {
    *staged() = Some(path.to_owned());
}

/// Renames the staged file to `target`.
///
/// # Errors
/// Those of the rename; the file is then still staged.
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
        // It may be gone already; and a failure here must not hide why we are giving up.
        drop(fs::remove_file(path));
    }
}

/// From now on SIGINT and SIGTERM cancel `token`. A job that does not notice within half a second (it may be
/// waiting for stdin) is ended, as it is by a second signal; the staged file is removed in any case.
#[cfg(unix)]
///
/// # Errors
/// [`CliError::Internal`] where the system does not let the process watch.
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
    let start = move || {
        let thread = std::thread::Builder::new().name("interrupt".to_owned()).spawn(watch);
        thread.map(drop).map_err(|e| unwatched(&e))
    };
    if rayon::current_thread_index().is_none() || rayon::current_num_threads() < 2 {
        return start();
    }
    // To start a thread takes as long as to read a small structure: another thread of the pool has nothing to do yet.
    rayon::spawn(move || {
        if let Err(error) = start() {
            discard();
            error.print(Style::stderr());
            super::leave(error.code())
        }
    });
    Ok(())
}

/// What it means that signals cannot be watched.
#[cfg(unix)]
fn unwatched(error: &std::io::Error) -> CliError {
    CliError::Internal(format!("cannot watch for signals: {error}"))
}

/// Without signals nothing is watched: the system ends the process, and may leave the staged file behind.
#[cfg(not(unix))]
pub(crate) fn watch(_token: &CancelToken) -> Result<(), CliError> {
    Ok(())
}
