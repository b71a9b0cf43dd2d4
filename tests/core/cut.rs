//! Surfaces of selections that are cut out of the surface of the whole structure (`context=whole`).
#![allow(clippy::pedantic, clippy::unwrap_used, clippy::panic, reason = "tests fail by panicking")]

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};

use molmesh::formats::{Encoder, Format};
use molmesh::pipeline::params::{self, ParamError};
use molmesh::pipeline::{Choice, JobError, JobLimits, Product, estimate, run};
use molmesh::structure::{ReadLimits, StructureError, read, read_with, select};
use molmesh::surface::{Control, CpuBackend, Limit, MemoryMeter, Mesh, OutOfMemory, SurfaceError, SurfaceLimits};
use serde::Deserialize;

use crate::split::dimer;
use crate::tools;
use crate::tools::files::Files;

const SAMPLE: &str = include_str!("../../samples/4pti.pdb");

fn meshed_with(text: &str, pairs: &[(&str, &str)], limits: &JobLimits) -> Result<Product, JobError> {
    let backend = CpuBackend::new(Some(2)).unwrap();
    let choice = Choice { backend: &backend, reason: "" };
    let options = params::parse(pairs.iter().copied()).unwrap().options;
    run(text.as_bytes(), &options, limits, &choice, &Control::default(), &(), None)
}

fn meshed(text: &str, pairs: &[(&str, &str)]) -> Product {
    meshed_with(text, pairs, &JobLimits::default()).unwrap()
}

fn whole<'a>(pairs: &[(&'a str, &'a str)]) -> Vec<(&'a str, &'a str)> {
    [&[("context", "whole"), ("resolution", "0.9")], pairs].concat()
}

/// Triangle as the bits of its corners, in an order that does not depend on the first corner.
type Corners = [[u32; 3]; 3];

fn corners(mesh: &Mesh, triangle: [u32; 3]) -> Corners {
    let at = triangle.map(|v| mesh.position(v as usize).map(f32::to_bits));
    (0..3).map(|k| [at[k], at[(k + 1) % 3], at[(k + 2) % 3]]).min().unwrap()
}

fn triangles(mesh: &Mesh) -> BTreeSet<Corners> {
    let all: BTreeSet<_> = mesh.triangles.iter().map(|triangle| corners(mesh, *triangle)).collect();
    assert_eq!(all.len(), mesh.n_triangles());
    all
}

/// Returns, for each vertex, the distance to the nearest sphere that is selected and to the nearest that is not, by
/// brute force in double precision.
fn distances(text: &str, mesh: &Mesh, pairs: &[(&str, &str)]) -> Vec<[f64; 2]> {
    let structure = read(text.as_bytes(), &ReadLimits::default()).unwrap();
    let selected = select(&structure, &params::parse(pairs.iter().copied()).unwrap().options.selection).unwrap();
    let spheres = selected.spheres(&structure).unwrap();
    let of_vertex = |v: usize| {
        let at: [f64; 3] = std::array::from_fn(|k| mesh.centre[k] + f64::from(mesh.position(v)[k]));
        let mut nearest = [f64::INFINITY; 2];
        for (row, &i) in selected.atoms.iter().enumerate() {
            let centre = spheres.centre(row);
            let square: f64 = (0..3).map(|k| (at[k] - centre[k]).powi(2)).sum();
            let distance = square.sqrt() - f64::from(structure.vdw_radius(i as usize));
            let nearest = &mut nearest[usize::from(!selected.has(i))];
            *nearest = nearest.min(distance);
        }
        nearest
    };
    (0..mesh.n_vertices()).map(of_vertex).collect()
}

