//! Table of requests and expected responses. Lines and columns count from 1.

use serde_json::{Value, json};

use crate::bcif_support::{CRAMBIN, atoms, block, byte_array, category, column, file, i32s, reals, run_length};
use crate::http_support::{SAMPLE, gzip};

/// Limits of the server, and of the command line if it has them. All other limits have their defaults.
pub(crate) const BODY_BYTES: u64 = 4 << 20;
pub(crate) const INFLATED_BYTES: u64 = 6 << 20;
pub(crate) const ATOMS: u64 = 100_000;

const ATOM: &str = "ATOM      2  CA  ALA A  12      11.104  -6.134   0.500  1.00 20.25           C  \n";

/// Expected value of a member of a problem or of a header of a mesh.
#[derive(Debug, Clone)]
pub(crate) enum Is {
    Equal(Value),
    /// A greater number.
    Above(f64),
    /// A string that contains this text.
    Contains(&'static str),
}

impl Is {
    pub(crate) fn fits(&self, value: &Value) -> bool {
        match self {
            Self::Equal(expected) => value == expected,
            Self::Above(bound) => value.as_f64().is_some_and(|v| v > *bound),
            Self::Contains(part) => value.as_str().is_some_and(|text| text.contains(part)),
        }
    }
}

/// Request with its expected response.
#[derive(Debug, Clone)]
pub(crate) struct Row {
    pub(crate) name: &'static str,
    pub(crate) method: &'static str,
    pub(crate) path: String,
    pub(crate) query: String,
    pub(crate) headers: Vec<(&'static str, &'static str)>,
    pub(crate) body: Vec<u8>,
    pub(crate) status: u16,
    /// Last path segment of the problem type; empty for a mesh.
    pub(crate) slug: &'static str,
    /// Expected members of the problem, or headers of the mesh (numbers if possible).
    pub(crate) named: Vec<(&'static str, Is)>,
    /// Exit code of `molmesh mesh - -o -` if the command line supports the request.
    pub(crate) exit: Option<i32>,
}

impl Row {
    fn header(mut self, name: &'static str, value: &'static str) -> Self {
        self.headers.push((name, value));
        // Headers exist only in HTTP.
        self.exit = None;
        self
    }

