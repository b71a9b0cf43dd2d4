//! Structure files: from bytes to a mesh and a mesh file.

use molmesh::formats::{Compress, Format};
use molmesh::fuzzing;
use molmesh::pipeline::{self, Choice, JobLimits, params};
use molmesh::structure::ReadLimits;
use molmesh::surface::{Control, CpuBackend, SurfaceLimits};

/// Words of PDB files.
pub(super) const PDB: &[&str] = &[
    "ATOM  ",
    "HETATM",
    "MODEL ",
    "ENDMDL",
    "TER   ",
    "END\n",
    "CONECT",
    "HEADER",
    "TITLE ",
    "SEQRES",
    "MODRES",
    "ANISOU",
    "REMARK",
    "REMARK 350 BIOMOLECULE: 1",
    "REMARK 350 APPLY THE FOLLOWING TO CHAINS: A, B",
    "REMARK 350   BIOMT1   1  1.000000  0.000000  0.000000        0.00000",
    "HOH",
    "MSE",
    "NAG",
    "HEM",
    " A",
    " CA ",
    "ZN",
    "\r\n",
    "\u{feff}",
    "*****",
    "A0000",
    "1-",
    "   0.000",
    "-999.999",
    "9999.999",
];
/// Words of PQR files.
pub(super) const PQR: &[&str] = &[
    "ATOM ",
    "HETATM",
    "HETATM10000 ",
    "REMARK ",
    "TER\n",
    "END\n",
    " A1000 ",
    " ARG A 1 ",
    " CA ",
    " ZN ",
    " 0.3000",
    " 1.8240",
    " -0",
    " 100",
    "\t",
    "\r\n",
    "\n",
];
/// Words of XYZ files.
pub(super) const XYZ: &[&str] = &[
    "1\n",
    "2\n\n",
    "Lattice=\"9 0 0 0 9 0 0 0 9\"",
    "Properties=",
    "species:S:1:",
    "pos:R:3",
    ":I:1",
    "C 0 0 0\n",
    "Xx ",
    "H1 ",
    "6 ",
    " 1.5e0",
    " -1D3",
    "\t",
    "\r\n",
    "\n\n",
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
    "_pdbx_struct_assembly_gen.assembly_id ",
    "_pdbx_struct_assembly_gen.oper_expression ",
    "_pdbx_struct_assembly_gen.asym_id_list ",
    "_pdbx_struct_oper_list.id ",
    "_pdbx_struct_oper_list.matrix[1][1] ",
    "_pdbx_struct_oper_list.vector[3] ",
    "'(1-60)(X0,P)'",
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
    "_pdbx_struct_assembly_gen",
    "oper_expression",
    "asym_id_list",
    "_pdbx_struct_oper_list",
    "matrix[1][1]",
    "\u{0}\u{0}\u{0}\u{0}",
    "\u{1}\u{0}",
];

/// Parameters of the jobs: one text of each row.
const PARAMETERS: [&[&str]; 6] = [
    &[
        "select=polymer",
        "select=all",
        "select=byres within 4 of (ligand or ion)",
        "select=not water and not resi 1-9,hydrogens",
    ],
    &["resolution=2", "detail=0", "resolution=3", "max_triangles=1000"],
    &[
        "surface=gaussian",
        "surface=ses",
        "surface=sas&probe=0.5",
        "surface=vdw",
        "surface=soft-object",
        "surface=inverse-square",
        "surface=ses&probe=4",
        "surface=gaussian&radius_scale=4",
    ],
    &["split=none", "split=none", "split=chain", "split=entity", "split=residue-group"],
    &[
        "atom_ids=false",
        "atom_ids=true",
        "color=chain",
        "color=bfactor&palette=cividis",
        "color=hydrophobicity",
        "color=entity",
    ],
    &["compress=none", "compress=quantize", "assembly=1", "assembly=1&compress=quantize"],
];

const LIMITS: JobLimits = JobLimits {
    read: ReadLimits {
        max_inflated_bytes: 1 << 20,
        max_atoms: 5_000,
        max_duplicates: 1_000,
        max_copies: 100,
        max_parts: 100,
        max_distances: 1 << 24,
    },
    surface: SurfaceLimits { max_grid_points: 1 << 19, max_mesh_bytes: 8 << 20, max_candidates: 1 << 18 },
    picture: molmesh::picture::PictureLimits { max_side: 64 },
    map: molmesh::structure::map::MapLimits { max_points: 1 << 16, max_inflated_bytes: 1 << 20 },
};

/// Reads a structure in one and in several pieces, meshes one of the surfaces on a coarse grid, checks the mesh exactly
/// and writes it in every format.
pub(super) fn mesh(bytes: &[u8]) {
    // Some bits of the input choose the job, so that each input has one.
    let bits = bytes.iter().fold(bytes.len(), |hash, byte| hash.wrapping_mul(31).wrapping_add(usize::from(*byte)));
    let read = |n| fuzzing::structure(bytes, &LIMITS.read, n);
    assert!(read(1) == read(2 + bits % 7), "the pieces differ from the whole");
    let (mut rest, mut query) = (bits, "validation=exact".to_owned());
    for texts in PARAMETERS {
        query.extend(["&", texts[rest % texts.len()]]);
        rest /= texts.len();
    }
    let pairs = query.split('&').filter_map(|pair| pair.split_once('='));
    let job = params::parse(pairs).expect("valid parameters").options;
    let choice = Choice { backend: &CpuBackend::default(), reason: "fuzzing" };
    let product = match pipeline::run(bytes, &job, &LIMITS, &choice, &Control::default(), &(), None) {
        Ok(product) => product,
        Err(error) => return assert_readable(&error.to_string()),
    };
    let report = &product.report;
    assert!(report.closed && report.oriented && report.manifold, "not watertight: {query}");
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