#[test]
fn the_triangles_are_those_of_the_nearest_atoms_by_brute_force() {
    for (surface, select) in
        [("gaussian", "resi 10-25"), ("ses", "polymer and elem O,S"), ("vdw", "resn HOH and resi 1-150")]
    {
        let pairs = whole(&[("select", select), ("surface", surface)]);
        let cut = meshed(SAMPLE, &pairs);
        let context = format!("polymer or ({select})");
        let plain = meshed(SAMPLE, &[("select", &context), ("surface", surface), ("resolution", "0.9")]);
        assert_eq!((plain.report.atoms, plain.mesh.centre), (cut.report.atoms, cut.mesh.centre));
        let distances = distances(SAMPLE, &plain.mesh, &pairs);
        let found = triangles(&cut.mesh);
        let (mut n_kept, mut n_unsure) = (0, 0);
        for triangle in plain.mesh.triangles.iter() {
            // Distances that differ by less than rounding errors do not decide.
            let unsure = triangle.iter().any(|&v| (distances[v as usize][0] - distances[v as usize][1]).abs() < 1e-3);
            let is_kept = triangle.iter().filter(|&&v| distances[v as usize][0] < distances[v as usize][1]).count() > 1;
            n_unsure += usize::from(unsure);
            n_kept += usize::from(is_kept && !unsure);
            assert!(unsure || found.contains(&corners(&plain.mesh, *triangle)) == is_kept, "{surface} {select}");
        }
        assert!(n_unsure < plain.mesh.n_triangles() / 50 && n_kept > 20, "{surface}: {n_kept} {n_unsure}");
        assert!(found.is_subset(&triangles(&plain.mesh)) && found.len() < plain.mesh.n_triangles());
        // Negative control: another selection keeps other triangles.
        let other = meshed(SAMPLE, &whole(&[("select", "resi 11-26"), ("surface", surface)]));
        assert_ne!(triangles(&other.mesh), found);
        let report = &cut.report;
        assert!(!report.closed && report.oriented && !report.manifold, "{surface}");
        assert_eq!((report.open_reason, report.volume, report.validation), (Some("cut"), None, "exact"));
        assert_eq!((report.voids, report.void_list.len()), (0, 0));
        assert!(report.component_list.iter().all(|component| component.volume.is_none()));
        let area: f64 = report.component_list.iter().map(|component| component.area).sum();
        assert!((area / report.area - 1.0).abs() < 1e-6 && report.area < plain.report.area);
        assert_eq!(report.selected_atoms, Some(meshed(SAMPLE, &[("select", select)]).report.atoms));
        assert!(plain.report.closed && plain.report.open_reason.is_none() && plain.report.selected_atoms.is_none());
        let used: BTreeSet<u32> = cut.mesh.triangles.iter().flatten().copied().collect();
        assert_eq!((used.len(), cut.mesh.n_vertices() as u64), (cut.mesh.n_vertices(), report.vertices));
    }
}

#[test]
fn complementary_selections_share_the_surface() {
    let of = |select: &str| meshed(SAMPLE, &whole(&[("select", select)]));
    let (a, b, all) = (of("polymer and resi 1-29"), of("polymer and not resi 1-29"), of("polymer"));
    let [a, b] = [a, b].map(|product| (triangles(&product.mesh), product.report.area));
    assert!(a.0.is_disjoint(&b.0));
    assert_eq!(a.0.union(&b.0).copied().collect::<BTreeSet<_>>(), triangles(&all.mesh));
    assert!(((a.1 + b.1) / all.report.area - 1.0).abs() < 1e-6);
    // A selection of everything is the plain mesh: nothing is cut.
    let plain = meshed(SAMPLE, &[("resolution", "0.9")]);
    assert_eq!(all.mesh, plain.mesh);
    assert!(all.report.closed && all.report.open_reason.is_none() && !all.mesh.cut);
    assert_eq!((all.report.volume, all.report.validation), (plain.report.volume, "checksum"));
}

