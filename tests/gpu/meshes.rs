//! Meshes of the engine compared with those of the CPU backend, on software Vulkan.
#![expect(clippy::unwrap_used, clippy::float_cmp, reason = "tests may panic and compare exactly")]

use crate::gpu_support;
use crate::measure_support::agree;

use std::sync::Arc;

use gpu_support::{
    POSITION_BOUND, Random, SURFACES, engine, engine_with, job, measures, mesh_of, params, quantized, run, sample,
    spheres,
};
use molmesh::gpu::plan::ChunkLimits;
use molmesh::gpu::{DeviceLimits, Engine, Executor, GpuError, GpuJob, Prepared};
use molmesh::surface::quantize::BEYOND;
use molmesh::surface::{
    Backend, Control, CpuBackend, Limit, Mesh, MeshOutput, Quantized, Spheres, SurfaceError, SurfaceKind,
    SurfaceLimits, SurfaceOptions, SurfaceParams,
};

fn cpu(spheres: &Spheres, params: &SurfaceParams) -> MeshOutput {
    CpuBackend::new(Some(2)).unwrap().run(spheres, params, &SurfaceLimits::default(), &Control::default()).unwrap()
}

/// Maximum relative difference of measures of surfaces of spheres, whose vertices lie within 10⁻⁴ Å of the surface.
const SPHERE_BOUND: f64 = 1e-4;
/// Maximum distance of vertices along their edges, Å. An edge that is almost tangent to the surface magnifies the
/// distance of its vertex from the surface.
const TANGENT_BOUND: f32 = 5e-3;

/// Returns the first difference of `mesh` from `expected`, with bounds in Å. Distances along the normals, which are
/// those of the surfaces, have a closer bound.
fn difference(mesh: &Mesh, expected: &Mesh) -> Option<String> {
    if mesh.centre != expected.centre {
        return Some("centre".to_owned());
    }
    if mesh.triangles != expected.triangles {
        let first = mesh.triangles.iter().zip(&expected.triangles).position(|(a, b)| a != b);
        return Some(format!("{} triangles of {}, first at {first:?}", mesh.n_triangles(), expected.n_triangles()));
    }
    let furthest = |a: &[[f32; 3]], b: &[[f32; 3]]| {
        let apart = |(a, b): (&[f32; 3], &[f32; 3])| (0..3).map(|k| (a[k] - b[k]).abs()).fold(0.0, f32::max);
        a.iter().zip(b).map(apart).fold(0.0, f32::max)
    };
    let (n, shifted) = (mesh.n_vertices(), furthest(&mesh.positions, &expected.positions));
    let rows = mesh.positions.iter().zip(&expected.positions).zip(&expected.normals);
    let apart = rows.map(|((a, b), n)| (0..3).map(|k| (a[k] - b[k]) * n[k]).sum::<f32>().abs()).fold(0.0, f32::max);
    let turned = furthest(&mesh.normals, &expected.normals);
    let same_size = n == expected.n_vertices() && mesh.normals.len() == n;
    (!same_size || apart > POSITION_BOUND || shifted > TANGENT_BOUND || turned > 2e-2).then(|| {
        format!("{n} vertices of {}, {apart} Å apart, shifted by {shifted}, normals {turned}", expected.n_vertices())
    })
}

fn assert_equal(gpu: &MeshOutput, spheres: &Spheres, params: &SurfaceParams, what: &str) {
    let cpu = cpu(spheres, params);
    let measure = if params.surface.kernel().is_some() { 1e-5 } else { SPHERE_BOUND };
    assert_eq!(difference(&gpu.mesh, &cpu.mesh), None, "{what}");
    assert_eq!(gpu.grid, cpu.grid, "{what}");
    let (a, b) = (measures(gpu), measures(&cpu));
    assert!(a.closed && a.oriented && a.manifold, "{what}: {a:?}");
    assert_eq!((a.euler, a.components.len()), (b.euler, b.components.len()), "{what}");
    assert!((a.area / b.area - 1.0).abs() < measure && (a.volume / b.volume - 1.0).abs() < measure, "{what}");
    assert_measured(gpu, what);
    for n in &gpu.mesh.normals {
        let length = n.iter().map(|c| f64::from(*c).powi(2)).sum::<f64>().sqrt();
        assert!((length - 1.0).abs() < 1e-5, "{what}: normal {n:?}");
    }
}

