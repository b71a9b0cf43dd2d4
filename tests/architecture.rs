//! The map of `ARCHITECTURE.md`, checked: which room may name which, how long a file may be, that a stage's parts
//! exist, and that nothing unfinished is left lying about. Every checker has a negative control: a made-up bad
//! source that it must find fault with.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::iter::Peekable;
use std::path::{Path, PathBuf};
use std::str::Chars;

/// A source file: its path from the repository's root, with `/`, and its text.
struct Source {
    path: String,
    text: String,
}

/// What a room may name of the crate: rooms, and for some of them only certain items.
struct Room {
    name: &'static str,
    rooms: &'static [(&'static str, Items)],
    /// External crates that it must not name.
    crates: &'static [&'static str],
}

enum Items {
    Any,
    Only(&'static [&'static str]),
}
use Items::{Any, Only};

/// What no room below the service may name.
const SERVICE: &[&str] =
    &["tokio", "axum", "tower", "tower_http", "hyper", "hyper_util", "tracing", "metrics", "toml", "clap", "indicatif"];
/// What the core may not name: that, files, and other people's molecules.
const NOT_CORE: &[&str] = &[
    "tokio",
    "axum",
    "tower",
    "tower_http",
    "hyper",
    "hyper_util",
    "tracing",
    "metrics",
    "toml",
    "clap",
    "indicatif",
    "serde",
    "serde_json",
    "pdbtbx",
    "gltf_json",
    "wgpu",
    "flate2",
    "ruzstd",
];

/// `surface ← picture ← gpu; surface ← structure, formats, picture ← pipeline ← jobs ← http`; the binary may name everything.
const ROOMS: &[Room] = &[
    Room { name: "surface", rooms: &[], crates: NOT_CORE },
    Room { name: "picture", rooms: &[("surface", Any)], crates: NOT_CORE },
    Room { name: "gpu", rooms: &[("surface", Any), ("picture", Any)], crates: SERVICE },
    Room {
        name: "structure",
        rooms: &[("surface", Only(&["Spheres", "SurfaceError", "spheres"]))],
        crates: &["tokio", "axum", "tower", "hyper", "tracing", "wgpu", "gltf_json", "clap"],
    },
    Room {
        name: "formats",
        rooms: &[("surface", Only(&["Mesh", "MeshPart", "MeshSink", "SinkFailed", "Vertices", "quantize"]))],
        crates: &["tokio", "axum", "tower", "hyper", "tracing", "wgpu", "pdbtbx", "clap"],
    },
    Room {
        name: "pipeline",
        rooms: &[("surface", Any), ("structure", Any), ("formats", Any), ("picture", Any)],
        crates: SERVICE,
    },
    Room {
        name: "config",
        rooms: &[("surface", Any), ("structure", Any), ("formats", Any), ("picture", Any), ("pipeline", Any)],
        crates: &["axum", "tower", "tower_http", "hyper", "wgpu", "clap"],
    },
    Room { name: "telemetry", rooms: &[("config", Any)], crates: &["axum", "tower", "hyper", "wgpu", "clap"] },
    Room {
        name: "access",
        rooms: &[("pipeline", Only(&["nearest"])), ("config", Any)],
        crates: &[
            "tokio",
            "axum",
            "tower",
            "tower_http",
            "hyper",
            "hyper_util",
            "tracing",
            "metrics",
            "wgpu",
            "clap",
            "reqwest",
        ],
    },
    Room {
        name: "store",
        rooms: &[("config", Any), ("telemetry", Any)],
        crates: &["axum", "tower", "tower_http", "hyper", "hyper_util", "wgpu", "clap", "reqwest"],
    },
    Room {
        name: "archive",
        rooms: &[("structure", Any), ("config", Any), ("telemetry", Any), ("store", Any)],
        crates: &["axum", "tower", "tower_http", "wgpu", "clap"],
    },
    Room {
        name: "jobs",
        rooms: &[
            ("surface", Any),
            ("structure", Any),
            ("formats", Any),
            ("picture", Any),
            ("pipeline", Any),
            ("config", Any),
            ("telemetry", Any),
            ("store", Any),
        ],
        crates: &["axum", "tower", "tower_http", "hyper", "hyper_util", "wgpu", "clap"],
    },
    Room {
        name: "http",
        rooms: &[
            ("surface", Any),
            ("structure", Any),
            ("formats", Any),
            ("picture", Any),
            ("pipeline", Any),
            ("config", Any),
            ("telemetry", Any),
            ("store", Any),
            ("archive", Any),
            ("jobs", Any),
            ("access", Any),
        ],
        crates: &["wgpu", "clap", "rayon"],
    },
];

