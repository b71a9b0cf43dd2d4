//! Checks of the repository's structure that the compiler does not make: references between the modules of `src` and
//! inside `gpu` and `http`, the map in `ARCHITECTURE.md`, the index of decision records, file lengths, type names, the
//! parts of each stage, unfinished work and the length of the glossary. Every checker has a negative control with bad
//! input that it must report.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::iter::Peekable;
use std::path::{Path, PathBuf};
use std::str::Chars;

/// A text file: its path relative to the repository root, separated by `/`, and its text.
pub(crate) struct Source {
    pub(crate) path: String,
    pub(crate) text: String,
}

/// The modules of `src` in order: each may reference only modules that precede it, and the [`CRATES`].
const MODULES: &[&str] = &[
    "tls",
    "config",
    "telemetry",
    "access",
    "client_shares",
    "readers",
    "single_flight",
    "memory_budget",
    "store",
    "archive",
    "jobs",
    "fuzzing",
    "http",
    "lib",
    "cli",
    "main",
];

/// Crates of the workspace by their names in `src/lib.rs`. The crate `gpu` is absent, because only `cli` may reference
/// it, as `molmesh::gpu`.
const CRATES: &[&str] = &["formats", "picture", "pipeline", "structure", "surface", "sync"];

/// Limit for the lines of `ARCHITECTURE.md`.
const MAX_MAP_LINES: usize = 150;

/// Folders and files with code.
pub(crate) const CODE: &[&str] =
    &["build.rs", "src", "crates", "shaders", "tests", "bench", "benches", "fuzz", "python", "examples"];

const STAGES: &[&str] = &["bin", "field", "classify", "scan", "refine", "interpolate", "emit", "measure"];
/// Maximum number of types with the same name.
const MAX_TYPES_PER_NAME: usize = 2;
/// Maximum number of terms in the glossary.
const MAX_TERMS: usize = 50;
/// Limit for the lines of a source file, without its tests.
const MAX_LINES: usize = 400;

// ---------------------------------------------------------------------------------------------- reading sources

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

/// Collects the files below `path` (or `path` itself) with one of the `extensions`. Skips build output and packages.
fn walk(path: &Path, extensions: &[&str], found: &mut Vec<PathBuf>) {
    const SKIPPED: [&str; 3] = ["target", "node_modules", "dist"];
    let Ok(entries) = fs::read_dir(path) else {
        let matches = path.extension().is_some_and(|e| extensions.iter().any(|wanted| e == *wanted));
        found.extend((matches && path.is_file()).then(|| path.to_owned()));
        return;
    };
    for entry in entries.map(|e| e.expect("a folder can be listed")) {
        let name = entry.file_name().to_string_lossy().into_owned();
        if !name.starts_with('.') && !SKIPPED.contains(&name.as_str()) {
            walk(&entry.path(), extensions, found);
        }
    }
}

/// Reads the files below `places` (folders or files below the root) with one of the `extensions`, sorted by path.
pub(crate) fn files(places: &[&str], extensions: &[&str]) -> Vec<Source> {
    let mut found = Vec::new();
    for place in places {
        walk(&root().join(place), extensions, &mut found);
    }
    found.sort();
    let relative = |p: &Path| p.strip_prefix(root()).expect("below the root").to_string_lossy().replace('\\', "/");
    found
        .iter()
        .map(|p| Source { path: relative(p), text: fs::read_to_string(p).expect("a source is UTF-8") })
        .collect()
}

/// Reads the sources of the package and of its crates.
fn library() -> Vec<Source> {
    files(&["src", "crates"], &["rs"])
}

/// Returns the code without comments and without the content of literals. Line numbers stay the same.
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
                // A raw string ends at a quote with as many hashes, a plain one at the first unescaped quote.
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

/// Called after a single quote: skips a character literal, keeps a lifetime.
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

/// Returns the module of a source: `src/http/x.rs` and `src/http.rs` belong to `http`.
fn module_of(path: &str) -> &str {
    let rest = path.strip_prefix("src/").unwrap_or(path);
    rest.split('/').next().unwrap_or(rest).trim_end_matches(".rs")
}