/// Asserts that the device's measures are those of the mesh.
#[track_caller]
fn assert_measured(gpu: &MeshOutput, what: &str) {
    let (taken, found) = (gpu.measures.as_ref().unwrap(), measures(gpu));
    assert!(agree(taken, &found, &gpu.mesh), "{what}: {taken:?} {found:?}");
    assert_eq!(gpu.bounds, Some(gpu.mesh.bounds()), "{what}");
    // Negative control: the measures of one component less.
    let mut fewer = taken.clone();
    fewer.components.pop();
    assert!(!agree(&fewer, &found, &gpu.mesh));
}

#[test]
fn structures_are_equal_to_the_cpu_with_every_kernel() {
    for name in ["4pti.pdb", "1crn.cif"] {
        let spheres = sample(name);
        for surface in SURFACES {
            let params = params(surface, 0.5);
            let meshed = mesh_of(&mut engine(), &spheres, &params);
            assert_equal(&meshed, &spheres, &params, &format!("{name} {surface}"));
        }
    }
}

/// Asserts that the engine's quantized vertices equal its single-precision vertices quantized by the host, bit by bit,
/// and that the rest of the mesh is unchanged. Returns the quantized mesh.
#[track_caller]
fn assert_quantized(engine: &mut Engine, spheres: &Spheres, params: &SurfaceParams, what: &str) -> MeshOutput {
    let single = mesh_of(engine, spheres, params).mesh;
    assert_quantizes(engine, &single, spheres, params, what)
}

/// The same, with the single-precision mesh.
#[track_caller]
fn assert_quantizes(
    engine: &mut Engine,
    single: &Mesh,
    spheres: &Spheres,
    params: &SurfaceParams,
    what: &str,
) -> MeshOutput {
    let small = quantized(spheres, params);
    let meshed = mesh_of(engine, spheres, &small);
    let mut expected = single.clone();
    assert!(expected.quantize(small.quantize.unwrap()));
    assert!(meshed.mesh == expected, "{what}");
    assert!(meshed.mesh.positions.is_empty() && meshed.mesh.normals.is_empty());
    assert_eq!(single.bytes() - meshed.mesh.bytes(), 12 * single.n_vertices() as u64, "{what}");
    let quantized = meshed.mesh.quantized.as_ref().unwrap();
    assert!(quantized.positions.iter().all(|row| row[3] == 0 && !row.contains(&BEYOND)), "{what}");
    // Negative controls: a vertex and a normal that are off by one.
    let changed = |change: &dyn Fn(&mut Quantized)| {
        let mut mesh = meshed.mesh.clone();
        change(mesh.quantized.as_mut().unwrap());
        mesh != expected
    };
    assert!(changed(&|q| q.positions[5][2] += 1) && changed(&|q| q.normals[5][0] ^= 1));
    assert_measured(&meshed, what);
    meshed
}

#[test]
fn quantized_vertices_equal_those_of_the_host_with_every_kernel() {
    for name in ["4pti.pdb", "1crn.cif"] {
        let spheres = sample(name);
        for surface in SURFACES {
            let params = params(surface, 0.5);
            let meshed = assert_quantized(&mut engine(), &spheres, &params, &format!("{name} {surface}"));
            let (found, cpu) = (measures(&meshed), measures(&cpu(&spheres, &quantized(&spheres, &params))));
            assert!(found.closed && found.oriented && found.manifold, "{name} {surface}: {found:?}");
            assert_eq!((found.euler, found.components.len()), (cpu.euler, cpu.components.len()));
            let bound = if params.surface.kernel().is_some() { 1e-5 } else { SPHERE_BOUND };
            assert!((found.area / cpu.area - 1.0).abs() < bound && (found.volume / cpu.volume - 1.0).abs() < bound);
        }
    }
}

#[test]
fn edge_cases_are_quantized_like_on_the_host() {
    for (name, rows, resolution) in edge_cases() {
        let spheres = spheres(&rows);
        for surface in SURFACES {
            let params = params(surface, resolution);
            let single = run(&mut engine(), &job(&spheres, &params));
            if let Ok(single) = single {
                let what = format!("{name} {surface}");
                assert_quantizes(&mut engine(), &single.meshed.mesh, &spheres, &params, &what);
            }
        }
    }
}

