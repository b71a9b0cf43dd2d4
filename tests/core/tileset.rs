//! Tiles of a tileset compared with the mesh of the whole structure.
#![allow(clippy::pedantic, clippy::unwrap_used, clippy::panic, reason = "tests fail by panicking")]

use std::collections::HashMap;
use std::fmt::Write;
use std::ops::Deref;

use molmesh::formats::tileset::{TileAddress, assembly_document};
use molmesh::pipeline::tileset::{AssemblyTileset, Tileset};
use molmesh::pipeline::{Choice, JobError, JobLimits, Options, StageClock, WorkScope, params, run};
use molmesh::structure::{self, ReadLimits, Structure};
use molmesh::surface::{Control, CpuBackend, Limit, Measures, Mesh, SurfaceError, SurfaceLimits, Validation};
use serde_json::Value;

use crate::instances::{OPERATORS, with_rules};

const SAMPLE: &[u8] = include_bytes!("../../samples/4pti.pdb");

/// Tileset with its job.
struct Prepared {
    tileset: Tileset<Box<Structure>>,
    options: Options,
}

impl Prepared {
    /// Returns the grid spacing of a level, Å.
    fn spacing(&self, level: u32) -> f64 {
        self.bounds().error / f64::from(1_u32 << level)
    }

    fn mesh(&self, tile: TileAddress) -> Option<Mesh> {
        let (backend, options) =
            (CpuBackend::new(Some(2)).unwrap(), Options { tile: Some(tile), ..self.options.clone() });
        let color = |coloring| self.tileset.colors(coloring, &Control::default()).unwrap();
        let colors = options.color.map(color);
        let limits = SurfaceLimits::default();
        self.tileset.mesh(&options, colors.as_ref(), &backend, &limits, &Control::default()).unwrap()
    }
}

impl Deref for Prepared {
    type Target = Tileset<Box<Structure>>;

    fn deref(&self) -> &Self::Target {
        &self.tileset
    }
}

fn tileset(pairs: &[(&str, &str)]) -> Prepared {
    tileset_of(SAMPLE, pairs)
}

/// Returns the parameters of tiles that are not compressed.
fn tileset_options(pairs: &[(&str, &str)]) -> Options {
    let pairs = pairs.iter().chain(&[("compress", "none")]);
    let mut pairs = pairs.map(|(name, value)| ((*name).to_owned(), (*value).to_owned())).collect();
    params::parse_tileset(&mut pairs).unwrap().options
}

fn tileset_of(file: &[u8], pairs: &[(&str, &str)]) -> Prepared {
    let options = tileset_options(pairs);
    let read = |control: &Control<'_>| structure::read_with(file, &ReadLimits::default(), control).map(Box::new);
    let clock = StageClock::new(&());
    let scope = WorkScope::new(&clock, &Control::default());
    let tileset = Tileset::new(read, &options, &ReadLimits::default(), &scope).unwrap();
    Prepared { tileset, options }
}

/// Returns the meshes of all tiles of a level.
fn meshes(tileset: &Prepared, level: u32) -> Vec<Mesh> {
    let tiles = tileset.tiles().iter().filter(|tile| tile.level == level);
    tiles.filter_map(|tile| tileset.mesh(*tile)).collect()
}

