//! Single stages of a device, run on the results of the CPU's previous stages and compared with the CPU's stage: `bin`,
//! `classify`, `scan` and `emit` bit by bit, `field`, `interpolate` and `measure` within bounds. Outputs are poisoned
//! before a stage runs.

use crate::gpu_support;

use std::collections::HashMap;

use bytemuck::{Pod, pod_collect_to_vec};
use gpu_support::{FIELD_BOUND, Random, SURFACES, engine_with, job, params, sample, spheres};
use molmesh::gpu::GpuJob;
use molmesh::gpu::plan::Plan;
use molmesh::gpu::plan::layout::{BrickRecord, Counters, GROUP, NONE};
use molmesh::gpu::single_stages::{BufferId, SingleStages};
use molmesh::surface::cpu::stage_results::{
    BrickResults, SheetResults, StageResults, SurfaceResults, checksum, run_stages,
};
use molmesh::surface::lattice::LatticeAtom;
use molmesh::surface::quantize::{BEYOND, normal};
use molmesh::surface::{Spheres, Stage, Step, SurfaceKind, SurfaceLimits};

/// Maximum distance of vertices that are made from the same densities, Å.
const POSITION_BOUND: f32 = 1e-4;
/// Depth below a surface of spheres up to which distances are exact, spacings.
const EXACT_DEPTH: f32 = 0.05;
/// Maximum difference of normals, per component.
const NORMAL_BOUND: f32 = 1e-3;

/// Job with the results of the CPU and its buffers on the device.
struct Setup {
    job: GpuJob,
    cpu: StageResults,
    stages: SingleStages,
    /// Bricks of the CPU in the order of the plan; `None` for a brick of the plan that the CPU does not have.
    bricks: Vec<Option<BrickResults>>,
    surface: Vec<Option<SurfaceResults>>,
}

fn halves(word: u64) -> [u32; 2] {
    [word & 0xffff_ffff, word >> 32].map(|half| u32::try_from(half).unwrap())
}

fn u32_of(n: usize) -> u32 {
    u32::try_from(n).unwrap()
}

/// Coordinates of each brick, in bricks.
fn coords(plan: &Plan) -> Vec<Vec<i32>> {
    let coord = |&brick: &u32| {
        let tile = plan.tiles[(brick >> 9) as usize].coord;
        let local = [0, 3, 6].map(|shift| i32::try_from(brick >> shift & 7).unwrap());
        local.iter().zip(tile).map(|(b, t)| 8 * t + b).collect()
    };
    plan.bricks.iter().map(coord).collect()
}

impl Setup {
    fn new(spheres: &Spheres, surface: SurfaceKind, resolution: f64) -> Self {
        let params = params(surface, resolution);
        let job = job(spheres, &params);
        let cpu = run_stages(&job.prepared.lattice, &params, &SurfaceLimits::default()).unwrap();
        let rows = [cpu.mesh.n_vertices(), cpu.mesh.n_triangles()].map(u32_of);
        let stages = SingleStages::new(engine_with(|_| ()), &job, rows[0], rows[1]).unwrap();
        let plan = &job.prepared.plan;
        let coords = coords(plan);
        let mut bricks: HashMap<Vec<i32>, BrickResults> =
            cpu.bricks.iter().map(|b| (b.coord.to_vec(), b.clone())).collect();
        let mut surface: HashMap<Vec<i32>, SurfaceResults> =
            cpu.surface.iter().map(|b| (b.coord.to_vec(), b.clone())).collect();
        let bricks_in_order = coords.iter().map(|c| bricks.remove(c)).collect();
        let surface_in_order = coords.iter().map(|c| surface.remove(c)).collect();
        assert!(bricks.is_empty() && surface.is_empty(), "the plan has every brick of the CPU");
        Self { job, cpu, stages, bricks: bricks_in_order, surface: surface_in_order }
    }

    /// Runs `stage` on `inputs` with every output poisoned, and reads the outputs.
    fn run(&self, stage: Stage, inputs: &[(BufferId, Vec<u8>)], outputs: &[BufferId]) -> Vec<Vec<u8>> {
        for (id, bytes) in inputs {
            self.stages.write(*id, bytes);
        }
        self.stages.run(stage).unwrap();
        outputs.iter().map(|&id| self.stages.read(id, self.stages.size(&self.job, id)).unwrap()).collect()
    }

    fn poison(&self, buffers: &[BufferId]) {
        for id in buffers {
            self.stages.poison(*id);
        }
    }

    /// Candidate lists of the CPU in the layout of the device: entries, and (start, reaching, all, brick) per brick.
    /// Lists of arcs follow those of atoms. Their order does not affect the stages.
    fn lists(&self) -> (Vec<u32>, Vec<[u32; 4]>) {
        let (mut entries, mut heads) = self.atom_lists();
        let plan = &self.job.prepared.plan;
        if plan.n_kinds() == 2 {
            let arcs: HashMap<Vec<u8>, u32> =
                plan.arcs.bounds.iter().map(raw_atom).zip(u32_of(plan.n_atoms())..).collect();
            for (id, brick) in self.bricks.iter().enumerate() {
                let start = u32_of(entries.len());
                entries.extend(brick.iter().flat_map(|b| &b.arcs).map(|arc| arcs[&raw_atom(arc)]));
                let n = u32_of(entries.len()) - start;
                heads.push([start, n, n, u32_of(id)]);
            }
        }
        (entries, heads)
    }

    fn atom_lists(&self) -> (Vec<u32>, Vec<[u32; 4]>) {
        let (mut entries, mut heads) = (Vec::new(), Vec::new());
        for (id, brick) in self.bricks.iter().enumerate() {
            let start = u32_of(entries.len());
            let (reaching, gap): (&[u32], &[u32]) = brick.as_ref().map_or((&[], &[]), |b| (&b.reaching, &b.gap_only));
            entries.extend(reaching.iter().chain(gap));
            heads.push([start, u32_of(reaching.len()), u32_of(reaching.len() + gap.len()), u32_of(id)]);
        }
        (entries, heads)
    }