/// Returns the depth of the file's module: 1 for `src/http.rs` and `src/http/mod.rs`, 2 for `src/http/x.rs`.
fn depth_of(path: &str) -> usize {
    let rest = path.trim_start_matches("src/").trim_end_matches(".rs").trim_end_matches("/mod");
    rest.split('/').count()
}

fn is_ident(c: char) -> bool {
    c.is_alphanumeric() || c == '_'
}

/// Returns the name after `crate::` of each reference, including use trees and paths through `super`.
fn references(source: &Source) -> BTreeSet<String> {
    const SUPER: &str = "super::";
    let code = code(&source.text);
    let starts_a_path = |at: usize| !code[..at].chars().next_back().is_some_and(|c| is_ident(c) || c == ':');
    let mut found = BTreeSet::new();
    for (at, start) in code.match_indices("crate::").filter(|(at, _)| starts_a_path(*at)) {
        found.extend(first_segments(&code[at + start.len()..]));
    }
    let tests_from = tests_start(&source.text);
    for (at, _) in code.match_indices(SUPER).filter(|(at, _)| starts_a_path(*at)) {
        let rest = code[at..].trim_start_matches(SUPER);
        let n_supers = (code.len() - at - rest.len()) / SUPER.len();
        // Inside the test module every path is one level deeper.
        let in_tests = tests_from.is_some_and(|from| code[..at].matches('\n').count() >= from);
        if n_supers >= depth_of(&source.path) + usize::from(in_tests) {
            found.extend(first_segments(rest));
        }
    }
    found
}

/// Returns the first segment of a path, or of every path in a use tree.
fn first_segments(text: &str) -> Vec<String> {
    let segment = |text: &str| text.trim_start().chars().take_while(|&c| is_ident(c)).collect::<String>();
    let Some(tree) = text.strip_prefix('{') else { return vec![segment(text)] };
    let (mut depth, mut found) = (0_u32, vec![segment(tree)]);
    for (at, c) in tree.char_indices() {
        match c {
            '{' => depth += 1,
            '}' if depth == 0 => break,
            '}' => depth -= 1,
            ',' if depth == 0 => found.push(segment(&tree[at + 1..])),
            _ => {}
        }
    }
    // A comma at the end precedes no path.
    found.retain(|name| !name.is_empty());
    found
}

/// Returns the line (from 0) at which the test module begins. The test module is the last item of a file.
fn tests_start(text: &str) -> Option<usize> {
    let lines: Vec<&str> = text.lines().collect();
    (0..lines.len()).find(|&i| {
        lines[i].trim() == "#[cfg(test)]"
            && lines[i + 1..]
                .iter()
                .find(|l| !l.trim_start().starts_with("#["))
                .is_some_and(|l| l.starts_with("mod ") && l.ends_with('{'))
    })
}

// --------------------------------------------------------------------------------------------------- the checkers

/// Returns references to later modules, references to `gpu`, and sources of unlisted modules.
fn forbidden_references(sources: &[Source]) -> Vec<String> {
    let mut wrong = Vec::new();
    for source in sources {
        let (path, own) = (&source.path, module_of(&source.path));
        let Some(at) = MODULES.iter().position(|module| *module == own) else {
            wrong.push(format!("{path}: `{own}` is not in the list of modules"));
            continue;
        };
        let is_allowed = |other: &str| MODULES[..=at].contains(&other) || CRATES.contains(&other);
        let others = references(source).into_iter().filter(|other| !is_allowed(other));
        wrong.extend(others.map(|other| format!("{path}: `{own}` must not reference crate::{other}")));
        if own != "lib" && code(&source.text).contains("molmesh_gpu") {
            wrong.push(format!("{path}: `{own}` must not reference molmesh_gpu"));
        }
    }
    wrong
}

type Edges = BTreeMap<String, BTreeSet<String>>;

/// Returns a reference cycle between modules, if there is one.
fn cycle(sources: &[Source]) -> Option<Vec<String>> {
    fn visit(at: &str, edges: &Edges, trail: &mut Vec<String>, done: &mut BTreeSet<String>) -> bool {
        if done.contains(at) {
            return false;
        }
        let seen = trail.iter().any(|t| t == at);
        trail.push(at.to_owned());
        if seen || edges.get(at).is_some_and(|next| next.iter().any(|n| visit(n, edges, trail, done))) {
            return true;
        }
        trail.pop();
        done.insert(at.to_owned());
        false
    }
    let mut edges = Edges::new();
    for source in sources {
        let module = module_of(&source.path).to_owned();
        let others = references(source).into_iter().filter(|other| *other != module);
        edges.entry(module.clone()).or_default().extend(others);
    }
    let mut done = BTreeSet::new();
    edges.keys().find_map(|module| {
        let mut trail = Vec::new();
        visit(module, &edges, &mut trail, &mut done).then_some(trail)
    })
}