#[test]
fn chains_restrict_the_selection_and_not_the_surface() {
    let text = dimer();
    let chain = meshed(&text, &whole(&[("chains", "A")]));
    let same = meshed(&text, &whole(&[("select", "polymer and chain A")]));
    assert_eq!((&chain.mesh, chain.report.selected_atoms), (&same.mesh, Some(454)));
    assert_eq!(chain.report.atoms, 908);
    // Left out are the atoms that are not meshed: waters and ions.
    assert_eq!(chain.report.left_out.total, 4);
    // Selected atoms of other kinds join the surface, those of other chains do not.
    let ion = meshed(&text, &whole(&[("select", "ion"), ("chains", "B")]));
    assert_eq!((ion.report.atoms, ion.report.selected_atoms), (909, Some(1)));
    assert_eq!(ion.report.left_out.other_chains, 2);
    // The ion is far away, so its surface is closed and has a volume.
    assert!(ion.report.closed && ion.report.open_reason.is_none() && ion.report.volume.unwrap() > 1.0);
}

/// Mesh as read by trimesh.
#[derive(Debug, Deserialize)]
struct Read {
    watertight_parts: Vec<bool>,
    faces: u64,
    area: f64,
    watertight: bool,
    oriented: bool,
    boundary_edges: u64,
}

fn encode(format: Format, product: &Product) -> Vec<u8> {
    let mut bytes = Vec::new();
    let encoder =
        Encoder::with_bounds(format, product.storage, &product.mesh, product.bounds, &product.meta()).unwrap();
    encoder.write(&mut bytes).unwrap();
    assert!(encoder.encoded_len().is_none_or(|len| len == bytes.len() as u64));
    bytes
}

#[test]
fn other_readers_see_the_open_patch_and_the_closed_whole() {
    let text = dimer();
    let cases: [&[(&str, &str)]; 5] = [
        &[("select", "resi 3-20"), ("color", "element"), ("atom_ids", "true")],
        &[("select", "resi 3-20"), ("compress", "quantize"), ("normals", "none")],
        &[("split", "chain")],
        &[("split", "chain"), ("compress", "quantize"), ("color", "chain")],
        &[("split", "chain"), ("select", "resi 3-20 and within 9 of chain B")],
    ];
    let (mut files, mut products) = (Files::new(), Vec::new());
    for (n, pairs) in cases.iter().enumerate() {
        let product = meshed(&text, &whole(pairs));
        for format in [Format::Glb, Format::Gltf, Format::Ply] {
            if format != Format::Ply || product.mesh.quantized.is_none() {
                files.add(&format!("{n}.{format}"), &encode(format, &product));
                products.push((format, product.clone()));
            }
        }
        for format in [Format::PlyText, Format::Stl, Format::Obj, Format::Vtp] {
            if product.mesh.quantized.is_none() {
                assert!(!encode(format, &product).is_empty());
            }
        }
    }
    // Negative control: a mesh of two closed parts.
    let apart = meshed(&text, &[("split", "chain"), ("resolution", "0.9")]);
    files.add("apart.glb", &encode(Format::Glb, &apart));
    for (path, (format, product)) in files.paths.iter().zip(&products) {
        if *format == Format::Glb {
            let json = tools::readers::split_glb(&std::fs::read(path).unwrap()).json;
            assert_eq!(json["materials"][0]["doubleSided"], true, "{}", path.display());
            let extras = &json["asset"]["extras"];
            assert_eq!(extras["closed"], product.report.closed);
            assert_eq!(extras["open_reason"].as_str(), product.report.open_reason);
        }
    }
    let gltf: Vec<_> = files.paths.iter().filter(|path| path.extension().unwrap() != "ply").collect();
    if let Some(reports) = tools::gltf_validate(&gltf) {
        reports.iter().for_each(tools::GltfReport::assert_clean);
    }
    let Some(read) = tools::python::<Read>("check_cut.py", &files.paths) else { return };
    let (apart, read) = read.split_last().unwrap();
    assert!(apart.watertight_parts == [true, true] && apart.watertight);
    assert_eq!(read.len(), products.len());
    for (read, (format, product)) in read.iter().zip(&products) {
        let Product { report, mesh, .. } = product;
        assert_eq!((read.faces, read.oriented), (report.triangles, true), "{format} {read:?}");
        assert_eq!((read.watertight, read.boundary_edges == 0), (report.closed, report.closed), "{format} {read:?}");
        assert!((read.area / report.area - 1.0).abs() < 1e-4, "{format} {read:?}");
        let open = if *format == Format::Ply {
            vec![mesh.parts.is_empty() && report.closed]
        } else {
            vec![false; mesh.parts.len().max(1)]
        };
        assert_eq!(read.watertight_parts, open, "{format} {read:?}");
    }
}

