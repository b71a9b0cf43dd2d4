//! Simplified meshes remain closed manifolds near the original.

use std::f64::consts::PI;

use molmesh_surface::triangle_grid::TriangleGrid;
use molmesh_surface::vector::{length, sub};
use molmesh_surface::{Backend as _, CpuBackend, Measures, Spheres, SurfaceKind, SurfaceLimits, SurfaceOptions};
use molmesh_surface::{SurfaceParams, Validation};

use super::deviation::samples;
use super::fans::topology;
use super::piece::ClosedComponents;
use super::*;

fn within(error: f64) -> Simplify {
    Simplify { error, max_triangles: None }
}

/// Returns the mesh of spheres in a row, which overlap.
fn row(n: u32, surface: SurfaceKind, resolution: f64) -> Mesh {
    let centres = (0..n).map(|i| 2.0 * f64::from(i)).collect();
    let count = n as usize;
    let spheres = Spheres::new(centres, vec![0.3; count], vec![-0.2; count], vec![1.7; count]).unwrap();
    let options = SurfaceOptions { surface: Some(surface), resolution: Some(resolution), ..SurfaceOptions::default() };
    let params = SurfaceParams::new(&options).unwrap();
    let backend = CpuBackend::new(Some(2)).unwrap();
    let mut mesh = backend.run(&spheres, &params, &SurfaceLimits::default(), &Control::default()).unwrap().mesh;
    mesh.make_contiguous();
    mesh
}

fn measures(mesh: &Mesh) -> Measures {
    Measures::of(mesh, Validation::Exact, &Control::default()).unwrap()
}

#[test]
fn simplified_meshes_are_closed_manifolds_within_the_error() {
    for surface in [SurfaceKind::Gaussian, SurfaceKind::Ses, SurfaceKind::Vdw] {
        let mesh = row(12, surface, 0.2);
        let whole = measures(&mesh);
        let mut before = mesh.n_triangles();
        for error in [0.003, 0.01, 0.1] {
            let mut simplified = mesh.clone();
            let found = simplify(&mut simplified, within(error), 0.2, &Control::default()).unwrap();
            let m = measures(&simplified);
            let what = format!("{surface} {error}: {found:?}");
            assert!(m.closed && m.oriented && m.manifold, "{what}");
            assert_eq!((m.euler, found.triangles_before), (whole.euler, mesh.n_triangles() as u64), "{what}");
            assert!(simplified.n_triangles() < before, "{what}: {} of {before}", simplified.n_triangles());
            before = simplified.n_triangles();
            assert!(found.max_deviation < 1.5 * error && found.mean_deviation < 0.5 * error, "{what}");
            let corners = |t: &[u32; 3]| t.map(|v| simplified.position(v as usize));
            let grid = TriangleGrid::new(simplified.triangles.iter().map(corners).collect(), 0.4);
            let all = vec![true; simplified.n_triangles()];
            assert_eq!(grid.intersections(&simplified.triangles, &all), Vec::<[usize; 2]>::new(), "{what}");
            assert!((m.volume / whole.volume - 1.0).abs() < 2.0 * error, "{what}");
            // Every vertex is used, and is one of the original with its normal.
            let used: std::collections::HashSet<u32> = simplified.triangles.iter().flatten().copied().collect();
            assert_eq!(used.len(), simplified.n_vertices());
            let original: std::collections::HashSet<_> = mesh
                .positions
                .iter()
                .zip(&mesh.normals[..])
                .map(|(p, n)| (p.map(f32::to_bits), n.map(f32::to_bits)))
                .collect();
            let own = simplified.positions.iter().zip(&simplified.normals[..]);
            assert!(own.map(|(p, n)| (p.map(f32::to_bits), n.map(f32::to_bits))).all(|v| original.contains(&v)));
        }
    }
}

#[test]
fn deviations_are_distances() {
    // An octahedron instead of a sphere: the centroids of its triangles are the farthest points.
    let mesh = row(1, SurfaceKind::Vdw, 0.1);
    let at = |axis: usize, sign: f32| {
        let far = |v: &u32| sign * mesh.position(*v as usize)[axis];
        (0..to_u32(mesh.n_vertices())).max_by(|a, b| far(a).total_cmp(&far(b))).unwrap()
    };
    let corner = |axis: usize, bits: usize| at(axis, if bits >> axis & 1 == 0 { 1.0 } else { -1.0 });
    let face = |bits: usize| {
        let [x, y, z] = [0, 1, 2].map(|axis| corner(axis, bits));
        if bits.count_ones().is_multiple_of(2) { [x, y, z] } else { [y, x, z] }
    };
    let octahedron = Mesh { triangles: (0..8).map(face).collect::<Vec<_>>().into(), ..mesh.clone() };
    let sampled = |after: &Mesh| {
        let triangles = |rows| Triangles { positions: &mesh.positions, rows, parts: &[] };
        let (before, after) = (triangles(&mesh.triangles), triangles(&after.triangles));
        SimplificationReport::sampled(before, after, 0.5, CubeSide(2.4), &Control::default()).unwrap()
    };
    let found = sampled(&octahedron);
    let farthest = 1.7 * (1.0 - 1.0 / 3.0_f64.sqrt());
    assert!((found.max_deviation - farthest).abs() < 0.02, "{found:?}, expected {farthest}");
    let none = sampled(&mesh);
    // Distances have single precision.
    assert!(none.max_deviation < 1e-3, "{none:?}");
    assert!((measures(&octahedron).volume - 4.0 / 3.0 * 1.7_f64.powi(3)).abs() < 0.1 * PI);
}