/// Returns the modules below `folder` without their tests, as if `path` were the root of their crate. [`cycle`] then
/// finds cycles between them.
fn modules_of(sources: &[Source], folder: &str, path: &str) -> Vec<Source> {
    // The root re-exports the modules and the OpenAPI document describes them, so both may reference all of them.
    let left_out = ["lib.rs", "mod.rs", "openapi/"].map(|name| format!("{folder}{name}"));
    let modules =
        sources.iter().filter(|s| s.path.starts_with(folder) && !left_out.iter().any(|path| s.path.starts_with(path)));
    modules
        .map(|s| {
            let lines = s.text.lines().take(tests_start(&s.text).unwrap_or(usize::MAX));
            // References to outer modules must not count as references to modules of the same name.
            let text = lines.collect::<Vec<_>>().join("\n").replace(path, "super::super::super::");
            let text = text.replace("crate::", "outside::").replace("super::super::super::", "crate::");
            Source { path: s.path.replacen(folder, "src/", 1), text }
        })
        .collect()
}

fn too_long(sources: &[Source]) -> Vec<String> {
    let length = |s: &Source| tests_start(&s.text).unwrap_or_else(|| s.text.lines().count());
    sources
        .iter()
        .filter(|s| length(s) > MAX_LINES)
        .map(|s| format!("{}: {} lines without its tests, {MAX_LINES} are allowed", s.path, length(s)))
        .collect()
}

fn without_doc(sources: &[Source]) -> Vec<String> {
    let bare = |s: &&Source| !s.text.starts_with("//!") && !s.text.starts_with("#!");
    sources.iter().filter(bare).map(|s| format!("{}: has no module documentation", s.path)).collect()
}

/// Returns the name of the type that a line of code defines. Associated types are indented and do not count.
fn defined_type(line: &str) -> Option<&str> {
    let item = line.trim_start();
    let item = match item.strip_prefix("pub") {
        Some(rest) if rest.starts_with('(') => rest.split_once(')')?.1.trim_start(),
        Some(rest) if rest.starts_with(' ') => rest.trim_start(),
        _ => item,
    };
    let (keyword, rest) = item.split_once(' ')?;
    let is_type =
        ["struct", "enum", "trait", "union"].contains(&keyword) || (keyword == "type" && !line.starts_with(' '));
    rest.split(|c| !is_ident(c)).next().filter(|name| is_type && !name.is_empty())
}

/// Returns the names that more than [`MAX_TYPES_PER_NAME`] types outside tests have, with their files.
fn ambiguous_types(sources: &[Source]) -> Vec<String> {
    let mut types: BTreeMap<String, Vec<&str>> = BTreeMap::new();
    for source in sources.iter().filter(|s| !s.path.ends_with("/tests.rs") && !s.path.contains("/tests/")) {
        let n_lines = tests_start(&source.text).unwrap_or(usize::MAX);
        for name in code(&source.text).lines().take(n_lines).filter_map(defined_type) {
            types.entry(name.to_owned()).or_default().push(&source.path);
        }
    }
    types.retain(|_, paths| paths.len() > MAX_TYPES_PER_NAME);
    types.iter().map(|(name, paths)| format!("{name}: {}", paths.join(", "))).collect()
}

/// Returns the number of terms in the glossary of `text`, the last section of `CONTRIBUTING.md`. A row defines one
/// term, or several separated by commas.
fn glossary_terms(text: &str) -> usize {
    let (_, glossary) = text.split_once("\n## Glossary\n").unwrap_or_default();
    let rows = glossary.lines().filter_map(|line| line.strip_prefix("| ")?.split_once(" | "));
    rows.skip(1).map(|(terms, _)| terms.split(", ").count()).sum()
}