/// The crate's root and the binary, which stand above the map.
const ABOVE: &[&str] = &["lib", "main", "cli"];

const STAGES: &[&str] = &["bin", "field", "classify", "scan", "interpolate", "emit"];
const MAX_LINES: usize = 400;
/// Tables may be longer.
const TABLES: &[&str] = &["src/surface/cases.rs", "src/structure/radii.rs", "src/structure/residues.rs"];

// ---------------------------------------------------------------------------------------------- reading sources

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

fn walk(folder: &Path, found: &mut Vec<PathBuf>) {
    let Ok(entries) = fs::read_dir(folder) else { return };
    for entry in entries.map(|e| e.expect("a folder can be listed")) {
        let path = entry.path();
        if path.is_dir() {
            walk(&path, found);
        } else if path.extension().is_some_and(|e| e == "rs") {
            found.push(path);
        }
    }
}

fn sources_under(folder: &str) -> Vec<Source> {
    let mut found = Vec::new();
    walk(&root().join(folder), &mut found);
    found.sort();
    let relative = |p: &Path| p.strip_prefix(root()).expect("below the root").to_string_lossy().replace('\\', "/");
    found
        .iter()
        .map(|p| Source { path: relative(p), text: fs::read_to_string(p).expect("a source is UTF-8") })
        .collect()
}

/// The code without comments and without what stands in strings and character literals; lines keep their numbers.
fn code(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    let mut chars = text.chars().peekable();
    while let Some(c) = chars.next() {
        match c {
            '/' if chars.peek() == Some(&'/') => while chars.next_if(|&c| c != '\n').is_some() {},
            '/' if chars.peek() == Some(&'*') => {
                let mut last = ' ';
                for c in chars.by_ref() {
                    out.extend((c == '\n').then_some('\n'));
                    if last == '*' && c == '/' {
                        break;
                    }
                    last = c;
                }
            }
            '"' => {
                // A raw string ends at its own number of hashes, a plain one at the first bare quote.
                let hashes = out.chars().rev().take_while(|&c| c == '#').count();
                let raw = out.trim_end_matches('#').ends_with('r');
                out.push('"');
                skip_string(&mut chars, &mut out, raw.then_some(hashes));
                out.push('"');
            }
            '\'' => skip_character(&mut chars),
            c => out.push(c),
        }
    }
    out
}

fn skip_string(chars: &mut Peekable<Chars<'_>>, out: &mut String, raw: Option<usize>) {
    while let Some(c) = chars.next() {
        match (c, raw) {
            ('\n', _) => out.push('\n'),
            ('\\', None) => out.extend(chars.next().filter(|&c| c == '\n')),
            ('"', None) => return,
            ('"', Some(hashes)) => {
                let mut ahead = chars.clone();
                if (0..hashes).all(|_| ahead.next() == Some('#')) {
                    return;
                }
            }
            _ => {}
        }
    }
}

/// Behind a single quote: skips a character literal, leaves a lifetime alone.
fn skip_character(chars: &mut Peekable<Chars<'_>>) {
    let mut ahead = chars.clone();
    let (first, second) = (ahead.next(), ahead.next());
    if first == Some('\\') {
        chars.nth(1);
        chars.by_ref().find(|&c| c == '\'');
    } else if second == Some('\'') {
        chars.nth(1);
    }
}

/// The room that a source belongs to: `src/http/x.rs` and `src/http.rs` are `http`.
fn room_of(path: &str) -> &str {
    let rest = path.strip_prefix("src/").unwrap_or(path);
    rest.split('/').next().unwrap_or(rest).trim_end_matches(".rs")
}

/// How deep the file's module lies: `src/http.rs` and `src/http/mod.rs` 1, `src/http/x.rs` 2.
fn depth_of(path: &str) -> usize {
    let rest = path.trim_start_matches("src/").trim_end_matches(".rs").trim_end_matches("/mod");
    rest.split('/').count()
}

fn is_ident(c: char) -> bool {
    c.is_alphanumeric() || c == '_'
}