    /// Parameters of the vertices on the crossing edges of each brick, three per grid point; not a number on all other
    /// edges.
    fn crossings(&self) -> Vec<f32> {
        let mut all = vec![f32::NAN; 3 * 512 * self.surface.len()];
        for (id, brick) in self.surface.iter().enumerate() {
            let Some(brick) = brick else { continue };
            let mut of_vertices = self.cpu.t[brick.first[0] as usize..].iter();
            for (word, bits) in brick.crossing.iter().enumerate() {
                for bit in (0..64).filter(|bit| bits >> bit & 1 == 1) {
                    all[3 * (512 * id + 64 * (word / 3) + bit) + word % 3] = *of_vertices.next().unwrap();
                }
            }
        }
        all
    }

    fn fields(&self) -> Vec<f32> {
        self.bricks.iter().flat_map(|b| b.as_ref().map_or([0.0; 512], |b| b.field)).collect()
    }

    fn inside(&self) -> Vec<u32> {
        self.bricks.iter().flat_map(|b| b.as_ref().map_or([0; 8], |b| b.inside)).flat_map(halves).collect()
    }

    /// Neighbours of every brick.
    fn neighbours(&self) -> Vec<[u32; 8]> {
        let coords: Vec<Vec<i32>> = coords(&self.job.prepared.plan);
        let ids: HashMap<&[i32], u32> = coords.iter().map(Vec::as_slice).zip(0..).collect();
        let neighbour = |at: &[i32], n: usize| {
            let there: Vec<i32> = at.iter().enumerate().map(|(k, c)| c + i32::from(n >> k & 1 == 1)).collect();
            ids.get(&there[..]).copied().unwrap_or(NONE)
        };
        coords.iter().map(|at| std::array::from_fn(|n| neighbour(at, n))).collect()
    }

    fn records(&self) -> Vec<BrickRecord> {
        let record = |(b, neighbours): (&Option<SurfaceResults>, [u32; 8])| {
            let mut record = BrickRecord { crossing: [0; 48], layers: [0; 8], neighbours };
            let Some(b) = b else { return record };
            let words: Vec<u32> = b.crossing.iter().flat_map(|w| halves(*w)).collect();
            record.crossing.copy_from_slice(&words);
            for (z, layer) in record.layers.iter_mut().enumerate() {
                let [x, y] = [3 * z, 3 * z + 1].map(|w| b.crossing[w].count_ones());
                *layer = u32::from(b.before[3 * z]) | x << 16 | y << 24;
            }
            record
        };
        self.surface.iter().zip(self.neighbours()).map(record).collect()
    }

    fn counts(&self) -> Vec<u32> {
        self.surface.iter().map(|b| b.as_ref().map_or(0, |b| b.count[0] | b.count[1] << 16)).collect()
    }

    fn groups(&self) -> Vec<[u32; 4]> {
        let sum = |group: &[Option<SurfaceResults>]| {
            let there = group.iter().flatten();
            there.fold([0; 4], |s, b| [s[0] + b.count[0], s[1] + b.count[1], s[2] + 1, 0])
        };
        self.surface.chunks(GROUP as usize).map(sum).collect()
    }

    /// First vertex and first triangle of each brick.
    fn offsets(&self) -> Vec<[u32; 2]> {
        let mut at = [0; 2];
        let mut next = |b: &Option<SurfaceResults>| {
            let first = at;
            if let Some(b) = b {
                assert_eq!(b.first, at, "the CPU numbers bricks in the order of the plan");
                at = [at[0] + b.count[0], at[1] + b.count[1]];
            }
            first
        };
        self.surface.iter().map(&mut next).collect()
    }
}

/// Bytes of an atom without its index in the input, which several arcs share.
fn raw_atom(atom: &LatticeAtom) -> Vec<u8> {
    raw(&[LatticeAtom { source: 0, ..*atom }])
}

fn raw<T: bytemuck::NoUninit>(values: &[T]) -> Vec<u8> {
    bytemuck::cast_slice(values).to_vec()
}

fn cast<T: Pod>(bytes: &[u8]) -> Vec<T> {
    pod_collect_to_vec(bytes)
}

/// Returns the first difference of two columns.
fn unequal<T: PartialEq + std::fmt::Debug>(got: &[T], expected: &[T]) -> Option<String> {
    if got.len() != expected.len() {
        return Some(format!("{} rows of {}", got.len(), expected.len()));
    }
    let at = got.iter().zip(expected).position(|(a, b)| a != b)?;
    Some(format!("row {at}: {:?}, expected {:?}", got[at], expected[at]))
}

/// Returns the first difference of two columns of more than `bound` times the expected value, or times `min`.
fn differs_by(got: &[f32], expected: &[f32], bound: f32, min: f32) -> Option<String> {
    if got.len() != expected.len() {
        return Some(format!("{} values of {}", got.len(), expected.len()));
    }
    let close = |(a, b): (&f32, &f32)| (a - b).abs() <= bound * b.abs().max(min);
    let at = got.iter().zip(expected).position(|pair| !close(pair))?;
    Some(format!("value {at}: {}, expected {}", got[at], expected[at]))
}

