//! Reading speed in bytes of inflated text per second, on one thread and on all. Run it with `cargo bench --bench
//! read`.
//!
//! Reads the small files of `samples/`, and large files of the folder in `MOLMESH_STRUCTURES`, if it is set. Create
//! `6zu5.bcif` there with `target/test-tools/venv/bin/python tests/tools/write_bcif.py compressed 6zu5.cif.gz
//! 6zu5.bcif`. For BinaryCIF, compare atoms per second, not bytes.

use std::hint::black_box;
use std::io::Read;
use std::path::{Path, PathBuf};

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use molmesh::structure::{ReadLimits, Selection, read, select};

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

criterion_group!(read_benches, benches);
criterion_main!(read_benches);
