//! Small texts: parameters, configuration, keys, signatures, and files of the data folder.

use std::fs;
use std::path::PathBuf;
use std::sync::{Arc, LazyLock};
use std::time::UNIX_EPOCH;

use molmesh::access::{self, Signed, SigningKeys};
use molmesh::archive::{Archive, Uncounted};
use molmesh::config::{self, Config};
use molmesh::jobs::{Record, rfc3339};
use molmesh::pipeline::params;
use molmesh::telemetry::{Tracer, traceparent};
use tempfile::TempDir;
use tokio::runtime::Runtime;

use super::assert_short;

/// Words of queries.
pub(super) const PARAMETERS: &[&str] = &[
    "&",
    "=",
    ",",
    "preset=",
    "kernel=",
    "resolution=",
    "detail=",
    "max_triangles=",
    "isovalue=",
    "smoothness=",
    "radius_scale=",
    "radius_offset=",
    "cutoff_tolerance=",
    "paper_a=",
    "paper_b=",
    "paper_c=",
    "atom_ids=",
    "model=",
    "chains=",
    "select=",
    "altloc=",
    "validation=",
    "check=",
    "format=",
    "compress=",
    "normals=",
    "units=",
    "width=",
    "height=",
    "view=",
    "azimuth=",
    "elevation=",
    "background=",
    "style=",
    "true",
    "gaussian",
    "soft-object",
    "png",
    "obj",
    "polymer",
    "ligands",
    "water",
    "hydrogens",
    "all",
    "exact",
    "meter",
    "none",
    "transparent",
    "#fff",
];
/// Words of the configuration.
pub(super) const CONFIG: &[&str] = &[
    "[server]\n",
    "[limits]\n",
    "[jobs]\n",
    "[devices]\n",
    "[archive]\n",
    "[store]\n",
    "[access]\n",
    "[log]\n",
    "[telemetry]\n",
    "\n---\n",
    "MOLMESH__",
    "__",
    " = ",
    "\"none\"",
    "GiB",
    "listen",
    "url",
    "filter",
    "format",
    "sample_ratio",
    "endpoint",
    "trusted_proxies",
    "cors_origins",
    "secret_headers",
    "signing_secret",
    "head_bytes",
    "{id}",
    "{middle}",
    "https://",
    "[::1]:0",
    "10.0.0.0/8",
    "true",
    "'''",
    "\"\"\"",
    "1979-05-27T07:32:00Z",
    "\\u0007",
];
/// Words of key files.
pub(super) const KEY_FILE: &[&str] = &[
    "[[key]]\n",
    "key = [",
    "id = ",
    "hash = ",
    "scopes = ",
    "requests = ",
    "work_s = ",
    "concurrent = ",
    "window_s = ",
    "expires = ",
    "note = ",
    "sha256:",
    "\"mesh\"",
    "\"read\"",
    "2030-01-31T00:00:00Z",
    "1e9",
    "\\u0000",
    "[",
    "{",
];
/// Words of signing keys and signed addresses.
pub(super) const SIGNATURE: &[&str] =
    &["expires=", "key_id=", "signature=", "?", "&", "/", "%41", ":", "\n", "0123456789abcdef0123456789abcdef"];
/// Words of records of jobs.
pub(super) const RECORD: &[&str] = &[
    "\"id\"",
    "\"input\"",
    "\"parameters\"",
    "\"format\"",
    "\"client\"",
    "\"urgency\"",
    "\"status\"",
    "\"accepted\"",
    "\"running\"",
    "\"attempts\"",
    "\"created_ms\"",
    "\"problem\"",
    "\"requester\"",
    "\"traceparent\"",
    "null",
    "[[",
    "{\"a\":",
    "\"resolution\"",
    "\\ud800",
    "1e400",
    "00-",
    "-01",
];
/// Words of the metadata of copies.
pub(super) const ARCHIVE_COPY: &[&str] =
    &["\"bytes\"", "\"sha256\"", "\"url\"", "\"etag\"", "\"last_modified\"", "\"checked_ms\"", "null", "{", "\\u0000"];

/// Parses a query. Equal jobs have equal canonical texts, which the content key contains.
pub(super) fn parameters(bytes: &[u8]) {
    let text = String::from_utf8_lossy(bytes);
    let pairs: Vec<_> = text.split('&').map(|pair| pair.split_once('=').unwrap_or((pair, ""))).collect();
    match params::parse(pairs.iter().copied()) {
        Ok(request) => {
            let canonical = params::canonical(&request.job);
            assert!(!canonical.contains('\n'), "more than one line: {canonical:?}");
            // The order of parameters does not matter.
            let reversed = params::parse(pairs.iter().rev().copied()).expect("the same parameters in another order");
            assert_eq!(canonical, params::canonical(&reversed.job));
        }
        Err(error) => assert_short(&error.to_string()),
    }
}