#[test]
fn quantized_vertices_in_chunks_pieces_and_readback_buffers_have_the_same_bytes() {
    let cloud: Vec<[f64; 4]> =
        Random(11).cloud(1500, 70.0).iter().map(|[x, y, z, r]| [x - 20.0, y + 3.0, z - 40.0, *r]).collect();
    let crowd = spheres(&cloud);
    let ids = SurfaceOptions { resolution: Some(0.5), atom_ids: true, ..SurfaceOptions::default() };
    let ids = SurfaceParams::new(&ids).unwrap();
    let whole = assert_quantized(&mut engine(), &crowd, &ids, "whole");
    let small = quantized(&crowd, &ids);
    let cut: [(&str, Change); 2] = [
        ("all three", |b| (b.chunk_bricks, b.piece_bytes, b.readback_bytes) = (1200, 1 << 20, 2 << 20)),
        ("counted first", |b| b.small_bytes = 0),
    ];
    for (what, change) in cut {
        let mut engine = engine_with(change);
        // Reuses buffers of a job with the other vertex layout, and its own.
        for params in [&ids, &small, &small] {
            let meshed = mesh_of(&mut engine, &crowd, params);
            assert_eq!(meshed.mesh.quantized.is_some(), params.quantize.is_some());
            if params.quantize.is_some() {
                assert!(meshed.mesh == whole.mesh, "{what}");
                assert_eq!(meshed.measures, whole.measures, "{what}");
            }
        }
    }
}

#[test]
fn jobs_with_both_vertex_layouts_share_a_submission() {
    let mut random = Random(5);
    let clouds: Vec<Spheres> = (2..=6).map(|n| spheres(&random.cloud(n * n * 7, 6.0 * n as f64))).collect();
    let wanted = |(i, cloud): (usize, &Spheres)| {
        let plain = params(SURFACES[i % 3], 0.5);
        job(cloud, &if i % 2 == 0 { plain } else { quantized(cloud, &plain) })
    };
    let jobs: Vec<_> = clouds.iter().enumerate().map(wanted).collect();
    let mut engine = engine_with(|_| ());
    let answers = engine.run(&jobs);
    assert_eq!(engine.submissions(), 1);
    for ((i, answer), job) in answers.into_iter().enumerate().zip(&jobs) {
        let (together, alone) = (answer.unwrap().meshed, run(&mut engine, job).unwrap().meshed);
        assert_eq!(together.mesh.quantized.is_some(), i % 2 == 1);
        assert!(together.mesh == alone.mesh, "{i}");
    }
    // If the estimate is too low, the output is made again.
    let mut engine = engine_with(|b| b.rows_per_brick = [20, 20]);
    let again = mesh_of(&mut engine, &clouds[1], &jobs[1].prepared.params);
    assert!(again.mesh == run(&mut engine_with(|_| ()), &jobs[1]).unwrap().meshed.mesh);
}

#[test]
fn idle_readback_buffers_are_kept_between_jobs_and_released_on_request() {
    let spheres = sample("1crn.cif");
    let wanted = params(SURFACES[0], 0.4);
    let held = |idle_bytes| {
        let mut engine = engine_with(|b| (b.small_bytes, b.idle_bytes) = (0, idle_bytes));
        let mesh = mesh_of(&mut engine, &spheres, &wanted).mesh;
        let (bytes, in_use) = (mesh.bytes(), engine.held_bytes());
        drop(mesh);
        let between = engine.held_bytes();
        engine.release_idle_memory();
        let after = engine.held_bytes();
        assert!(mesh_of(&mut engine, &spheres, &wanted).mesh.n_triangles() > 0, "it works afterwards");
        (bytes, [in_use, between, after])
    };
    let (bytes, [in_use, between, after]) = held([1 << 30, 0]);
    assert_eq!(between, in_use, "kept for the next job");
    assert!(after + bytes <= between, "{after} {bytes} {between}");
    // Negative controls: a higher limit keeps the buffers, and a limit of 0 frees them at once.
    let (_, [in_use, between, after]) = held([1 << 30, 1 << 30]);
    assert_eq!([between, after], [in_use; 2]);
    let (bytes, [in_use, between, _]) = held([0, 0]);
    assert!(between + bytes <= in_use, "{between} {bytes} {in_use}");
}