/// What of the crate's root the code names: `(room, item)` for `crate::room::item`, also in braces, also by way of
/// `super`. The item is empty where the room itself is named.
fn named(source: &Source) -> BTreeSet<(String, String)> {
    const SUPER: &str = "super::";
    let code = code(&source.text);
    let starts_a_path = |at: usize| !code[..at].chars().next_back().is_some_and(|c| is_ident(c) || c == ':');
    let mut found = BTreeSet::new();
    for (at, start) in code.match_indices("crate::").filter(|(at, _)| starts_a_path(*at)) {
        found.extend(paths(&code[at + start.len()..]));
    }
    let tests_from = tests_start(&source.text);
    for (at, _) in code.match_indices(SUPER).filter(|(at, _)| starts_a_path(*at)) {
        let rest = code[at..].trim_start_matches(SUPER);
        let n_supers = (code.len() - at - rest.len()) / SUPER.len();
        // Inside the module of tests every path is one level deeper.
        let in_tests = tests_from.is_some_and(|from| code[..at].matches('\n').count() >= from);
        if n_supers >= depth_of(&source.path) + usize::from(in_tests) {
            found.extend(paths(rest));
        }
    }
    found
}

fn segment(text: &str) -> String {
    text.chars().take_while(|&c| is_ident(c)).collect()
}

/// The first two segments of every path in a use tree, or of a plain path.
fn paths(text: &str) -> Vec<(String, String)> {
    match text.strip_prefix('{') {
        Some(tree) => top_level(tree).iter().flat_map(|part| room_and_items(part)).collect(),
        None => room_and_items(text),
    }
}

fn room_and_items(text: &str) -> Vec<(String, String)> {
    let room = segment(text);
    let items = match text[room.len()..].strip_prefix("::") {
        None => vec![String::new()],
        Some(rest) => match rest.strip_prefix('{') {
            Some(tree) => top_level(tree).iter().map(|part| segment(part)).collect(),
            None => vec![segment(rest)],
        },
    };
    items.into_iter().map(|item| (room.clone(), item)).collect()
}

/// The comma-separated parts of a brace group whose opening brace is already gone.
fn top_level(tree: &str) -> Vec<String> {
    let (mut depth, mut parts) = (0_u32, vec![String::new()]);
    for c in tree.chars() {
        match c {
            '{' => depth += 1,
            '}' if depth == 0 => break,
            '}' => depth -= 1,
            ',' if depth == 0 => {
                parts.push(String::new());
                continue;
            }
            _ => {}
        }
        parts.last_mut().expect("there is one").push(c);
    }
    parts.into_iter().map(|p| p.trim().to_owned()).filter(|p| !p.is_empty()).collect()
}

/// The line (from 0) at which the module of tests begins, which by house style ends the file.
fn tests_start(text: &str) -> Option<usize> {
    let lines: Vec<&str> = text.lines().collect();
    (0..lines.len()).find(|&i| {
        lines[i].trim() == "#[cfg(test)]"
            && lines[i + 1..].iter().find(|l| !l.trim_start().starts_with("#[")).is_some_and(|l| l.starts_with("mod "))
    })
}

// --------------------------------------------------------------------------------------------------- the checkers

/// Rooms and crates named that may not be named, and rooms that the map does not know.
fn wrong_edges(sources: &[Source]) -> Vec<String> {
    let mut wrong = Vec::new();
    for source in sources.iter().filter(|s| !ABOVE.contains(&room_of(&s.path))) {
        let (path, room) = (&source.path, room_of(&source.path));
        let Some(rules) = ROOMS.iter().find(|r| r.name == room) else {
            wrong.push(format!("{path}: the map has no room `{room}`"));
            continue;
        };
        for (other, item) in named(source) {
            let allowed = |(name, items): &(&str, Items)| {
                *name == other
                    && match items {
                        Any => true,
                        Only(items) => items.contains(&item.as_str()),
                    }
            };
            if other != room && !rules.rooms.iter().any(allowed) {
                wrong.push(format!("{path}: `{room}` must not name crate::{other}::{item}"));
            }
        }
        let code = code(&source.text);
        for krate in rules.crates {
            let start = format!("{krate}::");
            let begins = |at: usize| !code[..at].chars().next_back().is_some_and(|c| is_ident(c) || c == ':');
            if code.match_indices(&start).any(|(at, _)| begins(at)) {
                wrong.push(format!("{path}: `{room}` must not name the crate {krate}"));
            }
        }
    }
    wrong
}

type Edges = BTreeMap<String, BTreeSet<String>>;