    fn http_only(self) -> Self {
        Self { exit: None, ..self }
    }
}

fn request(name: &'static str, method: &'static str, path: impl Into<String>, status: u16, slug: &'static str) -> Row {
    let (path, headers, named) = (path.into(), Vec::new(), Vec::new());
    Row { name, method, path, query: String::new(), headers, body: Vec::new(), status, slug, named, exit: None }
}

fn upload(name: &'static str, body: impl AsRef<[u8]>, status: u16, slug: &'static str, exit: i32) -> Row {
    let (body, exit) = (body.as_ref().to_vec(), Some(exit));
    Row { body, exit, ..request(name, "POST", "/v1/meshes", status, slug) }
}

/// Bytes that are not a structure: the problem names the detected content.
fn not_a_structure(name: &'static str, body: impl AsRef<[u8]>, found: &'static str) -> Row {
    let named = vec![("found", Is::Contains(found))];
    Row { named, ..upload(name, body, 422, "unreadable-structure", 4) }
}

/// Structure with an error at a line and column.
fn broken(name: &'static str, body: impl AsRef<[u8]>, [line, column]: [usize; 2], expected: &'static str) -> Row {
    let named = vec![
        ("line", Is::Equal(line.into())),
        ("column", Is::Equal(column.into())),
        ("found", Is::Contains("")),
        ("expected", Is::Contains(expected)),
    ];
    Row { named, ..upload(name, body, 422, "unreadable-structure", 4) }
}

/// Compressed data with an error.
fn damaged(name: &'static str, body: impl AsRef<[u8]>, encoding: &str) -> Row {
    let named = vec![("encoding", Is::Equal(encoding.into()))];
    Row { named, ..upload(name, body, 422, "unreadable-structure", 4) }
}

/// Structure without atoms.
fn atomless(name: &'static str, body: impl AsRef<[u8]>, found: &'static str) -> Row {
    Row { named: vec![("found", Is::Contains(found))], ..upload(name, body, 422, "no-atoms", 4) }
}

/// Input over a limit.
fn beyond(name: &'static str, body: impl AsRef<[u8]>, status: u16, slug: &'static str, limit: u64) -> Row {
    Row { named: vec![("limit", Is::Equal(limit.into()))], ..upload(name, body, status, slug, 5) }
}

/// Unusual but valid input with the number of its atoms.
fn legal(name: &'static str, body: impl AsRef<[u8]>, atoms: u64) -> Row {
    let named = vec![("molmesh-atoms", Is::Equal(atoms.into()))];
    Row { named, query: "resolution=1".to_owned(), ..upload(name, body, 200, "", 0) }
}

/// Invalid parameter with a valid file.
fn parameter(name: &'static str, query: &str, parameter: &str, value: impl Into<Value>) -> Row {
    let named = vec![
        ("parameter", Is::Equal(parameter.into())),
        ("value", Is::Equal(value.into())),
        ("expected", Is::Contains("")),
    ];
    Row { named, query: query.to_owned(), ..upload(name, ATOM, 400, "bad-parameter", 2) }
}

/// Selection without atoms in a valid file.
fn empty_selection(name: &'static str, query: &str, parameter: &str, value: &str, available: &'static str) -> Row {
    let named = vec![
        ("parameter", Is::Equal(parameter.into())),
        ("value", Is::Equal(value.into())),
        ("expected", Is::Contains(available)),
    ];
    Row { named, query: query.to_owned(), ..upload(name, ATOM, 422, "empty-selection", 4) }
}

/// Returns a zstd frame of `n` blocks, each of which encodes 128 KiB of spaces in four bytes.
fn zstd_bomb(window: u8, n: usize) -> Vec<u8> {
    let mut frame = vec![0x28, 0xb5, 0x2f, 0xfd, 0x00, window];
    for i in 0..n {
        let header = u32::from(i + 1 == n) | 1 << 1 | (128 << 10) << 3;
        frame.extend_from_slice(&header.to_le_bytes()[..3]);
        frame.push(b' ');
    }
    frame
}

/// Returns an `atom_site` loop; its rows begin in line 9.
fn cif(rows: &str) -> String {
    format!(
        "data_x\nloop_\n_atom_site.auth_asym_id\n_atom_site.label_alt_id\n_atom_site.pdbx_PDB_model_num\n\
         _atom_site.Cartn_x\n_atom_site.Cartn_y\n_atom_site.Cartn_z\n{rows}"
    )
}

fn many(n: u64, row: impl Fn(u64) -> String) -> String {
    cif(&(0..n).map(row).collect::<String>())
}

/// Returns the atom record with a different x in columns 31 to 38.
fn x(field: &str) -> String {
    ATOM.replace("  11.104", field)
}

/// Returns a form with one part.
fn form(name: &str, content: &str) -> String {
    format!("--XX\r\ncontent-disposition: form-data; name=\"{name}\"\r\n\r\n{content}\r\n--XX--\r\n")
}

const FORM: (&str, &str) = ("content-type", "multipart/form-data; boundary=XX");
const X: &str = "the x coordinate in Å, within ±100000";
const Y: &str = "Cartn_y in Å, within ±100000";

/// Content that is not a structure.
fn not_structures() -> Vec<Row> {
    vec![
        not_a_structure("empty", "", "nothing (0 bytes)"),
        not_a_structure("white space", " \n\n\t", "only white space"),
        not_a_structure(
            "binary",
            (0..=255).cycle().take(100_000).collect::<Vec<u8>>(),
            "binary data beginning with 00 01",
        ),
        not_a_structure("zeros", vec![0; 1 << 20], "binary data"),
        not_a_structure("prose", "lorem ipsum dolor\n".repeat(1000), "`lorem ipsum dolor`"),
        not_a_structure("3 MB of one letter", "x".repeat(3 << 20), "text beginning with"),
        not_a_structure("HTML", "<!DOCTYPE html><title>404</title>", "an HTML page"),
        not_a_structure("JSON", "{\"pdb_id\": \"4pti\"}", "JSON"),
        not_a_structure("ZIP", b"PK\x03\x04rest", "ZIP"),
        not_a_structure("UTF-16", b"\xff\xfeA\0T\0O\0M\0", "UTF-16"),
        not_a_structure("MMTF", b"\xde\x00\x20\xabmmtfVersion\xa51.0.0", "MMTF"),
        not_a_structure("END only", "END\n", "`END`"),
        not_a_structure("gzip in gzip", gzip(&gzip(ATOM.as_bytes())), "gzip inside a compressed file"),
        not_a_structure("gzip of nothing", gzip(b""), "nothing (0 bytes)"),
    ]
}

/// Compressed files.
fn compressed() -> Vec<Row> {
    let packed = gzip(ATOM.repeat(1000).as_bytes());
    let mut flipped = packed.clone();
    let crc = flipped.len() - 8;
    flipped[crc] ^= 1;
    vec![
        damaged("truncated gzip", &packed[..packed.len() / 2], "gzip"),
        damaged("gzip magic number only", b"\x1f\x8b", "gzip"),
        damaged("gzip with another checksum", flipped, "gzip"),
        damaged("gzip followed by plain text", [&packed[..], b"hello"].concat(), "gzip"),
        damaged("zstd magic number only", b"\x28\xb5\x2f\xfd", "zstd"),
        damaged("zstd with a window of 2 TiB", zstd_bomb(0xf8, 1), "zstd"),
        damaged("zstd skippable frame of 4 GiB", b"\x50\x2a\x4d\x18\xff\xff\xff\xff", "zstd"),
        beyond("gzip bomb", gzip(&vec![b' '; 256 << 20]), 413, "inflated-too-large", INFLATED_BYTES),
        beyond("zstd bomb", zstd_bomb(0x38, 10_000), 413, "inflated-too-large", INFLATED_BYTES),
    ]
}

/// PDB files.
fn pdb() -> Vec<Row> {
    let cut = SAMPLE.windows(6).position(|w| w == b"\nATOM ").unwrap() + 10 * 81 + 1 + 40;
    let line = SAMPLE[..cut].split(|&b| b == b'\n').count();
    let cryst = "CRYST1   28.070   28.070   53.350  90.00  90.00  90.00 Q 99 99 9   8\n";
    vec![
        broken("truncated in an ATOM line", &SAMPLE[..cut], [line, 41], "coordinates in columns 31 to 54"),
        broken("bare ATOM", "ATOM", [1, 5], "coordinates in columns 31 to 54"),
        broken("bare HETATM", "REMARK\nHETATM\n", [2, 7], "coordinates in columns 31 to 54"),
        atomless("bare MODEL and ENDMDL", "MODEL\nENDMDL\n", "it has MODEL, ENDMDL"),
        atomless("bare HEADER", "HEADER", "it has HEADER"),
        atomless("zero atoms", "HEADER    X\nREMARK   1\nCRYST1\nEND\n", "without ATOM and HETATM"),
        broken("a truncated atom record", format!("{ATOM}ATOM\n{ATOM}"), [2, 5], "coordinates"),
        broken("MODEL of 1e400", format!("MODEL     1e400\n{ATOM}"), [1, 11], "a model number"),
        broken("NaN", x("     NaN"), [1, 31], X),
        broken("inf", x("     inf"), [1, 31], X),
        broken("-infinity", x("-infinit"), [1, 31], X),
        broken("1e30", x("    1e30"), [1, 31], X),
        broken("one atom at 1e9", format!("{ATOM}{}", x("     1e9")), [2, 31], X),
        broken("no x", x("        "), [1, 31], X),
        broken("asterisks for an overflow", x("********"), [1, 31], X),
        broken("a NUL in a number", x("  11\x00104"), [1, 31], X),
        legal("NaN as occupancy", ATOM.replace("  1.00", "   NaN"), 1),
        legal("1e999 as B-factor", ATOM.replace(" 20.25", " 1e999"), 1),
        legal("a residue number of asterisks", ATOM.replace("  12 ", "**** "), 1),
        broken("3 MB in one ATOM line", format!("ATOM{}", " ".repeat(3 << 20)), [1, 31], X),
        legal("a bad space group in CRYST1", format!("{cryst}{ATOM}"), 1),
        legal("NaN in CRYST1", format!("{}{ATOM}", cryst.replace("28.070", "   NaN")), 1),
        legal("a bare CRYST1", format!("CRYST1\n{ATOM}"), 1),
        legal("bare SEQRES, ANISOU, MASTER, TER and CONECT", format!("SEQRES\nANISOU\n{ATOM}MASTER\nTER\nCONECT"), 1),
        legal("multibyte names", ATOM.replace(" CA ", "éé"), 1),
        legal("control characters in names", ATOM.replace(" CA ", "\u{1}\u{2}\u{3}\u{4}"), 1),
        legal("a chain that is a NUL", ATOM.replace("ALA A", "ALA \0"), 1),
        legal("a remark of multibyte characters", format!("REMARK {}\n{ATOM}", "€".repeat(100)), 1),
        legal("Latin-1", [b"TITLE     M\xfcller\n", ATOM.as_bytes()].concat(), 1),
        legal("entry and line in columns 73-80, no element", old_file(), 3),
        legal("a byte order mark and old line ends", format!("\u{feff}{}", ATOM.repeat(3).replace('\n', "\r")), 3),
        legal("no element and an unknown name", ATOM.replace(" CA  ALA", "QQQ  ZZZ").replace("  C  ", "     "), 1),
        legal("1,000 atoms at one place", ATOM.repeat(1000), 1000),
        legal("atoms 200,000 Å apart", format!("{}{}", x("99999.0 "), x("-99999.0")), 2),
    ]
}

/// Three atoms in the format used before 1996: no elements; entry id and line number in columns 73 to 80.
fn old_file() -> String {
    [1, 2, 3].map(|i| format!("{:<72}4PTI{i:>4}\n", &x(&format!("{i:>6}.0"))[..66])).concat()
}

/// mmCIF files.
fn mmcif() -> Vec<Row> {
    let ids = "data_x\nloop_\n_atom_site.id\n_atom_site.auth_seq_id\n_atom_site.Cartn_x\n_atom_site.Cartn_y\n\
               _atom_site.Cartn_z\n";
    vec![
        broken("mmCIF with NaN", cif("A . 1 1.0 NaN 3.0\n"), [9, 11], Y),
        broken("mmCIF with 1e30", cif("A . 1 1.0 1e30 3.0\n"), [9, 11], Y),
        broken("mmCIF with an atom at 1e9", cif("A . 1 1 2 3\nA . 1 1.0 1000000000.0 3.0\n"), [10, 11], Y),
        broken("mmCIF with an unknown y", cif("A . 1 1.0 ? 3.0\n"), [9, 11], Y),
        broken("mmCIF with a model of 1e400", cif("A . 1e400 1 2 3\n"), [9, 5], "a model number"),
        broken("mmCIF with a model beyond 32 bits", cif("A . 4294967296 1 2 3\n"), [9, 5], "a model number"),
        legal("mmCIF with a residue of 1e400", format!("{ids}1 1e400 1 2 3\n"), 1),
        legal("mmCIF with ids of 1e400", format!("{ids}1e400 1 1 2 3\n"), 1),
        broken("mmCIF truncated in a row", cif("A . 1 1.0 2.0"), [9, 14], "value 6 of the 6 in a row of atom_site"),
        broken("loop_ and again", "data_x\nloop_\nloop_\n_atom_site.id\n1\n", [3, 1], "a tag after loop_"),
        broken("100,000 times loop_", format!("data_x\n{}", "loop_\n".repeat(100_000)), [3, 1], "a tag after loop_"),
        legal("loop_ after the atoms", cif("A . 1 1 2 3\nloop_\nloop_\n"), 1),
        broken("an open quote", "data_x\n_a.b 'open\n", [2, 6], "a closing '"),
        broken("an open text field", "data_x\n_a.b\n;open\n", [3, 1], "a line that begins with ;"),
        atomless("mmCIF without coordinates", "data_x\n_entry.id X\n_cell.length_a 1\n", "categories entry, cell"),
        atomless("an empty data block", "data_\n", "nothing in it"),
        atomless(
            "atom_site without z",
            cif("").replace("_atom_site.Cartn_z\n", "") + "A . 1 1 2\n",
            "atom_site without Cartn_z",
        ),
        atomless("an atom_site without rows", cif(""), "atom_site"),
        legal("100,000 models", many(ATOMS, |i| format!("A . {i} 1 2 3\n")), 1),
        Row { query: "chains=c7".to_owned(), ..legal("one of 100,000 chains", chains(), 1) },
        Row {
            body: chains().into_bytes(),
            ..empty_selection("none of 100,000 chains", "chains=Z", "chains", "Z", "c0")
        },
        beyond("100,001 atoms", many(ATOMS + 1, |i| format!("A . 1 {i} 2 3\n")), 422, "too-many-atoms", ATOMS),
        beyond("blanks beyond every limit", vec![b' '; 9 << 20], 413, "body-too-large", BODY_BYTES),
    ]
}

/// BinaryCIF file with an error at a place.
fn malformed(name: &'static str, body: impl AsRef<[u8]>, place: &'static str, expected: &'static str) -> Row {
    let named =
        vec![("location", Is::Contains(place)), ("found", Is::Contains("")), ("expected", Is::Contains(expected))];
    Row { named, ..upload(name, body, 422, "unreadable-structure", 4) }
}

/// BinaryCIF files.
fn binary() -> Vec<Row> {
    let runs = |rows: i64, count: i32| {
        let column = |name| column(name, i32s(&[0, count]), vec![run_length(count.into()), byte_array(3)]);
        let all = ["Cartn_x", "Cartn_y", "Cartn_z"].map(column).to_vec();
        file(vec![block("x", vec![category("_atom_site", rows, all)])])
    };
    let mut flipped = CRAMBIN.to_vec();
    let at = flipped.windows(9).position(|w| w == b"ByteArray").unwrap();
    flipped[at] = b'b';
    let x = |values: &[f64]| atoms(values.len(), vec![reals("Cartn_x", values)]);
    vec![
        legal("BinaryCIF", CRAMBIN, 327),
        legal("BinaryCIF in gzip", gzip(CRAMBIN), 327),
        malformed("half a BinaryCIF", &CRAMBIN[..CRAMBIN.len() / 2], "BinaryCIF, byte ", "bytes or more"),
        malformed("BinaryCIF with NaN", x(&[0.0, f64::NAN]), "BinaryCIF, atom_site, Cartn_x, row 2", "Cartn_x in Å"),
        malformed("BinaryCIF with an atom at 1e9", x(&[1e9]), "BinaryCIF, atom_site, Cartn_x, row 1", "within ±100000"),
        malformed("BinaryCIF with an unknown encoding", flipped, "encoding ", "one of BinaryCIF's seven"),
        malformed("a run of 2³¹ atoms", runs(2, i32::MAX), "Cartn_x, RunLength (encoding 1 of 2)", "at most 6"),
        malformed("a wrong row count", runs(3, 2), "BinaryCIF, atom_site, Cartn_x", "3, as rowCount says"),
        malformed(
            "2,000,000 arrays in arrays",
            [b"\x81\xaadataBlocks".as_slice(), &[0x91; 2_000_000], &[0]].concat(),
            "BinaryCIF",
            "a map",
        ),
        malformed(
            "an array of 4 billion",
            b"\x81\xaadataBlocks\xdd\xff\xff\xff\xff",
            "BinaryCIF, byte 17",
            "bytes or more",
        ),
        beyond("a row count of 2³¹", runs(i64::from(i32::MAX), i32::MAX), 422, "too-many-atoms", ATOMS),
        atomless("BinaryCIF without blocks", b"\x83\xa7encoder\xa1x\xa7version\xa1y\xaadataBlocks\x90", "BinaryCIF"),
    ]
}

fn chains() -> String {
    many(ATOMS, |i| format!("c{i} . 1 {} 2 {}\n", i % 40, i / 40 % 50))
}

/// Returns a file whose assembly names chains that it does not have.
fn absent_chains() -> String {
    let head = "REMARK 350 BIOMOLECULE: 1\nREMARK 350 APPLY THE FOLLOWING TO CHAINS: X, Y\n";
    let row = |k: usize| {
        let m = [1, 2, 3].map(|j| if j == k { "1.000000" } else { "0.000000" }).join("  ");
        format!("REMARK 350   BIOMT{k}   1  {m}        0.00000\n")
    };
    format!("{head}{}{ATOM}", [1, 2, 3].map(row).concat())
}

/// Parameters with a valid file.
fn parameters() -> Vec<Row> {
    let mut far_too_fine = Row {
        query: "resolution=0.01".to_owned(),
        ..beyond("a grid that is far too fine", SAMPLE, 422, "too-many-candidates", 1 << 27)
    };
    far_too_fine.named.extend([
        ("actual", Is::Above(134_217_728.0)),
        ("resolution", Is::Equal(json!(0.01))),
        ("suggested_resolution", Is::Above(0.01)),
    ]);
    vec![
        far_too_fine,
        parameter("a resolution of zero", "resolution=0", "resolution", "0"),
        parameter("a resolution below zero", "resolution=-1", "resolution", "-1"),
        parameter("a resolution of minus zero", "resolution=-0.0", "resolution", "-0"),
        parameter("a resolution of 1e-6", "resolution=1e-6", "resolution", "0.000001"),
        parameter("a resolution of NaN", "resolution=NaN", "resolution", "NaN"),
        parameter("a resolution of inf", "resolution=inf", "resolution", "inf"),
        parameter("a resolution of 1e400", "resolution=1e400", "resolution", "1e400"),
        parameter("a resolution of 1e26", "resolution=1e26", "resolution", "100000000000000000000000000"),
        parameter("no resolution", "resolution=", "resolution", ""),
        parameter("a resolution that is not a number", "resolution=fine", "resolution", "fine"),
        parameter("a resolution with a comma", "resolution=0,5", "resolution", "0,5"),
        parameter("a resolution that is not UTF-8", "resolution=%ff", "resolution", "\u{fffd}").http_only(),
        parameter("a resolution of 8 KB", &format!("resolution={}", "9".repeat(8192)), "resolution", "9".repeat(64)),
        parameter("an isovalue of 1e300", "isovalue=1e300", "isovalue", format!("1{}", "0".repeat(300))),
        parameter("an isovalue of zero", "isovalue=0", "isovalue", "0"),
        parameter("a smoothness below zero", "smoothness=-2", "smoothness", "-2"),
        parameter("radii below zero", "radius_offset=-5", "radius_offset", "-5"),
        parameter("an unknown surface", "surface=sphere", "surface", "sphere"),
        parameter("an isovalue of a surface of spheres", "surface=ses&isovalue=2", "isovalue", "2"),
        parameter("a probe that is too large", "surface=ses&probe=11", "probe", "11"),
        parameter("half of the paper's parameters", "paper_a=1", "paper_a", "1"),
    ]
}

/// Selections and formats with a valid file.
fn selections() -> Vec<Row> {
    let misspelt = vec![("parameter", Is::Equal("resolutoin".into())), ("nearest", Is::Equal("resolution".into()))];
    let twice = vec![("parameter", Is::Equal("resolution".into()))];
    let no_water = vec![("found", Is::Contains("polymer"))];
    vec![
        parameter("a chain without a name", "chains=,", "chains", ","),
        Row {
            named: vec![
                ("parameter", Is::Equal("chains".into())),
                ("expected", Is::Equal("at most 4096 bytes".into())),
            ],
            ..parameter("chains of 4 KB", &format!("chains=A{}", ",A".repeat(2048)), "", "")
        },
        parameter(
            "chains of almost 4 KB",
            &format!("chains=A{},", ",A".repeat(2047)),
            "chains",
            format!("A{}", ",A".repeat(31)) + ",",
        ),
        parameter("a model beyond 32 bits", "model=99999999999", "model", "99999999999"),
        parameter("an altloc of two letters", "altloc=AB", "altloc", "AB"),
        parameter("an unknown kind of atoms", "select=everything", "select", "everything"),
        Row {
            named: vec![
                ("parameter", Is::Equal("select".into())),
                ("value", Is::Equal("chain A and (resi 1-x or water)".into())),
                ("column", Is::Equal(json!(19))),
                ("found", Is::Equal("1-x".into())),
                ("expected", Is::Contains("a range such as 10-20")),
            ],
            ..parameter("a range that is none", "select=chain%20A%20and%20(resi%201-x%20or%20water)", "", "")
        },
        parameter("an unknown format", "format=exe", "format", "exe"),
        Row { named: misspelt, ..parameter("a misspelt parameter", "resolutoin=1", "", "") },
        Row { named: twice, ..parameter("a repeated parameter", "resolution=1&resolution=2", "", "") },
        empty_selection("an unknown chain", "chains=Z", "chains", "Z", "A"),
        empty_selection("an unknown model", "model=7", "model", "7", "1"),
        empty_selection("an unknown alternative location", "altloc=Q", "altloc", "Q", "none"),
        empty_selection("no chain without a name", "chains=_", "chains", "_", "A"),
        Row {
            named: vec![("location", Is::Equal("assembly 1".into())), ("found", Is::Contains("without atoms: X, Y"))],
            query: "assembly=1".to_owned(),
            ..upload("an assembly of absent chains", absent_chains(), 422, "unreadable-structure", 4)
        },
        Row {
            named: vec![("found", Is::Contains("an atom of radius 0"))],
            ..upload("radii of zero", "ATOM 1 C GLY 1 0 0 0 0 0\n", 422, "empty-selection", 4)
        },
        Row {
            named: no_water,
            query: "select=water".to_owned(),
            ..upload("no water", ATOM, 422, "empty-selection", 4)
        },
        Row {
            named: vec![("parameter", Is::Equal("isovalue".into())), ("isovalue", Is::Equal(json!(1000.0)))],
            query: "isovalue=1000".to_owned(),
            ..upload("an isovalue above the maximum", ATOM, 422, "no-surface", 2)
        },
    ]
}

/// Media types of meshes and pictures.
const MEDIA_TYPES: [&str; 10] = [
    "model/gltf-binary",
    "model/gltf+json",
    "application/ply",
    "model/x-ply-text",
    "model/stl",
    "model/obj",
    "model/x-vtp",
    "model/x-msms-vert",
    "model/x-msms-face",
    "image/png",
];
const FILES: [&str; 11] = [
    "surface.glb",
    "surface.gltf",
    "surface.ply",
    "surface.ply-text",
    "surface.stl",
    "surface.obj",
    "surface.vtp",
    "surface.vert",
    "surface.face",
    "surface.png",
    "tileset.json",
];

fn http() -> Vec<Row> {
    let with = |row: Row, named: Vec<(&'static str, Is)>| Row { named, ..row };
    let bytes = |name, status, slug| upload(name, ATOM, status, slug, 0);
    let says = |member, words| vec![(member, Is::Contains(words))];
    let id = |value: &str| vec![("parameter", Is::Equal("id".into())), ("value", Is::Equal(value.into()))];
    let surface =
        |name, id: &str, status, slug| request(name, "GET", format!("/v1/pdb/{id}/surface.glb"), status, slug);
    let formed = |name, body: String| upload(name, body, 400, "bad-request", 0).header(FORM.0, FORM.1);
    vec![
        with(
            bytes("a wrong encoding", 415, "unsupported-encoding").header("content-encoding", "gzip"),
            says("detail", "gzip"),
        ),
        with(
            bytes("an unknown encoding", 415, "unsupported-encoding").header("content-encoding", "br"),
            says("detail", "`br`"),
        ),
        with(
            bytes("PDB declared as mmCIF", 415, "unsupported-media-type").header("content-type", "chemical/x-mmcif"),
            vec![("declared", Is::Equal("chemical/x-mmcif".into())), ("found", Is::Equal("pdb".into()))],
        ),
        with(
            upload("noise declared as PNG", "noise", 415, "unsupported-media-type", 0)
                .header("content-type", "image/png"),
            says("declared", "image/png"),
        ),
        with(
            bytes("an unsupported media type", 406, "not-acceptable").header("accept", "text/html"),
            vec![("available", Is::Equal(json!(MEDIA_TYPES)))],
        ),
        with(formed("a form without a file", form("resolution", "1")), says("expected", "file")),
        with(formed("a truncated form", form("file", ATOM).replace("--XX--", "")), says("detail", "form")),
        with(formed("a body that is not a form", ATOM.to_owned()), says("detail", "form")),
        with(
            upload("a form without a boundary", ATOM, 400, "bad-request", 0)
                .header("content-type", "multipart/form-data"),
            says("detail", "boundary"),
        ),
        with(
            upload("a form field of 5,000 bytes", form("resolution", &"1".repeat(5000)), 400, "bad-parameter", 0)
                .header(FORM.0, FORM.1),
            vec![("parameter", Is::Equal("resolution".into())), ("limit", Is::Equal(4096.into()))],
        ),
        with(
            request("an unsupported method", "DELETE", "/v1/meshes", 405, "method-not-allowed"),
            says("detail", "/v1/meshes"),
        ),
        with(request("an unknown path", "GET", "/v2/meshes", 404, "not-found"), says("detail", "/v2/meshes")),
        with(surface("an id that is a path", "..%2f..%2fetc%2fpasswd", 400, "bad-parameter"), id("../../etc/passwd")),
        with(surface("an id with a NUL", "4pt%00", 400, "bad-parameter"), id("4pt\0")),
        with(surface("an id of 10,000 letters", &"a".repeat(10_000), 400, "bad-parameter"), says("parameter", "id")),
        with(surface("an id that is not UTF-8", "%ff", 400, "bad-request"), says("detail", "UTF-8 in `id`")),
        with(
            request("a problem that is not UTF-8", "GET", "/problems/%ff", 400, "bad-request"),
            says("detail", "UTF-8"),
        ),
        with(
            upload("a JSON number as structure", "{\"structure\": 1}", 400, "bad-parameter", 0)
                .header("content-type", "application/json"),
            vec![
                ("parameter", Is::Equal("structure".into())),
                ("value", Is::Equal("1".into())),
                ("expected", Is::Contains("digest")),
            ],
        ),
        with(
            upload("a JSON document with a bad id", "{\"pdb_id\": \"../x\"}", 400, "bad-parameter", 0)
                .header("content-type", "application/json"),
            vec![("parameter", Is::Equal("pdb_id".into())), ("value", Is::Equal("../x".into()))],
        ),
        with(
            request("colours without a scheme", "GET", "/v1/pdb/4pti/colors", 400, "bad-parameter"),
            vec![("parameter", Is::Equal("scheme".into())), ("value", Is::Equal("no value".into()))],
        ),
        with(surface("a missing entry", "9zzz", 404, "not-in-archive"), says("detail", "9zzz")),
        with(surface("an entry that is noise", "1bad", 422, "unreadable-structure"), says("found", "`noise`")),
        with(
            request("an unknown extension", "GET", "/v1/pdb/1bad/surface.exe", 404, "not-found"),
            vec![("available", Is::Equal(json!(FILES)))],
        ),
    ]
}

/// Returns all rows.
pub(crate) fn rows() -> Vec<Row> {
    [not_structures(), compressed(), pdb(), mmcif(), binary(), parameters(), selections(), http()].concat()
}