#[test]
fn parts_of_one_surface_together_are_closed() {
    let text = dimer();
    let plain = meshed(&text, &[("resolution", "0.9"), ("atom_ids", "true")]);
    for validation in ["checksum", "exact"] {
        let product = meshed(&text, &whole(&[("split", "chain"), ("validation", validation), ("atom_ids", "true")]));
        let (report, mesh) = (&product.report, &product.mesh);
        assert!(report.closed && report.oriented && report.manifold && report.open_reason.is_none());
        assert_eq!((report.validation, report.euler), (validation, plain.report.euler));
        assert_eq!((report.volume, report.area), (plain.report.volume, plain.report.area));
        assert_eq!(triangles(mesh), triangles(&plain.mesh));
        let [a, b] = &report.parts[..] else { panic!("{:?}", report.parts) };
        assert_eq!((a.name.as_str(), b.name.as_str(), a.atoms, b.atoms), ("A", "B", 454, 454));
        assert_eq!(a.triangles + b.triangles, report.triangles);
        assert_eq!((a.volume, b.volume, a.vertices + b.vertices), (None, None, report.vertices));
        assert!(report.vertices > plain.report.vertices, "vertices on the border belong to both parts");
        assert!(((a.area + b.area) / report.area - 1.0).abs() < 1e-6);
        // The parts are those of two selections.
        for (range, chain) in mesh.parts.iter().zip(["A", "B"]) {
            let own = meshed(&text, &whole(&[("chains", chain)]));
            let of_part: BTreeSet<_> =
                mesh.triangles[range.triangles.clone()].iter().map(|t| corners(mesh, *t)).collect();
            assert_eq!(of_part, triangles(&own.mesh));
            assert!((own.report.area / range.area - 1.0).abs() < 1e-6);
        }
        // Atom indices belong to the same positions.
        let ids = |mesh: &Mesh| -> BTreeMap<[u32; 3], u32> {
            let ids = mesh.atom_ids.as_ref().unwrap();
            (0..mesh.n_vertices()).map(|v| (mesh.position(v).map(f32::to_bits), ids[v])).collect()
        };
        assert_eq!(ids(mesh), ids(&plain.mesh));
    }
    // Copies in an assembly are parts; the surface is one.
    let copies = format!("{}{text}", operators(2));
    let assembly = meshed(&copies, &whole(&[("assembly", "1"), ("split", "chain")]));
    let names: Vec<&str> = assembly.report.parts.iter().map(|part| part.name.as_str()).collect();
    assert_eq!(names, ["A-1", "B-1", "A-2", "B-2"]);
    assert!(assembly.report.closed);
    let half = meshed(&copies, &whole(&[("assembly", "1"), ("chains", "A")]));
    assert_eq!((half.report.selected_atoms, half.report.atoms), (Some(908), 1816));
    let area: f64 = assembly.report.parts.iter().step_by(2).map(|part| part.area).sum();
    assert!((half.report.area / area - 1.0).abs() < 1e-6);
}