/// Joins meshes. Vertices that are at most 2e-5 Å apart become one.
fn welded(meshes: &[Mesh]) -> Mesh {
    const CELL: f64 = 1e-3;
    let mut joined = Mesh::default();
    let mut cells: HashMap<[i64; 3], Vec<u32>> = HashMap::new();
    let (mut positions, mut normals, mut triangles) = (Vec::<[f64; 3]>::new(), Vec::new(), Vec::new());
    for mesh in meshes {
        let mut numbers = Vec::new();
        for v in 0..mesh.n_vertices() {
            let p: [f64; 3] = std::array::from_fn(|k| mesh.centre[k] + f64::from(mesh.position(v)[k]));
            let cell = p.map(|c| (c / CELL).round() as i64);
            let around = (0..27_i64).map(|i| [cell[0] + i % 3 - 1, cell[1] + i / 3 % 3 - 1, cell[2] + i / 9 - 1]);
            let near = |v: &u32| (0..3).all(|k| (positions[*v as usize][k] - p[k]).abs() < 2e-5);
            let same = around.filter_map(|cell| cells.get(&cell)).flatten().copied().find(near);
            numbers.push(same.unwrap_or_else(|| {
                cells.entry(cell).or_default().push(positions.len() as u32);
                positions.push(p);
                normals.push(mesh.normals[v]);
                positions.len() as u32 - 1
            }));
        }
        triangles.extend(mesh.triangles.iter().map(|triangle| triangle.map(|v| numbers[v as usize])));
    }
    joined.positions = positions.iter().map(|p| p.map(|c| c as f32)).collect();
    joined.normals = normals.into_iter().collect();
    joined.triangles = triangles.into_iter().collect();
    joined
}

fn measured(mesh: &Mesh) -> Measures {
    Measures::of(mesh, Validation::Exact, &Control::default()).unwrap()
}

#[test]
fn tiles_of_each_level_join_to_a_closed_mesh() {
    let backend = CpuBackend::new(Some(2)).unwrap();
    let choice = Choice { backend: &backend, reason: "" };
    for surface in ["gaussian", "soft-object", "vdw", "sas", "ses"] {
        let pairs = [("surface", surface), ("resolution", "0.25"), ("color", "element"), ("atom_ids", "true")];
        let tileset = tileset(&pairs);
        let levels = tileset.bounds().levels;
        assert!(levels > 2, "{levels} levels");
        for level in 0..levels {
            let all = meshes(&tileset, level);
            let joined = welded(&all);
            let (found, resolution) = (measured(&joined), tileset.spacing(level).to_string());
            let what = format!("{surface}, {resolution} Å: {} tiles", all.len());
            assert!(found.closed && found.oriented && found.manifold, "{what}");
            assert!(all.len() > 1 || level == 0, "{what}");
            let options = params::parse([("surface", surface), ("resolution", &*resolution)]).unwrap().options;
            let whole = run(SAMPLE, &options, &JobLimits::default(), &choice, &Control::default(), &(), None).unwrap();
            assert_eq!(joined.triangles.len() as u64, whole.report.triangles, "{what}");
            assert!(
                (found.area / whole.report.area - 1.0).abs() < 1e-6,
                "{what}: {} {}",
                found.area,
                whole.report.area
            );
            assert!((found.volume / whole.report.volume.unwrap() - 1.0).abs() < 1e-6, "{what}");
            for mesh in &all {
                assert!(mesh.colors.as_ref().is_some_and(|colors| colors.len() == mesh.n_vertices()));
                assert!(mesh.atom_ids.as_ref().is_some_and(|ids| ids.iter().all(|id| *id < 1000)));
            }
            // Without one of its tiles, the mesh is open.
            if all.len() > 1 {
                assert!(!measured(&welded(&all[1..])).closed, "{what}");
            }
        }
    }
}

#[test]
fn coarse_levels_group_atoms_and_keep_the_shape() {
    // A bar of 432 × 24 × 24 Å with an atom for every 27 Å³.
    let mut text = String::new();
    for i in 0..144 * 8 * 8 {
        let [x, y, z] = [i / 64, i / 8 % 8, i % 8].map(|c| 3.0 * f64::from(c));
        let residue = i / 64 + 1;
        writeln!(text, "ATOM  {:5}  CA  ALA A{residue:4}    {x:8.3}{y:8.3}{z:8.3}  1.00  0.00           C", i + 1)
            .unwrap();
    }
    let tileset = tileset_of(text.as_bytes(), &[("resolution", "1")]);
    let levels = tileset.bounds().levels;
    assert_eq!((0..levels).map(|level| tileset.spacing(level)).collect::<Vec<_>>(), [8.0, 4.0, 2.0, 1.0]);
    let found: Vec<Measures> = (0..levels).map(|level| measured(&welded(&meshes(&tileset, level)))).collect();
    for level in &found {
        assert!(level.closed && level.oriented && level.manifold);
        assert!((level.volume / found[3].volume - 1.0).abs() < 0.3, "{} {}", level.volume, found[3].volume);
    }
    assert_eq!(found[0].components.len(), 1);
}