/// Setups for every stage: a structure with each surface, atoms across bricks and tiles, a dense crowd, one atom.
fn setups() -> Vec<(String, Setup)> {
    let mut all: Vec<(String, Setup)> = SURFACES
        .iter()
        .map(|&surface| (format!("4pti {surface}"), Setup::new(&sample("4pti.pdb"), surface, 0.7)))
        .collect();
    let seams: Vec<[f64; 4]> = (0..60)
        .map(|i| f64::from(i) * 1.1)
        .map(|s| [s - 40.0, 0.4 * s - 31.9, 31.7 - 0.7 * s, 1.3 + 0.01 * s])
        .collect();
    all.push(("seams".to_owned(), Setup::new(&spheres(&seams), SurfaceKind::Gaussian, 0.5)));
    // Lists that take a second pass; within one tile, because the CPU assigns atoms to tiles without slack.
    let crowd: Vec<[f64; 4]> =
        Random(5).cloud(700, 6.0).iter().map(|[x, y, z, r]| [x + 8.0, y + 8.0, z + 8.0, *r]).collect();
    all.push(("crowd".to_owned(), Setup::new(&spheres(&crowd), SurfaceKind::Gaussian, 0.5)));
    // Coinciding and touching spheres, one within another, and a ring of probes.
    let odd = [
        [0.0, 0.0, 0.0, 1.5],
        [0.0, 0.0, 0.0, 1.5],
        [0.3, 0.0, 0.0, 0.5],
        [3.0, 0.0, 0.0, 1.5],
        [3.0, 3.0, 0.0, 1.5],
        [0.0, 3.0, 0.0, 1.5],
    ];
    all.push(("ring".to_owned(), Setup::new(&spheres(&odd), SurfaceKind::Ses, 0.3)));
    all.push(("one atom".to_owned(), Setup::new(&spheres(&[[0.0, 0.0, 0.0, 1.7]]), SurfaceKind::Gaussian, 0.5)));
    all
}

/// Candidate lists by brick, independent of their order in the buffer. Lists of arcs, numbered from `first_arc` on, are
/// sorted.
fn by_brick(entries: &[u32], heads: &[[u32; 4]], first_arc: usize) -> Vec<(u32, Vec<u32>)> {
    let list = |h: &[u32; 4]| {
        let mut list = entries[h[0] as usize..(h[0] + h[2]) as usize].to_vec();
        let of_arcs = list.first().is_some_and(|first| *first as usize >= first_arc);
        if of_arcs {
            list.sort_unstable();
        }
        (if of_arcs { h[2] } else { h[1] }, list)
    };
    heads.iter().map(list).collect()
}

#[test]
fn bin_finds_the_same_candidates_in_the_same_order() {
    for (name, setup) in setups() {
        let zero = [(BufferId::Counters, raw(&[Counters::default()]))];
        setup.poison(&[BufferId::Lists, BufferId::Heads]);
        let out = setup.run(Stage::Bin, &zero, &[BufferId::Lists, BufferId::Heads, BufferId::Counters]);
        let (entries, heads): (Vec<u32>, Vec<[u32; 4]>) = (cast(&out[0]), cast(&out[1]));
        let (expected, expected_heads) = setup.lists();
        let plan = &setup.job.prepared.plan;
        let [got, want] = [(&entries, &heads), (&expected, &expected_heads)]
            .map(|(entries, heads)| by_brick(entries, heads, plan.n_atoms()));
        assert_eq!(unequal(&got, &want), None, "{name}");
        let ids = (0..u32_of(plan.bricks.len())).cycle();
        assert!(heads.iter().zip(ids).all(|(h, id)| h[3] == id), "{name}");
        assert_eq!(cast::<Counters>(&out[2])[0].list_end as usize, expected.len(), "{name}");
        let counted = plan.candidates.iter().sum::<u64>();
        // Arcs are also counted in bricks out of reach of the atoms.
        assert!(counted == expected.len() as u64 || plan.n_kinds() == 2 && counted > expected.len() as u64, "{name}");
        // Negative controls: a missing atom, and two atoms in another order.
        let mut wrong = got.clone();
        let longest = (0..wrong.len()).max_by_key(|&i| wrong[i].1.len()).unwrap();
        wrong[longest].1.pop();
        assert!(unequal(&wrong, &want).is_some());
        if got[longest].1.len() > 1 {
            wrong[longest].1.clone_from(&got[longest].1);
            wrong[longest].1.swap(0, 1);
            assert!(unequal(&wrong, &want).is_some());
        }
    }
}

#[test]
fn bin_counts_lists_that_do_not_fit_and_writes_nothing_beyond_the_capacity() {
    let mut setup = Setup::new(&sample("1crn.cif"), SurfaceKind::Gaussian, 0.7);
    let all = setup.lists().0.len();
    setup.stages.params.list_capacity = u32_of(all / 2);
    setup.stages.poison(BufferId::Lists);
    let zero = [(BufferId::Counters, raw(&[Counters::default()]))];
    let out = setup.run(Stage::Bin, &zero, &[BufferId::Counters, BufferId::Lists, BufferId::Heads]);
    assert_eq!(cast::<Counters>(&out[0])[0].list_end as usize, all);
    assert!(cast::<u32>(&out[1])[all / 2..].iter().all(|&entry| entry == 0xa5a5_a5a5));
    assert!(cast::<[u32; 4]>(&out[2]).iter().all(|h| h[2] == 0 || (h[0] + h[2]) as usize <= all / 2));
}

#[test]
fn field_is_within_its_bound_and_marks_inside_grid_points() {
    for (name, setup) in setups() {
        let (entries, heads) = setup.lists();
        setup.poison(&[BufferId::Field, BufferId::Inside]);
        let out = setup.run(
            Stage::Field,
            &[(BufferId::Lists, raw(&entries)), (BufferId::Heads, raw(&heads))],
            &[BufferId::Field, BufferId::Inside],
        );
        // Of grid points deeper inside a surface of spheres, only the side of the surface is exact.
        let most = if setup.job.prepared.params.surface.kernel().is_some() { f32::MAX } else { 1.0 + EXACT_DEPTH };
        let [got, expected] = [cast::<f32>(&out[0]), setup.fields()]
            .map(|values| values.iter().map(|value| value.min(most)).collect::<Vec<_>>());
        assert_eq!(differs_by(&got, &expected, FIELD_BOUND, 0.1), None, "{name}");
        let iso = setup.stages.params.isovalue;
        let bits = |half: &[f32]| (0..).zip(half).fold(0, |word, (i, f)| word | u32::from(*f >= iso) << i);
        let inside: Vec<u32> = got.chunks(32).map(bits).collect();
        assert_eq!(unequal(&cast::<u32>(&out[1]), &inside), None, "{name}");
        // Out of reach the density is exactly 0.
        assert!(got.iter().zip(&expected).all(|(a, b)| (*b == 0.0) == (*a == 0.0) || *a < 1e-5), "{name}");
        // Negative control: 2.5 times the bound.
        let mut wrong = got.clone();
        let highest = (0..wrong.len()).max_by(|&a, &b| wrong[a].total_cmp(&wrong[b])).unwrap();
        wrong[highest] *= 1.0 + 2.5 * FIELD_BOUND;
        assert!(differs_by(&wrong, &expected, FIELD_BOUND, 0.1).is_some());
    }
}

