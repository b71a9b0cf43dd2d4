//! Results of a batch: lines of the summary, joined table, counts, errors and progress bar.

use std::collections::BTreeMap;
use std::fs;
use std::io::{self, Write as _};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use molmesh::surface::CancelToken;
use serde_json::{Value, json};

use super::super::args::ReportStyle;
use super::super::error::{CliError, meaning};
use super::super::output::is_stdio;
use super::super::page::grouped;
use super::super::style::{Style, printable};
use super::lines::SummaryLines;
use super::table::JoinedTable;
use super::{Batch, IN_WORK, ItemEnd, ItemResult};

/// Maximum number of inputs that are in work, or whose results wait in memory for those of earlier inputs.
const WINDOW: usize = 256;
/// Size of the waiting tables, bytes, from which on no further input is handed out.
const MAX_WAITING_BYTES: usize = 64 << 20;
/// Interval between updates of the progress bar.
const INTERVAL: Duration = Duration::from_millis(80);

/// Results of a batch so far.
pub(super) struct Record<'a> {
    batch: &'a Batch<'a>,
    start: Instant,
    bar: ProgressBar,
    lines: Vec<SummaryLines>,
    table: Option<JoinedTable>,
    /// Indices of the inputs whose files were written.
    written: Vec<usize>,
    skipped: usize,
    /// Number of failed inputs for each exit code.
    failed: BTreeMap<i32, usize>,
    /// Error that ended the batch.
    fatal: Option<CliError>,
}

impl<'a> Record<'a> {
    pub(super) fn new(batch: &'a Batch<'a>, cancel: &CancelToken) -> Result<Self, CliError> {
        if let Some(folder) = batch.folder {
            let failed = |source| CliError::Output { name: folder.display().to_string(), source };
            fs::create_dir_all(folder).map_err(failed)?;
        }
        let table = batch.table.map(|path| JoinedTable::open(path, cancel)).transpose()?;
        let summary = batch.args.summary.as_deref();
        let mut lines = Vec::new();
        if let Some(path) = summary {
            lines.push(SummaryLines::open(path, batch.args.skip_existing)?);
        }
        if batch.run.report == ReportStyle::Json && !summary.is_some_and(is_stdio) {
            lines.push(if batch.table.is_some_and(is_stdio) { SummaryLines::Stderr } else { SummaryLines::Stdout });
        }
        // Hidden if stderr is not a terminal.
        let target = if batch.run.quiet { ProgressDrawTarget::hidden() } else { ProgressDrawTarget::stderr() };
        let bar = ProgressBar::with_draw_target(Some(batch.items.len() as u64), target);
        if let Ok(style) = ProgressStyle::with_template("{spinner} {pos} of {len} files [{bar:32}] {elapsed}{msg}") {
            bar.set_style(style.progress_chars("█▉▊▋▌▍▎▏ "));
        }
        bar.enable_steady_tick(INTERVAL);
        let (written, failed) = (Vec::new(), BTreeMap::new());
        Ok(Self { batch, start: Instant::now(), bar, lines, table, written, skipped: 0, failed, fatal: None })
    }

    /// Hands out the inputs and records their ends, until all are recorded or an error ends the batch.
    pub(super) fn collect(
        &mut self,
        to_do: SyncSender<usize>,
        ends: &Receiver<(usize, ItemEnd, Duration)>,
        is_stopped: &AtomicBool,
    ) {
        let (n, jobs) = (self.batch.items.len(), self.batch.jobs);
        let (mut handed_out, mut in_work, mut recorded, mut bytes) = (0, 0, 0, 0);
        let mut waiting = BTreeMap::new();
        while recorded < n && self.fatal.is_none() && !is_stopped.load(Ordering::Relaxed) {
            while handed_out < n.min(recorded + WINDOW) && in_work < IN_WORK * jobs && bytes < MAX_WAITING_BYTES {
                if to_do.send(handed_out).is_err() {
                    break;
                }
                handed_out += 1;
                in_work += 1;
            }
            let Ok((index, end, time)) = ends.recv() else { break };
            in_work -= 1;
            bytes += end.table_bytes();
            waiting.insert(index, (end, time));
            while let Some((end, time)) = waiting.remove(&recorded) {
                bytes -= end.table_bytes();
                self.add(recorded, end, time);
                recorded += 1;
            }
        }
        is_stopped.store(true, Ordering::Relaxed);
        // Workers end when the queue is closed.
        drop(to_do);
        waiting.extend(ends.iter().map(|(index, end, time)| (index, (end, time))));
        // Those behind an input that was not begun.
        for (index, (end, time)) in waiting {
            self.add(index, end, time);
        }
    }

