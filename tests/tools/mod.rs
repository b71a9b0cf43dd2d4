//! External checkers for integration tests: trimesh and the Khronos glTF validator, installed by `setup.sh`.
//!
//! Tests call [`trimesh`], [`gltf_validate`], or [`python`] with a script. Without the tools these print a line that
//! begins with `SKIPPED:` to standard error and return `None`. If `CI` or `MOLMESH_REQUIRE_TOOLS` is set, they panic.
#![allow(dead_code, unreachable_pub, reason = "each test binary uses a part")]
#![allow(clippy::unwrap_used, clippy::panic, reason = "tests fail by panicking")]

pub mod files;
pub mod meshopt;
pub mod readers;
pub mod shapes;

use std::collections::BTreeMap;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use serde::de::DeserializeOwned;
use serde::{Deserialize, Deserializer};

/// Report of trimesh on a file. Only `file` and `error` are set if the file could not be read.
#[derive(Debug, Clone, Default, Deserialize, PartialEq)]
#[serde(default)]
#[allow(clippy::struct_excessive_bools, reason = "independent results of the checker")]
pub struct TrimeshReport {
    pub file: String,
    /// Read error.
    pub error: Option<String>,
    pub vertices: u64,
    pub faces: u64,
    /// True if there are no faces. Nothing below is set then.
    pub empty: bool,
    /// STL only: vertices with equal coordinates were merged.
    pub welded: bool,
    /// True if every edge belongs to two faces.
    pub watertight: bool,
    pub winding_consistent: bool,
    /// Watertight, with consistent winding and outward normals.
    pub is_volume: bool,
    pub euler: i64,
    /// NaN if coordinates are not finite, as are volume and bounds.
    #[serde(deserialize_with = "nan_for_null")]
    pub area: f64,
    #[serde(deserialize_with = "nan_for_null")]
    pub volume: f64,
    pub bodies: u64,
    #[serde(deserialize_with = "nans_for_nulls")]
    pub bounds: [[f64; 3]; 2],
    /// Number of coordinates and normal components that are not finite.
    pub nan_count: u64,
    pub unused_vertices: u64,
    pub duplicate_faces: u64,
    pub degenerate_faces: u64,
    /// Edges with one face or more than two.
    pub bad_edges: u64,
    /// Largest difference of a normal's length from 1; `None` for files without vertex normals.
    pub max_normal_error: Option<f64>,
    /// Smallest cosine between a normal and the area-weighted mean normal of its faces.
    pub min_normal_dot: Option<f64>,
    /// STL only: smallest cosine between a written face normal and its face, without tiny faces.
    pub min_face_normal_dot: Option<f64>,
    /// Names of custom vertex attributes, such as `_ATOM`.
    pub attributes: Vec<String>,
}

fn nan_for_null<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    Ok(Option::deserialize(deserializer)?.unwrap_or(f64::NAN))
}

fn nans_for_nulls<'de, D: Deserializer<'de>>(deserializer: D) -> Result<[[f64; 3]; 2], D::Error> {
    let rows = <[[Option<f64>; 3]; 2]>::deserialize(deserializer)?;
    Ok(rows.map(|row| row.map(|v| v.unwrap_or(f64::NAN))))
}

/// Report of the glTF validator on a file. Only `file` and `error` are set if the file is not glTF.
#[derive(Debug, Clone, Default, Deserialize, PartialEq)]
#[serde(default)]
pub struct GltfReport {
    pub file: String,
    /// Read error.
    pub error: Option<String>,
    pub errors: u64,
    pub warnings: u64,
    pub infos: u64,
    pub hints: u64,
    /// Number of occurrences by issue code.
    pub codes: BTreeMap<String, u64>,
    /// Messages of the first few issues.
    pub messages: Vec<String>,
    pub vertices: u64,
    pub triangles: u64,
}

impl TrimeshReport {
    /// Panics unless the file holds a closed, oriented, manifold surface with unit normals that point outwards.
    #[track_caller]
    pub fn assert_proper(&self) {
        assert_eq!(self.error, None, "{self:#?}");
        assert!(!self.empty && self.watertight && self.winding_consistent && self.is_volume, "{self:#?}");
        let faults = [self.nan_count, self.duplicate_faces, self.degenerate_faces, self.bad_edges];
        assert_eq!(faults, [0; 4], "{self:#?}");
        assert!(self.max_normal_error.is_none_or(|e| e < 2e-4), "{self:#?}");
        assert!(self.min_normal_dot.is_none_or(|d| d > 0.0), "{self:#?}");
        assert!(self.min_face_normal_dot.is_none_or(|d| d > 0.0), "{self:#?}");
    }
}

impl GltfReport {
    /// Panics if the validator reports an error or a warning.
    #[track_caller]
    pub fn assert_clean(&self) {
        assert_eq!((&self.error, self.errors, self.warnings), (&None, 0, 0), "{self:#?}");
    }
}

