//! Reading speed in bytes of inflated text per second, on one thread and on all, and time of selections. Run it with
//! `cargo bench --bench read`, `-- million` for the selections in a generated structure of a million atoms only.
//!
//! Reads the small files of `samples/`, and large files of the folder in `MOLMESH_STRUCTURES`, if it is set. Create
//! `6zu5.bcif` there with `target/test-tools/venv/bin/python tests/tools/write_bcif.py compressed 6zu5.cif.gz
//! 6zu5.bcif`. For BinaryCIF, compare atoms per second, not bytes.

use std::fmt::Write as _;
use std::hint::black_box;
use std::io::Read;
use std::path::{Path, PathBuf};

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use molmesh::structure::{ReadLimits, Selection, Structure, read, select};

fn plain(path: &Path) -> Vec<u8> {
    let bytes = std::fs::read(path).expect("a readable file");
    if !bytes.starts_with(b"\x1f\x8b") {
        return bytes;
    }
    let mut out = Vec::new();
    flate2::read::MultiGzDecoder::new(&bytes[..]).read_to_end(&mut out).expect("gzip data");
    out
}

fn files() -> Vec<PathBuf> {
    let folder = std::env::var_os("MOLMESH_STRUCTURES").map(PathBuf::from);
    let large = ["1ubq.pdb.gz", "1aon.pdb.gz", "3v2u.pdb.gz", "7cth.cif.gz", "6zu5.cif.gz", "7cgo.cif.gz", "6zu5.bcif"];
    let samples = ["samples/4pti.pdb", "samples/1crn.cif", "tests/bcif_support/1crn.bcif"].map(PathBuf::from);
    let files = folder.iter().flat_map(|folder| large.map(|name| folder.join(name))).chain(samples);
    files.filter(|path| path.exists()).collect()
}

/// Expressions: conditions on single atoms, distances to few and to many atoms, and whole residues.
const EXPRESSIONS: [&str; 7] = [
    "polymer",
    "chain A and resi 10-200 and name CA",
    "not (water or ion) and (elem N,O,S or resn LEU)",
    "protein and within 5 of ligand",
    "byres (protein within 5 of ligand)",
    "within 5 of (name CA)",
    "(protein within 4 of water) and not (within 8 of ligand)",
];

/// Returns a structure of a million atoms at the density of proteins: 100 chains, each a cube with 1,125 residues, a
/// ligand of 40 atoms and 960 water molecules.
fn million() -> Structure {
    const SIDE: f64 = 58.5;
    let mut state = 7_u64;
    let mut next = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 11) as f64 / (1_u64 << 53) as f64
    };
    let items = "group_PDB type_symbol label_atom_id label_comp_id auth_asym_id auth_seq_id Cartn_x Cartn_y Cartn_z";
    let mut text = "data_million\nloop_\n".to_owned();
    for item in items.split(' ') {
        writeln!(text, "_atom_site.{item}").expect("memory");
    }
    let names = [("N", "N"), ("C", "CA"), ("C", "C"), ("O", "O"), ("C", "CB"), ("C", "CG"), ("C", "CD1"), ("C", "CD2")];
    for chain in 0..100 {
        let name = if chain == 0 { "A".to_owned() } else { format!("A{chain}") };
        let cube = [chain % 5, chain / 5 % 5, chain / 25].map(|k| f64::from(k) * SIDE);
        for i in 0..10_000_usize {
            let (record, (element, atom), residue, number) = match i {
                0..9_000 => ("ATOM", names[i % 8], ["LEU", "ILE", "LYS"][i / 8 % 3], i / 8 + 1),
                9_000..9_040 => ("HETATM", ("C", "C1"), "LIG", 2_000),
                _ => ("HETATM", ("O", "O"), "HOH", i),
            };
            let width = if residue == "LIG" { 8.0 } else { SIDE };
            let [x, y, z] = cube.map(|low| low + width * next());
            writeln!(text, "{record} {element} {atom} {residue} {name} {number} {x:.3} {y:.3} {z:.3}").expect("memory");
        }
    }
    read(text.as_bytes(), &ReadLimits::default()).expect("atoms")
}

/// Times parsing and evaluation of expressions.
fn selections(c: &mut Criterion) {
    let structure = million();
    let mut group = c.benchmark_group("select in a million atoms");
    group.sample_size(20).throughput(Throughput::Elements(structure.len() as u64));
    for text in EXPRESSIONS {
        group.bench_function(text, |b| {
            b.iter(|| {
                let atoms = black_box(text).parse().expect("an expression");
                select(&structure, &Selection { atoms, ..Selection::default() }).expect("atoms").atoms.len()
            });
        });
    }
    group.finish();
}

fn benches(c: &mut Criterion) {
    let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().expect("a thread");
    let limits = ReadLimits::default();
    for path in files() {
        let text = plain(&path);
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let mut group = c.benchmark_group(name);
        group.sample_size(20).throughput(Throughput::Bytes(text.len() as u64));
        group.bench_function("read, one thread", |b| {
            b.iter(|| one.install(|| read(black_box(&text), &limits).expect("atoms").len()));
        });
        group.bench_function("read, all threads", |b| b.iter(|| read(black_box(&text), &limits).expect("atoms").len()));
        let structure = read(&text, &limits).expect("atoms");
        group.throughput(Throughput::Elements(structure.len() as u64));
        group.bench_function("select", |b| {
            b.iter(|| select(black_box(&structure), &Selection::default()).map(|s| s.atoms.len()));
        });
        let near = Selection { atoms: "within 5 of (name CA)".parse().expect("an expression"), ..Selection::default() };
        group.bench_function("select by distance", |b| {
            b.iter(|| select(black_box(&structure), &near).map(|s| s.atoms.len()));
        });
        group.finish();
    }
}

criterion_group!(read_benches, benches, selections);
criterion_main!(read_benches);
