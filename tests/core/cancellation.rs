//! Every stage of a job ends soon after its cancellation.

use std::fmt::Write as _;
use std::io::{self, Write};
use std::sync::{Arc, Once, OnceLock};
use std::time::{Duration, Instant};

use molmesh::formats::{Format, GlbSink, RandomAccess};
use molmesh::picture::{PictureParams, SelectedRenderer};
use molmesh::pipeline::{self, Choice, Job, JobError, JobLimits, ProgressSink, params};
use molmesh::structure::{self, ReadLimits, Selection};
use molmesh::surface::{
    Backend as _, CancelToken, Control, CpuBackend, Measures, MeshSink, Observer, Spheres, Stage, SurfaceError,
    SurfaceLimits, SurfaceParams, Validation,
};

/// Maximum time from the cancellation to the end of a job. Tests without optimization run beside others.
const LIMIT: Duration = Duration::from_millis(if cfg!(debug_assertions) { 500 } else { 150 });
/// The same for the exact validation.
const EXACT_LIMIT: Duration = Duration::from_millis(if cfg!(debug_assertions) { 500 } else { 50 });
/// Time from the start of the stage to the cancellation.
const DELAY: Duration = Duration::from_millis(5);

/// Cancels a job soon after one of its stages has begun.
struct CancelIn {
    stage: &'static str,
    delay: Duration,
    limit: Duration,
    cancel: CancelToken,
    begun: Once,
    cancelled: Arc<OnceLock<Instant>>,
}

impl CancelIn {
    fn new(stage: &'static str) -> Self {
        let (cancel, cancelled) = (CancelToken::default(), Arc::default());
        Self { stage, delay: DELAY, limit: LIMIT, cancel, begun: Once::new(), cancelled }
    }

    fn start(&self, stage: &'static str) {
        if stage == self.stage {
            self.begun.call_once(|| {
                let (cancel, cancelled, delay) = (self.cancel.clone(), Arc::clone(&self.cancelled), self.delay);
                std::thread::spawn(move || {
                    std::thread::sleep(delay);
                    cancelled.set(Instant::now()).unwrap();
                    cancel.cancel();
                });
            });
        }
    }

    fn control(&self) -> Control<'_> {
        Control { cancel: self.cancel.clone(), observer: self, ..Control::default() }
    }

    /// Checks that the job has just ended in time.
    fn assert_in_time(&self) {
        assert!(self.begun.is_completed(), "the stage has begun");
        let time = self.cancelled.get().map_or(Duration::ZERO, Instant::elapsed);
        assert!(time < self.limit, "{} after {:?}: {time:?}", self.stage, self.delay);
    }
}

/// Output that keeps nothing.
struct Discard;

impl RandomAccess for Discard {
    fn write_all_at(&self, _: &[u8], _: u64) -> io::Result<()> {
        Ok(())
    }
}

impl ProgressSink for CancelIn {
    fn progress(&self, stage: &'static str, _fraction: f64) {
        self.start(stage);
    }
}

impl Observer for CancelIn {
    fn span(&self, stage: Stage, work: &mut dyn FnMut()) {
        self.start(stage.name());
        work();
    }
}

/// Fails once the job is cancelled, as the outputs of the service and the command line do.
struct Output(CancelToken);

