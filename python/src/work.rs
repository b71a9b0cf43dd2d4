//! Runs the work of a call on a thread, while the calling thread waits for signals and reports the progress.

use std::process;
use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::thread;
use std::time::Duration;

use molmesh_pipeline::{ProgressSink as _, Tracker};
use molmesh_surface::{CancelOnDrop, Control};
use pyo3::exceptions::{PyOSError, PyRuntimeError};
use pyo3::prelude::*;

use crate::error::Failure;

/// Interval between two checks for signals and two reports of the progress.
const POLL: Duration = Duration::from_millis(20);
/// Maximum time that cancelled work has to remove its unfinished file.
const GRACE: Duration = Duration::from_secs(1);

/// Process that used the package first. Its threads do not exist in a process forked from it.
static PROCESS: OnceLock<u32> = OnceLock::new();

/// Runs `work`, which begins with `stage`, without the global interpreter lock. `progress` gets the stage and the
/// fraction of the work that is done, on the calling thread. A signal whose handler raises an exception, such as
/// Ctrl-C, cancels the work.
///
/// # Errors
/// Returns the failure of `work`, and the exceptions of signal handlers and of `progress`.
pub(crate) fn run<T: Send + 'static>(
    py: Python<'_>,
    progress: Option<&Bound<'_, PyAny>>,
    stage: &'static str,
    work: impl FnOnce(&Control<'_>, &Tracker) -> Result<T, Failure> + Send + 'static,
) -> PyResult<T> {
    if *PROCESS.get_or_init(process::id) != process::id() {
        return Err(PyRuntimeError::new_err(
            "molmesh was used before this process was forked, and its threads do not exist here; use threads, or the \
             start method `spawn` or `forkserver` of multiprocessing",
        ));
    }
    let (stop, tracker) = (CancelOnDrop::default(), Arc::new(Tracker::default()));
    tracker.progress(stage, 0.0);
    let (cancel, seen) = (stop.0.clone(), Arc::clone(&tracker));
    let (sender, receiver) = sync_channel(1);
    let run = move || {
        let control = Control { cancel, ..Control::default() };
        // Without a receiver, the caller has been interrupted.
        drop(sender.send(work(&control, &tracker)));
    };
    thread::Builder::new().name("molmesh".to_owned()).spawn(run).map_err(|e| PyOSError::new_err(e.to_string()))?;
    let receiver = Mutex::new(receiver);
    let mut shown = None;
    let mut report = |now: (&'static str, f64)| match progress {
        Some(progress) if shown != Some(now) => {
            shown = Some(now);
            progress.call1(now).map(drop)
        }
        _ => Ok(()),
    };
    loop {
        match py.detach(|| wait(&receiver, POLL)) {
            Ok(result) => {
                let value = result?;
                report((seen.now().0, 1.0))?;
                return Ok(value);
            }
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => return Err(Failure::Panicked.into()),
        }
        if let Err(error) = py.check_signals().and_then(|()| report(seen.now())) {
            stop.0.cancel();
            drop(py.detach(|| wait(&receiver, GRACE)));
            return Err(error);
        }
    }
}

fn wait<T>(receiver: &Mutex<Receiver<T>>, time: Duration) -> Result<T, RecvTimeoutError> {
    receiver.lock().unwrap_or_else(PoisonError::into_inner).recv_timeout(time)
}