/// Returns the records of an assembly of chains A and B whose copies are 20 Å apart.
fn operators(n: usize) -> String {
    let row = |copy: usize, k: usize| {
        let m = [0, 1, 2].map(|j| if j + 1 == k { "1.000000" } else { "0.000000" }).join("  ");
        let shift = if k == 2 { 20.0 * copy as f64 } else { 0.0 };
        format!("{:<80}\n", format!("REMARK 350   BIOMT{k} {:>3}  {m}  {shift:>13.5}", copy + 1))
    };
    let rows: String = (0..n).flat_map(|copy| [1, 2, 3].map(|k| row(copy, k))).collect();
    format!("{:<80}\n{:<80}\n{rows}", "REMARK 350 BIOMOLECULE: 1", "REMARK 350 APPLY THE FOLLOWING TO CHAINS: A, B")
}

#[test]
fn vertices_keep_their_colours_and_indices() {
    for scheme in ["residue", "bfactor"] {
        let own = [("color", scheme), ("atom_ids", "true"), ("resolution", "0.9")];
        let plain = meshed(SAMPLE, &own);
        let cut = meshed(SAMPLE, &whole(&[("select", "resi 5-30"), ("color", scheme), ("atom_ids", "true")]));
        assert_eq!(cut.report.color.as_ref().unwrap().range, plain.report.color.as_ref().unwrap().range);
        let rows = |mesh: &Mesh| -> BTreeMap<[u32; 3], ([u8; 4], u32, [u32; 3])> {
            let (colors, ids) = (mesh.colors.as_ref().unwrap(), mesh.atom_ids.as_ref().unwrap());
            let row = |v: usize| (colors[v], ids[v], mesh.normals[v].map(f32::to_bits));
            (0..mesh.n_vertices()).map(|v| (mesh.position(v).map(f32::to_bits), row(v))).collect()
        };
        let all = rows(&plain.mesh);
        let own = rows(&cut.mesh);
        assert!(own.len() > 100 && own.iter().all(|(at, row)| all.get(at) == Some(row)), "{scheme}");
    }
    // Without a request there are no indices.
    assert!(meshed(SAMPLE, &whole(&[("select", "resi 5-30")])).mesh.atom_ids.is_none());
}

#[test]
fn limits_and_estimates_know_the_whole_surface() {
    let pairs = whole(&[("select", "resi 5-30"), ("resolution", "0.7")]);
    let pairs: Vec<_> = pairs.into_iter().filter(|pair| *pair != ("resolution", "0.9")).collect();
    let made = meshed(SAMPLE, &pairs);
    let plain = meshed(SAMPLE, &[("resolution", "0.7")]);
    assert_eq!(made.report.grid_points, plain.report.grid_points);
    let backend = CpuBackend::new(Some(2)).unwrap();
    let choice = Choice { backend: &backend, reason: "" };
    let options = params::parse(pairs.iter().copied()).unwrap().options;
    let estimated = |limits: &JobLimits| {
        let read = |control: &Control<'_>| read_with(SAMPLE.as_bytes(), &limits.read, control).map(Box::new);
        estimate(read, &options, limits, &choice, &Control::default()).unwrap()
    };
    let expected = estimated(&JobLimits::default());
    let mesh = expected.mesh.clone().unwrap();
    assert_eq!((expected.atoms, mesh.grid_points), (made.report.atoms, made.report.grid_points));
    for (guess, n) in [
        (mesh.triangles, made.report.triangles),
        (mesh.vertices, made.report.vertices),
        (mesh.whole_vertices, plain.report.vertices),
    ] {
        let ratio = guess as f64 / n as f64;
        assert!((0.75..1.3).contains(&ratio), "{guess} {n}");
    }
    assert!(expected.work(&options).unwrap() > 0.0);
    // The size of the whole surface is limited, not that of the patch.
    let few = SurfaceLimits { max_mesh_bytes: plain.mesh.bytes() / 2, ..SurfaceLimits::default() };
    let few = JobLimits { surface: few, ..JobLimits::default() };
    assert!(made.mesh.bytes() < few.surface.max_mesh_bytes, "the control");
    let refused = meshed_with(SAMPLE, &pairs, &few).unwrap_err();
    assert!(matches!(&refused, JobError::Surface(error) if error.exceeded(Limit::MeshBytes).is_some()), "{refused}");
    assert!(estimated(&few).mesh.unwrap_err().exceeded(Limit::MeshBytes).is_some());
    // A limit on triangles is that of the patch.
    let limited = meshed(SAMPLE, &[("context", "whole"), ("select", "resi 5-30"), ("max_triangles", "3000")]);
    assert!((2000..=3000).contains(&limited.report.triangles), "{}", limited.report.triangles);
}

