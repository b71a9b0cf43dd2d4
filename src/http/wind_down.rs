//! Shutdown of the service: finishes requests and jobs, and returns unfinished jobs to the queue.

use std::time::Duration;

use tokio::sync::watch;
use tokio::task::JoinHandle;
use tokio::time::{Instant, sleep_until, timeout};

use super::results;
use super::state::Shared;
use super::stop::{self, Stop};

/// Time for cancelled work to stop and for unfinished jobs to return to the queue.
const CANCELLING: Duration = Duration::from_secs(1);

/// Result of an orderly stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Stopped {
    /// True if every request was finished.
    pub requests_finished: bool,
    /// Number of asynchronous jobs that ended during the stop.
    pub jobs_finished: usize,
    /// Number of asynchronous jobs that returned to the queue, without a counted attempt.
    pub jobs_returned: usize,
    /// Number of asynchronous jobs whose end or return is not on record. Their attempts count.
    pub jobs_unrecorded: usize,
    /// Number of results of synchronous requests that were not stored in time. They are computed again when needed.
    pub results_unsaved: usize,
}

impl Stopped {
    /// Returns true if every request was finished and the state of every job is on record.
    #[must_use]
    pub const fn is_orderly(&self) -> bool {
        self.requests_finished && self.jobs_unrecorded == 0
    }
}

/// Shuts the service down in the phases that `orders` requests.
pub(super) async fn wind_down(
    app: &Shared,
    stop: &watch::Sender<Stop>,
    orders: &mut watch::Receiver<Stop>,
    mut serving: JoinHandle<bool>,
) -> Stopped {
    let notice = Duration::from_millis(app.config.server.termination_notice_ms.unwrap_or_default());
    if orders.has_changed().is_ok() && *orders.borrow() == Stop::Notice && !notice.is_zero() {
        stop.send_replace(Stop::Notice);
        tracing::info!(notice_ms = notice.as_millis(), "termination notice: not ready, but serving");
        drop(timeout(notice, stop::reached(orders, Stop::Drain)).await);
    }
    tracing::info!("draining: finishing requests, accepting no new ones");
    let end = Instant::now() + Duration::from_millis(app.config.server.drain_timeout_ms);
    // Only orders received from here on count as new.
    orders.borrow_and_update();
    app.job_store.stop_claiming();
    app.pool.leave();
    stop.send_replace(Stop::Drain);
    let mut served = None;
    let finish = async {
        // Requests whose bodies are still arriving may submit jobs; after the last one no job can be submitted.
        served = Some((&mut serving).await);
        app.pool.finish().await;
        all_stored(app).await;
    };
    let in_time = tokio::select! {
        () = finish => true,
        () = sleep_until(end) => false,
        () = stop::further(orders) => false,
    };
    if !in_time {
        // First the jobs, so that no attempt begins any more.
        app.job_store.return_jobs();
        stop.send_replace(Stop::Now);
        app.pool.cancel();
    }
    let served = match served {
        Some(served) => served,
        // Cancelled jobs end their requests, which respond before their connections are closed.
        None => serving.await,
    };
    drop(timeout(CANCELLING, all_stored(app)).await);
    let jobs = app.job_store.stopped_jobs();
    let stopped = Stopped {
        requests_finished: served.unwrap_or(false),
        jobs_finished: jobs.finished,
        jobs_returned: jobs.returned,
        jobs_unrecorded: jobs.unrecorded,
        results_unsaved: results::unsaved(app),
    };
    log(&stopped);
    stopped
}

/// Waits until the results of all finished work are stored and all jobs have ended or returned to the queue.
async fn all_stored(app: &Shared) {
    tokio::join!(app.job_store.all_recorded(), results::all_saved(app));
}

fn log(stopped: &Stopped) {
    let Stopped { requests_finished, jobs_finished, jobs_returned, jobs_unrecorded, results_unsaved } = *stopped;
    if jobs_unrecorded > 0 {
        tracing::error!(jobs_unrecorded, "the state of some jobs could not be recorded in time: their attempts count");
    }
    tracing::info!(requests_finished, jobs_finished, jobs_returned, jobs_unrecorded, results_unsaved, "stopped");
}
