//! Quantized vertices from end to end: by devices, the CPU and the reference backend, in files and through pipes, by
//! the command line and over HTTP. The report must agree with measurements of the received file.

use crate::cli_support;
use crate::gpu_support;
use crate::tools;

use std::fs;
use std::io::{Read, Write};
use std::net::TcpStream;

use cli_support::{Folder, Service, assert_code, mesh, run, stdout};
use molmesh::formats::{Encoder, Format, FormatError, GlbSink, Packing, Step};
use molmesh::gpu::{DevicePool, Executor, GpuBackend, PoolDevice, PoolSettings};
use molmesh::pipeline::{self, Choice, JobLimits, Options, Product, params};
use molmesh::surface::{
    Backend, Control, CpuBackend, Mesh, ReferenceBackend, SurfaceLimits, SurfaceParams, Validation,
};
use serde_json::Value;
use tools::files::{Files, MemoryFile};
use tools::readers::{gltf_contents, split_glb};

const SAMPLE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/samples/4pti.pdb");

fn sample() -> Vec<u8> {
    fs::read(SAMPLE).unwrap()
}

fn options(more: &[(&'static str, &'static str)]) -> Options {
    let pairs = [("compress", "quantize")].iter().chain(more).copied();
    params::parse(pairs).unwrap().options
}

/// Returns a backend of `n` software devices.
fn devices(n: usize) -> GpuBackend {
    let device = |number| {
        let build = || Ok(Box::new(gpu_support::engine_with(|_| ())) as Box<dyn Executor>);
        PoolDevice { number, name: format!("device {number}"), build: Box::new(build) }
    };
    let settings = PoolSettings { min_partition_bricks: Some(1), ..PoolSettings::default() };
    GpuBackend::with_pool(DevicePool::start((0..n).map(device).collect(), &settings).unwrap())
}

fn made(backend: &dyn Backend, options: &Options) -> Product {
    let choice = Choice { backend, reason: "set by a test" };
    pipeline::run(&sample(), options, &JobLimits::default(), &choice, &Control::default(), &(), None).unwrap()
}

fn glb(product: &Product) -> Vec<u8> {
    let encoder = Encoder::new(Format::Glb, product.storage, &product.mesh, &product.meta()).unwrap();
    let mut bytes = Vec::new();
    encoder.write(&mut bytes).unwrap();
    bytes
}

/// Returns area and volume of the mesh in a GLB.
fn measured(glb: &[u8]) -> [f64; 2] {
    let file = split_glb(glb);
    let contents = gltf_contents(&file.json, &file.bin);
    let corner = |v: u32| contents.positions[v as usize].map(f64::from);
    contents.triangles.iter().fold([0.0; 2], |[area, volume], t| {
        let [a, b, c] = t.map(corner);
        let [u, v]: [[f64; 3]; 2] = [b, c].map(|p| std::array::from_fn(|k| p[k] - a[k]));
        let n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
        let length = n.iter().map(|x| x * x).sum::<f64>().sqrt();
        [area + 0.5 * length, volume + (0..3).map(|k| a[k] * n[k]).sum::<f64>() / 6.0]
    })
}

fn near(a: f64, b: f64, bound: f64) -> bool {
    (a / b - 1.0).abs() < bound
}

#[test]
fn every_backend_returns_integers_and_reports_their_measures() {
    let options = options(&[("resolution", "0.8")]);
    let plain = params::parse([("resolution", "0.8")]).unwrap().options;
    let (one, cpu) = (devices(1), CpuBackend::new(Some(2)).unwrap());
    for backend in [&one as &dyn Backend, &cpu, &ReferenceBackend] {
        let product = made(backend, &options);
        let name = backend.name();
        assert!(product.mesh.quantized.is_some() && product.mesh.positions.is_empty(), "{name}");
        assert_eq!(Packing::of(&product.mesh), product.storage.packing, "{name}");
        let [area, volume] = measured(&glb(&product));
        assert!(near(product.report.area, area, 3e-6) && near(product.report.volume.unwrap(), volume, 3e-6), "{name}");
        assert!(product.report.closed && product.report.manifold, "{name}");
        // Without the parameter vertices have single precision.
        let plain = made(backend, &plain);
        assert!(plain.mesh.quantized.is_none() && plain.storage.packing == Packing::Full, "{name}");
        assert_eq!(
            (plain.report.vertices, plain.report.triangles),
            (product.report.vertices, product.report.triangles)
        );
        // Other formats get unquantized vertices.
        let refused =
            Encoder::new(Format::Ply, Packing::of(&product.mesh), &product.mesh, &product.meta()).unwrap_err();
        assert_eq!(refused, FormatError::QuantizationNotSupported { format: "ply" });
    }
}

