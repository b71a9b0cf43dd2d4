//! Pictures drawn by a device against those of the CPU: the same view, the same samples, the same shading, up to rounding. The
//! device is the software one, which every machine can have.
#![cfg(feature = "gpu")]
#![allow(clippy::unwrap_used, reason = "tests say what they expect by panicking")]

mod tools;

use molmesh::gpu::{GpuRenderer, Look, discover};
use molmesh::picture::{CpuRenderer, Image, PictureError, PictureParams, Renderer, Style, View};
use molmesh::surface::{CancelToken, Control, DeviceChoice, Mesh, Step};
use tools::shapes::{icosphere, union};

/// Software Vulkan, which CI has: `mesa-vulkan-drivers`. Elsewhere a machine may lack it, and says so.
fn gpu(fallback: bool) -> Option<GpuRenderer> {
    let choice: DeviceChoice = "software".parse().unwrap();
    let found = discover(&choice, Look::Thorough);
    if found.taken().next().is_none() {
        assert!(std::env::var_os("CI").is_none(), "no software Vulkan: install mesa-vulkan-drivers. {found:?}");
        #[expect(clippy::print_stderr, reason = "a test that does not run says so")]
        {
            eprintln!("SKIPPED: no software Vulkan on this machine; install mesa-vulkan-drivers");
        }
        return None;
    }
    Some(GpuRenderer::start(&found, fallback.then(CpuRenderer::default)).unwrap())
}

fn params(style: Style, view: View) -> PictureParams {
    PictureParams { width: 200, height: 150, style, view, ..PictureParams::default() }
}

/// Balls in front of, beside and within each other: steps, pockets, rims.
fn balls() -> Mesh {
    let parts = [(3.0, [0.0, 0.0, 0.0]), (2.0, [4.0, 1.0, 1.0]), (1.5, [-2.0, 2.5, 4.0]), (1.0, [7.0, 0.0, 0.0])];
    let ball = |(radius, at): (f64, [f64; 3])| icosphere(4, radius, at, false);
    parts.into_iter().map(ball).reduce(|all, part| union(&all, &part)).unwrap()
}

fn of(renderer: &dyn Renderer, mesh: &Mesh, params: &PictureParams) -> Image {
    let rendered = renderer.render(mesh, params, &Control::default()).unwrap();
    assert_eq!(rendered.served, None);
    rendered.image
}

/// Pixels whose alpha differs, and among the others those of which a channel differs by more than two levels.
fn differences(a: &Image, b: &Image) -> (usize, usize) {
    assert_eq!((a.width, a.height, a.pixels.len()), (b.width, b.height, b.pixels.len()));
    let pairs = || a.pixels.iter().zip(&b.pixels);
    let alpha = pairs().filter(|(a, b)| a[3] != b[3]).count();
    let color = pairs().filter(|(a, b)| a[3] == b[3] && a.iter().zip(*b).any(|(a, b)| a.abs_diff(*b) > 2)).count();
    (alpha, color)
}

#[test]
fn a_device_draws_the_cpus_picture() {
    let Some(gpu) = gpu(false) else { return };
    assert_eq!(gpu.name(), "gpu");
    assert!(gpu.describe().contains("software"), "{}", gpu.describe());
    let (cpu, mesh) = (CpuRenderer::default(), balls());
    for (style, view, background) in [
        (Style::Gouraud, View::Front, "transparent"),
        (Style::Surface, View::Principal, "transparent"),
        (Style::Surface, View::Top, "#20406080"),
    ] {
        let params = PictureParams { background: background.parse().unwrap(), ..params(style, view) };
        let expected = of(&cpu, &mesh, &params);
        let covered = expected.pixels.iter().filter(|p| p[3] == 255).count();
        assert!(covered > 3_000, "{covered}");
        let (alpha, color) = differences(&expected, &of(&gpu, &mesh, &params));
        // A sample may lie so near to an edge that rounding decides: one pixel in a hundred of the rim, about. Half precision
        // of what is interpolated is below a level; where a sample is another triangle's, its neighbours see it too.
        assert!(alpha <= 12, "{style:?} {view:?}: {alpha} pixels of another alpha");
        assert!(color <= covered / 100, "{style:?} {view:?}: {color} of {covered} pixels of another colour");
        // The controls: another style, another view and a mesh turned inside out are found.
        let other_style = if style == Style::Surface { Style::Gouraud } else { Style::Surface };
        let other = of(&gpu, &mesh, &PictureParams { style: other_style, ..params });
        assert!(differences(&expected, &other).1 > covered / 20);
        let other = of(&gpu, &mesh, &PictureParams { azimuth: 5.0, ..params });
        assert!(differences(&expected, &other).0 > 100);
        let mut wrong = mesh.clone();
        wrong.triangles = wrong.triangles.iter().map(|[a, b, c]| [*a, *c, *b]).collect();
        assert!(differences(&expected, &of(&gpu, &wrong, &params)).1 > covered / 4);
    }
    // The same again, byte for byte, from a device that has drawn others.
    let params = params(Style::Surface, View::Front);
    assert_eq!(of(&gpu, &mesh, &params), of(&gpu, &mesh, &params));
}

#[test]
fn what_a_device_cannot_draw_is_drawn_by_the_cpu_which_says_so_or_by_nobody() {
    let (Some(alone), Some(helped)) = (gpu(false), gpu(true)) else { return };
    // Wider than any texture.
    let wide = PictureParams { width: 100_000, height: 1, ..params(Style::Gouraud, View::Front) };
    let mesh = icosphere(2, 1.0, [0.0; 3], false);
    let refused = alone.render(&mesh, &wide, &Control::default()).unwrap_err();
    assert!(matches!(&refused, PictureError::Device { why } if why.contains("a texture's side")), "{refused}");
    let rendered = helped.render(&mesh, &wide, &Control::default()).unwrap();
    let served = rendered.served.unwrap();
    assert_eq!(served.backend, "cpu");
    assert!(served.fallback_reason.unwrap().contains("the GPU could not draw it"));
    assert_eq!(rendered.image, of(&CpuRenderer::default(), &mesh, &wide));
    // What nobody draws is not handed on.
    let cancel = CancelToken::default();
    cancel.cancel();
    let control = Control { cancel, ..Control::default() };
    let small = params(Style::Surface, View::Front);
    assert_eq!(helped.render(&mesh, &small, &control), Err(PictureError::Cancelled));
    let mut packed = mesh.clone();
    packed.quantize(Step::covering(2.0));
    assert_eq!(helped.render(&packed, &small, &Control::default()), Err(PictureError::Quantized));
}
