//! Time to prepare a GPU job on the host, on one thread and on all threads: lattice of atoms, and plan of bricks.
//!
//! Run it with `cargo bench --bench prepare`. The atoms are generated at the density of proteins, domain by domain, so
//! that consecutive atoms are near each other, as in files.

use std::hint::black_box;

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use molmesh::gpu::plan::Plan;
use molmesh::surface::lattice::Lattice;
use molmesh::surface::{Control, Spheres, SurfaceLimits, SurfaceParams};

/// Side of a domain, Å, and its number of heavy atoms: 20 Å³ per atom.
const DOMAIN: (f64, usize) = (30.0, 1350);

fn atoms(n: usize) -> Spheres {
    let edge = (1..=n).find(|e| e.pow(3) * DOMAIN.1 >= n).unwrap_or(1);
    let mut state = 7_u64;
    let mut next = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 11) as f64 / (1_u64 << 53) as f64
    };
    let mut columns = [const { Vec::new() }; 3];
    for i in 0..n {
        let domain = i / DOMAIN.1;
        for (column, cell) in columns.iter_mut().zip([domain % edge, domain / edge % edge, domain / edge / edge]) {
            column.push(DOMAIN.0 * (cell as f64 - 0.5 * edge as f64 + next()));
        }
    }
    let [x, y, z] = columns;
    let radii = (0..n).map(|i| [1.7, 1.7, 1.55, 1.52][i % 4]).collect();
    Spheres::new(x, y, z, radii).expect("finite spheres")
}

fn benches(c: &mut Criterion) {
    let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().expect("a thread");
    let (params, limits) =
        (SurfaceParams::default(), SurfaceLimits { max_grid_points: 1 << 40, ..SurfaceLimits::default() });
    let lattice = |spheres: &Spheres| Lattice::new(spheres, &params, &Control::default()).expect("a lattice");
    let plan = |lattice: &Lattice| Plan::new(lattice, &limits, &Control::default()).expect("a plan");
    for n in [10_000, 100_000, 335_722, 1_000_000, 3_000_000] {
        let spheres = atoms(n);
        let placed = lattice(&spheres);
        let mut group = c.benchmark_group("prepare");
        group.sample_size(10).throughput(Throughput::Elements(n as u64));
        group.bench_function(BenchmarkId::new("lattice, one thread", n), |b| {
            b.iter(|| one.install(|| lattice(black_box(&spheres)).atoms.len()));
        });
        group.bench_function(BenchmarkId::new("plan, one thread", n), |b| {
            b.iter(|| one.install(|| plan(black_box(&placed)).bricks.len()));
        });
        group.bench_function(BenchmarkId::new("both, all threads", n), |b| {
            b.iter(|| plan(&lattice(black_box(&spheres))).bricks.len());
        });
        group.finish();
    }
}

criterion_group!(prepare_benches, benches);
criterion_main!(prepare_benches);
