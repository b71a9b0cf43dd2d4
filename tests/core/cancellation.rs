//! Every stage of a job ends soon after its cancellation.

use std::fmt::Write as _;
use std::io::{self, Write};
use std::sync::{Arc, Once, OnceLock};
use std::time::{Duration, Instant};

use molmesh::formats::{Format, GlbSink, RandomAccess};
use molmesh::picture::{PictureParams, SelectedRenderer};
use molmesh::pipeline::{self, Choice, JobError, JobLimits, Options, ProgressSink, params};
use molmesh::structure::{self, ReadLimits, Selection};
use molmesh::surface::lattice::Lattice;
use molmesh::surface::{
    Backend as _, BackendJob, CancelToken, Control, CpuBackend, Measures, MeshSink, Observer, Spheres, Stage,
    SurfaceError, SurfaceKind, SurfaceLimits, SurfaceParams, Validation,
};

/// Maximum time from the cancellation to the end of a job on an idle machine.
const LIMIT: Duration = Duration::from_millis(50);
/// Number of attempts. Other programs may delay one of them; work that does not check is late in each.
const ATTEMPTS: usize = 5;
/// Time from the start of the stage to the cancellation.
const DELAY: Duration = Duration::from_millis(5);

/// Cancels a job soon after one of its stages has begun.
struct CancelIn {
    stage: &'static str,
    delay: Duration,
    cancel: CancelToken,
    begun: Once,
    cancelled: Arc<OnceLock<Instant>>,
}