#[test]
fn classify_finds_the_same_edges_and_counts() {
    for (name, setup) in setups() {
        setup.poison(&[BufferId::Records, BufferId::Counts]);
        let inputs = [
            (BufferId::Inside, raw(&setup.inside())),
            (BufferId::Groups, raw(&vec![[0_u32; 4]; setup.groups().len()])),
        ];
        let out = setup.run(Stage::Classify, &inputs, &[BufferId::Records, BufferId::Counts, BufferId::Groups]);
        let (records, counts): (Vec<BrickRecord>, Vec<u32>) = (cast(&out[0]), cast(&out[1]));
        assert_eq!(unequal(&records, &setup.records()), None, "{name}");
        assert_eq!(unequal(&counts, &setup.counts()), None, "{name}");
        assert_eq!(unequal(&cast::<[u32; 4]>(&out[2]), &setup.groups()), None, "{name}");
        // Negative control: one inside bit changed.
        let mut wrong = setup.inside();
        let some = wrong.iter().position(|w| *w != 0 && *w != u32::MAX).unwrap();
        wrong[some] ^= 1 << wrong[some].trailing_zeros();
        let out =
            setup.run(Stage::Classify, &[(BufferId::Inside, raw(&wrong))], &[BufferId::Records, BufferId::Counts]);
        assert!(unequal(&cast::<BrickRecord>(&out[0]), &setup.records()).is_some());
    }
}

#[test]
fn scan_numbers_bricks_in_order() {
    for (name, mut setup) in setups() {
        setup.stages.poison(BufferId::Offsets);
        let inputs = |s: &Setup| {
            [
                (BufferId::Counts, raw(&s.counts())),
                (BufferId::Groups, raw(&s.groups())),
                (BufferId::Counters, raw(&[Counters::default()])),
            ]
        };
        let out = setup.run(Stage::Scan, &inputs(&setup), &[BufferId::Offsets, BufferId::Counters]);
        let want = setup.offsets();
        assert_eq!(unequal(&cast::<[u32; 2]>(&out[0]), &want), None, "{name}");
        let tally = cast::<Counters>(&out[1])[0];
        let mesh = &setup.cpu.mesh;
        assert_eq!((tally.vertices as usize, tally.triangles as usize), (mesh.n_vertices(), mesh.n_triangles()));
        // Totals of earlier chunks are added. This is also the negative control.
        (setup.stages.params.first_vertex, setup.stages.params.first_triangle) = (1000, 7);
        let out = setup.run(Stage::Scan, &inputs(&setup), &[BufferId::Offsets]);
        let moved: Vec<[u32; 2]> = want.iter().map(|[v, t]| [v + 1000, t + 7]).collect();
        assert_eq!(unequal(&cast::<[u32; 2]>(&out[0]), &moved), None, "{name}");
        assert!(unequal(&cast::<[u32; 2]>(&out[0]), &want).is_some());
    }
}

#[test]
fn refine_moves_vertices_to_the_same_points() {
    for (name, setup) in setups() {
        let (entries, heads) = setup.lists();
        let inputs = [
            (BufferId::Lists, raw(&entries)),
            (BufferId::Heads, raw(&heads)),
            (BufferId::Field, raw(&setup.fields())),
            (BufferId::Inside, raw(&setup.inside())),
        ];
        setup.poison(&[BufferId::Crossings]);
        let out = setup.run(Stage::Refine, &inputs, &[BufferId::Crossings]);
        let (got, expected) = (cast::<f32>(&out[0]), setup.crossings());
        // Vertices of surfaces of spheres lie within a tolerance of the surface. Edges may be oblique to it.
        let oblique = if setup.job.prepared.params.surface.kernel().is_some() { 1.0 } else { 10.0 };
        let bound = oblique * POSITION_BOUND / setup.stages.params.spacing;
        let error = |got: &[f32]| {
            let wrong = |(a, b): (&f32, &f32)| {
                if b.is_nan() { a.to_bits() != 0xa5a5_a5a5 } else { (a - b).abs() > bound || a.is_nan() }
            };
            let at = got.iter().zip(&expected).position(wrong)?;
            Some(format!("edge {at}: {}, expected {}", got[at], expected[at]))
        };
        assert_eq!((got.len(), error(&got)), (expected.len(), None), "{name}");
        // Negative controls: a vertex twice the bound away, and an edge without a vertex.
        let [some, none] = [false, true].map(|nan| expected.iter().position(|t| t.is_nan() == nan).unwrap());
        for (edge, value) in [(some, got[some] + 2.0 * bound), (none, 0.5)] {
            let mut wrong = got.clone();
            wrong[edge] = value;
            assert!(error(&wrong).is_some(), "{name}");
        }
    }
}