#[test]
fn the_exact_validation_measures_the_same_vertices() {
    for backend in [&devices(1) as &dyn Backend, &CpuBackend::new(Some(2)).unwrap()] {
        let [quick, exact] = ["checksum", "exact"]
            .map(|validation| made(backend, &options(&[("validation", validation), ("resolution", "1")])));
        assert_eq!((quick.report.validation, exact.report.validation), ("checksum", "exact"));
        assert!(quick.mesh == exact.mesh);
        assert!(near(quick.report.area, exact.report.area, 2e-6) && exact.report.manifold);
    }
}

/// Rounding to a coarse step changes area and volume, and the report contains the changed values.
#[test]
fn a_coarse_step_changes_the_measures() {
    let spheres = gpu_support::sample("4pti.pdb");
    let single = SurfaceParams::default();
    let coarse = SurfaceParams { quantize: Some(Step::covering(8000.0)), ..single.clone() };
    let cpu = CpuBackend::new(Some(2)).unwrap();
    let of = |params: &SurfaceParams| {
        cpu.run(&spheres, params, &SurfaceLimits::default(), &Control::default()).unwrap().measures.unwrap()
    };
    let (fine, found) = (of(&single), of(&coarse));
    let device = devices(1);
    let meshed = device.run(&spheres, &coarse, &SurfaceLimits::default(), &Control::default()).unwrap();
    let theirs = molmesh::surface::Measures::of(&meshed.mesh, Validation::Checksum, &Control::default()).unwrap();
    assert!(near(found.area, theirs.area, 1e-4) && near(found.volume, theirs.volume, 1e-4), "{found:?} {theirs:?}");
    assert!(!near(found.area, fine.area, 1e-3), "{} {}", found.area, fine.area);
}

/// Returns the document without its sums, whose last digits depend on the partition of the mesh.
fn document_without_sums(glb: &[u8]) -> Value {
    let mut document = split_glb(glb).json;
    let extras = document["asset"]["extras"].as_object_mut().unwrap();
    for sum in ["area", "volume", "component_list"] {
        assert!(extras.remove(sum).is_some(), "{sum}");
    }
    document
}

#[test]
fn one_and_two_devices_make_the_same_file_in_any_write_order() {
    let options = options(&[("resolution", "0.4")]);
    let [one, two] = [1, 2].map(devices);
    let (alone, spread) = (made(&one, &options), made(&two, &options));
    assert!(spread.report.device.starts_with("2 devices"), "{}", spread.report.device);
    let expected = [&alone, &spread].map(glb);
    assert_eq!(document_without_sums(&expected[0]), document_without_sums(&expected[1]));
    assert!(contents(&expected[0]).1 == contents(&expected[1]).1, "the meshes differ");
    let sums = [&alone, &spread].map(|product| (product.report.area, product.report.volume.unwrap()));
    assert!(near(sums[0].0, sums[1].0, 1e-12) && near(sums[0].1, sums[1].1, 1e-12), "{sums:?}");
    for (backend, expected) in [(&one as &dyn Backend, &expected[0]), (&two, &expected[1])] {
        let file = MemoryFile::default();
        let sink = GlbSink::new(&file);
        let (choice, limits) = (Choice { backend, reason: "set by a test" }, JobLimits::default());
        let control = Control::default();
        let product = pipeline::run(&sample(), &options, &limits, &choice, &control, &(), Some(&sink)).unwrap();
        drop(sink);
        assert!(product.mesh.positions.is_empty() && product.streamed_bytes == Some(expected.len() as u64));
        assert!(file.into_bytes() == *expected);
    }
    // Control: another spacing gives another file.
    let other = glb(&made(&one, &self::options(&[("resolution", "0.45")])));
    assert!(
        contents(&other).1 != contents(&expected[0]).1
            && document_without_sums(&other) != document_without_sums(&expected[0])
    );
}

