//! Time as a function of the number of atoms, and time of the field stage per pair of a grid point and an atom. Prints
//! a table of medians.
//!
//! `cargo bench --bench growth -- --max 300000` stops earlier. `RAYON_NUM_THREADS=1` sets the number of threads.

#![expect(clippy::print_stdout, clippy::unwrap_used, reason = "a benchmark prints its table and may panic")]

use std::collections::BTreeMap;
use std::time::Instant;

use molmesh::pipeline::StageClock;
use molmesh::structure::{self, ReadLimits, Selection};
use molmesh::surface::{Backend, Control, CpuBackend, Spheres, SurfaceLimits, SurfaceParams};

/// Tiles the sample on a lattice of boxes until there are `n` atoms, which preserves density and sparsity.
fn tiled(sample: &Spheres, n: usize) -> Spheres {
    let [lo, hi] = sample.bounds().unwrap();
    let side: [f64; 3] = std::array::from_fn(|k| hi[k] - lo[k] + 3.0);
    let copies = n.div_ceil(sample.len());
    let edge = (1..=copies).find(|e| e.pow(3) >= copies).unwrap();
    let (mut columns, mut radii) = ([const { Vec::new() }; 3], Vec::new());
    for i in 0..n {
        let (copy, atom) = (i / sample.len(), i % sample.len());
        let cell = [copy % edge, copy / edge % edge, copy / edge / edge];
        let centre = sample.centre(atom);
        for k in 0..3 {
            columns[k].push(centre[k] + side[k] * cell[k] as f64);
        }
        radii.push(sample.radius(atom));
    }
    let [x, y, z] = columns;
    Spheres::new(x, y, z, radii).unwrap()
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

fn main() {
    let flag = |name: &str| {
        let mut arguments = std::env::args().skip_while(|a| a != name);
        arguments.nth(1).map(|v| v.parse::<usize>().unwrap())
    };
    let max = flag("--max").unwrap_or(1_000_000);
    let backend = CpuBackend::new(None).unwrap();
    let bytes = std::fs::read(concat!(env!("CARGO_MANIFEST_DIR"), "/samples/4pti.pdb")).unwrap();
    let sample = structure::read(&bytes, &ReadLimits::default()).unwrap();
    let sample = structure::select(&sample, &Selection::default()).unwrap().spheres(&sample).unwrap();
    println!("{}; the bundled sample tiled, Gaussian, 0.5 Å; medians", backend.describe());
    println!(
        "| atoms | bricks | pairs/atom | triangles | bin | field | classify | interpolate | emit | measure | total ms | µs/atom | field ns/pair |"
    );
    println!("|---|---|---|---|---|---|---|---|---|---|---|---|---|");
    let sizes = [1_000, 3_000, 10_000, 30_000, 100_000, 300_000, 1_000_000];
    for n in sizes.into_iter().filter(|&n| n <= max) {
        let spheres = tiled(&sample, n);
        let runs = (300_000 / n).clamp(3, 31);
        let mut stages: BTreeMap<&str, Vec<f64>> = BTreeMap::new();
        let mut totals = Vec::new();
        let (mut triangles, mut grid) = (0, None);
        for _ in 0..runs {
            let clock = StageClock::new(&());
            let control = Control { observer: &clock, ..Control::default() };
            let started = Instant::now();
            let run = || backend.run(&spheres, &SurfaceParams::default(), &SurfaceLimits::default(), &control).unwrap();
            let meshed = clock.pass(run);
            assert!(meshed.measures.is_some(), "the backend measures as it writes");
            totals.push(started.elapsed().as_secs_f64() * 1e3);
            (triangles, grid) = (meshed.mesh.n_triangles(), Some(meshed.grid));
            for (stage, ms) in clock.finish() {
                stages.entry(stage).or_default().push(ms);
            }
        }
        let grid = grid.unwrap();
        let mut of = |stage: &str| median(stages.remove(stage).unwrap());
        let (field, total) = (of("field"), median(totals));
        let pairs = grid.candidates as f64 * 512.0;
        println!(
            "| {n} | {} | {:.0} | {triangles} | {:.2} | {field:.2} | {:.2} | {:.2} | {:.2} | {:.2} | {total:.2} | {:.2} | {:.4} |",
            grid.bricks,
            pairs / n as f64,
            of("bin"),
            of("classify"),
            of("interpolate"),
            of("emit"),
            of("measure"),
            total * 1e3 / n as f64,
            // Processor time is the wall time times the number of threads.
            field * 1e6 * backend.threads() as f64 / pairs,
        );
    }
}