#[test]
fn interpolate_is_within_its_bounds() {
    for (name, setup) in setups() {
        setup.poison(&[BufferId::Positions, BufferId::Normals]);
        let inputs = interpolate_inputs(&setup);
        let out = setup.run(Stage::Interpolate, &inputs, &[BufferId::Positions, BufferId::Normals, BufferId::Counters]);
        let mesh = &setup.cpu.mesh;
        let (positions, normals): (Vec<f32>, Vec<f32>) = (cast(&out[0]), cast(&out[1]));
        let flat = |rows: &[[f32; 3]]| rows.as_flattened().to_vec();
        let (want, want_normals) = (flat(&mesh.positions), flat(&mesh.normals));
        let error = |got: &[f32], want: &[f32], bound: f32| {
            got.iter().zip(want).position(|(a, b)| (a - b).abs() > bound || !a.is_finite())
        };
        assert_eq!((positions.len(), error(&positions, &want, POSITION_BOUND)), (want.len(), None), "{name}");
        assert_eq!(error(&normals, &want_normals, NORMAL_BOUND), None, "{name}");
        assert_eq!(cast::<Counters>(&out[2])[0].flat, 0, "{name}");
        // Negative controls.
        let mut wrong = positions.clone();
        wrong[positions.len() / 2] += 2.0 * POSITION_BOUND;
        assert!(error(&wrong, &want, POSITION_BOUND).is_some());
        wrong.clone_from(&normals);
        wrong[normals.len() / 3] += 2.0 * NORMAL_BOUND;
        assert!(error(&wrong, &want_normals, NORMAL_BOUND).is_some());
    }
}

/// Inputs of `interpolate`.
fn interpolate_inputs(setup: &Setup) -> Vec<(BufferId, Vec<u8>)> {
    let (entries, heads) = setup.lists();
    vec![
        (BufferId::Lists, raw(&entries)),
        (BufferId::Heads, raw(&heads)),
        (BufferId::Field, raw(&setup.fields())),
        (BufferId::Crossings, raw(&setup.crossings())),
        (BufferId::Records, raw(&setup.records())),
        (BufferId::Counts, raw(&setup.counts())),
        (BufferId::Offsets, raw(&setup.offsets())),
        (BufferId::Counters, raw(&[Counters::default()])),
    ]
}

/// Positions and normals of `interpolate` in single precision.
fn single(setup: &mut Setup) -> [Vec<[f32; 3]>; 2] {
    setup.stages.params.steps_per_angstrom = 0.0;
    setup.poison(&[BufferId::Positions, BufferId::Normals]);
    let out = setup.run(Stage::Interpolate, &interpolate_inputs(setup), &[BufferId::Positions, BufferId::Normals]);
    [cast(&out[0]), cast(&out[1])]
}

/// Output of `interpolate` in steps: all bytes that single precision would take.
fn in_steps(setup: &mut Setup, step: Step) -> [Vec<u8>; 2] {
    setup.stages.params.steps_per_angstrom = step.per_angstrom();
    setup.poison(&[BufferId::Positions, BufferId::Normals]);
    let out = setup.run(Stage::Interpolate, &interpolate_inputs(setup), &[BufferId::Positions, BufferId::Normals]);
    setup.stages.params.steps_per_angstrom = 0.0;
    out.try_into().unwrap()
}

/// Vertices quantized on the host, and poison for the remaining bytes.
fn rounded(step: Step, positions: &[[f32; 3]], normals: &[[f32; 3]]) -> [Vec<u8>; 2] {
    let row = |p: &[f32; 3]| {
        let [x, y, z] = step.position(*p);
        [x, y, z, 0]
    };
    let unit = |n: &[f32; 3]| {
        let [x, y, z] = normal(*n);
        [x, y, z, 0]
    };
    let mut bytes = [
        raw(&positions.iter().map(row).collect::<Vec<[i16; 4]>>()),
        raw(&normals.iter().map(unit).collect::<Vec<[i8; 4]>>()),
    ];
    for column in &mut bytes {
        column.resize(12 * positions.len(), 0xa5);
    }
    bytes
}

#[test]
fn interpolate_quantizes_like_the_host() {
    for (name, mut setup) in setups() {
        let [positions, normals] = single(&mut setup);
        let extent = positions.as_flattened().iter().fold(0.0_f32, |most, v| most.max(v.abs()));
        // A step that fits, a coarse one, and one that does not cover the outermost vertices.
        let steps = [extent, 20_000.0, 0.5 * extent].map(|reach| Step::covering(f64::from(reach)));
        for (i, step) in steps.into_iter().enumerate() {
            let got = in_steps(&mut setup, step);
            let expected = rounded(step, &positions, &normals);
            assert_eq!(unequal(&got[0], &expected[0]), None, "{name} {step:?}: positions");
            // A driver that fuses the last product with its rounding may be off by one. Software Vulkan does not.
            assert_eq!(unequal(&got[1], &expected[1]), None, "{name} {step:?}: normals");
            let n_beyond = cast::<i16>(&got[0][..8 * positions.len()]).iter().filter(|&&v| v == BEYOND).count();
            assert_eq!(n_beyond > 0, i == 2, "{name} {step:?}: {n_beyond} beyond");
            // Negative controls: another step, and a vertex moved by one step.
            let other = rounded(Step::covering(2.1 * f64::from(step.reach())), &positions, &normals);
            assert!(unequal(&got[0], &other[0]).is_some());
            let (mut moved, mut turned) = (positions.clone(), normals.clone());
            moved[7][1] += step.length();
            turned[7] = turned[7].map(|c| c + 1.5 / 127.0);
            let other = rounded(step, &moved, &turned);
            assert!(unequal(&got[0], &other[0]).is_some() || n_beyond > 0, "{name}");
            assert!(unequal(&got[1], &other[1]).is_some());
        }
    }
}

#[test]
fn interpolate_marks_coordinates_that_are_not_numbers() {
    let mut setup = Setup::new(&spheres(&[[0.0, 0.0, 0.0, 1.7]]), SurfaceKind::Gaussian, 0.5);
    let spacing = setup.stages.params.spacing;
    for (bad, marked) in [(f32::NAN, true), (f32::INFINITY, true), (spacing, false)] {
        setup.stages.params.spacing = bad;
        let [positions, _] = in_steps(&mut setup, Step::covering(4.0));
        let n = setup.cpu.mesh.n_vertices();
        let rows: Vec<[i16; 4]> = cast(&positions[..8 * n]);
        // Infinity times 0 is not a number.
        let all = |row: &[i16; 4]| row[..3].iter().all(|&v| (v == BEYOND) == marked) && row[3] == 0;
        assert!(rows.iter().all(all), "{bad}: {rows:?}");
    }
}

