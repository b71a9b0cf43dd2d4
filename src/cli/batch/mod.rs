//! Batch: several inputs of one command. Each has output files of its own, and one that fails does not stop the others.

mod inputs;
mod lines;
mod record;
mod table;

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, sync_channel};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use molmesh::surface::CancelToken;
use serde_json::Value;

use super::args::{BatchArgs, RunArgs};
use super::error::CliError;
use super::job::name_of;
use super::output::{self, is_stdio};
use super::setup::JobThreads;
use super::{backend, panics};
pub(super) use inputs::{BatchItem, is_batch};
use record::Record;

/// Number of inputs in work for each job: one more than it runs, so that it does not wait for the next.
const IN_WORK: usize = 2;

/// Inputs of a command, their outputs, and the flags for all of them.
pub(super) struct Batch<'a> {
    args: &'a BatchArgs,
    run: &'a RunArgs,
    items: Vec<BatchItem>,
    /// Folder of the outputs; `None` if there is only a joined table.
    folder: Option<&'a Path>,
    /// Extensions of the outputs of each input.
    extensions: Vec<&'static str>,
    /// Table of the areas of all inputs.
    table: Option<&'a Path>,
    jobs: usize,
}

/// Outputs of a batch.
pub(super) struct BatchOutputs<'a> {
    /// Value of `--output`.
    pub(super) output: &'a Path,
    /// Extensions of the outputs of each input.
    pub(super) extensions: Vec<&'static str>,
    /// Value of `--table`.
    pub(super) table: Option<&'a Path>,
    /// Value of `--map`, an input that no output may replace.
    pub(super) map: Option<&'a Path>,
}

/// Report of an input, and its table if that is not in a file.
pub(super) struct ItemResult {
    /// JSON report.
    pub(super) document: Value,
    /// Table of the areas, if it is not in a file.
    pub(super) table: Option<Vec<u8>>,
}

/// End of the work on an input.
enum ItemEnd {
    Written(ItemResult),
    Skipped,
    Failed(CliError),
}

impl ItemEnd {
    /// Returns the size of the table in memory.
    fn table_bytes(&self) -> usize {
        match self {
            Self::Written(ItemResult { table: Some(table), .. }) => table.len(),
            _ => 0,
        }
    }
}

impl<'a> Batch<'a> {
    /// Collects the inputs and checks the names of all outputs. `is_file` is true if the name of an output is that of a
    /// file, not of a folder.
    pub(super) fn new(
        inputs: &[PathBuf],
        args: &'a BatchArgs,
        run: &'a RunArgs,
        BatchOutputs { output, extensions, table, map }: BatchOutputs<'a>,
        is_file: impl Fn(&Path) -> bool,
    ) -> Result<Self, CliError> {
        backend::check_threads("jobs", args.jobs)?;
        backend::check_threads("threads", run.threads)?;
        let items = inputs::collect(inputs, args.list.as_deref())?;
        // `areas` writes one table if a file is named.
        let names_table = || is_stdio(output) || output.exists() || is_file(output);
        let is_table = extensions == ["csv"] && !output.is_dir() && !output::ends_in_slash(output) && names_table();
        let (folder, table) = match table {
            Some(table) if is_table => {
                let (first, second) = (output.display(), table.display());
                return Err(CliError::usage(format!("`{first}` and `{second}` are two tables of all inputs")));
            }
            None if is_table => (None, Some(output)),
            table => (Some(output), table),
        };
        if let Some(folder) = folder {
            check_folder(folder, &is_file)?;
        } else if args.skip_existing {
            let message = "`--skip-existing` needs a file for each input";
            return Err(CliError::usage_with_hint(message, "name a folder with -o, and the joined table with --table"));
        }
        let summary = args.summary.as_deref();
        if let (Some(table), Some(summary)) = (table, summary) {
            output::refuse_same(table, summary)?;
        }
        let others: Vec<&Path> = table.into_iter().chain(summary).collect();
        for input in args.list.as_deref().into_iter().chain(map) {
            others.iter().try_for_each(|other| output::refuse_input(input, other))?;
        }
        inputs::check_outputs(&items, folder, &extensions, &others)?;
        let jobs = args.jobs.unwrap_or(1).min(items.len()).max(1);
        Ok(Self { args, run, items, folder, extensions, table, jobs })
    }

    /// Returns true if the list of inputs is stdin.
    pub(super) fn reads_stdin(&self) -> bool {
        self.args.list.as_deref().is_some_and(is_stdio)
    }

    /// Returns true if each input has output files, not only rows of the joined table.
    pub(super) fn has_folder(&self) -> bool {
        self.folder.is_some()
    }