/// A file is rejected if a vertex of the mesh is out of range, for every backend.
#[test]
fn vertices_beyond_the_step_are_rejected_when_writing() {
    let spheres = gpu_support::sample("1crn.cif");
    let short = SurfaceParams { quantize: Some(Step::covering(4.0)), ..SurfaceParams::default() };
    for backend in [&devices(1) as &dyn Backend, &CpuBackend::new(Some(2)).unwrap()] {
        let meshed = backend.run(&spheres, &short, &SurfaceLimits::default(), &Control::default()).unwrap();
        let packing = Packing::of(&meshed.mesh);
        let refusal = Encoder::new(Format::Glb, packing, &meshed.mesh, &molmesh::formats::Meta::default());
        assert!(matches!(refusal, Err(FormatError::OutOfQuantizationRange { .. })), "{}", backend.name());
    }
}

#[test]
fn external_readers_accept_vertices_quantized_by_devices() {
    let (mut files, mut reports) = (Files::new(), Vec::new());
    let two = devices(2);
    for (name, more) in [
        ("gaussian", vec![("resolution", "0.5")]),
        ("soft", vec![("surface", "soft-object"), ("resolution", "0.6")]),
        ("inverse", vec![("surface", "inverse-square"), ("resolution", "0.6"), ("atom_ids", "true")]),
    ] {
        let product = made(&two, &options(&more));
        files.add(&format!("{name}.glb"), &glb(&product));
        reports.push(product.report);
    }
    // Control: an invalid normal, and a vertex out of bounds.
    let mut broken = fs::read(&files.paths[0]).unwrap();
    let file = split_glb(&broken);
    let attributes = &file.json["meshes"][0]["primitives"][0]["attributes"];
    let at = |name: &str| file.bin_at + tools::readers::accessor_offset(&file.json, &attributes[name]);
    let (position, normal) = (at("POSITION"), at("NORMAL"));
    broken[position + 1] = 0x7f;
    broken[normal..normal + 3].fill(30);
    files.add("broken.glb", &broken);
    if let Some(mut found) = tools::gltf_validate(&files.paths) {
        let broken = found.pop().unwrap();
        assert!(broken.errors >= 2 && broken.codes.contains_key("ACCESSOR_VECTOR3_NON_UNIT"), "{broken:#?}");
        for (found, report) in found.iter().zip(&reports) {
            found.assert_clean();
            assert_eq!((found.vertices, found.triangles), (report.vertices, report.triangles));
        }
    }
    if let Some(found) = tools::trimesh(&files.paths[..3]) {
        for (found, report) in found.iter().zip(&reports) {
            assert_eq!(found.error, None, "{found:#?}");
            assert!(found.watertight && found.winding_consistent && found.is_volume, "{found:#?}");
            let counts = (found.vertices, found.faces, found.bodies, found.euler, found.nan_count, found.bad_edges);
            let expected = (report.vertices, report.triangles, report.components, report.euler, 0, 0);
            assert_eq!(counts, expected, "{found:#?}");
            assert!(
                near(found.area, report.area, 1e-5) && near(found.volume, report.volume.unwrap(), 1e-5),
                "{found:#?}"
            );
            assert!(found.max_normal_error.unwrap() < 0.006_74, "{found:#?}");
        }
    }
}

/// Returns the extras of a GLB and the bytes of its mesh.
fn contents(glb: &[u8]) -> (Value, Vec<u8>) {
    let file = split_glb(glb);
    (file.json["asset"]["extras"].clone(), file.bin)
}

const ON_SOFTWARE: [&str; 4] = ["--backend", "gpu", "--devices", "software"];