/// Near one direction and its mirror images, rounding makes a normal too long. The atom is placed so that one vertex
/// has that direction.
#[test]
fn interpolate_shortens_the_same_normals_as_the_host() {
    let mut setup = Setup::new(&spheres(&[[0.3, 0.1, 0.2, 1.7]]), SurfaceKind::Vdw, 0.5);
    let [positions, _] = single(&mut setup);
    let (h, centre) = (f64::from(setup.stages.params.spacing), setup.stages.params.centre);
    let atom = setup.job.prepared.lattice.atoms[0];
    let steep = [66.5_f64, 75.5, 77.5];
    let length = steep.iter().map(|c| c * c).sum::<f64>().sqrt();
    let orders = [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]];
    let mut shortened = 0;
    for (signs, order) in (0..8).flat_map(|signs| orders.map(|order| (signs, order))) {
        let sign = |k: usize| if signs >> k & 1 == 1 { -1.0 } else { 1.0 };
        let way: [f64; 3] = std::array::from_fn(|k| sign(k) * steep[order[k]] / length);
        // Position of the atom three spacings from the vertex.
        let at: [f64; 3] =
            std::array::from_fn(|k| f64::from(positions[9][k]) / h + f64::from(centre[k]) - 3.0 * way[k]);
        #[expect(clippy::cast_possible_truncation, reason = "a few spacings, and a fraction of one")]
        let moved =
            LatticeAtom { cell: at.map(|c| c.round() as i32), frac: at.map(|c| (c - c.round()) as f32), ..atom };
        setup.stages.write(BufferId::Atoms, bytemuck::bytes_of(&moved));
        let [positions, normals] = single(&mut setup);
        let step = Step::covering(8.0);
        let expected = rounded(step, &positions, &normals);
        let got = in_steps(&mut setup, step);
        assert_eq!(unequal(&got[1], &expected[1]), None, "{way:?}");
        let plain = normals[9].map(|c| (127.0 * c).round_ties_even().abs());
        shortened += usize::from(plain.iter().map(|c| c * c).sum::<f32>() > 16_347.0);
    }
    assert!(shortened > 24, "{shortened} of 48 normals were too long");
}

#[test]
fn emit_makes_the_same_triangles() {
    for (name, setup) in setups() {
        setup.stages.poison(BufferId::Triangles);
        let inputs = |counts: &[u32]| {
            [
                (BufferId::Inside, raw(&setup.inside())),
                (BufferId::Records, raw(&setup.records())),
                (BufferId::Counts, raw(counts)),
                (BufferId::Offsets, raw(&setup.offsets())),
                (BufferId::Counters, raw(&[Counters::default()])),
            ]
        };
        let mut counts = setup.counts();
        let out = setup.run(Stage::Emit, &inputs(&counts), &[BufferId::Triangles, BufferId::Counters]);
        let got: Vec<[u32; 3]> = cast(&out[0]);
        assert_eq!(unequal(&got, &setup.cpu.mesh.triangles), None, "{name}");
        let counters = cast::<Counters>(&out[1])[0];
        assert_eq!((counters.checksum, counters.degenerate), ([0, 0], 0), "{name}: a closed mesh");
        let mut wrong = got.clone();
        wrong[got.len() - 1].rotate_left(1);
        assert!(unequal(&wrong, &setup.cpu.mesh.triangles).is_some());
        // Without the last triangle the mesh has a hole, and the checksum is that of the host.
        let last = counts.iter().rposition(|count| count >> 16 > 0).unwrap();
        counts[last] -= 1 << 16;
        let out = setup.run(Stage::Emit, &inputs(&counts), &[BufferId::Counters]);
        let counters = cast::<Counters>(&out[0])[0];
        let expected = checksum(&got[..got.len() - 1]);
        assert_eq!((counters.checksum, counters.degenerate), (halves(expected), 0), "{name}: a hole");
        assert_ne!(expected, 0);
    }
}

#[test]
fn emit_counts_triangles_with_a_corner_twice() {
    let setup = Setup::new(&spheres(&[[0.0, 0.0, 0.0, 1.7]]), SurfaceKind::Gaussian, 0.5);
    // Without crossing edges before a word, several vertices have the same number.
    let mut records = setup.records();
    for record in &mut records {
        record.crossing = [0; 48];
    }
    let inputs = [
        (BufferId::Inside, raw(&setup.inside())),
        (BufferId::Records, raw(&records)),
        (BufferId::Counts, raw(&setup.counts())),
        (BufferId::Offsets, raw(&setup.offsets())),
        (BufferId::Counters, raw(&[Counters::default()])),
    ];
    let out = setup.run(Stage::Emit, &inputs, &[BufferId::Triangles, BufferId::Counters]);
    let twice = cast::<[u32; 3]>(&out[0]).iter().filter(|[a, b, c]| a == b || b == c || c == a).count();
    assert_eq!((twice > 0, cast::<Counters>(&out[1])[0].degenerate as usize), (true, twice));
}

/// Number of triangles that a workgroup lists at once.
const WINDOW: u32 = 256;

/// Block that `measure` writes for a brick.
#[derive(Debug, Clone, PartialEq)]
struct Block {
    sheets: Vec<SheetResults>,
    /// Owner, key and sheet of each shared vertex, if there are several sheets.
    vertices: Vec<[u32; 3]>,
}