/// Returns the missing parts of stages.
fn missing_parts(exists: impl Fn(&str) -> bool, stage_tests: &str) -> Vec<String> {
    let mut missing = Vec::new();
    for stage in STAGES {
        let parts = [format!("crates/surface/src/cpu/{stage}.rs"), format!("shaders/{stage}.wgsl")];
        missing.extend(parts.into_iter().filter(|part| !exists(part)));
        if !stage_tests.contains(&format!("fn {stage}_")) {
            missing.push(format!("tests/gpu/stages.rs::{stage}_*"));
        }
    }
    missing
}

/// Returns marks of unfinished work and lint switches without a reason.
fn unfinished(sources: &[Source]) -> Vec<String> {
    const MARKS: [&str; 6] = ["todo!", "unimplemented!", "dbg!", "#[ignore", "#[allow(", "#![allow("];
    let mut found = Vec::new();
    for source in sources {
        let code = code(&source.text);
        for mark in MARKS {
            for (at, _) in code.match_indices(mark) {
                // A switch with a reason is permitted.
                let attribute = code[at..].split(']').next().unwrap_or_default();
                if !(mark.contains("allow") && attribute.contains("reason =")) {
                    found.push(format!("{}:{}: {mark}", source.path, code[..at].matches('\n').count() + 1));
                }
            }
        }
    }
    found
}

/// Returns the `modules` (`src/http/`, `crates/gpu/`) that `map` does not show, its paths in backticks that do not
/// exist, and the length of a map that is too long.
fn map_faults(map: &str, modules: &[String], exists: impl Fn(&str) -> bool) -> Vec<String> {
    let quoted: Vec<&str> = map.lines().flat_map(|line| line.split('`').skip(1).step_by(2)).collect();
    let unlisted = modules.iter().filter(|module| !quoted.contains(&module.as_str()));
    let mut faults: Vec<String> = unlisted.map(|module| format!("ARCHITECTURE.md: {module} is missing")).collect();
    // Other paths are relative to the folder of their row, build output, or patterns.
    let is_path = |text: &&&str| text.split_once('/').is_some_and(|(folder, _)| exists(folder));
    let paths = quoted.iter().filter(is_path).filter(|path| !path.contains('<') && **path != "web/dist");
    faults.extend(paths.filter(|path| !exists(path)).map(|path| format!("ARCHITECTURE.md: {path} does not exist")));
    let n_lines = map.lines().count();
    faults.extend((n_lines > MAX_MAP_LINES).then(|| format!("ARCHITECTURE.md: {n_lines} lines of {MAX_MAP_LINES}")));
    faults
}

/// Returns the number of a decision record: the four digits at the beginning of its file name.
fn record_number(name: &str) -> Option<&str> {
    let (number, _) = name.split_once('-')?;
    (number.len() == 4 && number.bytes().all(|c| c.is_ascii_digit())).then_some(number)
}

/// Returns the decision records (sorted file names) that `index` does not link, that have no number, or that have the
/// number of another one. Numbers of removed records are absent.
fn record_faults(index: &str, records: &[String]) -> Vec<String> {
    let unlisted = records.iter().filter(|name| !index.contains(&format!("({name})")));
    let mut faults: Vec<String> = unlisted.map(|name| format!("docs/adr/README.md: {name} is missing")).collect();
    let unnumbered = records.iter().filter(|name| record_number(name).is_none());
    faults.extend(unnumbered.map(|name| format!("docs/adr/{name}: expected a number of four digits")));
    let repeated = records.windows(2).filter(|pair| record_number(&pair[0]) == record_number(&pair[1]));
    faults.extend(repeated.map(|pair| format!("docs/adr/{}: {} has its number", pair[1], pair[0])));
    faults
}

// ------------------------------------------------------------------------------------------------------ the tests

pub(crate) fn assert_none(found: &[String]) {
    assert!(found.is_empty(), "{} found, none is permitted:\n{}", found.len(), found.join("\n"));
}

/// Returns the names in a folder for which `wanted` holds, sorted.
fn names_in(folder: &str, wanted: impl Fn(&Path) -> bool) -> Vec<String> {
    let entries = fs::read_dir(root().join(folder)).expect("the folder can be listed").flatten();
    let mut names: Vec<String> = entries
        .filter(|entry| wanted(&entry.path()))
        .map(|entry| entry.file_name().to_string_lossy().into_owned())
        .collect();
    names.sort();
    names
}

