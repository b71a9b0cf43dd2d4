//! Parts, patches and instances of meshes of the GPU backend compared with those of the CPU backend, on software
//! Vulkan.

use crate::gpu_support;
use crate::gpu_support::POSITION_BOUND;

use std::fmt::Write as _;
use std::time::Duration;

use gpu_support::engine_with;
use molmesh::gpu::{DevicePool, Executor, GpuBackend, PoolDevice, PoolSettings};
use molmesh::pipeline::{self, Choice, JobLimits, PartReport, Product, params};
use molmesh::surface::{Backend, Control, CpuBackend, Mesh};

const SAMPLE: &str = include_str!("../../samples/4pti.pdb");

/// Returns two chains that touch, with an assembly of three copies: the identity and two rotations.
fn dimer() -> String {
    let mut text = format!("{:<80}\n", "REMARK 350 BIOMOLECULE: 1");
    writeln!(text, "{:<80}", "REMARK 350 APPLY THE FOLLOWING TO CHAINS: A, B").unwrap();
    let quarter = [[0.0, -1.0, 0.0, 9.5], [1.0, 0.0, 0.0, 40.0], [0.0, 0.0, 1.0, 0.0]];
    let half = [[-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 3.25]];
    let identity = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
    for (serial, rows) in (1..).zip([identity, quarter, half]) {
        for (k, [a, b, c, t]) in (1..).zip(rows) {
            let line = format!("REMARK 350   BIOMT{k} {serial:>3}{a:>10.6}{b:>10.6}{c:>10.6}{t:>15.5}");
            writeln!(text, "{line:<80}").unwrap();
        }
    }
    for (chain, shift) in [('A', 0.0), ('B', 14.0)] {
        for line in SAMPLE.lines().filter(|line| line.starts_with("ATOM")) {
            let x: f64 = line[30..38].trim().parse().unwrap();
            writeln!(text, "{}{chain}{}{:8.3}{}", &line[..21], &line[22..30], x + shift, &line[38..]).unwrap();
        }
    }
    text + "END\n"
}

fn gpu() -> GpuBackend {
    let build = || Ok(Box::new(engine_with(|_| ())) as Box<dyn Executor>);
    let device = PoolDevice { number: 0, name: "device 0".to_owned(), build: Box::new(build) };
    // Software devices are slow on a busy machine.
    let settings = &PoolSettings { hang_timeout: Duration::from_mins(10), ..PoolSettings::default() };
    GpuBackend::with_pool(DevicePool::start(vec![device], settings).unwrap())
}

fn made(backend: &dyn Backend, pairs: &[(&str, &str)]) -> Product {
    let choice = Choice { backend, reason: "set by a test" };
    let job = params::parse([("resolution", "1")].iter().chain(pairs).copied()).unwrap().options;
    let text = dimer();
    pipeline::run(text.as_bytes(), &job, &JobLimits::default(), &choice, &Control::default(), &(), None).unwrap()
}

/// Returns the largest distance between corresponding vertices along an axis, Å; infinite if the triangles differ.
fn distance(a: &Mesh, b: &Mesh) -> f32 {
    if (a.centre, &a.triangles, a.n_vertices()) != (b.centre, &b.triangles, b.n_vertices()) {
        return f32::INFINITY;
    }
    let apart = |v: usize| (0..3).map(|k| (a.position(v)[k] - b.position(v)[k]).abs()).fold(0.0, f32::max);
    (0..a.n_vertices()).map(apart).fold(0.0, f32::max)
}

fn near(a: f64, b: f64) -> bool {
    (a / b - 1.0).abs() < 1e-5
}

fn counts(part: &PartReport) -> (&str, u64, u64, u64, Option<u64>) {
    (&part.name, part.atoms, part.vertices, part.triangles, part.instances)
}

#[test]
fn parts_and_assemblies_equal_those_of_the_cpu() {
    let (gpu, cpu) = (gpu(), CpuBackend::new(Some(2)).unwrap());
    let cases: [&[(&str, &str)]; 7] = [
        &[("split", "chain")],
        &[("assembly", "1")],
        &[("assembly", "1"), ("split", "chain"), ("atom_ids", "true")],
        &[("assembly", "1"), ("split", "residue-group"), ("chains", "A"), ("compress", "quantize")],
        &[("assembly", "1"), ("instances", "true")],
        &[("select", "resi 3-20"), ("context", "whole")],
        &[("assembly", "1"), ("context", "whole"), ("split", "chain")],
    ];
    let mut meshes: Vec<Mesh> = Vec::new();
    for pairs in cases {
        let [a, b] = [&gpu as &dyn Backend, &cpu].map(|backend| made(backend, pairs));
        assert_eq!((a.report.backend, b.report.backend), ("gpu", "cpu"));
        // A vertex that is rounded the other way moves by a step.
        let step = a.mesh.quantized.as_ref().map_or(0.0, |quantized| quantized.step.length());
        let apart = distance(&a.mesh, &b.mesh);
        assert!(apart <= 2.0 * POSITION_BOUND + step, "{pairs:?}: {apart}");
        assert_eq!(
            a.report.parts.iter().map(counts).collect::<Vec<_>>(),
            b.report.parts.iter().map(counts).collect::<Vec<_>>()
        );
        for (a, b) in a.report.parts.iter().zip(&b.report.parts) {
            assert!(near(a.area, b.area), "{pairs:?}: {a:?} {b:?}");
            assert_eq!(a.volume.is_some(), b.volume.is_some());
            assert!(a.volume.zip(b.volume).is_none_or(|(a, b)| near(a, b)), "{pairs:?}: {a:?} {b:?}");
        }
        let facts = |product: &Product| {
            let report = &product.report;
            (report.closed, report.oriented, report.open_reason, report.euler, report.components, report.grid_points)
        };
        assert_eq!(facts(&a), facts(&b), "{pairs:?}");
        assert!(near(a.report.area, b.report.area), "{pairs:?}");
        assert_eq!(a.mesh.placements, b.mesh.placements);
        let ranges = |mesh: &Mesh| {
            mesh.parts.iter().map(|part| (part.vertices.clone(), part.triangles.clone())).collect::<Vec<_>>()
        };
        assert_eq!(ranges(&a.mesh), ranges(&b.mesh));
        assert_eq!(a.mesh.atom_ids.is_some(), b.mesh.atom_ids.is_some());
        // Negative control: the meshes of other cases differ.
        assert!(meshes.iter().all(|other| distance(&a.mesh, other).is_infinite()), "{pairs:?}");
        meshes.push(b.mesh);
    }
}