    /// Records the end of the work on an input.
    fn add(&mut self, index: usize, end: ItemEnd, time: Duration) {
        let input = &self.batch.items[index].input;
        let line = |status: &str| json!({ "input": input.display().to_string(), "status": status });
        let added = match end {
            ItemEnd::Failed(error) if error.ends_batch() => Err(error),
            ItemEnd::Failed(error) => self.fail(index, &error, time),
            ItemEnd::Skipped => self.add_table(index, None).and_then(|()| {
                self.skipped += 1;
                self.write_line(&line("skipped"))
            }),
            ItemEnd::Written(ItemResult { document, table }) => self.add_table(index, table).and_then(|()| {
                self.written.push(index);
                let mut line = line("written");
                line["seconds"] = seconds(time).into();
                line["report"] = document;
                self.write_line(&line)
            }),
        };
        let added = added.or_else(|error| {
            // A table with other columns, or one that is gone.
            let is_of_input = matches!(error, CliError::Usage { .. } | CliError::Input { .. });
            if is_of_input { self.fail(index, &error, time) } else { Err(error) }
        });
        if let Err(error) = added {
            self.fatal.get_or_insert(error);
        }
        self.bar.inc(1);
    }

    /// Adds the table of an input, which is read from the folder if it is not in memory, to the joined table.
    fn add_table(&mut self, index: usize, table: Option<Vec<u8>>) -> Result<(), CliError> {
        let (Some(joined), item) = (&mut self.table, &self.batch.items[index]) else { return Ok(()) };
        let table = match (table, self.batch.folder) {
            (Some(table), _) => table,
            (None, Some(folder)) => {
                let path = item.output(folder, "csv");
                let failed = |source| CliError::Input { name: path.display().to_string(), source };
                fs::read(&path).map_err(failed)?
            }
            (None, None) => return Ok(()),
        };
        // The table may be on the same terminal as the bar.
        match self.bar.suspend(|| joined.add(&item.input, &table)) {
            // The joined table is discarded then; the files of the input are complete.
            Err(CliError::Interrupted) => Ok(()),
            added => added,
        }
    }

    /// Records and prints the error of an input.
    fn fail(&mut self, index: usize, error: &CliError, time: Duration) -> Result<(), CliError> {
        *self.failed.entry(error.code()).or_default() += 1;
        self.bar.set_message(format!(", {} failed", self.n_failed()));
        self.bar.suspend(|| error.print(Style::stderr()));
        self.write_line(&json!({
            "input": self.batch.items[index].input.display().to_string(),
            "status": "failed",
            "seconds": seconds(time),
            "exit_code": error.code(),
            "error": error.to_string(),
            "hint": error.hint(),
        }))
    }

    fn write_line(&mut self, line: &Value) -> Result<(), CliError> {
        self.bar.suspend(|| self.lines.iter_mut().try_for_each(|lines| lines.write(line)))
    }

    fn n_failed(&self) -> usize {
        self.failed.values().sum()
    }

    /// Completes the joined table, prints the counts and returns the result of the batch.
    pub(super) fn finish(mut self, cancel: &CancelToken) -> Result<(), CliError> {
        self.bar.finish_and_clear();
        if cancel.is_cancelled() {
            self.fatal.get_or_insert(CliError::Interrupted);
        }
        // A part of the table would look like all of it.
        if let Some(table) = self.table.take().filter(|_| self.fatal.is_none())
            && let Err(error) = table.finish()
        {
            self.fatal = Some(error);
        }
        if !self.batch.run.quiet && self.batch.run.report == ReportStyle::Text {
            // A closed stderr is ignored; the exit code still reports failures.
            drop(io::stderr().write_all(self.text().as_bytes()));
        }
        match self.fatal {
            Some(error) => Err(error),
            None if self.failed.is_empty() => Ok(()),
            None => Err(CliError::Batch {
                failed: self.n_failed(),
                files: self.batch.items.len(),
                reasons: reasons(&self.failed),
            }),
        }
    }

    /// Formats the counts. After an error that ended the batch, also lists the written files if no summary does.
    fn text(&self) -> String {
        let Batch { items, folder, extensions, .. } = self.batch;
        let mut text = Vec::new();
        if let Some(folder) = folder.filter(|_| self.fatal.is_some() && self.lines.is_empty()) {
            let files = |&index: &usize| {
                let item = &items[index];
                extensions.iter().map(move |extension| item.output(folder, extension))
            };
            text.extend(
                self.written
                    .iter()
                    .flat_map(files)
                    .map(|path| printable(&format!("wrote {}", path.display())).into_owned()),
            );
        }
        let [all, written, skipped, failed] =
            [items.len(), self.written.len(), self.skipped, self.n_failed()].map(|n| grouped(n as u64));
        let seconds = self.start.elapsed().as_secs_f64();
        let counts = format!("{all} files: {written} written, {skipped} skipped, {failed} failed, in {seconds:.1} s");
        let end = match (&self.fatal, folder) {
            (Some(_), Some(_)) => "; continue with --skip-existing",
            (Some(_), None) => "; the table is not written",
            (None, _) => "",
        };
        text.push(format!("{counts}{end}\n"));
        text.join("\n")
    }
}

/// Returns the seconds of a line, rounded to milliseconds.
fn seconds(time: Duration) -> f64 {
    (time.as_secs_f64() * 1e3).round() / 1e3
}

/// Lists the meanings of exit codes, each with its number of inputs.
fn reasons(failed: &BTreeMap<i32, usize>) -> String {
    let reason = |(code, n): (&i32, &usize)| format!("{} ({})", meaning(*code), grouped(*n as u64));
    failed.iter().map(reason).collect::<Vec<_>>().join(", ")
}