/// A cycle between rooms, if there is one.
fn cycle(sources: &[Source]) -> Option<Vec<String>> {
    fn visit(at: &str, edges: &Edges, trail: &mut Vec<String>) -> bool {
        let seen = trail.iter().any(|t| t == at);
        trail.push(at.to_owned());
        if seen || edges.get(at).is_some_and(|next| next.iter().any(|n| visit(n, edges, trail))) {
            return true;
        }
        trail.pop();
        false
    }
    let mut edges = Edges::new();
    for source in sources {
        let room = room_of(&source.path);
        if !ABOVE.contains(&room) {
            let others = named(source).into_iter().map(|(other, _)| other).filter(|other| other != room);
            edges.entry(room.to_owned()).or_default().extend(others);
        }
    }
    edges.keys().find_map(|room| {
        let mut trail = Vec::new();
        visit(room, &edges, &mut trail).then_some(trail)
    })
}

/// Modules of `room` without their tests, as if `room` were the root of the crate: [`cycle`] then finds cycles between them.
fn modules_of(sources: &[Source], room: &str) -> Vec<Source> {
    let (folder, path) = (format!("src/{room}/"), format!("crate::{room}::"));
    let modules = sources.iter().filter(|s| s.path.starts_with(&folder) && s.path != format!("{folder}mod.rs"));
    modules
        .map(|s| {
            let lines = s.text.lines().take(tests_start(&s.text).unwrap_or(usize::MAX));
            // References to other rooms must not count as references to modules of the same name.
            let text = lines.collect::<Vec<_>>().join("\n").replace(&path, "super::super::super::");
            let text = text.replace("crate::", "outside::").replace("super::super::super::", "crate::");
            Source { path: s.path.replacen(&folder, "src/", 1), text }
        })
        .collect()
}

fn too_long(sources: &[Source]) -> Vec<String> {
    let length = |s: &Source| tests_start(&s.text).unwrap_or_else(|| s.text.lines().count());
    sources
        .iter()
        .filter(|s| !TABLES.contains(&s.path.as_str()) && length(s) > MAX_LINES)
        .map(|s| format!("{}: {} lines without its tests, {MAX_LINES} are allowed", s.path, length(s)))
        .collect()
}

fn without_doc(sources: &[Source]) -> Vec<String> {
    let bare = |s: &&Source| !s.text.starts_with("//!") && !s.text.starts_with("#!");
    sources.iter().filter(bare).map(|s| format!("{}: begins without a module doc", s.path)).collect()
}

/// Parts of stages that are missing. A part is asked for as soon as its folder or file exists.
fn missing_parts(files: &[String], stage_tests: Option<&str>) -> Vec<String> {
    let has = |path: &str| files.iter().any(|f| f == path);
    let any = |prefix: &str, suffix: &str| files.iter().any(|f| f.starts_with(prefix) && f.ends_with(suffix));
    let mut missing = Vec::new();
    for stage in STAGES {
        if any("src/surface/cpu/", ".rs") && !has(&format!("src/surface/cpu/{stage}.rs")) {
            missing.push(format!("src/surface/cpu/{stage}.rs"));
        }
        if any("shaders/", ".wgsl") && !has(&format!("shaders/{stage}.wgsl")) {
            missing.push(format!("shaders/{stage}.wgsl"));
        }
        if stage_tests.is_some_and(|text| !text.contains(&format!("fn {stage}_"))) {
            missing.push(format!("tests/stages.rs::{stage}_*"));
        }
    }
    missing
}

/// Marks of unfinished work and bare lint switches.
fn unfinished(sources: &[Source]) -> Vec<String> {
    const MARKS: [&str; 6] = ["todo!", "unimplemented!", "dbg!", "#[ignore", "#[allow(", "#![allow("];
    let mut found = Vec::new();
    for source in sources {
        let code = code(&source.text);
        for mark in MARKS {
            for (at, _) in code.match_indices(mark) {
                // A switch with a reason is let through: the lints ask for the reason.
                let attribute = code[at..].split(']').next().unwrap_or_default();
                if !(mark.contains("allow") && attribute.contains("reason =")) {
                    found.push(format!("{}:{}: {mark}", source.path, code[..at].matches('\n').count() + 1));
                }
            }
        }
    }
    found
}

// ------------------------------------------------------------------------------------------------------ the tests

fn nothing(found: &[String]) {
    assert!(found.is_empty(), "{} found:\n{}", found.len(), found.join("\n"));
}