#[test]
fn a_device_with_reserved_memory_allocates_no_readback_buffer() {
    const RESERVE: u64 = 64 << 20;
    let spheres = sample("1crn.cif");
    let wanted = params(SURFACES[0], 0.4);
    let ways: [Change; 2] = [|_| (), |b| b.small_bytes = 0];
    for way in ways {
        let engine = || {
            engine_with(|b| {
                b.idle_bytes = [1 << 30, 0];
                way(b);
            })
        };
        // Returns the bytes held before the job, while its mesh lives, and after the release of the idle buffers.
        let held = |mut engine: Engine| {
            let before = engine.held_bytes();
            let mesh = mesh_of(&mut engine, &spheres, &wanted).mesh;
            let in_use = engine.held_bytes();
            drop(mesh);
            engine.release_idle_memory();
            [before, in_use, engine.held_bytes()]
        };
        let [before, in_use, after] = held(engine());
        let workspace = after - before;
        assert!(in_use > after, "negative control: without a reserve the job allocates readback buffers");
        let mut reserved = engine();
        reserved.reserve_memory(RESERVE);
        let reserve = reserved.held_bytes() - before;
        assert!(reserve > RESERVE / 4 && reserve <= RESERVE, "{reserve}");
        let [full, in_use, after] = held(reserved);
        assert_eq!(in_use - full, workspace, "the job allocates a workspace only");
        assert_eq!(after - before, workspace, "the reserve is released");
        // A small limit holds, and no reserve is possible below the smallest buffers.
        for bytes in [0, 10_000, 40_000, 5 << 20] {
            let mut small = engine();
            small.reserve_memory(bytes);
            assert!(small.held_bytes() - before <= bytes, "{bytes}");
            assert_eq!(small.held_bytes() > before, bytes >= 16_384);
        }
        // No buffer is larger than the device allows.
        let mut limited = engine_with(|b| b.readback_bytes = 1 << 20);
        limited.reserve_memory(1 << 40);
        assert_eq!(limited.held_bytes() - before, (4 << 20) - 8192);
    }
}

#[test]
fn a_quantized_mesh_takes_less_memory_and_less_of_a_limit() {
    let spheres = sample("1crn.cif");
    let plain = params(SURFACES[0], 0.4);
    let small = quantized(&spheres, &plain);
    let held = |params: &SurfaceParams| {
        let mut engine = engine_with(|b| b.small_bytes = 0);
        let meshed = mesh_of(&mut engine, &spheres, params);
        (engine.held_bytes(), meshed.mesh.n_vertices() as u64)
    };
    let ((much, n), (less, _)) = (held(&plain), held(&small));
    // Twelve bytes per vertex less on the device and in the readback buffer; sizes are rounded.
    assert!(much > less + 14 * n, "{much} {less} {n}");
    let bytes = mesh_of(&mut engine(), &spheres, &small).mesh.bytes();
    let within = |params: &SurfaceParams, max_mesh_bytes| {
        let limits = SurfaceLimits { max_mesh_bytes, ..SurfaceLimits::default() };
        let prepared = Prepared::new(&spheres, params, &limits, &Control::default()).unwrap();
        run(&mut engine(), &GpuJob { prepared: Arc::new(prepared), ..job(&spheres, params) })
    };
    assert!(within(&small, bytes).is_ok());
    for refused in [within(&small, bytes - 1), within(&plain, bytes)] {
        assert!(matches!(refused, Err(GpuError::Surface(error)) if error.exceeded(Limit::MeshBytes).is_some()));
    }
}

/// With a very wide spacing vertices lie out of reach of all atoms. Their normals come from the adjacent triangles.
#[test]
fn quantized_vertices_without_a_gradient_have_normals() {
    let (spheres, params) = (spheres(&[[0.0, 0.0, 0.0, 0.7]]), params(SURFACES[0], 20.0));
    let small = quantized(&spheres, &params);
    for small_bytes in [0, 16 << 20] {
        let mut engine = engine_with(|b| b.small_bytes = small_bytes);
        let (single, meshed) = (mesh_of(&mut engine, &spheres, &params), mesh_of(&mut engine, &spheres, &small));
        let normals = &meshed.mesh.quantized.as_ref().unwrap().normals;
        assert_eq!((normals.len(), single.mesh.normals.len()), (6, 6));
        for (found, unit) in normals.iter().zip(&single.mesh.normals) {
            // Computed from the quantized triangles, so they differ slightly.
            let off = (0..3).map(|k| (f32::from(found[k]) - 127.0 * unit[k]).abs()).fold(0.0, f32::max);
            assert!(off < 1.5 && *found != [0; 4], "{found:?} {unit:?}");
        }
    }
}

#[test]
fn control_the_comparison_finds_differences() {
    let spheres = sample("1crn.cif");
    let good = cpu(&spheres, &params(SURFACES[0], 1.0)).mesh;
    assert_eq!(difference(&good, &good), None);
    let changed = |change: &dyn Fn(&mut Mesh)| {
        let mut mesh = good.clone();
        change(&mut mesh);
        difference(&mesh, &good)
    };
    assert!(changed(&|m| m.triangles[7].swap(0, 1)).is_some());
    assert!(changed(&|m| _ = m.triangles.edit().pop()).is_some());
    assert!(changed(&|m| m.positions[3][1] += 2.0 * TANGENT_BOUND).is_some());
    assert!(changed(&|m| m.positions[3][1] += 2.0 * POSITION_BOUND / m.normals[3][1]).is_some());
    assert!(changed(&|m| m.normals[5] = m.normals[5].map(|c| -c)).is_some());
    assert!(changed(&|m| _ = m.positions.edit().pop()).is_some());
    assert!(changed(&|m| m.centre[0] += 0.5).is_some());
}

