//! Pictures compared with independent results: the silhouette of a sphere, Lambert's law, the orientation of rods, and
//! a PNG reader of another program.

#![allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "pixels of small pictures")]

use crate::tools;

use std::f64::consts::PI;
use std::sync::Arc;

use molmesh::picture::light::{AMBIENT, COLOR, DIFFUSE, LIGHT, linear, srgb};
use molmesh::picture::{
    Background, CpuRenderer, Image, PictureError, PictureParams, Rendered, Renderer, Style, View, png,
};
use molmesh::surface::{CancelToken, Control, Mesh, Step};
use tools::shapes::{icosphere, two_spheres, union};

fn params(style: Style, view: View) -> PictureParams {
    PictureParams { width: 240, height: 200, style, view, ..PictureParams::default() }
}

fn render(mesh: &Mesh, params: &PictureParams) -> Rendered {
    CpuRenderer.render(&Arc::new(mesh.clone()), params, &Control::default()).unwrap()
}

fn image(mesh: &Mesh, params: &PictureParams) -> Image {
    render(mesh, params).image
}

/// Returns the mean difference of all channels, in levels.
fn difference(a: &Image, b: &Image) -> f64 {
    assert_eq!((a.width, a.height), (b.width, b.height));
    let of = |(a, b): (&[u8; 4], &[u8; 4])| a.iter().zip(b).map(|(a, b)| f64::from(a.abs_diff(*b))).sum::<f64>();
    a.pixels.iter().zip(&b.pixels).map(of).sum::<f64>() / (4.0 * a.pixels.len() as f64)
}

/// Returns the area and centroid of covered pixels, by alpha.
fn silhouette(image: &Image) -> (f64, [f64; 2]) {
    let (mut area, mut sum) = (0.0, [0.0; 2]);
    for y in 0..image.height {
        for x in 0..image.width {
            let share = f64::from(image.pixel(x, y)[3]) / 255.0;
            area += share;
            sum = [sum[0] + share * (f64::from(x) + 0.5), sum[1] + share * (f64::from(y) + 0.5)];
        }
    }
    (area, sum.map(|s| s / area))
}

/// Returns width and height of the covered area, in pixels.
fn extent(image: &Image) -> [u32; 2] {
    let covered = |x: &u32, y: &u32| image.pixel(*x, *y)[3] > 127;
    let columns = (0..image.width).filter(|x| (0..image.height).any(|y| covered(x, &y))).count();
    let rows = (0..image.height).filter(|y| (0..image.width).any(|x| covered(&x, y))).count();
    [columns, rows].map(|n| u32::try_from(n).unwrap())
}

/// Returns the rotation matrix of a quaternion.
fn rotation([w, x, y, z]: [f64; 4]) -> [[f64; 3]; 3] {
    let n = 2.0 / (w * w + x * x + y * y + z * z);
    [
        [1.0 - n * (y * y + z * z), n * (x * y - w * z), n * (x * z + w * y)],
        [n * (x * y + w * z), 1.0 - n * (x * x + z * z), n * (y * z - w * x)],
        [n * (x * z - w * y), n * (y * z + w * x), 1.0 - n * (x * x + y * y)],
    ]
}

fn turned(mesh: &Mesh, rows: [[f64; 3]; 3]) -> Mesh {
    let turn = |v: &[f32; 3]| rows.map(|row| (0..3).map(|k| row[k] * f64::from(v[k])).sum::<f64>() as f32);
    let mut mesh = mesh.clone();
    mesh.positions = mesh.positions.iter().map(turn).collect();
    mesh.normals = mesh.normals.iter().map(turn).collect();
    mesh
}

/// Asymmetric shape, longest along x, shortest along z.
fn lump() -> Mesh {
    let ball = |radius: f64, at: [f64; 3]| icosphere(4, radius, at, false);
    let parts = [
        ball(3.0, [0.0, 0.0, 0.0]),
        ball(2.2, [6.0, 1.0, 0.3]),
        ball(1.5, [-3.5, 3.6, 0.5]),
        ball(1.0, [10.0, 0.0, 0.0]),
    ];
    parts.iter().skip(1).fold(parts[0].clone(), |all, part| union(&all, part))
}

/// Reverses all triangles and normals.
fn inside_out(mesh: &Mesh) -> Mesh {
    let mut mesh = mesh.clone();
    mesh.normals = mesh.normals.iter().map(|n| n.map(|c| -c)).collect();
    mesh.triangles = mesh.triangles.iter().map(|[a, b, c]| [*a, *c, *b]).collect();
    mesh
}

