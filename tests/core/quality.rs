//! Jobs with improved triangles.
#![allow(clippy::pedantic, clippy::unwrap_used, clippy::panic, reason = "tests fail by panicking")]

use std::collections::HashMap;

use molmesh::formats::Format;
use molmesh::pipeline::params::{self, ParamError};
use molmesh::pipeline::{Choice, JobLimits, Product, estimate, run};
use molmesh::structure;
use molmesh::surface::reference::Density;
use molmesh::surface::{Control, CpuBackend, Measures, Mesh, SurfaceParams, TriangleShapes, Validation};

const SAMPLE: &[u8] = include_bytes!("../../samples/4pti.pdb");
const CHAINS: &[u8] = include_bytes!("../structures/1ubq.pdb.gz");

fn meshed(file: &[u8], pairs: &[(&str, &str)], threads: usize) -> Product {
    let backend = CpuBackend::new(Some(threads)).unwrap();
    let choice = Choice { backend: &backend, reason: "" };
    let options = params::parse(pairs.iter().copied()).unwrap().options;
    run(file, &options, &JobLimits::default(), &choice, &Control::default(), &(), None).unwrap()
}

type Point = [f64; 3];

fn sub(a: Point, b: Point) -> Point {
    std::array::from_fn(|k| a[k] - b[k])
}