/// Small cases at boundaries of the grid and of parameters.
fn edge_cases() -> Vec<(&'static str, Vec<[f64; 4]>, f64)> {
    let mut random = Random(7);
    let ring = |n: u32| {
        (0..n).map(move |i| {
            let angle = f64::from(i) * std::f64::consts::TAU / f64::from(n);
            [10.0 * angle.cos(), 10.0 * angle.sin(), 0.37 * f64::from(i), 1.7]
        })
    };
    vec![
        ("one atom", vec![[0.1, -0.2, 0.3, 1.7]], 0.5),
        ("one atom on a tile's corner", vec![[0.0, 0.0, 0.0, 1.7]], 0.5),
        ("one atom before a tile's corner", vec![[31.9, -32.1, 63.99, 1.5]], 0.5),
        ("two atoms far apart", vec![[-400.0, 300.0, 20.0, 1.2], [5000.0, -2000.0, 900.0, 1.9]], 0.5),
        ("negative coordinates", ring(24).map(|[x, y, z, r]| [x - 90.0, y - 90.0, z - 130.0, r]).collect(), 0.4),
        ("across tiles", ring(40).map(|[x, y, z, r]| [x + 32.0, y + 32.0, z + 26.0, r]).collect(), 0.5),
        ("coarse", random.cloud(300, 60.0), 3.0),
        ("coarser than the atoms", random.cloud(60, 60.0), 1.3),
        ("fine", vec![[0.0, 0.0, 0.0, 1.5], [1.6, 0.3, -0.2, 1.7], [-0.9, 1.3, 0.4, 1.2]], 0.1),
        ("a crowd", random.cloud(2000, 24.0), 0.6),
        ("coinciding atoms", vec![[1.0, 2.0, 3.0, 1.5]; 5], 0.5),
        ("very different radii", vec![[0.0, 0.0, 0.0, 14.0], [16.0, 1.0, 0.0, 0.3], [-9.0, 12.0, 3.0, 1.1]], 0.6),
    ]
}

#[test]
fn edge_cases_are_equal_to_the_cpu() {
    for (name, rows, resolution) in edge_cases() {
        let spheres = spheres(&rows);
        for surface in SURFACES {
            let params = params(surface, resolution);
            let meshed = match run(&mut engine(), &job(&spheres, &params)) {
                Ok(finished) => finished.meshed,
                Err(e) => {
                    // The CPU finds no surface either.
                    let cpu = CpuBackend::new(Some(2)).unwrap();
                    let same = cpu.run(&spheres, &params, &SurfaceLimits::default(), &Control::default()).unwrap_err();
                    assert_eq!(e, GpuError::Surface(same), "{name} {surface}");
                    continue;
                }
            };
            assert_equal(&meshed, &spheres, &params, &format!("{name} {surface}"));
        }
    }
}

#[test]
fn parameters_of_the_paper_and_presets_are_equal_to_the_cpu() {
    use molmesh::surface::{Preset, SurfaceKind};
    let spheres = sample("1crn.cif");
    let all = [
        SurfaceOptions { preset: Some(Preset::SesLike), ..SurfaceOptions::default() },
        SurfaceOptions { preset: Some(Preset::VdwLike), atom_ids: true, ..SurfaceOptions::default() },
        SurfaceOptions { preset: Some(Preset::Quicksurf), radius_scale: Some(1.2), ..SurfaceOptions::default() },
        SurfaceOptions { smoothness: Some(40.0), cutoff_tolerance: Some(1e-6), ..SurfaceOptions::default() },
        SurfaceOptions { paper_a: Some(0.5), paper_b: Some(4.0), isovalue: Some(0.7), ..SurfaceOptions::default() },
        SurfaceOptions {
            surface: Some(SurfaceKind::SoftObject),
            paper_a: Some(1.5),
            paper_b: Some(3.0),
            isovalue: Some(0.6),
            ..SurfaceOptions::default()
        },
        SurfaceOptions {
            surface: Some(SurfaceKind::InverseSquare),
            paper_c: Some(0.8),
            paper_b: Some(5.0),
            isovalue: Some(0.9),
            atom_ids: true,
            ..SurfaceOptions::default()
        },
        SurfaceOptions { surface: Some(SurfaceKind::Sas), atom_ids: true, ..SurfaceOptions::default() },
        SurfaceOptions { surface: Some(SurfaceKind::Ses), probe: Some(0.0), ..SurfaceOptions::default() },
        SurfaceOptions {
            surface: Some(SurfaceKind::Ses),
            probe: Some(3.0),
            resolution: Some(0.8),
            atom_ids: true,
            ..SurfaceOptions::default()
        },
    ];
    for options in all {
        let params = SurfaceParams::new(&options).unwrap();
        let meshed = mesh_of(&mut engine(), &spheres, &params);
        assert_equal(&meshed, &spheres, &params, &format!("{options:?}"));
        let expected = cpu(&spheres, &params).mesh.atom_ids;
        assert_eq!(meshed.mesh.atom_ids.is_some(), expected.is_some());
        if let (Some(ids), Some(expected)) = (meshed.mesh.atom_ids, expected) {
            // Two atoms at the same distance may be exchanged.
            let other = ids.iter().zip(&expected).filter(|(a, b)| a != b).count();
            assert!(other * 1000 <= ids.len(), "{options:?}: {other} of {} nearest atoms differ", ids.len());
        }
    }
}

