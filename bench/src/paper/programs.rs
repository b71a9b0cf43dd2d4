//! Runners of the four programs, timed from spheres to a mesh in host memory.

use std::time::Instant;

use clap::ValueEnum;
use molmesh::gpu::{Engine, Executor as _, GpuJob, Prepared};
use molmesh::pipeline::StageClock;
use molmesh::surface::reference::Density;
use molmesh::surface::{Backend, CancelToken, Control, CpuBackend, ReferenceBackend, Spheres, SurfaceParams};

use super::result::Timed;
use crate::device::Selected;
use crate::error::{Error, Result};
use crate::gpu::LIMITS;
use crate::machine::peak_memory;
use crate::program_2010::Program2010;
use crate::stats::Summary;

/// Program of the comparison.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Program {
    /// Paper's CPU program: one thread, all atoms at all grid points, double precision
    Reference,
    /// CPU backend, on all cores
    Cpu,
    /// Paper's GPU program
    Paper,
    /// GPU stages of molmesh
    Gpu,
}

impl Program {
    pub(super) const ALL: [Self; 4] = [Self::Reference, Self::Cpu, Self::Paper, Self::Gpu];

    /// Returns the name in `--programs` and in stored results.
    pub(super) const fn name(self) -> &'static str {
        match self {
            Self::Reference => "reference",
            Self::Cpu => "cpu",
            Self::Paper => "paper",
            Self::Gpu => "gpu",
        }
    }

    /// Returns true if the program needs a device.
    pub(super) const fn on_device(self) -> bool {
        matches!(self, Self::Paper | Self::Gpu)
    }

    /// Prepares a CPU program.
    ///
    /// # Errors
    /// Returns [`Error::Failed`] if its threads cannot be started.
    pub(super) fn on_cpu(self, threads: Option<usize>) -> Result<Box<dyn Runner>> {
        let backend: Box<dyn Backend> = match self {
            Self::Reference => Box::new(ReferenceBackend),
            _ => Box::new(CpuBackend::new(threads).map_err(Error::Failed)?),
        };
        Ok(Box::new(backend))
    }

    /// Prepares a GPU program.
    ///
    /// # Errors
    /// Returns [`Error::Failed`] if the driver reports an error.
    pub(super) fn on(self, selected: &Selected) -> Result<Box<dyn Runner>> {
        Ok(match self {
            Self::Paper => Box::new(Program2010::new(selected.gpu()?)?),
            _ => Box::new(selected.engine()?),
        })
    }
}

/// Measurements of one run.
#[derive(Debug)]
pub(super) struct Sample {
    seconds: f64,
    /// True if the times of the stages are device times.
    on_device: bool,
    /// Time of each stage, s.
    stages: Vec<(&'static str, f64)>,
    pub(super) triangles: usize,
}

/// Program that can be timed.
pub(super) trait Runner {
    /// Meshes once.
    ///
    /// # Errors
    /// Returns the errors of the program.
    fn once(&mut self, spheres: &Spheres, params: &SurfaceParams) -> Result<Sample>;