#[test]
fn modules_reference_only_earlier_modules() {
    let sources = files(&["src"], &["rs"]);
    assert!(sources.len() > 20, "only {} sources found: wrong folder?", sources.len());
    assert_none(&forbidden_references(&sources));
}

#[test]
fn modules_of_gpu_and_http_have_no_reference_cycle() {
    let sources = library();
    for (folder, path) in [("crates/gpu/src/", "crate::"), ("src/http/", "crate::http::")] {
        let modules = modules_of(&sources, folder, path);
        assert!(modules.len() > 20, "only {} modules found in {folder}: wrong folder?", modules.len());
        assert_eq!(cycle(&modules), None);
    }
}

#[test]
fn files_are_short() {
    assert_none(&too_long(&files(&["src", "crates", "bench/src", "fuzz/src", "python/src"], &["rs"])));
    assert_none(&too_long(&files(&["web/src", "web/client/src"], &["ts"])));
}

#[test]
fn files_have_module_documentation() {
    assert_none(&without_doc(&files(&["src", "crates", "tests", "bench", "fuzz", "python"], &["rs"])));
}

#[test]
fn type_names_have_few_meanings() {
    assert_none(&ambiguous_types(&library()));
}

#[test]
fn the_glossary_is_short() {
    let text = fs::read_to_string(root().join("CONTRIBUTING.md")).expect("the file is there");
    let n = glossary_terms(&text);
    assert!((20..=MAX_TERMS).contains(&n), "{n} terms, {MAX_TERMS} are permitted");
}

#[test]
fn stages_have_all_their_parts() {
    let stage_tests = fs::read_to_string(root().join("tests/gpu/stages.rs")).expect("the tests are there");
    assert_none(&missing_parts(|path| root().join(path).is_file(), &stage_tests));
}

#[test]
fn no_unfinished_work_remains() {
    assert_none(&unfinished(&files(CODE, &["rs"])));
}

#[test]
fn the_map_shows_every_module_and_only_what_exists() {
    let in_src = |wanted: fn(&Path) -> bool| names_in("src", wanted).into_iter().map(|name| format!("src/{name}"));
    let crates = names_in("crates", Path::is_dir).into_iter().map(|name| format!("crates/{name}/"));
    let folders = in_src(Path::is_dir).map(|path| format!("{path}/"));
    let modules: Vec<String> = crates.chain(folders).chain(in_src(Path::is_file)).collect();
    assert!(modules.len() > 20, "only {} modules found: wrong folder?", modules.len());
    let map = fs::read_to_string(root().join("ARCHITECTURE.md")).expect("the map is there");
    assert_none(&map_faults(&map, &modules, |path| root().join(path).exists()));
}

#[test]
fn the_index_lists_every_decision_record() {
    let records = names_in("docs/adr", |path| path.file_name().is_some_and(|name| name != "README.md"));
    assert!(records.len() > 20, "only {} records found: wrong folder?", records.len());
    let index = fs::read_to_string(root().join("docs/adr/README.md")).expect("the index is there");
    assert_none(&record_faults(&index, &records));
}

// -------------------------------------------------------------------------------------------- negative controls

pub(crate) fn source(path: &str, text: &str) -> Vec<Source> {
    vec![Source { path: path.to_owned(), text: text.to_owned() }]
}

#[test]
fn control_forbidden_references_are_reported() {
    let bad = [
        ("src/store/s3.rs", "use crate::jobs::Pool;"),
        ("src/store/s3.rs", "fn f() { crate::http::run() }"),
        ("src/store/s3.rs", "use super::super::http::Server;"),
        ("src/store/mod.rs", "use super::http;"),
        ("src/store/s3.rs", "use std::fmt;\nuse crate::{config::{self, Config}, http};"),
        ("src/store/s3.rs", "fn f() {}\n\n#[cfg(test)]\nmod tests {\n    use super::super::super::http;\n}"),
        ("src/store/s3.rs", "use crate::*;"),
        ("src/http/router.rs", "let x = r#\"a \"quoted\" b\"#; let x = crate::gpu::unavailable();"),
        ("src/http/router.rs", "use molmesh_gpu::DevicePool;"),
        ("src/attic/old.rs", "fn f() {}"),
    ];
    for (path, text) in bad {
        assert_eq!(forbidden_references(&source(path, text)).len(), 1, "{path}: {text}");
    }
}