    /// Returns the path of the output of an item with this extension, and creates its folder.
    pub(super) fn output(&self, item: &BatchItem, extension: &str) -> Result<PathBuf, CliError> {
        let path = item.output(self.folder.unwrap_or(Path::new("")), extension);
        if let Some(parent) = path.parent() {
            let failed = |source| CliError::Output { name: parent.display().to_string(), source };
            fs::create_dir_all(parent).map_err(failed)?;
        }
        Ok(path)
    }

    /// Runs `work` for each input. Results are recorded in the order of the inputs.
    ///
    /// # Errors
    /// Returns [`CliError::Batch`] if inputs failed, and an error that ends the batch: an interrupt, a full disk, a
    /// missing backend.
    pub(super) fn run(
        &self,
        cancel: &CancelToken,
        work: impl Fn(&BatchItem, &JobThreads) -> Result<ItemResult, CliError> + Sync,
    ) -> Result<(), CliError> {
        let threads: Vec<JobThreads> =
            (0..self.jobs).map(|_| JobThreads::share(self.run.threads, self.jobs)).collect::<Result<_, _>>()?;
        let mut record = Record::new(self, cancel)?;
        let is_stopped = AtomicBool::new(false);
        // Both have room for all inputs in work.
        let (to_do, queue) = sync_channel::<usize>(IN_WORK * self.jobs);
        let (finished, ends) = sync_channel::<(usize, ItemEnd, Duration)>(IN_WORK * self.jobs);
        let queue = Mutex::new(queue);
        let worked = std::thread::scope(|scope| {
            for threads in &threads {
                let (queue, finished, work, is_stopped) = (&queue, finished.clone(), &work, &is_stopped);
                let work_off = move || {
                    while let Some(index) = next(queue) {
                        if is_stopped.load(Ordering::Relaxed) {
                            break;
                        }
                        let (start, item) = (Instant::now(), &self.items[index]);
                        let end = if cancel.is_cancelled() {
                            ItemEnd::Failed(CliError::Interrupted)
                        } else {
                            threads.install(|| self.end(item, || work(item, threads)))
                        };
                        // No input is begun after an error that ends the batch.
                        if matches!(&end, ItemEnd::Failed(error) if error.ends_batch()) {
                            is_stopped.store(true, Ordering::Relaxed);
                        }
                        if finished.send((index, end, start.elapsed())).is_err() {
                            break;
                        }
                    }
                };
                let started = std::thread::Builder::new().spawn_scoped(scope, work_off);
                started.map_err(|error| CliError::Internal(format!("cannot start a thread: {error}")))?;
            }
            drop(finished);
            record.collect(to_do, &ends, &is_stopped);
            Ok(())
        });
        worked.and_then(|()| record.finish(cancel))
    }

    /// Works on an item, unless its files exist.
    fn end(&self, item: &BatchItem, work: impl FnOnce() -> Result<ItemResult, CliError>) -> ItemEnd {
        let written = |extension: &&str| self.folder.is_some_and(|folder| item.output(folder, extension).is_file());
        if self.args.skip_existing && self.extensions.iter().all(written) {
            return ItemEnd::Skipped;
        }
        panics::caught(work).map_or_else(|error| ItemEnd::Failed(named(error, &item.input)), ItemEnd::Written)
    }
}

/// Names the input in errors that do not name a file.
fn named(error: CliError, input: &Path) -> CliError {
    match error {
        CliError::Format(error) => CliError::Job { name: name_of(input), source: error.into(), strict_finding: None },
        CliError::Internal(message) => CliError::Internal(format!("{}: {message}", input.display())),
        error => error,
    }
}

/// Waits for the next index; `None` when all are taken.
fn next(queue: &Mutex<Receiver<usize>>) -> Option<usize> {
    queue.lock().unwrap_or_else(PoisonError::into_inner).recv().ok()
}

/// Rejects a folder that is a file, or named like one.
fn check_folder(folder: &Path, is_file: impl Fn(&Path) -> bool) -> Result<(), CliError> {
    let hint = "name a folder with -o; it is created if it does not exist";
    if is_stdio(folder) {
        return Err(CliError::usage_with_hint("several files cannot be written to stdout", hint));
    }
    if folder.exists() && !folder.is_dir() {
        return Err(CliError::usage_with_hint(format!("`{}` is not a folder", folder.display()), hint));
    }
    if !folder.exists() && !output::ends_in_slash(folder) && is_file(folder) {
        let message = format!("`{}` is the name of a file, but a folder is needed", folder.display());
        return Err(CliError::usage_with_hint(message, hint));
    }
    Ok(())
}