#[test]
fn too_many_tiles_are_rejected() {
    let options = |resolution| params::parse([("radius_offset", "10"), ("resolution", resolution)]).unwrap().options;
    let read = |control: &Control<'_>| structure::read_with(SAMPLE, &ReadLimits::default(), control).map(Box::new);
    let clock = StageClock::new(&());
    let scope = WorkScope::new(&clock, &Control::default());
    let new = |resolution| Tileset::new(read, &options(resolution), &ReadLimits::default(), &scope);
    let Err(JobError::Surface(SurfaceError::Limit(error))) = new("0.01") else { panic!("accepted") };
    assert_eq!(error.limit, Limit::Tiles);
    assert!(new("0.2").is_ok_and(|tileset| (tileset.tiles().len() as u64) < error.max));
}

#[test]
fn an_assembly_repeats_the_tilesets_of_its_units() {
    let [one, two, three] = OPERATORS;
    let text = with_rules(&[("A", &[one]), ("A, B", &[two, three])]);
    let pairs = [("assembly", "1"), ("resolution", "1"), ("instances", "true")];
    let options = tileset_options(&pairs);
    let read =
        |control: &Control<'_>| structure::read_with(text.as_bytes(), &ReadLimits::default(), control).map(Box::new);
    let clock = StageClock::new(&());
    let scope = WorkScope::new(&clock, &Control::default());
    let assembly = AssemblyTileset::new(read, &options, &ReadLimits::default(), &scope).unwrap();
    let backend = CpuBackend::new(Some(2)).unwrap();
    let choice = Choice { backend: &backend, reason: "" };
    let (limits, control) = (JobLimits::default(), Control::default());
    let whole = run(text.as_bytes(), &options, &limits, &choice, &control, &(), None).unwrap();
    let parts = &whole.report.parts;
    assert_eq!((assembly.units().len(), parts.len()), (2, 2));
    let repeated = assembly.repeated(|number| number.to_string());
    for (number, (tileset, part)) in (1..).zip(repeated.iter().zip(parts)) {
        assert_eq!(tileset.placements.len() as u64, part.instances.unwrap());
        let number = number.to_string();
        let own = tileset_of(text.as_bytes(), &[("assembly", "1"), ("resolution", "1"), ("unit", &number)]);
        assert_eq!(own.bounds(), tileset.bounds);
        // The tiles of the last level join to the mesh of the unit.
        let joined = measured(&welded(&meshes(&own, own.bounds().levels - 1)));
        assert!(joined.closed && (joined.area / part.area - 1.0).abs() < 1e-6, "{} {}", joined.area, part.area);
    }
    // The root is the coarse mesh of all instances.
    let root = assembly.root(&options, &limits, &choice, &scope).unwrap().report;
    let (root_atoms, root_resolution) = (root.atoms, root.resolution);
    assert_eq!((root.atoms, root.instances.as_ref().unwrap().count), (whole.report.atoms, 3));
    assert_eq!(root.instances.unwrap().atoms_sum, whole.report.instances.unwrap().atoms_sum);
    assert_eq!(root.parts.iter().map(|part| part.atoms).collect::<Vec<_>>(), [454, 908]);
    assert!(root.closed && root.resolution == repeated.iter().map(|unit| unit.bounds.error).fold(0.0, f64::max));
    // A job on the root tile reports the times of all stages, including reading.
    let options = params::parse(pairs.into_iter().chain([("tile", "0/0/0/0")])).unwrap().options;
    let job = run(text.as_bytes(), &options, &limits, &choice, &control, &(), None).unwrap().report;
    assert_eq!((job.atoms, job.resolution), (root_atoms, root_resolution));
    let stages: Vec<&str> = job.timings_ms.keys().map(String::as_str).collect();
    assert!(stages.starts_with(&["read", "select", "index"]) && stages.contains(&"field"), "{stages:?}");
    let document = assembly_document("root.glb", &repeated);
    let root = &document["root"];
    let children = root["children"].as_array().unwrap();
    let numbers = |value: &Value| value.as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect::<Vec<f64>>();
    let around = numbers(&root["boundingVolume"]["box"]);
    for (child, (uri, m)) in children.iter().zip([("1", one), ("2", two), ("2", three)]) {
        assert_eq!(child["content"]["uri"], uri);
        assert!(child["geometricError"].as_f64() <= root["geometricError"].as_f64());
        let (columns, bounds) = (numbers(&child["transform"]), numbers(&child["boundingVolume"]["box"]));
        let stored = |k: usize| [columns[k], columns[4 + k], columns[8 + k], columns[12 + k]];
        // The axes of the root are x, -z and y of the structure.
        let row = |k: usize| [stored(0), stored(2), stored(1).map(|v| -v)][k];
        assert_eq!([row(0), row(1), row(2)].concat(), m);
        assert_eq!(stored(3), [0.0, 0.0, 0.0, 1.0]);
        // All corners of the instance lie in the box of the root.
        for corner in 0..8 {
            let p: [f64; 3] =
                std::array::from_fn(|k| bounds[k] + bounds[3] * if corner >> k & 1 == 1 { 1.0 } else { -1.0 });
            for k in 0..3 {
                let [a, b, c, t] = row(k);
                let at = a * p[0] + b * p[1] + c * p[2] + t;
                let (middle, half) = [(around[0], around[3]), (around[2], around[11]), (-around[1], around[7])][k];
                assert!((at - middle).abs() <= half + 1e-9, "{uri} {corner} {k}: {at} {around:?}");
            }
        }
    }
    assert_eq!(children.len(), 3);
}