#[test]
fn arrows_point_one_way() {
    let sources = sources_under("src");
    assert!(sources.len() > 20, "only {} sources found: the check looks in the wrong place", sources.len());
    nothing(&wrong_edges(&sources));
}

#[test]
fn rooms_have_no_cycle() {
    assert_eq!(cycle(&sources_under("src")), None);
}

#[test]
fn modules_of_gpu_have_no_cycle() {
    assert_eq!(cycle(&modules_of(&sources_under("src"), "gpu")), None);
}

#[test]
fn the_map_itself_has_no_cycle() {
    for (i, room) in ROOMS.iter().enumerate() {
        for (other, _) in room.rooms {
            let at = ROOMS.iter().position(|r| r.name == *other).expect("a room of the map");
            assert!(at < i, "{} stands before {other}, which it names", room.name);
        }
    }
}

#[test]
fn files_are_short() {
    nothing(&too_long(&sources_under("src")));
}

#[test]
fn files_say_what_they_are_for() {
    nothing(&without_doc(&sources_under("src")));
    nothing(&without_doc(&sources_under("tests")));
}

#[test]
fn stages_have_all_their_parts() {
    let mut files: Vec<String> = sources_under("src").into_iter().map(|s| s.path).collect();
    if let Ok(entries) = fs::read_dir(root().join("shaders")) {
        files.extend(entries.flatten().map(|e| format!("shaders/{}", e.file_name().to_string_lossy())));
    }
    let stage_tests = fs::read_to_string(root().join("tests/stages.rs")).ok();
    nothing(&missing_parts(&files, stage_tests.as_deref()));
}

#[test]
fn nothing_unfinished_is_left() {
    for folder in ["src", "tests", "benches", "examples"] {
        nothing(&unfinished(&sources_under(folder)));
    }
}

// -------------------------------------------------------------------------------------------- negative controls

fn made_up(path: &str, text: &str) -> Vec<Source> {
    vec![Source { path: path.to_owned(), text: text.to_owned() }]
}

#[test]
fn control_wrong_edges_are_seen() {
    let bad = [
        ("src/surface/grid.rs", "use crate::structure::Structure;"),
        ("src/surface/grid.rs", "fn f() { crate::pipeline::run() }"),
        ("src/surface/grid.rs", "use super::super::formats::Format;"),
        ("src/surface/mod.rs", "use super::formats;"),
        ("src/surface/grid.rs", "use serde::Serialize;"),
        ("src/surface/grid.rs", "use std::fmt;\nuse crate::{surface::Mesh, http};"),
        ("src/surface/grid.rs", "fn f() {}\n\n#[cfg(test)]\nmod tests {\n    use super::super::super::http;\n}"),
        ("src/structure/read.rs", "use crate::surface::{Spheres, Mesh};"),
        ("src/formats/glb.rs", "use crate::surface::Backend;"),
        ("src/formats/glb.rs", "use crate::surface::{\n    Mesh,\n    Measures,\n};"),
        ("src/jobs/pool.rs", "use crate::gpu::Device;"),
        ("src/picture/cpu.rs", "use crate::formats::Format;"),
        ("src/picture/cpu.rs", "fn f(_: wgpu::Device) {}"),
        ("src/jobs/pool.rs", "use crate::http::problem;"),
        ("src/jobs/pool.rs", "fn f() -> axum::Router { loop {} }"),
        ("src/http/router.rs", "let x = r#\"a \"quoted\" b\"#; let x = crate::gpu::unavailable();"),
        ("src/attic/old.rs", "fn f() {}"),
    ];
    for (path, text) in bad {
        assert_eq!(wrong_edges(&made_up(path, text)).len(), 1, "{path}: {text}");
    }
}

#[test]
fn control_good_edges_are_let_through() {
    let good = [
        ("src/surface/grid.rs", "use super::mesh::Mesh; // crate::http\nlet s = \"crate::http::x\";"),
        ("src/surface/cpu/bin.rs", "use super::super::mesh::Mesh; use crate::surface::Spheres;"),
        (
            "src/surface/grid.rs",
            "/// [`crate::http::Server`] and 'a'\nfn f<'a>(c: char) -> bool { c == '\"' || c == '\\'' }",
        ),
        ("src/surface/grid.rs", "/* crate::http */ fn f() { r#\"crate::http\"#; \"a \\\" crate::http\" }"),
        ("src/surface/grid.rs", "fn f() {}\n\n#[cfg(test)]\nmod tests {\n    use super::super::mesh::Mesh;\n}"),
        ("src/structure/select.rs", "use crate::surface::{Spheres, SurfaceError};"),
        ("src/http/router.rs", "use crate::{jobs::Pool, surface::Kernel}; use axum::Router;"),
    ];
    for (path, text) in good {
        assert_eq!(wrong_edges(&made_up(path, text)), Vec::<String>::new(), "{path}: {text}");
    }
}