impl CancelIn {
    fn new(stage: &'static str) -> Self {
        let (cancel, cancelled) = (CancelToken::default(), Arc::default());
        Self { stage, delay: DELAY, cancel, begun: Once::new(), cancelled }
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

    /// Returns the time since the cancellation.
    fn time(&self) -> Duration {
        assert!(self.begun.is_completed(), "{} has begun", self.stage);
        self.cancelled.get().map_or(Duration::ZERO, Instant::elapsed)
    }
}

/// Returns the wall time for which a thread gets a unit of CPU time, at least 1: two threads work for 20 ms.
fn load() -> f64 {
    let cpu_ns = || {
        let used = std::fs::read_to_string("/proc/thread-self/schedstat").ok()?;
        used.split(' ').next()?.parse::<f64>().ok()
    };
    let work = || {
        let (begun, before) = (Instant::now(), cpu_ns());
        while begun.elapsed() < Duration::from_millis(20) {
            std::hint::spin_loop();
        }
        let wall_ns = begun.elapsed().as_secs_f64() * 1e9;
        cpu_ns().zip(before).map_or(1.0, |(after, before)| wall_ns / (after - before).max(1.0))
    };
    std::thread::scope(|scope| {
        let threads = [scope.spawn(work), scope.spawn(work)];
        threads.into_iter().map(|thread| thread.join().unwrap()).fold(1.0, f64::max)
    })
}

/// Checks that `run` returns a time within the limit, which grows with the load of the machine, in one of several
/// attempts.
#[track_caller]
fn assert_in_time(what: &str, run: impl FnMut() -> Duration) {
    assert_in_time_at(what, load, run);
}

#[track_caller]
fn assert_in_time_at(what: &str, load: impl Fn() -> f64, mut run: impl FnMut() -> Duration) {
    let mut times = Vec::new();
    for _ in 0..ATTEMPTS {
        let limit = LIMIT.mul_f64(load());
        let time = run();
        if time <= limit {
            return;
        }
        times.push((time, limit));
    }
    panic!("{what}: {times:?}");
}

#[test]
#[should_panic(expected = "late")]
fn work_without_checks_is_late() {
    assert_in_time_at("late", || 1.0, || LIMIT + Duration::from_millis(1));
}

/// Output that discards everything.
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

/// Returns a PDB file of atoms with these positions and chains.
fn atoms(places: impl Iterator<Item = ([f64; 3], char)>) -> Vec<u8> {
    let mut text = String::new();
    for (i, ([x, y, z], chain)) in places.enumerate() {
        let residue = i % 9999;
        writeln!(text, "ATOM      1  CA  ALA {chain}{residue:>4}    {x:>8.3}{y:>8.3}{z:>8.3}  1.00  0.00           C")
            .unwrap();
    }
    text.into_bytes()
}

/// Returns a PDB file of `n`³ separate atoms, whose surface is large.
fn lattice(n: usize) -> Vec<u8> {
    let place = |i: usize| [i % n, i / n % n, i / (n * n)].map(|k| 4.0 * k as f64);
    atoms((0..n * n * n).map(|i| (place(i), 'A')))
}

fn options(pairs: &[(&str, &str)]) -> Options {
    params::parse(pairs.iter().copied()).unwrap().options
}

#[test]
fn jobs_end_soon_after_cancellation_in_any_stage() {
    let backend = CpuBackend::new(Some(2)).unwrap();
    let choice = Choice { backend: &backend, reason: "set by a test" };
    let many = lattice(100);
    let few = lattice(20);
    let exact = options(&[("resolution", "0.4"), ("validation", "exact")]);
    for (stage, input, options) in [("read", &many, &exact), ("select", &many, &exact), ("measure", &few, &exact)] {
        assert_in_time(stage, || {
            let at = CancelIn::new(stage);
            let stopped = pipeline::run(input, options, &JobLimits::default(), &choice, &at.control(), &at, None);
            let time = at.time();
            assert!(matches!(stopped, Err(JobError::Surface(SurfaceError::Cancelled))), "{stage}");
            time
        });
    }

    let quick = options(&[("resolution", "0.4")]);
    let product = pipeline::run(&few, &quick, &JobLimits::default(), &choice, &Control::default(), &(), None).unwrap();
    assert_in_time("encode", || {
        let at = CancelIn::new("encode");
        at.start("encode");
        let written = product.file(Format::Obj).unwrap().write(&mut Output(at.cancel.clone()));
        let time = at.time();
        assert_eq!(written.unwrap_err().kind(), io::ErrorKind::BrokenPipe);
        time
    });

    let measure = |control: &Control<'_>| Measures::of(&product.mesh, Validation::Exact, control);
    let whole = Instant::now();
    assert!(measure(&Control::default()).unwrap().manifold);
    let whole = whole.elapsed();
    for part in [0.0, 0.2, 0.4, 0.6] {
        assert_in_time("measure", || {
            let at = CancelIn { delay: whole.mul_f64(part), ..CancelIn::new("measure") };
            at.start("measure");
            let stopped = measure(&at.control());
            let time = at.time();
            // The last part may be over already.
            let cancelled = matches!(stopped, Err(SurfaceError::Cancelled));
            assert!(cancelled || (part > 0.3 && stopped.is_ok()), "after {part} of {whole:?}: {stopped:?}");
            time
        });
    }
}

/// Returns atoms on a sphere of 5.3 Å, after one at its centre. With a probe, they all overlap it.
fn crowd(n: usize) -> Vec<u8> {
    let on_sphere = |i: usize| {
        let (height, turn) = (1.0 - (2 * i + 1) as f64 / n as f64, 2.399_963 * i as f64);
        let across = (1.0 - height * height).sqrt();
        [across * turn.cos(), across * turn.sin(), height].map(|c| 5.3 * c)
    };
    atoms(std::iter::once([0.0; 3]).chain((0..n).map(on_sphere)).map(|place| (place, 'A')))
}

/// Returns a crowd of `n` atoms, chain A, and `side`² atoms on a part of a sphere around it, chain B: all of them are a
/// little farther than 50 Å from the crowd, but the corners of the box around them are not.
fn distant_crowds(n: usize, side: usize) -> Vec<u8> {
    let place = |i: usize| [i % 20, i / 20 % 20, 0].map(|k| 0.001 * k as f64);
    let other = |i: usize| {
        let [y, z] = [i % side, i / side].map(|k| 10.0 * k as f64 / side as f64);
        [(50.05_f64.powi(2) - y * y - z * z).sqrt(), y, z]
    };
    atoms((0..n).map(|i| (place(i), 'A')).chain((0..side * side).map(|i| (other(i), 'B'))))
}

/// Returns a lattice whose atoms belong to chains and an assembly of 60 copies in turn.
fn assembly(n: usize) -> Vec<u8> {
    let mut text = "REMARK 350 BIOMOLECULE: 1\nREMARK 350 APPLY THE FOLLOWING TO CHAINS: A, B, C, D\n".to_owned();
    for copy in 1..=60 {
        for (row, axes) in
            ["1.000000  0.000000  0.000000", "0.000000  1.000000  0.000000", "0.000000  0.000000  1.000000"]
                .into_iter()
                .enumerate()
        {
            let shift = if row == 2 { 4.0 * (n * copy) as f64 } else { 0.0 };
            writeln!(text, "REMARK 350   BIOMT{} {copy:>3}  {axes} {shift:>14.5}", row + 1).unwrap();
        }
    }
    let place = |i: usize| [i % n, i / n % n, i / (n * n)].map(|k| 4.0 * k as f64);
    [text.into_bytes(), atoms((0..n * n * n).map(|i| (place(i), ['A', 'B', 'C', 'D'][i % 4])))].concat()
}

/// Jobs that take about 10 s or more on two threads, each large for another reason.
#[test]
fn jobs_of_ten_seconds_end_soon_after_cancellation_at_any_time() {
    let backend = CpuBackend::new(Some(2)).unwrap();
    let choice = Choice { backend: &backend, reason: "set by a test" };
    let lattice = lattice(60);
    let copies = assembly(20);
    let fine = |pairs: &[(&str, &str)]| options(&[&[("resolution", "0.25")][..], pairs].concat());
    let jobs = [
        ("ses", &lattice, fine(&[("surface", "ses")])),
        ("sas", &lattice, fine(&[("surface", "sas")])),
        ("vdw", &lattice, fine(&[("surface", "vdw")])),
        ("overlaps of one atom", &crowd(20_000), options(&[("surface", "ses"), ("resolution", "1")])),
        ("within", &distant_crowds(300_000, 310), options(&[("select", "chain A and within 50 of chain B")])),
        ("split", &copies, fine(&[("split", "chain"), ("assembly", "1")])),
        ("color", &lattice, fine(&[("color", "element"), ("atom_ids", "true")])),
        ("context", &lattice, fine(&[("context", "whole"), ("select", "elem C")])),
        ("occupancy", &lattice, fine(&[("color", "occupancy")])),
        ("max_triangles", &lattice, options(&[("max_triangles", "10000000")])),
        ("assembly", &copies, fine(&[("assembly", "1")])),
    ];
    for (what, input, options) in &jobs {
        for delay in [20, 200, 700].map(Duration::from_millis) {
            assert_in_time(&format!("{what} after {delay:?}"), || {
                let at = CancelIn { delay, ..CancelIn::new("read") };
                let stopped = pipeline::run(input, options, &JobLimits::default(), &choice, &at.control(), &at, None);
                let time = at.time();
                let cancelled = matches!(stopped, Err(JobError::Surface(SurfaceError::Cancelled)));
                assert!(cancelled, "{what} after {delay:?}: {:?}", stopped.map(|product| product.report.timings_ms));
                time
            });
        }
    }
}

#[test]
fn simplifications_and_improvements_end_soon_after_cancellation_at_any_time() {
    let backend = CpuBackend::new(Some(2)).unwrap();
    let choice = Choice { backend: &backend, reason: "set by a test" };
    for (stage, parameter) in [("simplify", ("simplify", "0.1")), ("improve", ("quality", "high"))] {
        let (input, options) = (lattice(8), options(&[("resolution", "0.5"), parameter]));
        let run = |control: &Control<'_>, progress: &dyn ProgressSink| {
            pipeline::run(&input, &options, &JobLimits::default(), &choice, control, progress, None)
        };
        let whole = run(&Control::default(), &()).unwrap().report.timings_ms[stage].as_f64().unwrap();
        let time = Duration::from_secs_f64(whole / 1e3);
        for part in [0.0, 0.2, 0.4, 0.6, 0.8] {
            assert_in_time(stage, || {
                let at = CancelIn { delay: time.mul_f64(part), ..CancelIn::new(stage) };
                let stopped = run(&at.control(), &at);
                let late = at.time();
                // The last part may be over already.
                let cancelled = matches!(stopped, Err(JobError::Surface(SurfaceError::Cancelled)));
                assert!(cancelled || (part > 0.3 && stopped.is_ok()), "{stage} after {part} of {time:?}");
                late
            });
        }
    }
}