#[test]
fn units_have_the_colours_and_the_small_parts_of_the_assembly() {
    // Atoms 2,000 Å apart with other B-factors, each of which is a unit.
    let atom = |chain: char, x: f64, b: f64| {
        format!("HETATM    1 NA    NA {chain}   1    {x:8.3}{:8.3}{:8.3}  1.00{b:6.2}          NA\n", 3.3, 7.7)
    };
    let mut text = with_rules(&[("A", &OPERATORS[..1]), ("B", &OPERATORS[..1])]);
    text.truncate(text.find("ATOM").unwrap());
    text += &(atom('A', 0.3, 5.0) + &atom('A', 2000.7, 25.0) + &atom('B', 50.1, 90.0));
    let pairs = [("assembly", "1"), ("instances", "true"), ("select", "all"), ("color", "bfactor")];
    let options = params::parse(pairs).unwrap().options;
    let read =
        |control: &Control<'_>| structure::read_with(text.as_bytes(), &ReadLimits::default(), control).map(Box::new);
    let clock = StageClock::new(&());
    let scope = WorkScope::new(&clock, &Control::default());
    let assembly = AssemblyTileset::new(read, &options, &ReadLimits::default(), &scope).unwrap();
    assert_eq!(assembly.color_range(), Some([5.0, 90.0]));
    let backend = CpuBackend::new(Some(2)).unwrap();
    let choice = Choice { backend: &backend, reason: "" };
    let root = assembly.root(&options, &JobLimits::default(), &choice, &scope).unwrap().report;
    assert!(root.resolution > 8.0, "{}", root.resolution);
    assert_eq!((root.components, root.color.unwrap().range), (3, Some([5.0, 90.0])));
    // Each atom lies between the grid points of the roots, which do not group atoms.
    let mut text = with_rules(&[("A", &OPERATORS[..1])]);
    text.truncate(text.find("ATOM").unwrap());
    text += &[0.5, 40.5]
        .map(|x| format!("HETATM    1 MG    MG A   1    {x:8.3}{:8.3}{:8.3}  1.00  5.00          MG\n", 0.5, 0.5))
        .concat();
    let pairs =
        [("assembly", "1"), ("instances", "true"), ("select", "all"), ("surface", "vdw"), ("radius_scale", "0.4")];
    let options = params::parse(pairs).unwrap().options;
    let read =
        |control: &Control<'_>| structure::read_with(text.as_bytes(), &ReadLimits::default(), control).map(Box::new);
    let clock = StageClock::new(&());
    let scope = WorkScope::new(&clock, &Control::default());
    let assembly = AssemblyTileset::new(read, &options, &ReadLimits::default(), &scope).unwrap();
    let coarsest = assembly.repeated(|_| String::new())[0].bounds.error;
    let root = assembly.root(&options, &JobLimits::default(), &choice, &scope).unwrap().report;
    assert_eq!((root.components, coarsest / root.resolution), (2, 2.0));
}