#[test]
fn control_permitted_references_are_not_reported() {
    let good = [
        ("src/store/s3.rs", "use super::name::Name; // crate::http\nlet s = \"crate::http::x\";"),
        ("src/store/s3/upload.rs", "use super::super::name::Name; use crate::store::Store;"),
        (
            "src/store/s3.rs",
            "/// [`crate::http::Server`] and 'a'\nfn f<'a>(c: char) -> bool { c == '\"' || c == '\\'' }",
        ),
        ("src/store/s3.rs", "/* crate::http */ fn f() { r#\"crate::http\"#; \"a \\\" crate::http\" }"),
        ("src/store/s3.rs", "fn f() {}\n\n#[cfg(test)]\nmod tests {\n    use super::super::name::Name;\n}"),
        ("src/http/router.rs", "use crate::{\n    jobs::{Pool, Task},\n    surface::Kernel,\n}; use axum::Router;"),
        ("src/cli/backend.rs", "use molmesh::gpu::DevicePool;"),
    ];
    for (path, text) in good {
        assert_eq!(forbidden_references(&source(path, text)), Vec::<String>::new(), "{path}: {text}");
    }
}

#[test]
fn control_a_cycle_of_modules_is_reported() {
    let one = |path: &str, text: &str| source(path, text).remove(0);
    let cycle_of = |sources: &[Source], folder, path| cycle(&modules_of(sources, folder, path));
    let mut http = vec![
        one("src/http/mod.rs", "mod a; use a::X;"),
        one("src/http/a.rs", "use super::b::X;\n#[cfg(test)]\nmod tests {\n    use crate::http::c::Y;\n}"),
        one("src/http/b/deep.rs", "use super::super::c::Y;"),
        one("src/http/c.rs", "use crate::a::Mesh;"),
    ];
    assert_eq!(cycle_of(&http, "src/http/", "crate::http::"), None);
    http.push(one("src/http/c/other.rs", "use crate::http::a::Z;"));
    let expected = ["a", "b", "c", "a"].map(String::from).to_vec();
    assert_eq!(cycle_of(&http, "src/http/", "crate::http::"), Some(expected));
    let gpu = [
        one("crates/gpu/src/lib.rs", "mod a; pub use a::X;"),
        one("crates/gpu/src/a.rs", "use super::b::Y; use molmesh_surface::Mesh;"),
        one("crates/gpu/src/b.rs", "use crate::a::X;"),
    ];
    let expected = ["a", "b", "a"].map(String::from).to_vec();
    assert_eq!(cycle_of(&gpu, "crates/gpu/src/", "crate::"), Some(expected));
}

#[test]
fn control_a_long_file_is_reported_without_its_tests() {
    let long = "//! Doc.\n".to_owned() + &"fn f() {}\n".repeat(MAX_LINES);
    assert_eq!(too_long(&source("src/http/long.rs", &long)).len(), 1);
    let tested = "//! Doc.\n#[cfg(test)]\n#[expect(clippy::panic)]\nmod tests {\n".to_owned() + &long;
    assert_eq!(too_long(&source("src/http/tested.rs", &tested)).len(), 0);
    let declared = "//! Doc.\n#[cfg(test)]\nmod tests;\n".to_owned() + &long;
    assert_eq!(too_long(&source("src/http/mod.rs", &declared)).len(), 1);
}

#[test]
fn control_a_file_without_documentation_is_reported() {
    assert_eq!(without_doc(&source("src/http/x.rs", "use std::fmt;\n//! late")).len(), 1);
}

#[test]
fn control_ambiguous_types_are_reported() {
    let files = |texts: [&str; 3]| -> Vec<Source> {
        let named = ["src/a.rs", "src/b.rs", "src/c/d.rs"].into_iter().zip(texts);
        named.map(|(path, text)| Source { path: path.to_owned(), text: text.to_owned() }).collect()
    };
    let kinds = ["pub(super) struct Row<'a> {}", "    enum Row {}", "pub type Row = u8;"];
    assert_eq!(ambiguous_types(&files(kinds)), ["Row: src/a.rs, src/b.rs, src/c/d.rs"]);
    assert_eq!(ambiguous_types(&files(["trait Row {}\nunion Row {}\n", "pub enum Row {}", ""])).len(), 1);
    for last in
        ["// struct Row;", "    type Row = u8;", "struct Rows;", "#[cfg(test)]\nmod tests {\n    struct Row;\n}", ""]
    {
        assert_none(&ambiguous_types(&files([kinds[0], kinds[1], last])));
    }
}