fn bytes(mesh: &Mesh) -> (Vec<u8>, Vec<u8>, Vec<u8>) {
    let raw = |rows: &[[f32; 3]]| bytemuck::cast_slice(rows).to_vec();
    (raw(&mesh.positions), raw(&mesh.normals), bytemuck::cast_slice(&mesh.triangles).to_vec())
}

/// Makes a budget smaller.
type Change = fn(&mut DeviceLimits);

#[test]
fn chunks_pieces_and_readback_buffers_change_no_byte() {
    let cuts: [(&str, Change); 4] = [
        ("chunks", |b| b.chunk_bricks = 900),
        ("pieces", |b| (b.small_bytes, b.piece_bytes) = (0, 2 << 20)),
        ("readback buffers", |b| (b.small_bytes, b.readback_bytes) = (0, 3 << 20)),
        ("all three", |b| (b.chunk_bricks, b.piece_bytes, b.readback_bytes) = (1200, 2 << 20, 3 << 20)),
    ];
    check_cuts(&params(SurfaceKind::Gaussian, 0.5), &cuts);
    check_cuts(&params(SurfaceKind::Ses, 0.5), &cuts[3..]);
}

fn check_cuts(params: &SurfaceParams, cuts: &[(&str, Change)]) {
    let mut random = Random(11);
    let cloud: Vec<[f64; 4]> =
        random.cloud(1500, 70.0).iter().map(|[x, y, z, r]| [x - 20.0, y + 3.0, z - 40.0, *r]).collect();
    let crowd = spheres(&cloud);
    let whole = mesh_of(&mut engine(), &crowd, params);
    assert_equal(&whole, &crowd, params, "whole");
    // Large enough to be cut by every budget below.
    let plan = job(&crowd, params).prepared;
    let chunks = plan.plan.chunks(0..plan.plan.tiles.len(), ChunkLimits { bricks: 900, candidates: 1 << 30 }).unwrap();
    assert!(chunks.len() > 4 && chunks.iter().all(|c| c.n_slots() <= 900), "{} chunks", chunks.len());
    assert!(whole.mesh.n_triangles() * 12 > 5 << 20, "{} triangles", whole.mesh.n_triangles());
    let again = mesh_of(&mut engine(), &crowd, params);
    assert_eq!(bytes(&whole.mesh), bytes(&again.mesh), "two runs");
    let last = cuts.len() - 1;
    for (i, &(what, change)) in cuts.iter().enumerate() {
        let mut engine = engine_with(change);
        let meshed = mesh_of(&mut engine, &crowd, params);
        assert_eq!(bytes(&meshed.mesh), bytes(&whole.mesh), "{what}");
        assert_eq!((&meshed.grid, &meshed.measures), (&whole.grid, &whole.measures), "{what}");
        if i == last {
            // Atoms in reverse order, with reused buffers.
            let backwards: Vec<[f64; 4]> = cloud.iter().rev().copied().collect();
            let other = mesh_of(&mut engine, &spheres(&backwards), params);
            assert_eq!(bytes(&other.mesh), bytes(&whole.mesh), "{what}, other order");
        }
    }
}

