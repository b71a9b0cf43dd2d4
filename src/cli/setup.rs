//! Parameters, limits and backends that all jobs of a command share.

use std::path::Path;
use std::sync::Arc;

use molmesh::formats::Format;
use molmesh::pipeline::params::Request;
use molmesh::pipeline::params::areas::AreasRequest;
use molmesh::pipeline::{self, JobLimits, MapFile, Options, SelectedBackend};
use molmesh::surface::{CancelToken, DeviceChoice, Limit};
use rayon::{ThreadPool, ThreadPoolBuilder};

use super::args::JobArgs;
use super::backend::{self, BackendRequest, Purpose, SharedBackend, n_threads};
use super::error::CliError;
use super::job::{self, CommandJob};
use super::output::{self, Output};
use super::progress::Progress;
use super::{interrupt, request};

/// Parameters, limits and backends of the jobs of a command.
pub(super) struct JobSetup<'a> {
    pub(super) args: &'a JobArgs,
    pub(super) options: Options,
    /// Parameters of the tables of areas that a command writes beside the meshes.
    pub(super) areas: Option<AreasRequest>,
    /// Parameters of the pictures that a command draws beside the meshes.
    pub(super) picture: Option<Options>,
    pub(super) strict: bool,
    pub(super) limits: JobLimits,
    pub(super) cancel: CancelToken,
    purpose: Purpose,
    /// Backend of the jobs that may use a GPU.
    backend: SharedBackend,
}

impl<'a> JobSetup<'a> {
    /// Checks the flags and watches for interrupts. `reads_stdin` is true if a structure file or the list of inputs is
    /// stdin.
    pub(super) fn new(
        purpose: Purpose,
        Request { options, strict, .. }: Request,
        limits: JobLimits,
        reads_stdin: bool,
        args: &'a JobArgs,
    ) -> Result<Self, CliError> {
        request::check(args, &BackendRequest::for_command(args, purpose), &options, reads_stdin)?;
        let cancel = CancelToken::default();
        interrupt::watch(&cancel)?;
        let backend = SharedBackend::default();
        Ok(Self { args, options, areas: None, picture: None, strict, limits, cancel, purpose, backend })
    }

    /// Opens an output of the job of `input`.
    pub(super) fn open(&self, input: &Path, output: &Path, format: Format) -> Result<Output, CliError> {
        output::refuse_input(input, output)?;
        if let Some(map) = self.args.map.as_deref() {
            output::refuse_input(map, output)?;
        }
        let output = Output::open(output, &self.cancel)?;
        output.refuse_terminal(format)?;
        Ok(output)
    }

    /// Reads a structure file.
    pub(super) fn read(&self, path: &Path) -> Result<Vec<u8>, CliError> {
        job::read(path, Limit::InflatedBytes, self.limits.read.max_inflated_bytes)
    }

    /// Reads the map, if there is one.
    pub(super) fn read_map(&mut self) -> Result<(), CliError> {
        if let Some(map) = self.args.map.as_deref() {
            // The command line makes no content keys.
            let bytes = job::read(map, Limit::MapBytes, self.limits.map.max_inflated_bytes)?;
            let map = MapFile::new(String::new(), bytes);
            if let Some(picture) = &mut self.picture {
                picture.map = Some(map.clone());
            }
            self.options.map = Some(map);
        }
        Ok(())
    }

    /// Creates the job of a structure file with the content `input`. `streamed_atoms` is the estimated number of atoms
    /// of a structure that is read later.
    pub(super) fn job<'b>(
        &'b self,
        path: &'b Path,
        input: Vec<u8>,
        streamed_atoms: Option<f64>,
        threads: &JobThreads,
        has_progress: bool,
    ) -> Result<CommandJob<'b>, CliError> {
        let mut requested = BackendRequest::for_command(self.args, self.purpose);
        let atoms = streamed_atoms.unwrap_or_else(|| pipeline::estimate_atoms(&input));
        requested.work = Some(pipeline::estimate_work(atoms, &self.options));
        let progress = Progress::new(has_progress && !self.args.run.quiet);
        CommandJob::new(self, path, input, self.select(requested, threads)?, progress)
    }

    /// Selects the backend of a job that runs on `threads`.
    fn select(
        &self,
        mut requested: BackendRequest<'_>,
        threads: &JobThreads,
    ) -> Result<Arc<SelectedBackend>, CliError> {
        if !requested.may_use_gpu() {
            requested.threads = threads.threads;
            return threads.backend.get(&requested);
        }
        if threads.pool.is_none() {
            return self.backend.get(&requested);
        }
        // A CPU beside the GPU runs on the threads of the job.
        requested.threads = None;
        let shared = self.backend.get(&requested)?;
        if shared.no_gpu.is_none() {
            return Ok(shared);
        }
        // The CPU that is used instead of a GPU has all threads, which other jobs use as well.
        let devices = &DeviceChoice::Auto;
        let small = BackendRequest { devices, threads: threads.threads, work: Some(0.0), ..requested };
        Ok(Arc::new(SelectedBackend {
            backend: Arc::clone(&threads.backend.get(&small)?.backend),
            reason: shared.reason.clone(),
            renderer: shared.renderer.clone(),
            devices: Vec::new(),
            no_gpu: shared.no_gpu.clone(),
        }))
    }
}

/// Threads of one job, and the backend that runs on them.
pub(super) struct JobThreads {
    /// Number of threads; `None` for one per core.
    threads: Option<usize>,
    /// Threads for reading, exact areas and colours; `None` for the global ones.
    pool: Option<ThreadPool>,
    backend: SharedBackend,
}

impl JobThreads {
    /// Returns the threads of a command that runs one job at a time, and sets the number of the global threads, on
    /// which reading, exact areas and colours run.
    pub(super) fn all(threads: Option<usize>) -> Result<Self, CliError> {
        backend::check_threads("threads", threads)?;
        if let Some(n) = threads {
            let built = ThreadPoolBuilder::new().num_threads(n).build_global();
            built.map_err(|error| CliError::Internal(error.to_string()))?;
        }
        Ok(Self { threads, pool: None, backend: SharedBackend::default() })
    }

    /// Returns the threads of one of `jobs` jobs at the same time, which divide `threads`.
    pub(super) fn share(threads: Option<usize>, jobs: usize) -> Result<Self, CliError> {
        if jobs == 1 {
            return Self::all(threads);
        }
        let n = (n_threads(threads) / jobs).max(1);
        let pool = ThreadPoolBuilder::new().num_threads(n).build();
        let pool = pool.map_err(|error| CliError::Internal(error.to_string()))?;
        Ok(Self { threads: Some(n), pool: Some(pool), backend: SharedBackend::default() })
    }

    /// Runs `work` on the threads.
    pub(super) fn install<T: Send>(&self, work: impl FnOnce() -> T + Send) -> T {
        match &self.pool {
            Some(pool) => pool.install(work),
            None => work(),
        }
    }
}
