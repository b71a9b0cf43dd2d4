//! The four programs, timed alike: from spheres to a mesh in the host's memory.

use std::sync::Arc;
use std::time::Instant;

use clap::ValueEnum;
use molmesh::gpu::bench::{self, Opened};
use molmesh::gpu::{Engine, Executor, Finished, GpuJob, Look, Paper, Prepared, discover};
use molmesh::pipeline::StageClock;
use molmesh::surface::reference::Density;
use molmesh::surface::{
    Backend, CancelToken, Control, CpuBackend, DeviceChoice, ReferenceBackend, Spheres, SurfaceParams,
};

use super::super::measure::{LIMITS, Spread};
use super::memory;
use super::result::{Device, Timed, digits};

/// A program of the comparison.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Program {
    /// One thread, every atom at every sample, double precision: the paper's CPU program
    Reference,
    /// Every core, vectors, sparse bricks
    Cpu,
    /// The paper's GPU program on today's device
    Paper,
    /// Our stages on the device
    Gpu,
}

impl Program {
    pub(super) const ALL: [Self; 4] = [Self::Reference, Self::Cpu, Self::Paper, Self::Gpu];

    /// Its name, as `--programs` takes it.
    pub(super) const fn name(self) -> &'static str {
        match self {
            Self::Reference => "reference",
            Self::Cpu => "cpu",
            Self::Paper => "paper",
            Self::Gpu => "gpu",
        }
    }

    /// Whether it needs a device.
    pub(super) const fn on_device(self) -> bool {
        matches!(self, Self::Paper | Self::Gpu)
    }
}

/// One run.
#[derive(Debug, Default)]
pub(super) struct Sample {
    pub(super) seconds: f64,
    /// Whether `stages` are by a device's clock.
    pub(super) on_device: bool,
    /// s.
    pub(super) stages: Vec<(&'static str, f64)>,
    pub(super) triangles: usize,
}

/// Something that can be timed.
pub(super) trait Runner {
    /// Meshes once.
    ///
    /// # Errors
    /// In words, as the program puts it.
    fn once(&mut self, spheres: &Spheres, params: &SurfaceParams) -> Result<Sample, String>;