#[test]
fn dispatches_may_exceed_one_dimension() {
    // Isolated atoms: each has a few dozen bricks and little to compute.
    let rows: Vec<[f64; 4]> = (0..8000)
        .map(|i| [i % 20, i / 20 % 20, i / 400].map(|k| 41.3 * f64::from(k) - 300.0))
        .map(|[x, y, z]| [x, y, z, 1.4])
        .collect();
    let (spheres, params) = (spheres(&rows), params(SURFACES[1], 0.5));
    let job = job(&spheres, &params);
    assert!(job.prepared.plan.bricks.len() > 70_000, "{} bricks", job.prepared.plan.bricks.len());
    let meshed = run(&mut engine(), &job).unwrap().meshed;
    assert_equal(&meshed, &spheres, &params, "many");
}

#[test]
fn output_is_made_again_if_the_estimate_is_too_low() {
    let spheres = sample("1crn.cif");
    let params = params(SURFACES[0], 0.5);
    let whole = mesh_of(&mut engine(), &spheres, &params);
    for rows in [[1, 256], [128, 1], [20, 20]] {
        let mut engine = engine_with(|b| b.rows_per_brick = rows);
        let meshed = mesh_of(&mut engine, &spheres, &params);
        assert_eq!(bytes(&meshed.mesh), bytes(&whole.mesh), "{rows:?}");
        assert_eq!(meshed.measures, whole.measures, "{rows:?}");
    }
}

#[test]
fn sheets_are_made_again_if_the_estimate_is_too_low() {
    let crowd = spheres(&Random(11).cloud(900, 60.0));
    let params = params(SURFACES[0], 0.6);
    let whole = mesh_of(&mut engine(), &crowd, &params);
    assert_measured(&whole, "whole");
    let changes: [Change; 3] = [|b| b.small_bytes = 1 << 30, |b| b.small_bytes = 0, |b| b.chunk_bricks = 900];
    for (i, change) in changes.into_iter().enumerate() {
        let mut last = 0;
        for words in [64, 2] {
            let mut engine = engine_with(|b| {
                b.sheet_words_per_brick = words;
                change(b);
            });
            let meshed = mesh_of(&mut engine, &crowd, &params);
            assert_eq!(bytes(&meshed.mesh), bytes(&whole.mesh), "{i} {words}");
            assert_eq!(meshed.measures, whole.measures, "{i} {words}");
            assert!(engine.submissions() > last, "{i}: {} submissions with {words} words", engine.submissions());
            last = engine.submissions();
        }
    }
}

#[test]
fn measures_equal_those_of_the_cpu() {
    let relative = |a: f64, b: f64| (a / b - 1.0).abs();
    let crowd = spheres(&Random(11).cloud(1500, 50.0));
    for (k, (name, spheres, h)) in [("4pti", sample("4pti.pdb"), 0.4), ("crowd", crowd, 0.7)].into_iter().enumerate() {
        for (i, surface) in SURFACES.into_iter().enumerate() {
            let single = params(surface, h);
            // Each surface is quantized in one of the two cases.
            let params = if (i + k).is_multiple_of(2) { quantized(&spheres, &single) } else { single };
            let what = format!("{name} {surface} {:?}", params.quantize);
            let found = mesh_of(&mut engine(), &spheres, &params).measures.unwrap();
            let expected = cpu(&spheres, &params).measures.unwrap();
            assert_eq!((found.euler, found.components.len()), (expected.euler, expected.components.len()), "{what}");
            assert!(found.closed && found.manifold && found.validation == expected.validation);
            let bound = if params.surface.kernel().is_some() { 1e-6 } else { SPHERE_BOUND };
            assert!(relative(found.area, expected.area) < bound, "{what}: {} {}", found.area, expected.area);
            assert!(relative(found.volume, expected.volume) < bound, "{what}: {} {}", found.volume, expected.volume);
        }
    }
}

#[test]
fn jobs_that_share_a_submission_are_independent() {
    let mut random = Random(5);
    let clouds: Vec<Spheres> = (1..=7).map(|n| spheres(&random.cloud(n * n * 7, 6.0 * n as f64))).collect();
    let mut jobs: Vec<_> =
        clouds.iter().zip(SURFACES.iter().cycle()).map(|(cloud, &surface)| job(cloud, &params(surface, 0.5))).collect();
    // A job without a surface, a cancelled one, and a late one.
    let high = SurfaceOptions { isovalue: Some(1e6), ..SurfaceOptions::default() };
    jobs.push(job(&clouds[2], &SurfaceParams::new(&high).unwrap()));
    jobs.push(job(&clouds[3], &params(SURFACES[0], 0.5)));
    jobs[8].cancel.cancel();
    jobs.push(job(&clouds[3], &params(SURFACES[0], 0.5)));
    jobs[9].deadline = Some(std::time::Instant::now());
    let mut answers = gpu_support::run_all(&mut engine(), &jobs);
    assert_eq!(answers.len(), 10);
    assert_eq!(answers.pop().unwrap().unwrap_err(), GpuError::Surface(SurfaceError::Deadline));
    assert_eq!(answers.pop().unwrap().unwrap_err(), GpuError::Surface(molmesh::surface::SurfaceError::Cancelled));
    let none = molmesh::surface::SurfaceError::NoSurface { isovalue: Some(1e6) };
    assert_eq!(answers.pop().unwrap().unwrap_err(), GpuError::Surface(none));
    for ((answer, job), cloud) in answers.into_iter().zip(&jobs).zip(&clouds) {
        let together = answer.unwrap();
        assert_equal(&together.meshed, cloud, &job.prepared.params, "together");
        let alone = run(&mut engine(), job).unwrap();
        assert_eq!(bytes(&together.meshed.mesh), bytes(&alone.meshed.mesh));
    }
}

