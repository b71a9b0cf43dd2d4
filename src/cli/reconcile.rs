//! `molmesh reconcile`: dispatches the unfinished jobs that the broker of a cluster has lost, or lists them.

use std::time::Duration;

use molmesh::http::{Reconciled, reconcile};

use super::args::{ReconcileArgs, TextOrJson};
use super::error::CliError;
use super::page::Page;
use super::style::Style;

/// Time limit for the broker to answer.
const WAIT: Duration = Duration::from_secs(10);
/// Maximum number of jobs that the text lists.
const MAX_LISTED: usize = 20;

/// Runs the command.
pub(super) fn run(args: &ReconcileArgs) -> Result<(), CliError> {
    let config = super::config::load_with(args.config.as_deref(), &args.set, [])?.config;
    let url = config.broker.url.as_deref().ok_or_else(|| CliError::Usage {
        message: "the configuration has no broker.url".to_owned(),
        hint: Some("a service without a broker dispatches the jobs of its store when it starts".to_owned()),
    })?;
    let failed = |e: std::io::Error| CliError::Service(format!("cannot start the runtime: {e}"));
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().map_err(failed)?;
    let found = runtime.block_on(reconcile(&config, url, args.dry_run, WAIT));
    let found = found.map_err(|error| CliError::Service(error.to_string()))?;
    super::print(&match args.report {
        TextOrJson::Text => text(&found, args.dry_run),
        TextOrJson::Json => {
            let document = serde_json::to_value(&found).map_err(|error| CliError::Internal(error.to_string()))?;
            super::config::pretty(&document)
        }
    })?;
    found.error.map_or(Ok(()), |error| Err(CliError::Service(format!("stopped after an error of the broker: {error}"))))
}

/// Formats the result as text.
fn text(found: &Reconciled, dry_run: bool) -> String {
    let Reconciled { unfinished, dispatched, other_release_count, unreadable, lost, error: _ } = found;
    let mut page = Page::new(Style::stdout(), "jobs", &format!("{unfinished} unfinished on record"));
    let state = if dry_run { "not dispatched (--dry-run)".to_owned() } else { format!("{dispatched} dispatched") };
    page.row("lost", &format!("{} without a message in the broker, {state}", lost.len()));
    for job in lost.iter().take(MAX_LISTED) {
        page.row("", &format!("{} {}, accepted at {}", job.id, job.status, job.created));
    }
    if lost.len() > MAX_LISTED {
        page.row("", &format!("and {} others", lost.len() - MAX_LISTED));
    }
    if *other_release_count > 0 {
        page.row("left", &format!("{other_release_count} jobs to the releases that wrote their records"));
    }
    if *unreadable > 0 {
        page.row(
            "unreadable",
            &format!("{unreadable} damaged records; the next node that reads them moves them into quarantine"),
        );
    }
    page.finish()
}