impl Write for Output {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if self.0.is_cancelled() { Err(io::ErrorKind::BrokenPipe.into()) } else { Ok(bytes.len().min(1 << 20)) }
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Returns a PDB file of `n`³ separate atoms, whose surface is large.
fn lattice(n: usize) -> Vec<u8> {
    let mut text = String::new();
    for i in 0..n * n * n {
        let [x, y, z] = [i % n, i / n % n, i / (n * n)].map(|k| 4.0 * k as f64);
        writeln!(text, "ATOM  {:>5}  CA  ALA A{:>4}    {x:>8.3}{y:>8.3}{z:>8.3}  1.00  0.00           C", 1, i % 9999)
            .unwrap();
    }
    text.into_bytes()
}

fn job(pairs: &[(&str, &str)]) -> Job {
    params::parse(pairs.iter().copied()).unwrap().job
}

#[test]
fn jobs_end_soon_after_cancellation_in_any_stage() {
    let backend = CpuBackend::new(Some(2)).unwrap();
    let choice = Choice { backend: &backend, reason: "set by a test" };
    let many = lattice(100);
    let few = lattice(20);
    let exact = job(&[("resolution", "0.4"), ("validation", "exact")]);
    for (stage, input, job) in [("read", &many, &exact), ("select", &many, &exact), ("measure", &few, &exact)] {
        let at = CancelIn::new(stage);
        let stopped = pipeline::run(input, job, &JobLimits::default(), &choice, &at.control(), &at, None);
        at.assert_in_time();
        assert!(matches!(stopped, Err(JobError::Surface(SurfaceError::Cancelled))), "{stage}");
    }

    let quick = job(&[("resolution", "0.4")]);
    let product = pipeline::run(&few, &quick, &JobLimits::default(), &choice, &Control::default(), &(), None).unwrap();
    let at = CancelIn::new("encode");
    at.start("encode");
    let written = product.file(Format::Obj).unwrap().write(&mut Output(at.cancel.clone()));
    at.assert_in_time();
    assert_eq!(written.unwrap_err().kind(), io::ErrorKind::BrokenPipe);

    let measure = |control: &Control<'_>| Measures::of(&product.mesh, Validation::Exact, control);
    let whole = Instant::now();
    assert!(measure(&Control::default()).unwrap().manifold);
    let whole = whole.elapsed();
    for part in [0.0, 0.2, 0.4, 0.6] {
        let at = CancelIn { delay: whole.mul_f64(part), limit: EXACT_LIMIT, ..CancelIn::new("measure") };
        at.start("measure");
        let stopped = measure(&at.control());
        at.assert_in_time();
        // The last part may be over already.
        let cancelled = matches!(stopped, Err(SurfaceError::Cancelled));
        assert!(cancelled || (part > 0.3 && stopped.is_ok()), "after {part} of {whole:?}: {stopped:?}");
    }
}

#[test]
fn pictures_end_soon_after_cancellation_at_any_time() {
    let backend = CpuBackend::new(Some(2)).unwrap();
    let choice = Choice { backend: &backend, reason: "set by a test" };
    let coarse = job(&[("resolution", "0.7")]);
    let product =
        pipeline::run(&lattice(20), &coarse, &JobLimits::default(), &choice, &Control::default(), &(), None).unwrap();
    let picture = PictureParams { width: 4096, height: 4096, ..PictureParams::default() };
    let renderer = SelectedRenderer::cpu("set by a test");
    let draw = |at: &CancelIn| pipeline::draw(&mut product.clone(), &picture, &renderer, &at.control(), at);
    let mut whole = product.clone();
    pipeline::draw(&mut whole, &picture, &renderer, &Control::default(), &()).unwrap();
    for (stage, parts) in [("draw", &[0.0, 0.2, 0.5, 0.8][..]), ("png", &[0.0, 0.5])] {
        let time = Duration::from_secs_f64(whole.report.timings_ms[stage].as_f64().unwrap() / 1e3);
        for part in parts {
            let at = CancelIn { delay: time.mul_f64(*part), ..CancelIn::new(stage) };
            let stopped = draw(&at);
            at.assert_in_time();
            // The last part may be over already.
            let cancelled = matches!(stopped, Err(JobError::Surface(SurfaceError::Cancelled)));
            assert!(cancelled || (*part > 0.3 && stopped.is_ok()), "{stage} after {part} of {time:?}: {stopped:?}");
        }
    }
}

#[test]
fn backends_end_soon_after_cancellation_in_any_stage() {
    let structure = structure::read(&lattice(24), &ReadLimits::default()).unwrap();
    let spheres: Spheres = structure::select(&structure, &Selection::default()).unwrap().spheres(&structure).unwrap();
    let params = SurfaceParams { resolution: 0.4, ..SurfaceParams::default() };
    let backend = CpuBackend::new(Some(2)).unwrap();
    for stage in Stage::ALL.into_iter().filter(|stage| *stage != Stage::Measure) {
        let at = CancelIn::new(stage.name());
        let sink = GlbSink::new(&Discard);
        let sink = (stage == Stage::Write).then_some(&sink as &dyn MeshSink);
        let stopped = backend.write(&spheres, &params, &SurfaceLimits::default(), &at.control(), sink);
        at.assert_in_time();
        assert_eq!(stopped.map(|_| ()).unwrap_err(), SurfaceError::Cancelled, "{}", stage.name());
    }
}
