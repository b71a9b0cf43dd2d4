//! `ETag`s and bytes of meshes, pictures and documents, compared with recorded ones: equal `ETag`s of an address mean
//! equal bytes in every release. `MOLMESH_BLESS=1 cargo nextest run --test http recorded_bytes` records them after an
//! intended change.

use crate::http_support;
use crate::tools;

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use http_support::{SAMPLE, start};
use molmesh::store::Digest;
use molmesh::surface::{CpuBackend, arithmetic};

/// Document or file to be compared.
#[derive(Debug, Clone, Copy)]
struct Row {
    /// Path below the structure.
    path: &'static str,
    /// Number in `crates/pipeline/src/algorithm_versions.rs` of the code that it tests.
    number: &'static str,
}

const fn row(path: &'static str, number: &'static str) -> Row {
    Row { path, number }
}

/// Meshes of each kind of surface, in one format.
const SURFACES: [Row; 6] = [
    row("/surface.stl?resolution=1.5&surface=gaussian", "GAUSSIAN"),
    row("/surface.stl?resolution=1.5&surface=soft-object", "SOFT_OBJECT"),
    row("/surface.stl?resolution=1.5&surface=inverse-square", "INVERSE_SQUARE"),
    row("/surface.stl?resolution=1.5&surface=vdw", "VDW"),
    row("/surface.stl?resolution=1.5&surface=sas", "SAS"),
    row("/surface.stl?resolution=1.5&surface=ses", "SES"),
];
const OTHERS: [Row; 21] = [
    row("/surface.glb?resolution=1.5", "MESHES"),
    row("/surface.glb?resolution=1.5&compress=quantize", "MESHES"),
    row("/surface.glb?resolution=1.5&compress=meshopt", "MESHES"),
    row("/surface.gltf?resolution=1.5", "MESHES"),
    row("/surface.ply?resolution=1.5", "MESHES"),
    row("/surface.obj?resolution=1.5", "MESHES"),
    row("/surface.vtp?resolution=1.5", "MESHES"),
    row("/surface.vert?resolution=1.5&surface=ses", "MESHES"),
    row("/surface.face?resolution=1.5&surface=ses", "MESHES"),
    row("/surface.glb?resolution=1.5&color=element", "MESHES"),
    row("/surface.glb?resolution=1.5&color=element&compress=quantize", "MESHES"),
    row("/surface.ply?resolution=1.5&color=element&atom_ids=true&split=residue-group", "MESHES"),
    row("/surface.ply?resolution=1&quality=high&cavities=drop", "MESHES"),
    row("/surface.ply?resolution=1&simplify=0.2", "MESHES"),
    row("/surface.glb?tile=0/0/0/0", "MESHES"),
    row("/surface.png?resolution=1.5&width=64&height=64&color=element", "PICTURES"),
    row("", "DOCUMENTS"),
    row("/atoms", "DOCUMENTS"),
    row("/colors?scheme=element", "DOCUMENTS"),
    row("/areas?surface=ses", "DOCUMENTS"),
    row("/tileset.json", "DOCUMENTS"),
];

/// `ETag` and digest of a response.
#[derive(Debug, Clone, PartialEq)]
struct Recorded {
    etag: String,
    digest: String,
}

/// Recorded responses by path.
type Record = BTreeMap<String, Recorded>;

/// Returns the numbers to increase, given the paths whose bytes have changed.
fn to_increase(changed: &[&str]) -> Vec<&'static str> {
    let of = |rows: &[Row]| -> Vec<&'static str> {
        let mut numbers: Vec<_> = rows.iter().filter(|row| changed.contains(&row.path)).map(|row| row.number).collect();
        numbers.dedup();
        numbers
    };
    let (surfaces, others) = (of(&SURFACES), of(&OTHERS));
    match surfaces.len() {
        0 => others,
        6 if others.contains(&"DOCUMENTS") => vec!["STRUCTURES"],
        6 => vec!["MESHES"],
        // Further formats of these surfaces have changed with them.
        _ => surfaces,
    }
}

/// Returns the reason for which other bytes must not be recorded: some have an `ETag` that other bytes have.
fn reused_etags(recorded: &Record, now: &Record) -> Option<String> {
    let is_reused = |path: &str, now: &Recorded| {
        recorded.get(path).is_some_and(|old| old.etag == now.etag && old.digest != now.digest)
    };
    let changed: Vec<&str> =
        now.iter().filter(|(path, now)| is_reused(path, now)).map(|(path, _)| path.as_str()).collect();
    (!changed.is_empty()).then(|| {
        format!(
            "other bytes have the same ETag: increase {} in crates/pipeline/src/algorithm_versions.rs by one, then \
             record the bytes with MOLMESH_BLESS=1 cargo nextest run --test http recorded_bytes\n{}",
            to_increase(&changed).join(" and "),
            changed.join("\n")
        )
    })
}