/// Loads a configuration: a TOML file and, below a line `---`, environment variables.
pub(super) fn config(bytes: &[u8]) {
    static FOLDER: LazyLock<TempDir> = LazyLock::new(folder);
    let text = String::from_utf8_lossy(bytes);
    let (file, variables) = text.split_once("---\n").unwrap_or((&text, ""));
    let path = FOLDER.path().join("molmesh.toml");
    fs::write(&path, file).expect("the temporary folder is writable");
    let variables = variables.lines().filter_map(|line| line.split_once('='));
    // Keys that name files would make the result depend on the machine.
    let variables = variables.filter(|(name, _)| !name.to_ascii_lowercase().ends_with("_file"));
    let variables = variables.map(|(name, value)| (name.to_owned(), value.to_owned()));
    match config::load_with_sources(Some(&path), variables, &[]) {
        Ok(loaded) => assert!(loaded.config.limits.atoms > 0 && loaded.config.jobs.workers > 0, "a limit of zero"),
        // Errors quote the line of the file, which may be long.
        Err(error) => assert!(!error.to_string().is_empty()),
    }
}

/// Parses a key file. Errors do not quote what may be a key or a hash.
pub(super) fn key_file(bytes: &[u8]) {
    let text = String::from_utf8_lossy(bytes);
    if let Err(error) = access::parse(&text, 60) {
        let message = error.to_string();
        assert_short(&message);
        let words = text.split(|c: char| !c.is_ascii_alphanumeric()).filter(|word| word.len() >= 64);
        words.for_each(|word| assert!(!message.contains(word), "the error quotes the file: {message}"));
    }
}

/// Parses signing keys (first line), signs a target (third line) until a time (second line), and checks signatures.
pub(super) fn signature(bytes: &[u8]) {
    let text = String::from_utf8_lossy(bytes);
    let mut lines = text.splitn(3, '\n');
    let mut line = || lines.next().unwrap_or_default();
    let (keys, expires, target) = (line(), line().parse().unwrap_or(0), line().trim_end());
    let keys = match SigningKeys::parse(keys) {
        Ok(keys) => keys,
        Err(error) => return assert_short(&error),
    };
    let check = |target: &str| {
        let (path, query) = target.split_once('?').map_or((target, None), |(path, query)| (path, Some(query)));
        keys.check(path, query, UNIX_EPOCH)
    };
    assert!(matches!(check(target), Signed::No | Signed::Invalid), "a signature that nobody made: {target:?}");
    match keys.sign(None, target, expires) {
        Ok(signed) => {
            let valid = if expires == 0 { Signed::Expired(0) } else { Signed::Valid };
            assert_eq!(check(&signed), valid, "{signed:?}");
            assert_eq!(check(&format!("{signed}&a")), Signed::Invalid, "{signed:?}");
        }
        Err(error) => assert_short(&error.to_string()),
    }
}

/// Reads the record of a job, and what is made of it.
pub(super) fn record(bytes: &[u8]) {
    let Ok(record) = serde_json::from_slice::<Record>(bytes) else { return };
    let text = serde_json::to_vec(&record).expect("a record can be written");
    assert_eq!(serde_json::from_slice::<Record>(&text).ok().as_ref(), Some(&record), "a record changes when written");
    assert!(rfc3339(record.created_ms).ends_with('Z'));
    let parent = record.requester.parent(&Tracer::default());
    assert!(parent.context.is_none_or(|context| traceparent(&context).len() == 55));
    match params::parse(record.parameters.iter().map(|(name, value)| (name, value))) {
        Ok(mut request) => {
            if let Ok(format) = record.format.parse()
                && let Err(error) = params::settle(&mut request.job, format)
            {
                assert_short(&error.to_string());
            }
        }
        Err(error) => assert_short(&error.to_string()),
    }
}

/// Looks up an entry whose copy on disk has this metadata: the stored bytes or nothing.
pub(super) fn archive_copy(bytes: &[u8]) {
    static BODY: LazyLock<Vec<u8>> =
        LazyLock::new(|| fs::read(crate::corpus("pdb").join("plain.pdb")).expect("the seed exists"));
    static STATE: LazyLock<(Config, PathBuf, Runtime, TempDir)> = LazyLock::new(|| {
        let (dir, mut config) = (folder(), Config::default());
        dir.path().clone_into(&mut config.server.data_dir);
        config.archive.url = None;
        let copies = config.archive_cache_dir().join("pt");
        fs::create_dir_all(&copies).expect("the temporary folder is writable");
        (config, copies, runtime(), dir)
    });
    let (config, copies, runtime, _) = &*STATE;
    let write = |name: &str, bytes: &[u8]| fs::write(copies.join(name), bytes).expect("the folder is writable");
    write("4pti.body", &BODY);
    write("4pti.json", bytes);
    let id = "4pti".parse().expect("a valid id");
    match runtime.block_on(Archive::new(config, Arc::new(Uncounted)).fetch(&id)) {
        Ok(entry) => assert_eq!(entry.bytes, &BODY[..], "the copy changed"),
        Err(error) => assert_short(&error.to_string()),
    }
}

fn folder() -> TempDir {
    tempfile::tempdir().expect("a temporary folder can be created")
}

pub(super) fn runtime() -> Runtime {
    tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()
        .expect("a runtime can be started")
}