#[test]
fn pictures_end_soon_after_cancellation_at_any_time() {
    let backend = CpuBackend::new(Some(2)).unwrap();
    let choice = Choice { backend: &backend, reason: "set by a test" };
    let coarse = options(&[("resolution", "0.7")]);
    let product =
        pipeline::run(&lattice(20), &coarse, &JobLimits::default(), &choice, &Control::default(), &(), None).unwrap();
    let picture = PictureParams { width: 2048, height: 2048, ..PictureParams::default() };
    let renderer = SelectedRenderer::cpu("set by a test");
    let draw = |at: &CancelIn| pipeline::draw(&mut product.clone(), &picture, &renderer, &at.control(), at);
    let mut whole = product.clone();
    pipeline::draw(&mut whole, &picture, &renderer, &Control::default(), &()).unwrap();
    for (stage, parts) in [("draw", &[0.0, 0.2, 0.5, 0.8][..]), ("png", &[0.0, 0.5])] {
        let time = Duration::from_secs_f64(whole.report.timings_ms[stage].as_f64().unwrap() / 1e3);
        for part in parts {
            assert_in_time(stage, || {
                let at = CancelIn { delay: time.mul_f64(*part), ..CancelIn::new(stage) };
                let stopped = draw(&at);
                let late = at.time();
                // The last part may be over already.
                let cancelled = matches!(stopped, Err(JobError::Surface(SurfaceError::Cancelled)));
                assert!(cancelled || (*part > 0.3 && stopped.is_ok()), "{stage} after {part} of {time:?}: {stopped:?}");
                late
            });
        }
    }
}

