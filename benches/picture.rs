//! Time to draw a picture of a mesh, and a lower bound of it.
//!
//! `MOLMESH_STRUCTURES=FOLDER cargo bench --bench picture` also draws 2HHB from `FOLDER`; the default is only the
//! bundled 4PTI. The lower bound reads the corners of all triangles once and writes all pixels once.

use std::hint::black_box;
use std::path::PathBuf;
use std::sync::Arc;

use criterion::{BenchmarkId, Criterion, criterion_group, criterion_main};
use molmesh::picture::{CpuRenderer, Image, PictureParams, Renderer, Style, png};
use molmesh::pipeline::{self, Choice, JobLimits, params};
use molmesh::surface::{Control, CpuBackend, Mesh};
use rayon::prelude::*;

/// Returns the available structures: the bundled one, and 2HHB.
fn structures() -> Vec<(&'static str, PathBuf)> {
    let bundled = PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/samples/4pti.pdb"));
    let mut all = vec![("4pti", bundled)];
    if let Some(folder) = std::env::var_os("MOLMESH_STRUCTURES").map(PathBuf::from) {
        let names = ["2hhb.ent.gz", "2hhb.pdb.gz", "2hhb.cif.gz", "2hhb.pdb", "2hhb.cif"];
        all.extend(names.iter().map(|name| folder.join(name)).find(|path| path.exists()).map(|path| ("2hhb", path)));
    }
    all
}

#[expect(clippy::unwrap_used, reason = "a benchmark fails by panicking")]
fn mesh(path: &PathBuf) -> Mesh {
    let backend = CpuBackend::new(None).unwrap();
    let choice = Choice { backend: &backend, reason: "measured" };
    let options = params::parse::<&str, &str>([]).unwrap().options;
    let bytes = std::fs::read(path).unwrap();
    let product = pipeline::run(&bytes, &options, &JobLimits::default(), &choice, &Control::default(), &(), None);
    let mut mesh = product.unwrap().mesh;
    mesh.make_contiguous();
    mesh
}

/// Reads every corner of every triangle and writes every pixel.
fn floor(mesh: &Mesh, image: &mut Image) -> f32 {
    let (positions, normals) = (&mesh.positions[..], &mesh.normals[..]);
    let of_chunk = |chunk: &[[u32; 3]]| {
        let corner = |v: &u32| positions[*v as usize][0] + normals[*v as usize][0];
        chunk.iter().flatten().map(corner).sum::<f32>()
    };
    let sum = mesh.triangles.par_chunks(1 << 14).map(of_chunk).sum::<f32>();
    image.pixels.par_iter_mut().for_each(|pixel| *pixel = sum.to_le_bytes());
    sum
}

#[expect(clippy::unwrap_used, reason = "a benchmark fails by panicking")]
fn picture(criterion: &mut Criterion) {
    let renderer = CpuRenderer;
    for (name, path) in structures() {
        let mesh = Arc::new(mesh(&path));
        let mut group = criterion.benchmark_group(format!("picture/{name}/{} triangles", mesh.n_triangles()));
        group.sample_size(20);
        for side in [256, 512, 1024] {
            let size = PictureParams { width: side, height: side, ..PictureParams::default() };
            let draw = |params: &PictureParams| renderer.render(black_box(&mesh), params, &Control::default()).unwrap();
            for style in Style::ALL {
                let params = PictureParams { style, ..size };
                group.bench_function(BenchmarkId::new(format!("draw {}", style.name()), side), |b| {
                    b.iter(|| draw(&params));
                });
            }
            let mut image = draw(&size).image;
            group.bench_function(BenchmarkId::new("png", side), |b| {
                b.iter(|| png::encode(black_box(&image), &Control::default()).unwrap().len());
            });
            group.bench_function(BenchmarkId::new("all", side), |b| {
                b.iter(|| png::encode(&draw(&size).image, &Control::default()).unwrap().len());
            });
            group.bench_function(BenchmarkId::new("floor", side), |b| b.iter(|| floor(black_box(&mesh), &mut image)));
        }
        group.finish();
    }
}

criterion_group!(benches, picture);
criterion_main!(benches);