fn cross(a: Point, b: Point) -> Point {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

fn dot(a: Point, b: Point) -> f64 {
    (0..3).map(|k| a[k] * b[k]).sum()
}

/// Returns true if a segment crosses a triangle (Möller and Trumbore, Journal of Graphics Tools 2(1), 1997).
fn crosses(from: Point, to: Point, [a, b, c]: [Point; 3]) -> bool {
    let (direction, u, v) = (sub(to, from), sub(b, a), sub(c, a));
    let p = cross(direction, v);
    let det = dot(u, p);
    if det == 0.0 {
        return false;
    }
    let s = sub(from, a);
    let q = cross(s, u);
    let (x, y, t) = (dot(s, p) / det, dot(direction, q) / det, dot(v, q) / det);
    (0.0..=1.0).contains(&x) && y >= 0.0 && x + y <= 1.0 && (0.0..=1.0).contains(&t)
}

/// Returns the number of pairs of triangles that intersect. Pairs with a common edge do not count.
fn intersections(mesh: &Mesh) -> usize {
    let cell = 0.6;
    let point = |v: u32| mesh.position(v as usize).map(f64::from);
    let mut cells: HashMap<[i64; 3], Vec<usize>> = HashMap::new();
    let mut pairs = std::collections::HashSet::new();
    for (i, row) in mesh.triangles.iter().enumerate() {
        let corners = row.map(point);
        let end = |k: usize, f: fn(f64, f64) -> f64| (f(f(corners[0][k], corners[1][k]), corners[2][k]) / cell).floor();
        let range = |k: usize| end(k, f64::min) as i64..=end(k, f64::max) as i64;
        for x in range(0) {
            for y in range(1) {
                for z in range(2) {
                    let others = cells.entry([x, y, z]).or_default();
                    pairs.extend(others.iter().map(|j| [*j, i]));
                    others.push(i);
                }
            }
        }
    }
    let intersect = |[i, j]: &[usize; 2]| {
        let (a, b) = (mesh.triangles[*i], mesh.triangles[*j]);
        let edge_crosses = |from: [u32; 3], to: [u32; 3]| {
            [0, 1, 2].into_iter().any(|k| {
                let [p, q] = [from[k], from[(k + 1) % 3]];
                !to.contains(&p) && !to.contains(&q) && crosses(point(p), point(q), to.map(point))
            })
        };
        a.iter().filter(|v| b.contains(v)).count() < 2 && (edge_crosses(a, b) || edge_crosses(b, a))
    };
    pairs.iter().filter(|pair| intersect(pair)).count()
}

fn parsed(pairs: &[(&str, &str)]) -> SurfaceParams {
    params::parse(pairs.iter().copied()).unwrap().options.params
}

#[test]
fn improved_meshes_have_large_angles_and_no_intersections() {
    for surface in ["gaussian", "soft-object", "inverse-square", "ses", "sas", "vdw"] {
        let pairs = [("surface", surface), ("validation", "exact")];
        let before = meshed(CHAINS, &pairs, 2);
        let after = meshed(CHAINS, &[&pairs[..], &[("quality", "high")]].concat(), 2);
        let (report, old) = (&after.report, &before.report);
        assert!(report.closed && report.oriented && report.manifold, "{surface}");
        assert_eq!((report.euler, report.components), (old.euler, old.components), "{surface}");
        assert_eq!(intersections(&after.mesh), 0, "{surface}");
        assert!((report.area / old.area - 1.0).abs() < 0.01, "{surface}: {} {}", report.area, old.area);
        let [volume, old_volume] = [report, old].map(|report| report.volume.unwrap());
        assert!((volume / old_volume - 1.0).abs() < 0.005, "{surface}: {volume} {old_volume}");
        let shapes = report.triangle_shapes.clone().unwrap();
        // Van der Waals and solvent-accessible surfaces have creases, at which triangles stay thin.
        let [at_1_percent, at_0_1_percent] = match surface {
            "vdw" => [12.0, 1.5],
            "sas" => [25.0, 4.0],
            _ => [27.0, 10.0],
        };
        let worst = TriangleShapes::of(&before.mesh).angle_at(0.01);
        assert!(worst < 1.5 && shapes.angle_1_percent >= at_1_percent, "{surface}: {shapes:?}, was {worst}");
        assert!(shapes.angle_0_1_percent >= at_0_1_percent, "{surface}: {shapes:?}");
        for histogram in [&shapes.angle_histogram, &shapes.aspect_histogram] {
            assert_eq!(histogram.iter().sum::<u64>(), report.triangles, "{surface}");
        }
        assert!(old.triangle_shapes.is_none());
    }
}

#[test]
fn control_intersections_and_angles_are_detected() {
    let mut mesh = meshed(SAMPLE, &[("quality", "high"), ("resolution", "1")], 2).mesh;
    assert_eq!(intersections(&mesh), 0);
    // Moves a vertex through the molecule and out of it.
    mesh.positions[100] = mesh.positions[100].map(|c| -2.0 * c);
    assert!(intersections(&mesh) > 5);
    assert!(TriangleShapes::of(&mesh).smallest_angle < 10.0);
}

#[test]
fn vertices_stay_on_the_surface() {
    let structure = structure::read(SAMPLE, &Default::default()).unwrap();
    let selected = structure::select(&structure, &Default::default()).unwrap();
    let spheres = selected.spheres(&structure).unwrap();
    for surface in ["gaussian", "soft-object", "inverse-square"] {
        let pairs = [("surface", surface), ("resolution", "0.8"), ("quality", "high"), ("atom_ids", "true")];
        let mesh = meshed(SAMPLE, &pairs, 2).mesh;
        let params = parsed(&pairs);
        let density = Density::new(&spheres, &params).unwrap();
        let ids = mesh.atom_ids.as_ref().unwrap();
        let (mut distances, mut alongs) = (Vec::new(), Vec::new());
        for v in (0..mesh.n_vertices()).step_by(17) {
            let position = mesh.position(v);
            let x: Point = std::array::from_fn(|k| mesh.centre[k] + f64::from(position[k]));
            let gradient = density.gradient(x);
            let length = dot(gradient, gradient).sqrt();
            let distance = (density.value(x) - params.isovalue) / length;
            distances.push(distance.abs());
            let along = -dot(gradient, mesh.normals[v].map(f64::from)) / length;
            alongs.push(along);
            let gap = |i: usize| {
                let from = sub(x, spheres.centre(i));
                dot(from, from).sqrt() - f64::from(spheres.radius(i))
            };
            let row = selected.atoms.iter().position(|atom| *atom == ids[v]).unwrap();
            let nearest = (0..spheres.len()).map(gap).fold(f64::INFINITY, f64::min);
            assert!(gap(row) - nearest < 1e-3, "{surface}: {} {nearest}", gap(row));
        }
        distances.sort_unstable_by(f64::total_cmp);
        alongs.sort_unstable_by(f64::total_cmp);
        assert!(alongs[alongs.len() / 20] > 0.98, "{surface}: {:?}", &alongs[..9]);
        // Vertices of marching cubes, to which Newton's method applies one step, remain where no move is needed.
        let [most, rest] = [75, 95].map(|percent| distances[distances.len() * percent / 100]);
        assert!(most < 1e-3 && rest < 0.02, "{surface}: {most} {rest} Å");
    }
    let atom = b"HETATM    1  C   UNK A   1       0.000   0.000   0.000  1.00  0.00           C\n";
    for (surface, radius) in [("vdw", 1.7), ("sas", 3.1), ("ses", 1.7)] {
        let pairs = [("surface", surface), ("select", "all"), ("resolution", "0.3"), ("quality", "high")];
        let mesh = meshed(atom, &pairs, 2).mesh;
        for position in mesh.positions.iter() {
            let p: Point = std::array::from_fn(|k| mesh.centre[k] + f64::from(position[k]));
            assert!((dot(p, p).sqrt() - radius).abs() < 1e-3, "{surface}: {p:?}");
        }
    }
}

#[test]
fn other_parameters_apply_to_improved_meshes() {
    for extra in [
        &[("compress", "quantize")][..],
        &[("split", "residue-group"), ("select", "all")],
        &[("split", "residue-group"), ("select", "all"), ("compress", "quantize")],
        &[("context", "whole"), ("select", "resi 1-20"), ("compress", "quantize")],
        &[("cavities", "drop"), ("surface", "ses")],
        &[("color", "element"), ("color_blend", "smooth")],
        &[("color", "curvature")],
        &[("max_triangles", "9000")],
        &[("detail", "2")],
    ] {
        let pairs = [&[("quality", "high")][..], extra].concat();
        let product = meshed(SAMPLE, &pairs, 2);
        let (report, whole) = (&product.report, meshed(SAMPLE, extra, 2).report);
        let m = Measures::of(&product.mesh, Validation::Exact, &Control::default()).unwrap();
        assert_eq!((m.closed, m.manifold), (report.closed, report.manifold), "{pairs:?}");
        assert_eq!(report.closed, whole.closed, "{pairs:?}");
        assert_eq!(product.mesh.n_vertices() as u64, report.vertices, "{pairs:?}");
        assert!(report.triangle_shapes.as_ref().unwrap().angle_1_percent > 15.0, "{pairs:?}: {report:?}");
        for part in &product.mesh.parts {
            let own = &product.mesh.triangles[part.triangles.clone()];
            assert!(own.iter().flatten().all(|v| part.vertices.contains(&(*v as usize))), "{pairs:?} {}", part.name);
        }
    }
    let meshopt = meshed(SAMPLE, &[("quality", "high"), ("compress", "meshopt")], 2);
    let mut bytes = Vec::new();
    meshopt.file(Format::Glb).unwrap().write(&mut bytes).unwrap();
    assert!(bytes.starts_with(b"glTF"));
}

#[test]
fn improved_meshes_do_not_depend_on_the_number_of_threads() {
    let pairs = [("quality", "high"), ("resolution", "0.6"), ("atom_ids", "true")];
    let meshes = [1, 3].map(|threads| meshed(CHAINS, &pairs, threads).mesh);
    assert!(meshes[0] == meshes[1]);
}

#[test]
fn estimates_state_the_mesh_before_its_improvement() {
    let backend = CpuBackend::new(Some(2)).unwrap();
    let (choice, control) = (Choice { backend: &backend, reason: "" }, Control::default());
    let estimates = ["standard", "high"].map(|quality| {
        let options = params::parse([("quality", quality), ("resolution", "0.5")]).unwrap().options;
        let read = |control: &Control<'_>| structure::read_with(CHAINS, &Default::default(), control).map(Box::new);
        let estimate = estimate(read, &options, &JobLimits::default(), &choice, &control).unwrap();
        (estimate.work(&options).unwrap(), estimate.mesh.unwrap())
    });
    assert_eq!(estimates[0].1, estimates[1].1);
    assert!(estimates[1].0 > 10.0 * estimates[0].0, "{estimates:?}");
}

#[test]
fn improved_triangles_are_not_simplified() {
    let Err(ParamError::BadValue { name, expected, .. }) = params::parse([("quality", "high"), ("simplify", "0.1")])
    else {
        panic!("accepted")
    };
    assert!(name == "simplify" && expected.contains("quality=high"), "{name} {expected}");
    let canonical = |pairs: &[(&str, &str)]| params::canonical(&params::parse(pairs.iter().copied()).unwrap().options);
    assert_eq!(canonical(&[("quality", "standard")]), canonical(&[]));
    assert_ne!(canonical(&[("quality", "high")]), canonical(&[]));
}