#[test]
fn placing_on_the_lattice_ends_soon_after_cancellation() {
    const N: u32 = 1_000_000;
    // All atoms in one cell, a compact structure, and a box of too many tiles for a table.
    for (half, resolution) in [(0.2, 20.0), (150.0, 0.5), (99_999.0, 0.05)] {
        let column = |k: f64| (0..N).map(|i| half * (f64::from(i) * k).sin()).collect();
        let spheres = Spheres::new(column(0.37), column(1.13), column(2.71), vec![1.7; N as usize]).unwrap();
        let params = SurfaceParams { resolution, ..SurfaceParams::default() };
        let place = |control: &Control<'_>| Lattice::new(&spheres, &params, control).map(|lattice| lattice.atoms.len());
        let whole = Instant::now();
        assert_eq!(place(&Control::default()), Ok(N as usize), "the control");
        let whole = whole.elapsed();
        for part in [0.05, 0.2, 0.4, 0.6, 0.8] {
            assert_in_time(&format!("{resolution} after {part}"), || {
                let at = CancelIn { delay: whole.mul_f64(part), ..CancelIn::new("bin") };
                at.start("bin");
                let stopped = place(&at.control());
                let time = at.time();
                // The work may be over already.
                let cancelled = stopped == Err(SurfaceError::Cancelled);
                assert!(cancelled || (part > 0.3 && stopped.is_ok()), "after {part} of {whole:?}: {stopped:?}");
                time
            });
        }
    }
}

#[test]
fn backends_end_soon_after_cancellation_in_any_stage() {
    let structure = structure::read(&lattice(24), &ReadLimits::default()).unwrap();
    let spheres: Spheres = structure::select(&structure, &Selection::default()).unwrap().spheres(&structure).unwrap();
    let backend = CpuBackend::new(Some(2)).unwrap();
    for stage in Stage::ALL.into_iter().filter(|stage| ![Stage::Measure, Stage::Improve].contains(stage)) {
        // The CPU refines isosurfaces while it interpolates.
        let surface = if stage == Stage::Refine { SurfaceKind::Ses } else { SurfaceKind::default() };
        let params = SurfaceParams { surface, resolution: 0.4, ..SurfaceParams::default() };
        assert_in_time(stage.name(), || {
            let at = CancelIn::new(stage.name());
            let sink = GlbSink::new(&Discard);
            let sink = (stage == Stage::Write).then_some(&sink as &dyn MeshSink);
            let (limits, control) = (SurfaceLimits::default(), at.control());
            let (spheres, params) = (&spheres, &params);
            let stopped = backend.write(&BackendJob { spheres, params, limits: &limits, control: &control, sink });
            let time = at.time();
            assert_eq!(stopped.map(|_| ()).unwrap_err(), SurfaceError::Cancelled, "{}", stage.name());
            time
        });
    }
}