    /// Device memory that it holds.
    fn device_bytes(&self) -> Option<u64> {
        None
    }
}

/// Runs `runner` a few times without and `runs` times with the clock.
///
/// # Errors
/// Those of the runner.
pub(super) fn timed(
    runner: &mut dyn Runner,
    spheres: &Spheres,
    params: &SurfaceParams,
    [warm_up, runs]: [usize; 2],
) -> Result<Timed, String> {
    for _ in 0..warm_up {
        runner.once(spheres, params)?;
    }
    let watch = memory::Watch::start();
    let samples = (0..runs).map(|_| runner.once(spheres, params)).collect::<Result<Vec<_>, _>>()?;
    let host_bytes = watch.peak();
    let spread = |of: &dyn Fn(&Sample) -> f64| {
        let spread = Spread::of(samples.iter().map(of).collect());
        Spread { median: digits(spread.median), min: digits(spread.min) }
    };
    let first = samples.first().ok_or("no run")?;
    let sum = |s: &Sample| s.stages.iter().map(|(_, s)| s).sum();
    let stage = |(i, (name, _)): (usize, &(&'static str, f64))| {
        let of = |s: &Sample| s.stages.get(i).map_or(0.0, |(_, s)| *s);
        ((*name).to_owned(), spread(&of).median)
    };
    Ok(Timed {
        runs,
        seconds: spread(&|s| s.seconds),
        device_seconds: (first.on_device && !first.stages.is_empty()).then(|| spread(&sum)),
        stages: first.stages.iter().enumerate().map(stage).collect(),
        triangles: first.triangles,
        host_bytes,
        device_bytes: runner.device_bytes(),
    })
}

/// A backend of the CPU.
pub(super) struct OnCpu(pub(super) Box<dyn Backend>);

impl OnCpu {
    pub(super) fn reference() -> Self {
        Self(Box::new(ReferenceBackend))
    }

    /// The native backend on so many threads, or on every core; the number of threads.
    pub(super) fn native(threads: Option<usize>) -> Result<(Self, usize), String> {
        let backend = CpuBackend::new(threads)?;
        let threads = backend.threads();
        Ok((Self(Box::new(backend)), threads))
    }
}

impl Runner for OnCpu {
    fn once(&mut self, spheres: &Spheres, params: &SurfaceParams) -> Result<Sample, String> {
        let clock = StageClock::new(&());
        let control = Control { observer: &clock, ..Control::default() };
        let start = Instant::now();
        let meshed = clock.pass(|| self.0.run(spheres, params, &LIMITS, &control)).map_err(|e| e.to_string())?;
        let seconds = start.elapsed().as_secs_f64();
        let stages = clock.finish().into_iter().map(|(name, ms)| (name, ms * 1e-3)).collect();
        Ok(Sample { seconds, on_device: false, stages, triangles: meshed.mesh.n_triangles() })
    }
}

/// Seconds that the reference will take, from the rate at which it evaluates pairs at some of the samples of a box.
pub(super) fn reference_estimate(spheres: &Spheres, params: &SurfaceParams, cubes: u64) -> f64 {
    /// Pairs of the trial: some ten milliseconds.
    const PAIRS: usize = 4_000_000;
    let Some([lo, hi]) = spheres.bounds() else { return 0.0 };
    let density = Density::new(spheres, params);
    let n = (PAIRS / spheres.len().max(1)).clamp(16, 100_000);
    let start = Instant::now();
    for i in 0..n {
        // Spread evenly over the box by the powers of the plastic number.
        let at = std::array::from_fn(|k| {
            let step = [0.819_172_513_396_164_4, 0.671_043_606_703_789_2, 0.549_700_477_901_970_3][k];
            lo[k] - 4.0 + (hi[k] - lo[k] + 8.0) * (i as f64 * step).fract()
        });
        std::hint::black_box(density.value(at));
    }
    start.elapsed().as_secs_f64() / n as f64 * cubes as f64
}

fn job(spheres: &Spheres, params: &SurfaceParams) -> Result<GpuJob, String> {
    let prepared = Prepared::new(spheres, params, &LIMITS, &Control::default()).map_err(|e| e.to_string())?;
    Ok(GpuJob { prepared: Arc::new(prepared), cancel: CancelToken::default(), deadline: None })
}

/// From spheres to a mesh on a device, and the seconds that it took.
fn whole(device: &mut impl Executor, spheres: &Spheres, params: &SurfaceParams) -> Result<(Finished, f64), String> {
    let start = Instant::now();
    let job = job(spheres, params)?;
    let finished = device.run(std::slice::from_ref(&job)).pop().ok_or("no answer")?.map_err(|e| e.to_string())?;
    Ok((finished, start.elapsed().as_secs_f64()))
}

impl Runner for Engine {
    fn once(&mut self, spheres: &Spheres, params: &SurfaceParams) -> Result<Sample, String> {
        let (finished, seconds) = whole(self, spheres, params)?;
        let stages = finished.stages.iter().map(|(stage, ns)| (stage.name(), *ns as f64 * 1e-9)).collect();
        Ok(Sample { seconds, on_device: true, stages, triangles: finished.meshed.mesh.n_triangles() })
    }

    fn device_bytes(&self) -> Option<u64> {
        Some(self.held_bytes())
    }
}

impl Runner for Paper {
    fn once(&mut self, spheres: &Spheres, params: &SurfaceParams) -> Result<Sample, String> {
        let (finished, seconds) = whole(self, spheres, params)?;
        // Zeros where the device has no clock.
        let times = self.times().map(|(stage, ns)| (stage, ns as f64 * 1e-9));
        let stages = if finished.stages.is_empty() { Vec::new() } else { times.to_vec() };
        Ok(Sample { seconds, on_device: true, stages, triangles: finished.meshed.mesh.n_triangles() })
    }

    fn device_bytes(&self) -> Option<u64> {
        Some(self.held_bytes())
    }
}

/// The device that is measured.
#[derive(Debug, Clone)]
pub(super) struct Chosen {
    number: usize,
    pub(super) device: Device,
}

/// The first device of a choice, or why there is none.
pub(super) fn choose(choice: &DeviceChoice) -> Result<Chosen, String> {
    let found = discover(choice, Look::Thorough);
    let Some(number) = found.taken().next().map(|device| device.number) else {
        return Err(found.why_none().unwrap_or_else(|| "no device".to_owned()));
    };
    let opened = bench::open(number).map_err(|e| e.to_string())?;
    let Opened { name, driver, software, .. } = opened;
    Ok(Chosen { number, device: Device { name, driver, software } })
}

impl Chosen {
    /// An engine of its own.
    ///
    /// # Errors
    /// In words, as the driver puts it.
    pub(super) fn open(&self, program: Program) -> Result<Box<dyn Runner>, String> {
        let engine = self.engine()?;
        Ok(match program {
            Program::Paper => Box::new(Paper::new(engine).map_err(|e| e.to_string())?),
            _ => Box::new(engine),
        })
    }

    /// Our stages on it.
    ///
    /// # Errors
    /// As [`Self::open`].
    pub(super) fn engine(&self) -> Result<Engine, String> {
        bench::open(self.number).map(|opened| opened.engine).map_err(|e| e.to_string())
    }
}