#[test]
fn a_sphere_is_a_centred_disc_of_its_radius() {
    for style in Style::ALL {
        let params = params(style, View::Front);
        let Rendered { image, pixel, .. } = render(&icosphere(6, 4.0, [5.0, -3.0, 1.0], false), &params);
        let radius = 4.0 / pixel;
        // 92 % of the shorter side.
        assert!((radius - 92.0).abs() < 0.1, "{radius}");
        let (area, middle) = silhouette(&image);
        assert!((area / (PI * radius * radius) - 1.0).abs() < 2e-3, "{area} {}", PI * radius * radius);
        assert!((middle[0] - 120.0).abs() < 0.05 && (middle[1] - 100.0).abs() < 0.05, "{middle:?}");
    }
}

#[test]
fn a_sphere_follows_lamberts_law() {
    let radius = 92.0;
    let image = image(&icosphere(6, 4.0, [0.0; 3], false), &params(Style::Gouraud, View::Front));
    let mut seen = std::collections::BTreeSet::new();
    for (x, y) in [(120, 100), (70, 60), (100, 40), (160, 100), (180, 130), (120, 170), (60, 100), (90, 70)] {
        let [right, up] = [(f64::from(x) + 0.5 - 120.0) / radius, (100.0 - f64::from(y) - 0.5) / radius];
        let normal = [right, up, (1.0 - right * right - up * up).sqrt()];
        let cosine: f64 = normal.iter().zip(LIGHT).map(|(n, l)| n * f64::from(l)).sum();
        let light = f64::from(AMBIENT) + f64::from(DIFFUSE) * cosine.max(0.0);
        let found = image.pixel(x, y);
        for (k, level) in COLOR.into_iter().enumerate() {
            let expected = srgb(linear(level) * light);
            assert!(
                (f64::from(found[k]) - expected).abs() < 1.5,
                "({x}, {y}) {found:?}: expected {expected} for channel {k}"
            );
        }
        assert_eq!(found[3], 255);
        seen.insert(found);
    }
    assert_eq!(seen.len(), 8, "pixels of equal light");
}

#[test]
fn the_principal_view_shows_a_rod_horizontally_from_its_broad_side() {
    let mut rod = icosphere(5, 1.0, [0.0; 3], false);
    rod.positions = rod.positions.iter().map(|[x, y, z]| [*z, 2.0 * x, 6.0 * y]).collect();
    for quaternion in [[1.0, 0.0, 0.0, 0.0], [0.3, -0.5, 0.7, 0.2], [0.1, 0.9, -0.2, 0.4]] {
        let image = image(&turned(&rod, rotation(quaternion)), &params(Style::Gouraud, View::Principal));
        let [width, height] = extent(&image);
        // 12 × 4 Å over 92 % of 240 pixels; the third axis, 2 Å, is along the view.
        assert!(width.abs_diff(221) <= 1 && height.abs_diff(74) <= 1, "{width} × {height}");
    }
    // Control: from the front the end is visible, 2 × 4 Å.
    let [width, height] = extent(&image(&rod, &params(Style::Gouraud, View::Front)));
    assert!(width.abs_diff(92) <= 1 && height.abs_diff(184) <= 1, "{width} × {height}");
}

#[test]
fn the_principal_view_is_independent_of_rotation() {
    let lump = lump();
    let params = |view| PictureParams { view, ..params(Style::Surface, View::Principal) };
    let straight = image(&lump, &params(View::Principal));
    for quaternion in [[0.3, -0.5, 0.7, 0.2], [0.0, 1.0, 0.0, 0.0], [0.6, 0.1, 0.1, -0.8]] {
        let turned = turned(&lump, rotation(quaternion));
        let same = difference(&straight, &image(&turned, &params(View::Principal)));
        assert!(same < 0.25, "{quaternion:?}: {same}");
        // Control: along the axes of the file the picture differs.
        let other = difference(&image(&lump, &params(View::Front)), &image(&turned, &params(View::Front)));
        assert!(other > 10.0 * same && other > 5.0, "{quaternion:?}: {other}");
    }
}

#[test]
fn azimuth_and_elevation_equal_a_rotation_of_the_molecule() {
    let (lump, front) = (lump(), params(Style::Surface, View::Front));
    let (sin, cos) = (-40.0_f64).to_radians().sin_cos();
    let turn = [[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]];
    let walked = image(&lump, &PictureParams { azimuth: 40.0, ..front });
    let same = difference(&walked, &image(&turned(&lump, turn), &front));
    let other = difference(&walked, &image(&lump, &front));
    assert!(same < 0.05 && other > 3.0, "{same} {other}");
    let climbed = image(&lump, &PictureParams { elevation: 90.0, ..front });
    let same = difference(&climbed, &image(&lump, &params(Style::Surface, View::Top)));
    assert!(same < 0.05, "{same}");
}