#[test]
fn the_result_does_not_depend_on_the_number_of_threads() {
    let mesh = row(12, SurfaceKind::Gaussian, 0.25);
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let mut simplified = mesh.clone();
        pool.install(|| simplify(&mut simplified, within(0.05), 0.25, &Control::default()).unwrap());
        simplified
    };
    let one = on(1);
    assert_eq!(one, on(2));
    assert_eq!(one, on(7));
}

fn tetrahedron() -> [[u32; 3]; 4] {
    [[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]
}

#[test]
fn a_chord_of_two_pieces_remains_in_one() {
    let piece = |triangles: Option<u32>, chords: &[[u32; 2]], original: &[[u32; 2]]| CubeResult {
        triangles: triangles.map(|v| vec![[v; 3]]),
        chords: chords.to_vec(),
        original_chords: original.to_vec(),
    };
    let kept = |mut results: Vec<CubeResult>| {
        revert_conflicts(&mut results);
        results.iter().map(|result| result.triangles.is_none()).collect::<Vec<_>>()
    };
    let (new, other) = ([[3, 7]], [[2, 9]]);
    assert_eq!(kept(vec![piece(Some(0), &new, &[]), piece(Some(1), &other, &[])]), [false, false]);
    assert_eq!(kept(vec![piece(Some(0), &new, &[]), piece(Some(1), &new, &[])]), [false, true]);
    assert_eq!(kept(vec![piece(Some(0), &new, &[]), piece(None, &[], &new)]), [true, true]);
    // The second piece is reverted because of the first one, and the third one because of the second.
    let chain = vec![piece(Some(0), &new, &[]), piece(Some(1), &new, &other), piece(Some(2), &other, &[])];
    assert_eq!(kept(chain), [false, true, true]);
}

#[test]
fn pieces_that_are_no_manifolds_with_a_boundary_are_found() {
    // Two triangles of a square, and the same square divided the other way.
    let square = [[0, 1, 2], [0, 2, 3]];
    let boundary = topology(&square).unwrap().fans;
    assert_eq!(boundary, [([0, 1], 3), ([1, 2], 0), ([2, 3], 1), ([3, 0], 2)].into_iter().collect());
    assert_eq!(topology(&[[0, 1, 3], [1, 2, 3]]).unwrap().fans, boundary);
    assert_eq!((topology(&square).unwrap().chords, topology(&tetrahedron()).unwrap().chords), (vec![[0, 2]], vec![]));
    assert_ne!(topology(&square[..1]).unwrap().fans, boundary, "another boundary");
    assert_eq!(topology(&tetrahedron()).unwrap().fans, fans::BoundaryFans::default());
    for (what, triangles) in [
        ("degenerate", &[[0, 1, 1]][..]),
        ("an edge with three triangles", &[[0, 1, 2], [0, 1, 3]]),
        ("two equal triangles back to back", &[[0, 1, 2], [1, 0, 2]]),
        (
            "two tetrahedra at a vertex",
            &[[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2], [0, 5, 4], [0, 4, 6], [0, 6, 5], [4, 5, 6]],
        ),
        ("a tetrahedron at a boundary", &[[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2], [0, 4, 5]]),
    ] {
        assert_eq!(topology(triangles), None, "{what}");
    }
    // Two fans at a vertex of the boundary are allowed: another piece joins them.
    assert!(topology(&[[0, 1, 2], [0, 3, 4]]).is_some());
}

#[test]
fn large_errors_are_rejected_with_the_limit() {
    let mut mesh = row(1, SurfaceKind::Vdw, 0.5);
    let error = simplify(&mut mesh, within(1.1), 0.5, &Control::default()).unwrap_err();
    assert!(matches!(error, SurfaceError::BadParameter { name: "simplify", .. }), "{error}");
    assert!(error.to_string().contains("at most 2 grid spacings: 1.000 Å"), "{error}");
    assert!(simplify(&mut mesh, within(1.0), 0.5, &Control::default()).is_ok());
}

#[test]
fn distances_from_a_grid_are_those_of_a_search_through_all_triangles() {
    let mesh = row(3, SurfaceKind::Ses, 0.4);
    let corners: Vec<Corners> = mesh.triangles.iter().map(|t| t.map(|v| mesh.positions[v as usize])).collect();
    let point = |i: u16| [0.37, 1.13, 2.71].map(|k: f32| 7.0 * (f32::from(i) * k).sin());
    for cell in [0.1, 0.8, 20.0] {
        let grid = TriangleGrid::new(corners.clone(), cell);
        let mut nearest = 0;
        for i in 0..300 {
            // With one triangle, a grid has one cell, or few.
            let alone = corners.iter().map(|one| TriangleGrid::new(vec![*one], 100.0).distance(point(i), &mut 0));
            let expected = alone.fold(f32::INFINITY, f32::min);
            let mut near = nearest;
            let found = grid.distance(point(i), &mut nearest);
            let what = format!("{cell}, {:?}: {found}, {expected}", point(i));
            assert!((found - expected).abs() <= 1e-5 * expected.max(1.0), "{what}");
            let of_nearest = TriangleGrid::new(vec![corners[nearest as usize]], 100.0).distance(point(i), &mut 0);
            assert!((of_nearest - found).abs() <= 1e-6, "{what}");
            assert!(!grid.is_within(point(i), 0.999 * found - 1e-5, &mut near), "{what}");
            assert!(grid.is_within(point(i), 1.001 * found + 1e-5, &mut near), "{what}");
        }
    }
    assert!(TriangleGrid::new(Vec::new(), 1.0).distance([0.0; 3], &mut 0).is_infinite());
}

#[test]
fn samples_are_near_every_point_of_a_triangle() {
    let corners = [[0.0, 0.0, 0.0], [3.1, 0.2, 0.0], [0.4, 1.9, 0.7]];
    for step in [0.3, 1.0, 2.9, 5.0] {
        // A neighbour at each edge has the points that the triangle leaves to it.
        let [a, b, c] = corners;
        let points = samples([4, 9, 2], corners, step).chain(samples([9, 4, 2], [b, a, c], step)).chain(corners);
        let points: Vec<_> = points.collect();
        for (i, j) in (0..=40).flat_map(|i| (0..=40 - i).map(move |j| (i, j))) {
            let [u, v] = [i, j].map(|n: u8| f32::from(n) / 40.0);
            let p: [f32; 3] = std::array::from_fn(|k| a[k] + u * (b[k] - a[k]) + v * (c[k] - a[k]));
            let nearest = points.iter().map(|q| length(sub(p, *q))).fold(f32::INFINITY, f32::min);
            assert!(nearest < 0.58 * step, "{step} {p:?}: {nearest}");
        }
    }
    // Of two triangles with a common edge, one has its points.
    let edge =
        |rows: [u32; 3], corners: Corners| samples(rows, corners, 1.0).filter(|p| p[1] == 0.0 && p[2] == 0.0).count();
    let [p, q] = [[0.0; 3], [4.5, 0.0, 0.0]];
    for [v, w] in [[1, 2], [2, 1]] {
        let (above, below) = (edge([v, w, 3], [p, q, [2.0, 3.0, 0.0]]), edge([w, v, 4], [q, p, [2.0, -3.0, 0.0]]));
        assert_eq!((above + below, above.min(below)), (4, 0));
    }
}

#[test]
fn errors_of_a_larger_permitted_error_contain_those_of_a_smaller_one() {
    let of = |permitted: f64| piece::errors(permitted, 0.5).collect::<Vec<f64>>();
    assert_eq!(of(0.3), [0.125, 0.0625, 0.031_25]);
    assert_eq!(of(0.01), [0.003_906_25, 0.001_953_125, 0.000_976_562_5]);
    assert_eq!(of(0.4), of(1.0), "at most half a grid spacing");
    for permitted in [0.02, 0.05, 0.1, 0.31] {
        let [smaller, larger] = [of(0.9 * permitted), of(permitted)];
        assert!(larger[0] <= 0.7 * permitted && larger[0] > 0.35 * permitted, "{permitted} {larger:?}");
        assert!(larger.contains(&smaller[0]) && larger[0] >= smaller[0], "{smaller:?} {larger:?}");
    }
}

#[test]
fn closed_components_keep_half_of_their_volume() {
    let positions = vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.1, 0.1, 0.1]];
    let outwards = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]];
    // The last vertex belongs to the component, as if an edge had been collapsed.
    let triangles = [&outwards[..], &[[4, 0, 1]]].concat();
    let piece = CubePiece { vertices: vec![0, 1, 2, 3, 4], positions, triangles };
    let closed = ClosedComponents::new(&piece, &fans::BoundaryFans::default());
    assert!(closed.keep_volume(&piece, &outwards));
    let inverted = outwards.map(|[a, b, c]| [a, c, b]);
    assert!(!closed.keep_volume(&piece, &inverted));
    let flatter = outwards.map(|triangle| triangle.map(|v| if v == 3 { 4 } else { v }));
    assert!(!closed.keep_volume(&piece, &flatter));
    let open = ClosedComponents::new(&piece, &[([0, 1], 2)].into_iter().collect());
    assert!(open.keep_volume(&piece, &flatter), "components with a boundary are not measured");
}
