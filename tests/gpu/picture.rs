//! Pictures of a device compared with those of the CPU: equal up to rounding. The device is software Vulkan.

use crate::gpu_fakes::{FakePictures, SETTINGS, Step as Does, wait_for};
use crate::tools;

use std::sync::Arc;
use std::time::{Duration, Instant};

use molmesh::gpu::{DiscoveryMode, GpuError, GpuRenderer, PoolSettings, discover};
use molmesh::picture::{CpuRenderer, Image, PictureError, PictureParams, Renderer, Style, View};
use molmesh::surface::{CancelToken, Control, DeviceChoice, Mesh, Step};
use tools::shapes::{icosphere, union};

/// Renderer on the software Vulkan device (`mesa-vulkan-drivers`). CI has it; elsewhere the test is skipped without it.
fn gpu(fallback: bool) -> Option<GpuRenderer> {
    let choice: DeviceChoice = "software".parse().unwrap();
    let found = discover(&choice, DiscoveryMode::Thorough);
    if found.selected().next().is_none() {
        return tools::skip(&format!("no software Vulkan; install mesa-vulkan-drivers ({found:?})"));
    }
    // Tests that run beside this one delay a software device.
    let settings = PoolSettings { hang_timeout: Duration::from_mins(10), ..PoolSettings::default() };
    Some(GpuRenderer::start(&found, &settings, fallback.then_some(CpuRenderer)).unwrap())
}

fn params(style: Style, view: View) -> PictureParams {
    PictureParams { width: 200, height: 150, style, view, ..PictureParams::default() }
}

/// Balls that occlude, touch and contain each other.
fn balls() -> Mesh {
    let parts = [(3.0, [0.0, 0.0, 0.0]), (2.0, [4.0, 1.0, 1.0]), (1.5, [-2.0, 2.5, 4.0]), (1.0, [7.0, 0.0, 0.0])];
    let ball = |(radius, at): (f64, [f64; 3])| icosphere(4, radius, at, false);
    parts.into_iter().map(ball).reduce(|all, part| union(&all, &part)).unwrap()
}

fn of(renderer: &dyn Renderer, mesh: &Mesh, params: &PictureParams) -> Image {
    let rendered = renderer.render(&Arc::new(mesh.clone()), params, &Control::default()).unwrap();
    assert_eq!(rendered.made_by, None);
    rendered.image
}

/// Number of pixels whose alpha differs, and of other pixels with a channel that differs by more than two levels.
fn differences(a: &Image, b: &Image) -> (usize, usize) {
    assert_eq!((a.width, a.height, a.pixels.len()), (b.width, b.height, b.pixels.len()));
    let pairs = || a.pixels.iter().zip(&b.pixels);
    let alpha = pairs().filter(|(a, b)| a[3] != b[3]).count();
    let color = pairs().filter(|(a, b)| a[3] == b[3] && a.iter().zip(*b).any(|(a, b)| a.abs_diff(*b) > 2)).count();
    (alpha, color)
}