/// Meter that counts bytes.
#[derive(Debug, Default)]
struct Meter(AtomicI64);

impl MemoryMeter for Meter {
    fn grow(&self, bytes: u64) -> Result<(), OutOfMemory> {
        self.0.fetch_add(bytes as i64, Ordering::Relaxed);
        Ok(())
    }

    fn shrink(&self, bytes: u64) {
        self.0.fetch_sub(bytes as i64, Ordering::Relaxed);
    }
}

#[test]
fn only_the_memory_of_the_patch_stays_counted() {
    let held = |pairs: &[(&str, &str)]| {
        let (backend, meter) = (CpuBackend::new(Some(1)).unwrap(), Arc::new(Meter::default()));
        let choice = Choice { backend: &backend, reason: "" };
        let options = params::parse(pairs.iter().copied()).unwrap().options;
        let control = Control { memory: meter.clone(), ..Control::default() };
        let product = run(SAMPLE.as_bytes(), &options, &JobLimits::default(), &choice, &control, &(), None).unwrap();
        let (mesh, atoms) = (product.mesh, [product.report.atoms_in_file, product.report.atoms].map(|n| n as i64));
        (meter.0.load(Ordering::Relaxed), mesh.bytes() as i64, mesh.n_vertices() as i64, atoms)
    };
    let (plain, whole_bytes, _, _) = held(&[("resolution", "0.7")]);
    let (cut, bytes, vertices, [in_file, atoms]) =
        held(&[("resolution", "0.7"), ("context", "whole"), ("select", "resi 5-30")]);
    // Marks of the atoms, parts of the spheres, and atom indices.
    assert_eq!(cut - bytes - in_file - 4 * atoms - 4 * vertices, plain - whole_bytes);
    assert!(bytes < whole_bytes);
}

#[test]
fn selections_without_a_surface_are_rejected() {
    // The carbonyl carbon of a buried residue.
    let buried = meshed_with(SAMPLE, &whole(&[("select", "resi 21 and name C")]), &JobLimits::default()).unwrap_err();
    assert_eq!(buried, JobError::Surface(SurfaceError::NoPatch));
    let searched = meshed_with(
        SAMPLE,
        &[("context", "whole"), ("select", "resi 21 and name C"), ("max_triangles", "3000")],
        &JobLimits::default(),
    );
    assert_eq!(searched.map(drop), Err(JobError::Surface(SurfaceError::NoPatch)));
    let none = meshed_with(SAMPLE, &whole(&[("select", "ion")]), &JobLimits::default()).unwrap_err();
    assert!(matches!(none, JobError::Structure(StructureError::EmptySelection { .. })), "{none}");
    // A part without a triangle has no node.
    let parts = meshed(SAMPLE, &whole(&[("select", "all"), ("split", "residue-group")]));
    assert_eq!(parts.report.parts.iter().map(|part| part.triangles).sum::<u64>(), parts.report.triangles);
}

#[test]
fn bad_values_name_the_valid_ones() {
    let error = params::parse([("context", "all")]).unwrap_err();
    assert!(matches!(error, ParamError::BadValue { name: "context", .. }), "{error}");
    assert!(error.to_string().contains("selection, whole"), "{error}");
    let key = |value| params::canonical(&params::parse([("context", value)]).unwrap().options);
    let none = params::canonical(&params::parse::<&str, &str>([]).unwrap().options);
    assert_eq!(key("selection"), none);
    assert_ne!(key("whole"), none);
}