/// Checks mesh files of any format with trimesh. Returns one report per path in their order.
pub fn trimesh(paths: &[impl AsRef<Path>]) -> Option<Vec<TrimeshReport>> {
    python("check_mesh.py", paths)
}

/// Checks `.glb` and `.gltf` files with the Khronos validator. Returns one report per path in their order.
pub fn gltf_validate(paths: &[impl AsRef<Path>]) -> Option<Vec<GltfReport>> {
    if !installed_here().join("node/.stamp").is_file() {
        return missing("gltf-validator");
    }
    Some(ask(Path::new("node"), "validate_gltf.mjs", paths))
}

/// Result of `walk_tileset.mjs` for a tileset.
#[derive(Debug, Clone, Deserialize)]
pub struct WalkedTileset {
    /// Error of the traversal.
    pub error: Option<String>,
    /// Tiles.
    pub tiles: Vec<WalkedTile>,
}

/// Tile of a tileset.
#[derive(Debug, Clone, Deserialize)]
pub struct WalkedTile {
    /// Level, 0 for the root.
    pub level: usize,
    /// Path of the mesh, if the tile has one.
    pub content: Option<String>,
    /// Centre and half axes, in the axes of the tileset.
    #[serde(rename = "box")]
    pub bounds: Vec<f64>,
}

/// Walks tilesets with 3d-tiles-tools. Returns one result per path of `tileset.json` in their order.
pub fn walk_tileset(paths: &[impl AsRef<Path>]) -> Option<Vec<WalkedTileset>> {
    if !installed_here().join("node/.stamp").is_file() {
        return missing("3d-tiles-tools");
    }
    Some(ask(Path::new("node"), "walk_tileset.mjs", paths))
}

/// Result of `decode_meshopt.mjs` for a file.
#[derive(Debug, Clone, Deserialize)]
pub struct Decoded {
    /// Error of a decoder.
    pub error: Option<String>,
}

/// Decodes compressed GLB files with the decoders of meshoptimizer and three.js, which write the decoded buffer beside
/// each file. Returns one result per path in their order.
pub fn decode_meshopt(paths: &[impl AsRef<Path>]) -> Option<Vec<Decoded>> {
    if !installed_here().join("node/.stamp").is_file() {
        return missing("meshoptimizer");
    }
    Some(ask(Path::new("node"), "decode_meshopt.mjs", paths))
}

/// Result of `promql.py` for an expression.
#[derive(Debug, Clone, Deserialize)]
pub struct Expression {
    /// Panel or rule of the expression.
    pub place: String,
    /// Syntax error.
    pub error: Option<String>,
    pub selectors: Vec<Selector>,
}

/// Selector of an expression.
#[derive(Debug, Clone, Deserialize)]
pub struct Selector {
    pub metric: Option<String>,
    /// Label, value, and true if the value is a regular expression.
    pub matchers: Vec<(String, String, bool)>,
    /// Labels named by enclosing aggregations, legends and annotations.
    pub around: Vec<String>,
}

/// Queries of a dashboard or a file of rules.
#[derive(Debug, Clone, Deserialize)]
pub struct Queries {
    /// Read error of the file.
    pub error: Option<String>,
    pub expressions: Vec<Expression>,
}

/// Reads the queries of dashboards (`.json`) and rules (`.yaml`).
pub fn queries(paths: &[impl AsRef<Path>]) -> Option<Vec<Queries>> {
    python("promql.py", paths)
}

/// VTP file as read by VTK.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(default)]
pub struct Vtp {
    /// True if VTK is not installed. Nothing else is set then.
    pub missing: bool,
    /// Read error.
    pub error: Option<String>,
    pub points: u64,
    pub triangles: u64,
    pub bounds: [[f64; 3]; 2],
    pub area: f64,
    pub volume: f64,
    /// Edges with one triangle or more than two.
    pub bad_edges: u64,
    /// Name of the active scalars.
    pub scalars: Option<String>,
    pub normals: bool,
    pub colors: Option<Vec<[u8; 4]>>,
    pub atoms: Option<Vec<u32>>,
}

/// Reads VTP files.
pub fn vtp(paths: &[impl AsRef<Path>]) -> Option<Vec<Vtp>> {
    let reports: Vec<Vtp> = python("read_vtp.py", paths)?;
    if reports.iter().any(|report| report.missing) { missing("VTK") } else { Some(reports) }
}

/// PNG file as read by Pillow.
#[derive(Debug, Clone, Deserialize)]
pub struct Png {
    pub width: u32,
    pub height: u32,
    /// `RGB` or `RGBA`, as in the file.
    pub mode: String,
    /// True if the file declares sRGB.
    pub srgb: bool,
    /// Red, green, blue, alpha, in rows from the top.
    pub pixels: Vec<[u8; 4]>,
}

/// Solvent-accessible area as `FreeSASA` computes it.
#[derive(Debug, Clone, Deserialize)]
pub struct Sasa {
    /// Area of all spheres, Å².
    pub area: f64,
    /// Area of each sphere, Å².
    pub of_spheres: Vec<f64>,
}