#[test]
fn a_device_draws_the_picture_of_the_cpu() {
    let Some(gpu) = gpu(false) else { return };
    assert_eq!(gpu.name(), "gpu");
    assert!(gpu.describe().contains("software"), "{}", gpu.describe());
    let (cpu, mesh) = (CpuRenderer, balls());
    // Dark and bright tones of all channels.
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0 to 255")]
    let colors = mesh.positions.iter().map(|p| p.map(|c| (40.0 * c).rem_euclid(256.0) as u8));
    let colors = colors.map(|[r, g, b]| [r, g, b, 255]).collect();
    let colored = Mesh { colors: Some(colors), ..mesh.clone() };
    for (style, view, background, mesh) in [
        (Style::Gouraud, View::Front, "transparent", &mesh),
        (Style::Surface, View::Principal, "transparent", &mesh),
        (Style::Surface, View::Top, "#20406080", &mesh),
        (Style::Surface, View::Front, "transparent", &colored),
    ] {
        let params = PictureParams { background: background.parse().unwrap(), ..params(style, view) };
        let expected = of(&cpu, mesh, &params);
        let covered = expected.pixels.iter().filter(|p| p[3] == 255).count();
        assert!(covered > 3_000, "{covered}");
        let (alpha, color) = differences(&expected, &of(&gpu, mesh, &params));
        // Rounding decides samples very near to an edge: about one pixel in a hundred of the outline. Half precision of
        // the interpolated values is below one level, but a sample of another triangle also changes its neighbours.
        assert!(alpha <= 12, "{style:?} {view:?}: {alpha} pixels of another alpha");
        assert!(color <= covered / 100, "{style:?} {view:?}: {color} of {covered} pixels of another colour");
        // Negative controls: another style, another view and an inverted mesh.
        let other_style = if style == Style::Surface { Style::Gouraud } else { Style::Surface };
        let other = of(&gpu, mesh, &PictureParams { style: other_style, ..params });
        assert!(differences(&expected, &other).1 > covered / 20);
        let other = of(&gpu, mesh, &PictureParams { azimuth: 5.0, ..params });
        assert!(differences(&expected, &other).0 > 100);
        let mut wrong = mesh.clone();
        wrong.triangles = wrong.triangles.iter().map(|[a, b, c]| [*a, *c, *b]).collect();
        assert!(differences(&expected, &of(&gpu, &wrong, &params)).1 > covered / 4);
    }
    // The bytes do not depend on earlier pictures.
    let params = params(Style::Surface, View::Front);
    assert_eq!(of(&gpu, &mesh, &params), of(&gpu, &mesh, &params));
}

#[test]
fn pictures_end_soon_after_cancellation() {
    let Some(gpu) = gpu(false) else { return };
    let large = PictureParams { width: 2000, height: 2000, ..params(Style::Surface, View::Front) };
    let mesh = Arc::new(balls());
    let begun = Instant::now();
    gpu.render(&mesh, &large, &Control::default()).unwrap();
    let whole = begun.elapsed();
    let (cancel, other) = (CancelToken::default(), CancelToken::default());
    let render = |cancel: &CancelToken| {
        let control = Control { cancel: cancel.clone(), ..Control::default() };
        let stopped = gpu.render(&mesh, &large, &control);
        (stopped.map(|_| ()), Instant::now())
    };
    // The second picture waits for the first one.
    let (cancelled, [first, second]) = std::thread::scope(|scope| {
        let drawn = [&cancel, &other].map(|cancel| scope.spawn(move || render(cancel)));
        std::thread::sleep(whole / 4);
        let cancelled = Instant::now();
        cancel.cancel();
        other.cancel();
        (cancelled, drawn.map(|thread| thread.join().unwrap()))
    });
    for (stopped, ended) in [first, second] {
        assert_eq!(stopped, Err(PictureError::Cancelled));
        let time = ended.saturating_duration_since(cancelled);
        assert!(time < Duration::from_millis(500).max(whole / 4), "{time:?} of {whole:?}");
    }
    let small = params(Style::Surface, View::Front);
    assert_eq!(differences(&of(&CpuRenderer, &mesh, &small), &of(&gpu, &mesh, &small)).0, 0, "the device still works");
}