#[test]
fn the_command_line_quantizes_on_a_device() {
    let folder = Folder::new();
    let output = folder.path("out.glb");
    let flags = [&ON_SOFTWARE[..], &["--compress", "quantize", "--resolution", "0.5", "--report", "json"]].concat();
    let done = mesh(SAMPLE.as_ref(), &output, &flags);
    assert_code(&done, 0);
    let report: Value = serde_json::from_str(&stdout(&done)).unwrap();
    assert_eq!(report["backend"], "gpu");
    let file = fs::read(&output).unwrap();
    let (extras, bin) = contents(&file);
    assert_eq!((&extras["quantization"], &extras["backend"]), (&report["quantization"], &"gpu".into()));
    let [area, volume] = measured(&file);
    assert!(
        near(report["area"].as_f64().unwrap(), area, 3e-6) && near(report["volume"].as_f64().unwrap(), volume, 3e-6)
    );
    let quiet = [&ON_SOFTWARE[..], &["--compress", "quantize", "--resolution", "0.5", "--quiet"]].concat();
    let piped = run(["mesh", SAMPLE, "-o", "-"].iter().chain(&quiet));
    assert_code(&piped, 0);
    assert!(piped.stdout == file, "file and pipe differ");
    // The library makes the same mesh on the same device.
    assert!(contents(&glb(&made(&devices(1), &options(&[("resolution", "0.5")])))).1 == bin);
    let text = mesh(SAMPLE.as_ref(), &folder.path("out.gltf"), &quiet);
    assert_code(&text, 0);
    let ply = mesh(SAMPLE.as_ref(), &folder.path("out.ply"), &quiet);
    assert_code(&ply, 2);
}

/// POSTs the sample to a running service and returns the body of the response.
fn post(addr: &str, target: &str) -> Vec<u8> {
    let body = sample();
    let mut stream = TcpStream::connect(addr).unwrap();
    let head = format!(
        "POST /v1/{target} HTTP/1.1\r\nhost: {addr}\r\ncontent-length: {}\r\nconnection: close\r\n\r\n",
        body.len()
    );
    stream.write_all(head.as_bytes()).unwrap();
    stream.write_all(&body).unwrap();
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).unwrap();
    assert!(answer.starts_with(b"HTTP/1.1 200"), "{}", String::from_utf8_lossy(&answer[..answer.len().min(2000)]));
    let end = answer.windows(4).position(|w| w == b"\r\n\r\n").unwrap();
    answer.split_off(end + 4)
}

#[test]
fn a_service_quantizes_on_a_device() {
    let folder = Folder::new();
    let service = Service::start(&folder, &ON_SOFTWARE);
    let query = "compress=quantize&resolution=0.5";
    let file = post(&service.addr, &format!("meshes?{query}"));
    let (extras, bin) = contents(&file);
    assert_eq!(extras["backend"], "gpu");
    let expected = made(&devices(1), &options(&[("resolution", "0.5")]));
    assert!(contents(&glb(&expected)).1 == bin);
    let report: Value = serde_json::from_slice(&post(&service.addr, &format!("report?{query}"))).unwrap();
    let [area, volume] = measured(&file);
    assert!(
        near(report["area"].as_f64().unwrap(), area, 3e-6) && near(report["volume"].as_f64().unwrap(), volume, 3e-6)
    );
    // Without the parameter the result is different.
    let plain = post(&service.addr, "meshes?resolution=0.5");
    assert!(plain.len() as u64 > file.len() as u64 + 11 * expected.report.vertices);
}

/// The mesh of a product is quantized completely or not at all.
#[test]
fn an_empty_mesh_stays_empty_when_quantized() {
    let mut mesh = Mesh::default();
    assert!(mesh.quantize(Step::covering(1.0)));
    assert_eq!((mesh.n_vertices(), mesh.bounds()), (0, [[0.0; 3]; 2]));
    assert!(Encoder::new(Format::Glb, Packing::of(&mesh), &mesh, &molmesh::formats::Meta::default()).is_ok());
}