/// Blocks by brick. They follow the table of their offsets.
fn blocks(words: &[u32], n_bricks: usize) -> HashMap<u32, Block> {
    let all = words;
    let (table, mut words) = words.split_at(n_bricks);
    let mut blocks = HashMap::new();
    while let Some((&[brick, counts, x, y, z], rest)) = words.split_first_chunk() {
        assert_eq!(table[brick as usize] as usize, all.len() - words.len(), "the offset of brick {brick}");
        let (sheets, rest) = rest.split_at(12 * (counts & 0xffff) as usize);
        let (vertices, rest) = rest.split_at((counts >> 16) as usize);
        words = rest;
        let sheet = |words: &[u32; 12]| SheetResults {
            origin: [x, y, z].map(u32::cast_signed),
            count: [words[0] & 0xffff, words[0] >> 16],
            near: std::array::from_fn(|k| words[1].to_le_bytes()[k]),
            sums: std::array::from_fn(|k| f64::from(f32::from_bits(words[2 + k]))),
        };
        let block = Block {
            sheets: sheets.as_chunks().0.iter().map(sheet).collect(),
            vertices: vertices.iter().map(|word| [word & 7, word >> 3 & 0x7ff, word >> 14]).collect(),
        };
        assert!(blocks.insert(brick, block).is_none(), "brick {brick} has two blocks");
    }
    assert_eq!(table.iter().filter(|offset| **offset != NONE).count(), blocks.len());
    blocks
}

/// Twice the area of all sheets.
fn twice_the_area(blocks: &HashMap<u32, Block>) -> f64 {
    blocks.values().flat_map(|block| &block.sheets).map(|sheet| sheet.sums[0]).sum()
}

/// Returns true if two sheets have the same sums, up to rounding in single precision.
fn same_sheet(a: &SheetResults, b: &SheetResults, several: bool) -> bool {
    // Positions are at most 8: products are up to 24 times the area, moments up to 384 times.
    let bound = |k: usize| b.sums[0].max(0.01) * [2e-6, 4e-5, 6e-4][k.saturating_sub(1) / 3];
    let close = (0..10).all(|k| (a.sums[k] - b.sums[k]).abs() <= bound(k));
    let below = !several || a.near[1] == b.near[1];
    close && below && (a.origin, a.count, a.near[0]) == (b.origin, b.count, b.near[0])
}

/// Returns the first difference of a block from the CPU's sheets of a brick. Backends number sheets in different
/// orders.
fn block_difference(block: &Block, brick: &SurfaceResults) -> Option<String> {
    let several = brick.sheets.len() > 1;
    if block.sheets.len() != brick.sheets.len() || !several && !block.vertices.is_empty() {
        return Some(format!("{} sheets of {}", block.sheets.len(), brick.sheets.len()));
    }
    let own: HashMap<u32, usize> =
        block.vertices.iter().filter(|[owner, ..]| *owner == 0).map(|[_, key, on]| (*key, *on as usize)).collect();
    let mut number: Vec<Option<usize>> = vec![None; block.sheets.len()];
    for [key, theirs] in &brick.shared {
        let Some(sheet) = own.get(&u32::from(*key)) else { return Some(format!("no vertex {key:#x}")) };
        if *number[*sheet].get_or_insert(usize::from(*theirs)) != usize::from(*theirs) {
            return Some(format!("vertex {key:#x} is on sheet {sheet}"));
        }
    }
    if own.len() != brick.shared.len() {
        return Some(format!("{} shared vertices of {}", own.len(), brick.shared.len()));
    }
    // Sheets without such a vertex are recognized by their sums.
    let taken: Vec<usize> = number.iter().flatten().copied().collect();
    let mut left: Vec<usize> = (0..brick.sheets.len()).filter(|sheet| !taken.contains(sheet)).collect();
    for (sheet, number) in block.sheets.iter().zip(&number) {
        let same = |theirs: usize| same_sheet(sheet, &brick.sheets[theirs], several);
        let found =
            number.map_or_else(|| left.iter().position(|&theirs| same(theirs)).map(|at| left.swap_remove(at)), Some);
        if !found.is_some_and(same) {
            return Some(format!("{sheet:?}, expected {:?}", found.map_or(brick.sheets[0], |at| brick.sheets[at])));
        }
    }
    None
}

/// Inputs of `measure`.
fn measure_inputs(setup: &Setup) -> Vec<(BufferId, Vec<u8>)> {
    vec![
        (BufferId::Crossings, raw(&setup.crossings())),
        (BufferId::Inside, raw(&setup.inside())),
        (BufferId::Records, raw(&setup.records())),
        (BufferId::Counts, raw(&setup.counts())),
        (BufferId::Counters, raw(&[Counters::default()])),
    ]
}

/// Structures with several sheets per brick: small atoms on a coarse grid, whose cells have every case of the table,
/// and a shell around a void.
fn many_sheets() -> Vec<(String, Setup)> {
    let dust: Vec<[f64; 4]> = Random(23).cloud(500, 60.0).iter().map(|[x, y, z, _]| [*x, *y, *z, 1.2]).collect();
    let turn = |i: u32| f64::from(i) * 2.399_963;
    let shell: Vec<[f64; 4]> = (0..400)
        .map(|i| (1.0 - f64::from(i) / 199.5, turn(i)))
        .map(|(z, a)| (9.0 * z, 9.0 * (1.0 - z * z).max(0.0).sqrt(), a))
        .map(|(z, r, a)| [r * a.cos(), r * a.sin(), z, 1.6])
        .collect();
    let dust = |h| (format!("dust {h}"), Setup::new(&spheres(&dust), SurfaceKind::SoftObject, h));
    vec![dust(1.3), dust(2.1), ("shell".to_owned(), Setup::new(&spheres(&shell), SurfaceKind::Gaussian, 1.1))]
}