#[test]
fn the_cpu_is_the_fallback_and_is_reported() {
    let (Some(without), Some(with)) = (gpu(false), gpu(true)) else { return };
    // Wider than any texture.
    let wide = PictureParams { width: 100_000, height: 1, ..params(Style::Gouraud, View::Front) };
    let mesh = Arc::new(icosphere(2, 1.0, [0.0; 3], false));
    let refused = without.render(&mesh, &wide, &Control::default()).unwrap_err();
    assert!(matches!(&refused, PictureError::Device { why } if why.contains("a texture side")), "{refused}");
    let rendered = with.render(&mesh, &wide, &Control::default()).unwrap();
    let made_by = rendered.made_by.unwrap();
    assert_eq!(made_by.backend, "cpu");
    assert!(made_by.fallback_reason.unwrap().contains("the GPU could not draw it"));
    assert_eq!(rendered.image, of(&CpuRenderer, &mesh, &wide));
    // Errors of the request are not passed to the fallback.
    let cancel = CancelToken::default();
    cancel.cancel();
    let control = Control { cancel, ..Control::default() };
    let small = params(Style::Surface, View::Front);
    assert_eq!(with.render(&mesh, &small, &control), Err(PictureError::Cancelled));
    let mut packed = Mesh::clone(&mesh);
    packed.quantize(Step::covering(2.0));
    assert_eq!(with.render(&Arc::new(packed), &small, &Control::default()), Err(PictureError::Quantized));
}

/// Starts a renderer on a device that is considered hung after 200 ms, or after 600 ms in its first picture.
fn fake(pictures: &Arc<FakePictures>, fallback: bool) -> Result<GpuRenderer, GpuError> {
    fake_with(pictures, fallback, Duration::from_millis(200))
}

fn fake_with(pictures: &Arc<FakePictures>, fallback: bool, hang_timeout: Duration) -> Result<GpuRenderer, GpuError> {
    let settings = PoolSettings { hang_timeout, cool_down: Duration::from_secs(2), ..SETTINGS };
    GpuRenderer::with_build("fake".to_owned(), pictures.build(), &settings, fallback.then_some(CpuRenderer))
}

#[test]
fn a_picture_that_hangs_falls_back_and_the_device_is_used_again() {
    let (mesh, small) = (Arc::new(icosphere(2, 1.0, [0.0; 3], false)), params(Style::Gouraud, View::Front));
    let expected = of(&CpuRenderer, &mesh, &small);
    let pictures = FakePictures::new(&[Does::Hang, Does::Finish]);
    let renderer = fake(&pictures, true).unwrap();
    let render = || renderer.render(&mesh, &small, &Control::default()).unwrap();
    for n in 0..2 {
        let rendered = render();
        assert_eq!(rendered.image, expected, "{n}");
        let why = rendered.made_by.unwrap().fallback_reason.unwrap();
        assert!(why.contains("the device hung") && why.contains("600 ms"), "{why}");
    }
    assert_eq!(pictures.calls(), 1, "the second picture does not wait for the device");
    wait_for("the device to draw again", || render().made_by.is_none());
    assert_eq!(pictures.builds(), 2, "the first device was abandoned");
    pictures.release();
    // Without a fallback, the hang is an error.
    let pictures = FakePictures::new(&[Does::Hang]);
    let error = fake(&pictures, false).unwrap().render(&mesh, &small, &Control::default()).unwrap_err();
    assert!(matches!(&error, PictureError::Device { why } if why.contains("the device hung")), "{error}");
    pictures.release();
    // Panics and losses fall back as well; a lost device is opened again.
    for (step, builds) in [(Does::Panic, 2), (Does::Lose, 2), (Does::Fail, 1)] {
        let pictures = FakePictures::new(&[step, Does::Finish]);
        let renderer = fake_with(&pictures, true, Duration::from_mins(1)).unwrap();
        assert!(renderer.render(&mesh, &small, &Control::default()).unwrap().made_by.is_some(), "{step:?}");
        assert_eq!(renderer.render(&mesh, &small, &Control::default()).unwrap().made_by, None, "{step:?}");
        assert_eq!(pictures.builds(), builds, "{step:?}");
    }
}

#[test]
fn a_renderer_that_hangs_while_it_is_built_is_an_error() {
    let pictures = FakePictures::hanging_in_build();
    let begun = Instant::now();
    let error = fake(&pictures, true).map(|_| ()).unwrap_err();
    assert!(matches!(error, GpuError::Hung { after_ms: 600 }), "{error}");
    assert!(begun.elapsed() < Duration::from_secs(10));
    pictures.release();
}