#[test]
fn the_background_is_visible_around_the_surface_and_blended_at_edges() {
    let mesh = icosphere(5, 4.0, [0.0; 3], false);
    let on = |background: &str| {
        let background: Background = background.parse().unwrap();
        image(&mesh, &PictureParams { background, ..params(Style::Surface, View::Front) })
    };
    let clear = on("transparent");
    assert_eq!((clear.pixel(0, 0), clear.pixel(120, 100)[3]), ([0; 4], 255));
    for (name, corner) in [
        ("white", [255; 4]),
        ("black", [0, 0, 0, 255]),
        ("#102030", [16, 32, 48, 255]),
        ("#10203080", [16, 32, 48, 128]),
    ] {
        let picture = on(name);
        assert_eq!(picture.pixel(0, 0), corner, "{name}");
        assert_eq!(picture.pixel(120, 100), clear.pixel(120, 100), "{name}: the surface is opaque");
        // The transparent picture, blended over the colour in linear light, equals this picture.
        for (found, [r, g, b, a]) in picture.pixels.iter().zip(&clear.pixels).map(|(f, c)| (*f, *c)) {
            let (over, under) = (f64::from(a) / 255.0, f64::from(corner[3]) / 255.0);
            let alpha = over + under * (1.0 - over);
            assert!((f64::from(found[3]) - 255.0 * alpha).abs() <= 1.0, "{name}: {found:?}");
            for (k, level) in [r, g, b].into_iter().enumerate() {
                let light = (linear(level) * over + linear(corner[k]) * under * (1.0 - over)) / alpha;
                assert!((f64::from(found[k]) - srgb(light)).abs() <= 2.5, "{name}: {found:?} over {:?}", [r, g, b, a]);
            }
        }
    }
    // Edge pixels have the five coverages of four samples.
    let mut shares: Vec<u8> = clear.pixels.iter().map(|p| p[3]).collect();
    shares.sort_unstable();
    shares.dedup();
    assert_eq!(shares, [0, 64, 128, 191, 255]);
}

#[test]
fn an_inverted_surface_gives_a_different_picture() {
    for style in Style::ALL {
        let params = params(style, View::Front);
        for mesh in [lump(), icosphere(5, 4.0, [0.0; 3], false)] {
            let (right, wrong) = (image(&mesh, &params), image(&inside_out(&mesh), &params));
            assert!(difference(&right, &wrong) > 5.0, "{style:?}: {}", difference(&right, &wrong));
        }
    }
}

#[test]
fn vertex_colours_are_the_colours_of_the_picture() {
    let plain = lump();
    let of = |color: [u8; 4]| Mesh { colors: Some(vec![color; plain.n_vertices()].into()), ..plain.clone() };
    for style in [Style::Gouraud, Style::Surface] {
        let params = params(style, View::Front);
        let expected = image(&plain, &params);
        // The colour of a surface without colours of its own.
        let [r, g, b] = molmesh::picture::light::COLOR;
        let same = image(&of([r, g, b, 255]), &params);
        let differs = |a: &[u8; 4], b: &[u8; 4]| a.iter().zip(b).any(|(a, b)| a.abs_diff(*b) > 1);
        assert_eq!(expected.pixels.iter().zip(&same.pixels).filter(|(a, b)| differs(a, b)).count(), 0);
        let green = image(&of([0, 255, 0, 255]), &params);
        assert_eq!(silhouette(&green), silhouette(&expected));
        assert!(green.pixels.iter().all(|p| p[0] == 0 && p[2] == 0));
        assert!(green.pixels.iter().any(|p| p[1] > 230));
        // Half of the vertices red, the others blue: each half of the picture has its colour.
        let halves = plain.positions.iter().map(|p| if p[0] < 0.0 { [255, 0, 0, 255] } else { [0, 0, 255, 255] });
        let halved = image(&Mesh { colors: Some(halves.collect()), ..plain.clone() }, &params);
        let side = |k: usize| {
            let covered = (0..halved.height).flat_map(|y| (0..halved.width).map(move |x| (x, y)));
            let of_color = covered.filter(|(x, y)| halved.pixel(*x, *y)[k] > 60).map(|(x, _)| f64::from(x));
            let all: Vec<f64> = of_color.collect();
            all.iter().sum::<f64>() / all.len() as f64
        };
        assert!(side(0) + 20.0 < side(2), "{} {}", side(0), side(2));
    }
}