    /// Returns the device memory that the program holds, bytes.
    fn device_bytes(&self) -> Option<u64> {
        None
    }
}

/// Runs `runner` `warm_up` times unmeasured and `runs` times measured.
///
/// # Errors
/// Returns the errors of the runner.
pub(super) fn timed(
    runner: &mut dyn Runner,
    spheres: &Spheres,
    params: &SurfaceParams,
    [warm_up, runs]: [usize; 2],
) -> Result<Timed> {
    for _ in 0..warm_up {
        runner.once(spheres, params)?;
    }
    let measure = || (0..runs).map(|_| runner.once(spheres, params)).collect::<Result<Vec<_>>>();
    let (samples, host_bytes) = peak_memory(measure);
    let samples = samples?;
    let summary = |of: &dyn Fn(&Sample) -> f64| Summary::of(samples.iter().map(of)).rounded();
    let first = samples.first().ok_or_else(|| Error::failed("no run"))?;
    let sum = |s: &Sample| s.stages.iter().map(|(_, s)| s).sum();
    let stage = |(i, (name, _)): (usize, &(&'static str, f64))| {
        let of = |s: &Sample| s.stages.get(i).map_or(0.0, |(_, s)| *s);
        ((*name).to_owned(), summary(&of).median)
    };
    Ok(Timed {
        runs,
        seconds: summary(&|s| s.seconds),
        device_seconds: (first.on_device && !first.stages.is_empty()).then(|| summary(&sum)),
        stages: first.stages.iter().enumerate().map(stage).collect(),
        triangles: first.triangles,
        host_bytes,
        device_bytes: runner.device_bytes(),
    })
}

impl Runner for Box<dyn Backend> {
    fn once(&mut self, spheres: &Spheres, params: &SurfaceParams) -> Result<Sample> {
        let clock = StageClock::new(&());
        let control = Control { observer: &clock, ..Control::default() };
        let start = Instant::now();
        let meshed = clock.pass(|| self.run(spheres, params, &LIMITS, &control)).map_err(Error::failed)?;
        let seconds = start.elapsed().as_secs_f64();
        let stages = clock.finish().into_iter().map(|(name, ms)| (name, ms * 1e-3)).collect();
        Ok(Sample { seconds, on_device: false, stages, triangles: meshed.mesh.n_triangles() })
    }
}

impl Runner for Engine {
    fn once(&mut self, spheres: &Spheres, params: &SurfaceParams) -> Result<Sample> {
        let start = Instant::now();
        let prepared = Prepared::new(spheres, params, &LIMITS, &Control::default()).map_err(Error::failed)?;
        let job = GpuJob { prepared: prepared.into(), cancel: CancelToken::default(), deadline: None };
        let finished = self.run(&[job]).pop().ok_or_else(|| Error::failed("no result"))?.map_err(Error::failed)?;
        let seconds = start.elapsed().as_secs_f64();
        let stages = finished.stages.iter().map(|(stage, ns)| (stage.name(), *ns as f64 * 1e-9)).collect();
        Ok(Sample { seconds, on_device: true, stages, triangles: finished.meshed.mesh.n_triangles() })
    }

    fn device_bytes(&self) -> Option<u64> {
        Some(self.held_bytes())
    }
}

impl Runner for Program2010 {
    fn once(&mut self, spheres: &Spheres, params: &SurfaceParams) -> Result<Sample> {
        let start = Instant::now();
        let prepared = Prepared::new(spheres, params, &LIMITS, &Control::default()).map_err(Error::failed)?;
        let triangles = self.run(&prepared)?.n_triangles;
        let seconds = start.elapsed().as_secs_f64();
        let stages = self.steps()?.map(Vec::from).unwrap_or_default();
        Ok(Sample { seconds, on_device: true, stages, triangles })
    }

    fn device_bytes(&self) -> Option<u64> {
        Some(self.held_bytes())
    }
}

/// Estimates the time of the reference for `cubes` cubes, s, from its rate at some points of the box.
pub(super) fn reference_estimate(spheres: &Spheres, params: &SurfaceParams, cubes: u64) -> f64 {
    /// Pairs of the trial, which takes about ten milliseconds.
    const PAIRS: usize = 4_000_000;
    let Some([lo, hi]) = spheres.bounds() else { return 0.0 };
    let Ok(density) = Density::new(spheres, params) else { return 0.0 };
    let n = (PAIRS / spheres.len().max(1)).clamp(16, 100_000);
    let start = Instant::now();
    for i in 0..n {
        // Powers of the plastic number spread the points evenly.
        let at = std::array::from_fn(|k| {
            let step = [0.819_172_513_396_164_4, 0.671_043_606_703_789_2, 0.549_700_477_901_970_3][k];
            lo[k] - 4.0 + (hi[k] - lo[k] + 8.0) * (i as f64 * step).fract()
        });
        std::hint::black_box(density.value(at));
    }
    start.elapsed().as_secs_f64() / n as f64 * cubes as f64
}