/// Returns the paths with other `ETag`s or without a record.
fn other_etags(recorded: &Record, now: &Record) -> Vec<String> {
    let is_other = |path: &str, now: &Recorded| recorded.get(path).is_none_or(|old| old.etag != now.etag);
    now.iter().filter(|(path, now)| is_other(path, now)).map(|(path, _)| path.clone()).collect()
}

/// Parses the file: the arithmetic, then one line per path.
fn parse(text: &str) -> Record {
    let row = |line: &str| {
        let mut words = line.split(' ').map(str::to_owned);
        Some((words.next()?, Recorded { etag: words.next()?, digest: words.next()? }))
    };
    text.lines().skip(1).map(|line| row(line).expect("a path, an ETag and a digest")).collect()
}

#[test]
fn recorded_bytes_have_not_changed() {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/http/recorded_bytes.txt");
    let committed = std::fs::read_to_string(&file).unwrap_or_default();
    let bless = std::env::var_os("MOLMESH_BLESS").is_some();
    if !bless && committed.lines().next() != Some(&*arithmetic()) {
        return tools::print_skipped("the recorded bytes are those of another arithmetic");
    }
    let server = start(Arc::new(CpuBackend::new(None).unwrap()), |_| {});
    let structure = server.post("/v1/structures", &[], SAMPLE).header("location").unwrap().to_owned();
    let now: Record = SURFACES
        .iter()
        .chain(&OTHERS)
        .map(|Row { path, .. }| {
            let reply = server.get(&format!("{structure}{path}"));
            assert!(reply.status == 200 && reply.complete, "{path}: {}", String::from_utf8_lossy(&reply.body));
            let etag =
                reply.header("etag").unwrap_or_else(|| panic!("{path} has no ETag")).trim_matches('"').to_owned();
            ((*path).to_owned(), Recorded { etag, digest: Digest::of(&reply.body).to_string() })
        })
        .collect();
    let recorded = parse(&committed);
    let reused = reused_etags(&recorded, &now);
    assert!(reused.is_none(), "{}", reused.unwrap_or_default());
    if bless {
        let recorded_on = committed.lines().next();
        assert!(
            recorded_on.is_none_or(|line| line == arithmetic()),
            "record the bytes on a machine with {recorded_on:?}"
        );
        let rows = now.iter().map(|(path, Recorded { etag, digest })| format!("{path} {etag} {digest}\n"));
        std::fs::write(&file, format!("{}\n{}", arithmetic(), rows.collect::<String>())).unwrap();
        return;
    }
    assert_eq!(
        other_etags(&recorded, &now),
        [""; 0],
        "their ETags have changed, so no stored result and no copy of a client can be used any more. If a number in \
         crates/pipeline/src/algorithm_versions.rs was increased, record the bytes with MOLMESH_BLESS=1 cargo nextest \
         run --test http recorded_bytes; else the parameters of the key have changed"
    );
}

#[test]
fn control_changed_bytes_are_reported_with_the_number_to_increase() {
    let all: Vec<Row> = SURFACES.into_iter().chain(OTHERS).collect();
    let record = |changed: &[&str], etag: &str| -> Record {
        let of = |path: &str| if changed.contains(&path) { "other" } else { "same" }.to_owned();
        all.iter()
            .map(|Row { path, .. }| ((*path).to_owned(), Recorded { etag: etag.to_owned(), digest: of(path) }))
            .collect()
    };
    let recorded = record(&[], "a");
    assert_eq!((reused_etags(&recorded, &recorded), other_etags(&recorded, &recorded).len()), (None, 0));
    let paths = |rows: &[Row]| rows.iter().map(|row| row.path).collect::<Vec<_>>();
    let of = |number: &str| paths(&OTHERS.into_iter().filter(|row| row.number == number).collect::<Vec<_>>());
    for (changed, number) in [
        (vec![SURFACES[5].path, OTHERS[7].path], "increase SES in"),
        (paths(&SURFACES), "increase MESHES in"),
        (vec![OTHERS[4].path, OTHERS[5].path], "increase MESHES in"),
        (of("PICTURES"), "increase PICTURES in"),
        (of("DOCUMENTS"), "increase DOCUMENTS in"),
        (paths(&all), "increase STRUCTURES in"),
    ] {
        let now = record(&changed, "a");
        let fault = reused_etags(&recorded, &now).unwrap();
        assert!(fault.contains(number) && fault.contains(changed[0]), "{fault}");
        assert!(other_etags(&recorded, &now).is_empty());
        // With an increased number, the bytes can be recorded, and must be.
        let increased = record(&changed, "b");
        assert_eq!((reused_etags(&recorded, &increased), other_etags(&recorded, &increased).len()), (None, all.len()));
    }
    assert_eq!(other_etags(&Record::new(), &recorded).len(), all.len(), "without a record");
}