/// Computes solvent-accessible areas of files with a sphere per line.
pub fn sasa(paths: &[impl AsRef<Path>]) -> Option<Vec<Sasa>> {
    python("sasa.py", paths)
}

/// Reads PNG files.
pub fn png(paths: &[impl AsRef<Path>]) -> Option<Vec<Png>> {
    python("read_png.py", paths)
}

/// Returns `promtool` of Prometheus if `setup.sh` installed it.
pub fn promtool() -> Option<PathBuf> {
    let tool = installed_here().join("promtool");
    if tool.is_file() { Some(tool) } else { missing("promtool") }
}

/// Runs a script of `tests/tools` in the Python environment with one path per input line. Returns one JSON value per
/// path.
pub fn python<T: DeserializeOwned>(script: &str, paths: &[impl AsRef<Path>]) -> Option<Vec<T>> {
    match python_interpreter() {
        Some(python) => Some(ask(&python, script, paths)),
        None => missing(&format!("the Python for {script}")),
    }
}

/// Returns the interpreter of the Python environment if `setup.sh` has run.
pub fn python_interpreter() -> Option<PathBuf> {
    let venv = installed_here().join("venv");
    let python = ["bin/python", "Scripts/python.exe"].map(|p| venv.join(p)).into_iter().find(|p| p.is_file());
    // The stamp is written after all packages are installed.
    python.filter(|_| venv.join(".stamp").is_file())
}

/// Reports a missing tool, as [`skip`] does.
pub fn missing<T>(tool: &str) -> Option<T> {
    skip(&format!("{tool} is not installed; run tests/tools/setup.sh"))
}

/// Reports why a test cannot run: panics if `CI` or `MOLMESH_REQUIRE_TOOLS` is set, otherwise prints a skip message.
pub fn skip<T>(why: &str) -> Option<T> {
    let required = ["CI", "MOLMESH_REQUIRE_TOOLS"].into_iter().find(|variable| is_set(variable));
    if let Some(variable) = required {
        panic!("{why} ({variable} is set, so no test may be skipped)");
    }
    print_skipped(why);
    None
}

/// Returns the folder of real structures beside the repository, with a list of its files in `SOURCES.tsv`. If it does
/// not exist, tests that need it are skipped. If `CI` is set, they fail, unless `MOLMESH_NO_STRUCTURES` is set too.
pub fn structures() -> Option<PathBuf> {
    let folder = root().join("../shared/data/structures");
    if folder.is_dir() {
        return Some(folder);
    }
    let why = "no folder ../shared/data/structures; only those of tests/structures are used";
    if is_set("MOLMESH_NO_STRUCTURES") {
        print_skipped(why);
        return None;
    }
    skip(why)
}

/// Returns the folder of [`structures`], or the folder of the committed ones, which are entries of the PDB.
pub fn some_structures() -> PathBuf {
    structures().unwrap_or_else(|| root().join("tests/structures"))
}

/// Returns a file of [`some_structures`]; `None` if it is not among the committed ones.
pub fn some_structure(name: &str) -> Option<PathBuf> {
    match structures() {
        Some(folder) => Some(folder.join(name)),
        None => Some(some_structures().join(name)).filter(|path| path.is_file()),
    }
}

fn is_set(variable: &str) -> bool {
    std::env::var_os(variable).is_some_and(|value| !value.is_empty())
}

/// Prints that a test is skipped, also where tools are required: the cause is the machine.
pub fn print_skipped(why: &str) {
    let test = std::thread::current().name().unwrap_or("a test").to_owned();
    // The harness hides the output of `eprintln!` if the test passes.
    std::io::stderr().write_all(format!("SKIPPED: {test}: {why}\n").as_bytes()).unwrap();
}

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn installed_here() -> PathBuf {
    root().join("target/test-tools")
}

/// Runs a script of this folder on paths and parses one line of output per path.
fn ask<T: DeserializeOwned>(interpreter: &Path, script: &str, paths: &[impl AsRef<Path>]) -> Vec<T> {
    let mut child = Command::new(interpreter)
        .arg(root().join("tests/tools").join(script))
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap_or_else(|e| panic!("cannot start {}: {e}", interpreter.display()));
    let list: String = paths.iter().flat_map(|p| [p.as_ref().display().to_string(), "\n".to_owned()]).collect();
    let mut stdin = child.stdin.take().unwrap();
    // In a separate thread: with long lists both pipes could be full.
    let feeder = std::thread::spawn(move || stdin.write_all(list.as_bytes()));
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success(), "{script} failed with {}", output.status);
    feeder.join().unwrap().unwrap();
    let lines = String::from_utf8(output.stdout).unwrap();
    let answers: Vec<T> = lines
        .lines()
        .map(|line| serde_json::from_str(line).unwrap_or_else(|e| panic!("{script} answered {line}: {e}")))
        .collect();
    assert_eq!(answers.len(), paths.len(), "{script} answered {lines}");
    answers
}