#[test]
fn control_a_cycle_is_seen() {
    let source = |path: &str, text: &str| Source { path: path.to_owned(), text: text.to_owned() };
    let mut sources = vec![source("src/a/mod.rs", "use crate::b::X;"), source("src/b.rs", "use crate::c::Y;")];
    assert_eq!(cycle(&sources), None);
    sources.push(source("src/c/deep/er.rs", "fn f() { crate::a::f() }"));
    assert_eq!(cycle(&sources), Some(["a", "b", "c", "a"].map(String::from).to_vec()));
}

#[test]
fn control_a_cycle_of_modules_is_seen() {
    let source = |path: &str, text: &str| Source { path: path.to_owned(), text: text.to_owned() };
    let mut sources = vec![
        source("src/gpu/mod.rs", "mod a; use a::X;"),
        source("src/gpu/a.rs", "use super::b::X;\n#[cfg(test)]\nmod tests {\n    use crate::gpu::c::Y;\n}"),
        source("src/gpu/b/deep.rs", "use super::super::c::Y;"),
        source("src/gpu/c.rs", "use crate::a::Mesh;"),
    ];
    assert_eq!(cycle(&modules_of(&sources, "gpu")), None);
    sources.push(source("src/gpu/c/other.rs", "use crate::gpu::a::Z;"));
    assert_eq!(cycle(&modules_of(&sources, "gpu")), Some(["a", "b", "c", "a"].map(String::from).to_vec()));
}

#[test]
fn control_a_long_file_is_seen_and_its_tests_do_not_count() {
    let long = "//! Doc.\n".to_owned() + &"fn f() {}\n".repeat(MAX_LINES);
    assert_eq!(too_long(&made_up("src/http/long.rs", &long)).len(), 1);
    assert_eq!(too_long(&made_up(TABLES[0], &long)).len(), 0);
    let tested = "//! Doc.\n#[cfg(test)]\n#[expect(clippy::panic)]\nmod tests {\n".to_owned() + &long;
    assert_eq!(too_long(&made_up("src/http/tested.rs", &tested)).len(), 0);
}

#[test]
fn control_a_file_without_a_doc_is_seen() {
    assert_eq!(without_doc(&made_up("src/http/x.rs", "use std::fmt;\n//! late")).len(), 1);
}

#[test]
fn control_missing_parts_are_seen() {
    let whole = |folder: &str, suffix: &str| -> Vec<String> {
        STAGES.iter().map(|s| format!("{folder}/{s}.{suffix}")).collect()
    };
    let mut files = whole("src/surface/cpu", "rs");
    assert_eq!(missing_parts(&files, None).len(), 0);
    files.push("shaders/field.wgsl".to_owned());
    assert_eq!(missing_parts(&files, None).len(), STAGES.len() - 1);
    files.extend(whole("shaders", "wgsl"));
    files.retain(|f| f != "src/surface/cpu/scan.rs");
    assert_eq!(missing_parts(&files, None), ["src/surface/cpu/scan.rs"]);
    let tests = "fn bin_x() {} fn field_x() {} fn classify_x() {} fn scan_x() {} fn emit_x() {}";
    assert_eq!(missing_parts(&[], Some(tests)), ["tests/stages.rs::interpolate_*"]);
}

#[test]
fn control_unfinished_work_is_seen() {
    let bad = ["fn f() { todo!() }", "#[ignore = \"slow\"]\nfn f() {}", "#[allow(dead_code)]\nfn f() {}", "dbg!(1);"];
    for text in bad {
        assert_eq!(unfinished(&made_up("src/x.rs", text)).len(), 1, "{text}");
        let reasoned = "#![allow(\n    dead_code,\n    reason = \"a (good) one\"\n)]\nfn f() {}";
        assert_eq!(unfinished(&made_up("tests/x.rs", reasoned)).len(), 0);
        let comment = format!("// {}", text.replace('\n', "\n// "));
        assert_eq!(unfinished(&made_up("src/x.rs", &comment)).len(), 0, "{text}");
    }
}