#[test]
fn control_terms_are_counted() {
    let text =
        "| other | table |\n\n## Glossary\n\n| term | meaning |\n|---|---|\n| a | one |\n| b, c | two, three |\n";
    assert_eq!((glossary_terms(text), glossary_terms("| a | one |")), (3, 0));
}

#[test]
fn control_missing_parts_are_reported() {
    let tests = "fn bin_x() {} fn field_x() {} fn classify_x() {} fn scan_x() {} fn refine_x() {} fn interpolate_x() {}
        fn emit_x() {}";
    let missing = ["crates/surface/src/cpu/scan.rs", "shaders/emit.wgsl"];
    let expected = [missing[0], missing[1], "tests/gpu/stages.rs::measure_*"];
    assert_eq!(missing_parts(|path| !missing.contains(&path), tests), expected);
}

#[test]
fn control_unfinished_work_is_reported() {
    let bad = ["fn f() { todo!() }", "#[ignore = \"slow\"]\nfn f() {}", "#[allow(dead_code)]\nfn f() {}", "dbg!(1);"];
    for text in bad {
        assert_eq!(unfinished(&source("src/x.rs", text)).len(), 1, "{text}");
        let reasoned = "#![allow(\n    dead_code,\n    reason = \"a (good) one\"\n)]\nfn f() {}";
        assert_eq!(unfinished(&source("tests/x.rs", reasoned)).len(), 0);
        let comment = format!("// {}", text.replace('\n', "\n// "));
        assert_eq!(unfinished(&source("src/x.rs", &comment)).len(), 0, "{text}");
    }
}

#[test]
fn control_an_incomplete_map_is_reported() {
    let modules = ["src/http/", "src/tls.rs", "crates/gpu/"].map(String::from);
    let existing = ["src", "src/http/", "src/tls.rs", "crates", "crates/gpu/"];
    let faults = |map: &str| map_faults(map, &modules, |path| existing.contains(&path));
    assert_eq!(faults("`src/http/` `src/tls.rs` `crates/gpu/` `src/<stage>.rs` `load/`"), Vec::<String>::new());
    assert_eq!(faults("`src/http/` `crates/gpu/`, not src/tls.rs"), ["ARCHITECTURE.md: src/tls.rs is missing"]);
    let stale = "`src/http/`, `src/tls.rs`, `crates/gpu/`, `src/old_*.rs`";
    assert_eq!(faults(stale), ["ARCHITECTURE.md: src/old_*.rs does not exist"]);
    let long = "`src/http/` `src/tls.rs` `crates/gpu/`\n".repeat(MAX_MAP_LINES + 1);
    assert_eq!(faults(&long).len(), 1);
}

#[test]
fn control_an_incomplete_index_is_reported() {
    let records = ["0001-a.md", "0002-b.md"].map(String::from);
    assert_eq!(record_faults("[A](0001-a.md) [B](0002-b.md)", &records).len(), 0);
    assert_eq!(record_faults("[A](0001-a.md)", &records), ["docs/adr/README.md: 0002-b.md is missing"]);
    let gap = ["0001-a.md", "0003-c.md"].map(String::from);
    assert_eq!(record_faults("(0001-a.md) (0003-c.md)", &gap).len(), 0);
    let unnumbered = ["0001-a.md", "12-b.md"].map(String::from);
    let faults = record_faults("(0001-a.md) (12-b.md)", &unnumbered);
    assert_eq!(faults, ["docs/adr/12-b.md: expected a number of four digits"]);
    let repeated = ["0001-a.md", "0001-b.md"].map(String::from);
    let faults = record_faults("(0001-a.md) (0001-b.md)", &repeated);
    assert_eq!(faults, ["docs/adr/0001-b.md: 0001-a.md has its number"]);
}