#[test]
fn meshes_outlive_the_engine_and_return_their_memory() {
    let params = params(SURFACES[0], 1.0);
    let spheres = sample("1crn.cif");
    // As a small job, and counted first.
    let ways: [Change; 2] = [|_| (), |b| b.small_bytes = 0];
    for way in ways {
        let mut engine = engine_with(way);
        let first = mesh_of(&mut engine, &spheres, &params);
        let (kept, with_one) = (bytes(&first.mesh), engine.held_bytes());
        let while_kept = {
            let _second = mesh_of(&mut engine, &spheres, &params);
            engine.held_bytes()
        };
        assert!(while_kept > with_one, "two meshes have two readback buffers");
        // A third job reuses the readback buffer of the second, and the workspace.
        let third = mesh_of(&mut engine, &spheres, &params);
        assert_eq!(engine.held_bytes(), while_kept);
        drop(third);
        drop(engine);
        assert_eq!(bytes(&first.mesh), kept);
    }
}

#[test]
fn a_job_beyond_the_memory_is_rejected_with_numbers() {
    let spheres = sample("1crn.cif");
    let params = params(SURFACES[0], 0.3);
    let mut engine = engine_with(|b| b.memory = 1 << 20);
    let error = run(&mut engine, &job(&spheres, &params)).unwrap_err();
    let GpuError::OutOfMemory(error) = error else { panic!("{error}") };
    assert!(error.actual > Some(error.max) && error.max == 1 << 20, "{error}");
    assert!(error.suggested_resolution > Some(0.3), "{error}");
    let mut engine = engine_with(|b| b.chunk_bricks = 10);
    let error = run(&mut engine, &job(&spheres, &params)).unwrap_err();
    assert!(matches!(error, GpuError::OutOfMemory(_)), "{error}");
}

#[test]
fn stage_times_are_reported_if_the_device_has_timestamps() {
    let (spheres, params) = (sample("1crn.cif"), params(SURFACES[0], 0.7));
    let has_timestamps = gpu_support::device().0.features().contains(wgpu::Features::TIMESTAMP_QUERY);
    for small_bytes in [0, 16 << 20] {
        let mut engine = engine_with(|b| b.small_bytes = small_bytes);
        let finished = run(&mut engine, &job(&spheres, &params)).unwrap();
        if has_timestamps {
            let stages: Vec<_> = finished.stages.iter().map(|(stage, _)| *stage).collect();
            assert_eq!(stages, molmesh::surface::Stage::ALL[..8]);
            assert!(finished.stages.iter().all(|(_, ns)| *ns < 60_000_000_000), "{:?}", finished.stages);
            assert!(finished.stages.iter().map(|(_, ns)| ns).sum::<u64>() > 1000, "{:?}", finished.stages);
        } else {
            assert!(finished.stages.is_empty());
        }
    }
}

#[test]
fn a_lost_device_is_an_error_without_panic() {
    let (spheres, params) = (sample("1crn.cif"), params(SURFACES[0], 0.7));
    for small in [0, 16 << 20] {
        let (device, queue) = gpu_support::device();
        let mut budget = DeviceLimits::of(&device.limits());
        budget.small_bytes = small;
        let mut engine = molmesh::gpu::Engine::with_budget(device.clone(), queue, budget).unwrap();
        let before = mesh_of(&mut engine, &spheres, &params);
        device.destroy();
        for _ in 0..2 {
            let error = run(&mut engine, &job(&spheres, &params)).unwrap_err();
            assert!(matches!(error, GpuError::Lost(_)), "{error}");
        }
        // Earlier meshes stay readable.
        assert_eq!(measures(&before).euler, measures(&cpu(&spheres, &params)).euler);
    }
}
