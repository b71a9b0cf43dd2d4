//! Structure files: from bytes to a mesh and a mesh file.

use molmesh::formats::{Compress, Format};
use molmesh::fuzzing;
use molmesh::pipeline::{self, Choice, Job, JobLimits, Spacing};
use molmesh::structure::{ReadLimits, Selection};
use molmesh::surface::{Control, CpuBackend, SurfaceLimits, SurfaceOptions, SurfaceParams, Validation};

/// Words of PDB files.
pub(super) const PDB: &[&str] = &[
    "ATOM  ", "HETATM", "MODEL ", "ENDMDL", "TER   ", "END\n", "CONECT", "HEADER", "TITLE ", "SEQRES", "MODRES",
    "ANISOU", "REMARK", "HOH", "MSE", " A", " CA ", "ZN", "\r\n", "\u{feff}", "*****", "A0000", "1-", "   0.000",
    "-999.999", "9999.999",
];
/// Words of mmCIF files.
pub(super) const MMCIF: &[&str] = &[
    "data_",
    "loop_\n",
    "save_",
    "stop_",
    "global_",
    "\n;",
    ";\n",
    "# ",
    "'",
    "\"",
    " ? ",
    " . ",
    "_atom_site.id ",
    "_atom_site.group_PDB ",
    "_atom_site.Cartn_x ",
    "_atom_site.label_alt_id ",
    "_atom_site.label_entity_id ",
    "_atom_site.auth_asym_id ",
    "_atom_site.pdbx_PDB_model_num ",
    "_entity.type ",
    "_entity_poly.type ",
    "_struct_asym.id ",
    "_entry.id ",
    "_struct.title ",
    "_chem_comp.type ",
    "HETATM ",
    "HOH ",
    "1.5(3)",
    "1e39",
];
/// Words of `BinaryCIF` files, and heads of `MessagePack` values.
pub(super) const BINARYCIF: &[&str] = &[
    "dataBlocks",
    "categories",
    "columns",
    "name",
    "data",
    "mask",
    "encoding",
    "kind",
    "ByteArray",
    "FixedPoint",
    "IntervalQuantization",
    "RunLength",
    "Delta",
    "IntegerPacking",
    "StringArray",
    "type",
    "srcType",
    "factor",
    "origin",
    "srcSize",
    "byteCount",
    "isUnsigned",
    "stringData",
    "offsets",
    "offsetEncoding",
    "dataEncoding",
    "numSteps",
    "min",
    "max",
    "rowCount",
    "_atom_site",
    "Cartn_x",
    "_entity",
    "\u{0}\u{0}\u{0}\u{0}",
    "\u{1}\u{0}",
];

/// Selections of the jobs.
const EXPRESSIONS: [&str; 4] =
    ["polymer", "all", "byres within 4 of (ligand or ion)", "not water and not (resi 1-9 or elem C),hydrogens"];

const LIMITS: JobLimits = JobLimits {
    read: ReadLimits {
        max_inflated_bytes: 1 << 20,
        max_atoms: 5_000,
        max_duplicates: 1_000,
        max_copies: 100,
        max_parts: 100,
    },
    surface: SurfaceLimits { max_samples: 1 << 19, max_mesh_bytes: 8 << 20, max_candidates: 1 << 18 },
    picture: molmesh::picture::PictureLimits { max_side: 64 },
};

/// Reads a structure in one and in several pieces, meshes it on a coarse grid, checks the mesh exactly and writes it in
/// every format.
pub(super) fn mesh(bytes: &[u8]) {
    // Some bits of the input choose the job, so that each input has one.
    let bits = bytes.iter().fold(bytes.len(), |hash, byte| hash.wrapping_mul(31).wrapping_add(usize::from(*byte)));
    let has = |bit: u32| bits >> bit & 1 == 1;
    let read = |n| fuzzing::structure(bytes, &LIMITS.read, n);
    assert!(read(1) == read(2 + bits % 7), "the pieces differ from the whole");
    let options = SurfaceOptions { resolution: Some(2.0), atom_ids: has(0), ..SurfaceOptions::default() };
    let Ok(params) = SurfaceParams::new(&options) else { unreachable!("valid parameters") };
    let job = Job {
        selection: Selection { atoms: EXPRESSIONS[bits >> 1 & 3].parse().unwrap_or_default(), ..Selection::default() },
        params,
        spacing: if has(3) { Spacing::Detail(0) } else { Spacing::Given },
        validation: Validation::Exact,
        compress: if has(4) { Compress::Quantize } else { Compress::None },
        ..Job::default()
    };
    let choice = Choice { backend: &CpuBackend::default(), reason: "fuzzing" };
    let product = match pipeline::run(bytes, &job, &LIMITS, &choice, &Control::default(), &(), None) {
        Ok(product) => product,
        Err(error) => return assert_readable(&error.to_string()),
    };
    let report = &product.report;
    assert!(report.closed && report.oriented && report.manifold, "not watertight");
    assert!(product.mesh.bytes() <= LIMITS.surface.max_mesh_bytes, "the mesh has {} bytes", product.mesh.bytes());
    for format in Format::ALL.into_iter().filter(|f| !f.is_picture() && f.holds_units(job.units)) {
        if job.compress != Compress::None && !format.holds_quantized() {
            continue;
        }
        let mut out = Vec::new();
        match product.file(format) {
            Ok(file) => {
                file.write(&mut out).expect("memory accepts every byte");
                assert!(file.bytes().is_none_or(|bytes| bytes == out.len() as u64), "{format}: wrong length");
                assert!(out.len() as u64 <= file.bytes_bound(), "{format}: above the bound");
            }
            Err(error) => assert_readable(&error.to_string()),
        }
    }
}

/// Asserts that a message is short and has no control characters: a file must not change the terminal of its reader.
fn assert_readable(message: &str) {
    super::assert_short(message);
    let control = message.chars().find(|c| c.is_control() && *c != '\n');
    assert!(control.is_none(), "{control:?} in a message: {message:?}");
}