#[test]
fn the_same_pixels_on_any_number_of_threads() {
    let (mesh, params) = (lump(), params(Style::Surface, View::Principal));
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let rendered = pool.install(|| image(&mesh, &params));
        png::encode(&rendered, &Control::default()).unwrap()
    };
    let one = on(1);
    assert_eq!(one, on(2));
    assert_eq!(one, on(7));
    let other = image(&mesh, &PictureParams { azimuth: 1.0, ..params });
    assert_ne!(one, png::encode(&other, &Control::default()).unwrap());
}

#[test]
fn pockets_are_darker_and_silhouette_lines_are_drawn() {
    // Two touching spheres side by side.
    let mesh = union(&icosphere(5, 3.0, [-3.0, 0.0, 0.0], false), &icosphere(5, 3.0, [3.0, 0.0, 0.0], false));
    let [plain, shaded] = [Style::Gouraud, Style::Surface].map(|style| image(&mesh, &params(style, View::Front)));
    let light = |image: &Image, x: u32, y: u32| f64::from(image.pixel(x, y)[1]);
    let ratio = |x, y| light(&shaded, x, y) / light(&plain, x, y);
    // 18.4 pixels per Å: the middle of the left sphere, its side towards the other one, its rim.
    let rim = (9..13).map(|x| ratio(x, 100)).fold(1.0, f64::min);
    let (middle, pocket) = (ratio(65, 100), ratio(115, 100));
    assert!(middle > 0.97, "{middle}");
    assert!(pocket < 0.9 && rim < 0.8, "{pocket} {rim}");
    // Shading darkens pixels and keeps the silhouette.
    let alphas = |image: &Image| image.pixels.iter().map(|p| p[3]).collect::<Vec<_>>();
    assert_eq!(alphas(&plain), alphas(&shaded));
    // One sphere in front of the other: the depth step between them is drawn as a line.
    let behind = union(&icosphere(5, 2.0, [0.0, 0.0, 9.0], false), &icosphere(5, 5.0, [0.0; 3], false));
    let [plain, shaded] = [Style::Gouraud, Style::Surface].map(|style| image(&behind, &params(style, View::Front)));
    let ratio = |x: u32, y: u32| light(&shaded, x, y) / light(&plain, x, y);
    let at_edge = (80..90).map(|x| ratio(x, 100)).fold(1.0, f64::min);
    assert!(at_edge < 0.75 && ratio(120, 100) > 0.97, "{at_edge} {}", ratio(120, 100));
}

#[test]
fn pictures_of_any_size_are_complete() {
    let mesh = two_spheres();
    for (width, height) in [(1, 1), (1, 50), (50, 1), (63, 15), (65, 17), (300, 20)] {
        let params = PictureParams { width, height, background: Background::WHITE, ..PictureParams::default() };
        let image = image(&mesh, &params);
        assert_eq!(image.pixels.len(), (width * height) as usize);
        assert!(image.pixels.iter().all(|p| p[3] == 255));
        // In a picture of one column the molecule may lie between the samples.
        let seen = image.pixels.iter().any(|p| *p != [255; 4]);
        assert!(seen || width.min(height) < 10, "{width} × {height}");
    }
}

#[test]
fn cancelled_runs_and_quantized_meshes_are_errors() {
    let (mesh, cancel) = (lump(), CancelToken::default());
    cancel.cancel();
    let control = Control { cancel, ..Control::default() };
    let params = params(Style::Surface, View::Principal);
    assert_eq!(CpuRenderer.render(&Arc::new(mesh.clone()), &params, &control), Err(PictureError::Cancelled));
    let mut packed = mesh.clone();
    packed.quantize(Step::covering(20.0));
    let refused = CpuRenderer.render(&Arc::new(packed), &params, &Control::default());
    assert_eq!(refused, Err(PictureError::Quantized));
}

#[test]
fn another_program_reads_the_same_pixels() {
    let (folder, mut paths, mut images) = (tempfile::tempdir().unwrap(), Vec::new(), Vec::new());
    for (name, background) in [("clear", Background::TRANSPARENT), ("blue", Background([32, 64, 96, 255]))] {
        let image = image(&lump(), &PictureParams { width: 61, height: 47, background, ..PictureParams::default() });
        let path = folder.path().join(format!("{name}.png"));
        std::fs::write(&path, png::encode(&image, &Control::default()).unwrap()).unwrap();
        paths.push(path);
        images.push(image);
    }
    let Some(read) = tools::png(&paths) else { return };
    for ((read, image), mode) in read.iter().zip(&images).zip(["RGBA", "RGB"]) {
        assert_eq!((read.width, read.height, read.mode.as_str(), read.srgb), (61, 47, mode, true));
        assert_eq!(read.pixels, image.pixels);
    }
    assert_ne!(read[0].pixels, read[1].pixels);
}