#[test]
fn no_level_misses_atoms_that_are_far_apart() {
    let near = "2\n\nC 1.3 2.7 3.1\nC 2000.7 33.3 77.7\n";
    // Coordinates at the limit.
    let far = "2\n\nC 99900 0 0\nN -99900 0 0\n";
    for (text, surface) in [(near, "gaussian"), (near, "vdw"), (near, "ses"), (far, "gaussian")] {
        let tileset = tileset_of(text.as_bytes(), &[("surface", surface), ("select", "all")]);
        for level in 0..tileset.bounds().levels {
            let found = measured(&welded(&meshes(&tileset, level)));
            assert!(found.closed && found.components.len() == 2, "{surface} {level}: {}", found.components.len());
        }
    }
}

#[test]
fn a_job_can_mesh_one_tile() {
    let backend = CpuBackend::new(Some(2)).unwrap();
    let choice = Choice { backend: &backend, reason: "" };
    let pairs = [("resolution", "0.25"), ("atom_ids", "true"), ("color", "chain")];
    let tileset = tileset(&pairs);
    let made = |tile: &str| {
        let options = params::parse(pairs.iter().copied().chain([("tile", tile)])).unwrap().options;
        run(SAMPLE, &options, &JobLimits::default(), &choice, &Control::default(), &(), None)
    };
    let mut triangles = 0;
    for address in tileset.tiles() {
        let product = made(&address.path()).unwrap();
        let tile = tileset.mesh(*address);
        let report = &product.report;
        assert_eq!(report.resolution, tileset.spacing(address.level));
        let Some(tile) = tile else {
            assert_eq!(report.triangles, 0);
            continue;
        };
        // The triangles of the tile come first, then the skirts.
        let measures = measured(&tile);
        assert_eq!((report.closed, report.euler, report.area), (measures.closed, measures.euler, measures.area));
        assert_eq!(report.open_reason, (!measures.closed).then_some("cut"));
        assert_eq!(report.triangles as usize > tile.n_triangles(), !measures.closed);
        assert_eq!(
            product.mesh.triangles.iter().take(tile.n_triangles()).collect::<Vec<_>>(),
            tile.triangles.iter().collect::<Vec<_>>()
        );
        assert_eq!(
            product.mesh.atom_ids.iter().flatten().take(tile.n_vertices()).collect::<Vec<_>>(),
            tile.atom_ids.iter().flatten().collect::<Vec<_>>()
        );
        triangles += tile.n_triangles() as u64;
    }
    assert!(triangles > 100_000, "{triangles}");
    let Err(JobError::Surface(SurfaceError::BadParameter { name, expected, .. })) = made("9/0/0/0") else { panic!() };
    assert_eq!((name, &*expected), ("tile", "a tile of the tileset, whose levels are 0 to 2"));
}
