//! Encoding speed of meshes in MB/s per format, to a sink that discards the bytes and to memory.
//!
//! `MOLMESH_BENCH_SIDE=2738 cargo bench --bench encode` uses a torus of 2738² = 7.5 million vertices and 15 million
//! triangles, like a structure of some hundred thousand atoms.

use std::f64::consts::TAU;
use std::hint::black_box;
use std::io;

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use molmesh::formats::{Encoder, Format, Meta, Storage};
use molmesh::surface::Mesh;

/// Creates a torus of `side`² vertices, far from the origin.
#[expect(clippy::cast_possible_truncation, reason = "meshes are single precision")]
fn torus(side: u32) -> Mesh {
    let mut mesh = Mesh { centre: [123.456, -78.9, 1000.25], ..Mesh::default() };
    let angle = |i: u32| (f64::from(i) / f64::from(side) * TAU).sin_cos();
    for (i, j) in (0..side).flat_map(|i| (0..side).map(move |j| (i, j))) {
        let ((su, cu), (sv, cv)) = (angle(i), angle(j));
        let normal = [cv * cu, cv * su, sv];
        let ring = [60.0 * cu, 60.0 * su, 0.0];
        mesh.positions.edit().push(std::array::from_fn(|k| (ring[k] + 30.0 * normal[k]) as f32));
        mesh.normals.edit().push(normal.map(|v| v as f32));
        let at = |i: u32, j: u32| (i % side) * side + j % side;
        let (a, b, c, d) = (at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1));
        mesh.triangles.edit().extend([[a, b, c], [a, c, d]]);
    }
    mesh
}

fn write(format: Format, mesh: &Mesh, meta: &Meta, out: &mut dyn io::Write) -> io::Result<()> {
    Encoder::new(format, Storage::default(), mesh, meta).map_err(io::Error::other)?.write(out)
}

fn encode(criterion: &mut Criterion) {
    let side = std::env::var("MOLMESH_BENCH_SIDE").ok().and_then(|v| v.parse().ok()).unwrap_or(700);
    let mesh = torus(side);
    let meta = Meta { name: Some("torus".into()), ..Meta::default() };
    let mut group = criterion.benchmark_group("encode");
    group.sample_size(10);
    for format in Format::MESHES {
        let mut bytes = Vec::new();
        let written = write(format, &mesh, &meta, &mut bytes);
        assert!(written.is_ok(), "{written:?}");
        group.throughput(Throughput::Bytes(bytes.len() as u64));
        group.bench_function(BenchmarkId::new("sink", format), |b| {
            b.iter(|| write(format, black_box(&mesh), &meta, &mut io::sink()));
        });
        // Into allocated memory, like a pooled buffer.
        group.bench_function(BenchmarkId::new("memory", format), |b| {
            b.iter(|| {
                bytes.clear();
                write(format, black_box(&mesh), &meta, &mut bytes)
            });
        });
    }
    let glb = Encoder::new(Format::Glb, Storage::default(), &mesh, &meta).ok().and_then(|e| e.encoded_len());
    group.throughput(Throughput::Bytes(glb.unwrap_or_default()));
    group.bench_function("check only", |b| {
        b.iter(|| Encoder::new(Format::Glb, Storage::default(), black_box(&mesh), &meta).map(|e| e.encoded_len()));
    });
    // Baseline of GLB: copies of the same columns.
    let mut copy = Vec::new();
    group.bench_function("copy of the columns", |b| {
        b.iter(|| {
            copy.clear();
            copy.extend_from_slice(bytemuck::must_cast_slice::<_, u8>(black_box(&mesh.positions[..])));
            copy.extend_from_slice(bytemuck::must_cast_slice::<_, u8>(black_box(&mesh.normals[..])));
            copy.extend_from_slice(bytemuck::must_cast_slice::<_, u8>(black_box(&mesh.triangles[..])));
        });
    });
    group.finish();
}

criterion_group!(benches, encode);
criterion_main!(benches);