#[test]
fn measure_finds_the_same_sheets_and_sums() {
    let (mut most, mut long) = (0, false);
    for (name, setup) in setups().into_iter().chain(many_sheets()) {
        setup.poison(&[BufferId::Sheets]);
        let out = setup.run(Stage::Measure, &measure_inputs(&setup), &[BufferId::Sheets, BufferId::Counters]);
        let n_bricks = setup.surface.len();
        let (words, made) = (cast::<u32>(&out[0]), n_bricks + cast::<Counters>(&out[1])[0].sheet_words as usize);
        assert!(words[made..].iter().all(|&word| word == 0xa5a5_a5a5), "{name}: beyond the last block");
        let blocks = blocks(&words[..made], n_bricks);
        assert_eq!(blocks.len(), setup.cpu.surface.len(), "{name}");
        for (id, brick) in (0..).zip(&setup.surface) {
            // An empty brick has no block.
            assert_eq!(blocks.contains_key(&id), brick.is_some(), "{name}");
            let Some(brick) = brick else { continue };
            assert_eq!(block_difference(&blocks[&id], brick), None, "{name}: brick {id}");
            most = most.max(brick.sheets.len());
            long |= brick.sheets.len() > 1 && brick.count[1] > WINDOW;
        }
        let sheets = setup.surface.iter().flatten().flat_map(|brick| &brick.sheets);
        let (found, expected) = (twice_the_area(&blocks), sheets.map(|sheet| sheet.sums[0]).sum::<f64>());
        assert!((found / expected - 1.0).abs() < 1e-6, "{name}: {found}, expected {expected}");
        // Negative controls: sums that are off by ten times their bound, and a vertex on another sheet.
        let (id, brick) = (0..).zip(&setup.surface).find_map(|(id, b)| Some((id, b.as_ref()?))).unwrap();
        for (k, bound) in [(0, 2e-6), (3, 2e-6), (5, 4e-5), (9, 6e-4)] {
            let mut wrong = blocks[&id].clone();
            wrong.sheets[0].sums[k] += 10.0 * bound * brick.sheets[0].sums[0].max(0.01);
            assert!(block_difference(&wrong, brick).is_some(), "{name}: {k}");
        }
        let several = (0..).zip(&setup.surface).find(|(_, b)| b.as_ref().is_some_and(|b| b.shared.len() > 1));
        if let Some((id, Some(brick))) = several {
            let mut wrong = blocks[&id].clone();
            let own = wrong.vertices.iter().position(|[owner, ..]| *owner == 0).unwrap();
            wrong.vertices[own][2] = (wrong.vertices[own][2] + 1) % u32_of(brick.sheets.len());
            assert!(block_difference(&wrong, brick).is_some(), "{name}");
        }
    }
    assert!(most > 10, "at most {most} sheets in a brick");
    assert!(long, "no brick with several sheets takes several windows");
}

#[test]
fn measure_sums_the_positions_that_interpolate_rounds() {
    let mut setup = Setup::new(&sample("4pti.pdb"), SurfaceKind::Gaussian, 0.7);
    let [positions, _] = single(&mut setup);
    let inputs = measure_inputs(&setup);
    let triangles = setup.cpu.mesh.triangles.clone();
    let mut area_in_steps = |step: Step| {
        setup.stages.params.steps_per_angstrom = step.per_angstrom();
        let out = setup.run(Stage::Measure, &inputs, &[BufferId::Sheets, BufferId::Counters]);
        setup.stages.params.steps_per_angstrom = 0.0;
        let n_bricks = setup.surface.len();
        let made = n_bricks + cast::<Counters>(&out[1])[0].sheet_words as usize;
        twice_the_area(&blocks(&cast::<u32>(&out[0])[..made], n_bricks))
    };
    for reach in [100.0, 5_000.0] {
        let step = Step::covering(reach);
        let rounded: Vec<[f64; 3]> = positions.iter().map(|p| step.position(*p).map(f64::from)).collect();
        let exact: Vec<[f64; 3]> =
            positions.iter().map(|p| p.map(|c| f64::from(c) * f64::from(step.per_angstrom()))).collect();
        let area = |positions: &[[f64; 3]]| -> f64 {
            let twice = |t: &[u32; 3]| {
                let [a, b, c] = t.map(|v| positions[v as usize]);
                let [u, v] = [b, c].map(|p| [p[0] - a[0], p[1] - a[1], p[2] - a[2]]);
                let n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
                n.iter().map(|c| c * c).sum::<f64>().sqrt()
            };
            triangles.iter().map(twice).sum()
        };
        let (expected, unrounded) = (area(&rounded), area(&exact));
        let found = area_in_steps(step);
        assert!((found / expected - 1.0).abs() < 1e-6, "{step:?}: {found}, expected {expected}");
        // Negative control: positions that are not rounded.
        assert!((unrounded / expected - 1.0).abs() > 2e-6, "{step:?}: {unrounded}, {expected}");
    }
}

#[test]
fn measure_counts_blocks_that_do_not_fit_and_writes_nothing_beyond_the_capacity() {
    let mut setup = Setup::new(&sample("1crn.cif"), SurfaceKind::Gaussian, 0.7);
    let inputs = measure_inputs(&setup);
    let run = |setup: &Setup| {
        setup.poison(&[BufferId::Sheets]);
        let out = setup.run(Stage::Measure, &inputs, &[BufferId::Counters, BufferId::Sheets]);
        (cast::<Counters>(&out[0])[0].sheet_words, cast::<u32>(&out[1]))
    };
    let (all, _) = run(&setup);
    let (size, n_bricks) = (setup.stages.params.sheet_capacity as usize, setup.surface.len());
    setup.stages.params.sheet_capacity = u32_of(n_bricks) + all / 2;
    let (counted, words) = run(&setup);
    setup.stages.params.sheet_capacity = u32_of(size);
    assert_eq!((counted, words.len()), (all, n_bricks + all as usize / 2));
    assert!(words[n_bricks..].iter().any(|&word| word != 0xa5a5_a5a5));
    assert!(words[..n_bricks].iter().all(|&place| place == NONE || (place as usize) < words.len()));
    let beyond = setup.stages.read(BufferId::Sheets, 4 * (n_bricks as u64 + u64::from(all))).unwrap();
    assert!(cast::<u32>(&beyond)[words.len()..].iter().all(|&word| word == 0xa5a5_a5a5));
}
