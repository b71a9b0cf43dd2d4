//! Small texts: parameters, configuration, keys, signatures, and files of the data folder.

use std::fs;
use std::sync::LazyLock;

use molmesh::access::SigningKeys;
use molmesh::archive::Archive;
use molmesh::config::{self, Config};
use molmesh::fuzzing;
use molmesh::memory_budget::Budget;
use molmesh::pipeline::params;
use tempfile::TempDir;
use tokio::runtime::Runtime;

use super::assert_short;

/// Words of queries, besides the names and values of parameters.
pub(super) const PARAMETERS: &[&str] = &[
    "&",
    "=",
    ",",
    "true",
    "polymer",
    "ligand,water",
    "hydrogens",
    "all",
    "chain A",
    "resi 10-20,52A",
    "resn HEM",
    "name \"O5\"",
    "elem Fe",
    "within 5 of (",
    "byres ",
    " and ",
    " or ",
    "not ",
    "none",
    "transparent",
    "#fff",
    "uniform:#ff8800",
    "element",
    "bfactor",
    "plddt",
    "-4.5,4.5",
    "asymmetric-unit",
];
/// Returns words of the configuration: all keys, and values.
pub(super) fn config_words() -> Vec<String> {
    const VALUES: &[&str] = &[
        "\n---\n",
        "MOLMESH__",
        "__",
        " = ",
        "\"none\"",
        "\"auto\"",
        "GiB",
        "{id}",
        "{middle}",
        "https://",
        "[::1]:0",
        "10.0.0.0/8",
        "true",
        "\"\"\"",
        "'''",
        "1979-05-27T07:32:00Z",
        "\\u0007",
    ];
    let mut words = super::owned(VALUES);
    let config = serde_json::to_value(Config::default()).expect("a configuration is JSON");
    for (section, keys) in config.as_object().into_iter().flatten() {
        words.push(format!("[{section}]\n"));
        words.push(format!("MOLMESH__{}__", section.to_ascii_uppercase()));
        words.extend(keys.as_object().into_iter().flatten().map(|(key, _)| format!("{key} = ")));
    }
    words
}

/// Words of headers that name the client of a proxy.
pub(super) const FORWARDED: &[&str] =
    &[", ", "\n", "10.0.0.1", "192.0.2.60", "[2001:db8::1]", "::ffff:10.0.0.2", ":4711", "unknown"];
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
            let canonical = params::canonical(&request.options);
            assert!(!canonical.contains('\n'), "more than one line: {canonical:?}");
            // The order of parameters does not matter.
            let reversed = params::parse(pairs.iter().rev().copied()).expect("the same parameters in another order");
            assert_eq!(canonical, params::canonical(&reversed.options));
            // The canonical form of an expression is an expression with the same meaning.
            let atoms = request.options.selection.atoms;
            assert_eq!(atoms.to_string().parse(), Ok(atoms));
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
    match config::load(Some(&path), variables, &[]) {
        Ok(loaded) => assert!(loaded.config.limits.atoms > 0 && loaded.config.jobs.workers > 0, "a limit of zero"),
        // Errors quote keys and values, which may be long.
        Err(error) => assert!(!error.to_string().is_empty()),
    }
}

/// Parses a key file. Errors quote no word that may be a key or a hash.
pub(super) fn key_file(bytes: &[u8]) {
    let text = String::from_utf8_lossy(bytes);
    if let Err(error) = fuzzing::key_file(&text) {
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
    let is_valid = |target: &str| fuzzing::has_valid_signature(&keys, target);
    assert!(!is_valid(target), "a signature that nobody made: {target:?}");
    match keys.sign(None, target, expires) {
        Ok(signed) => {
            // All signatures are checked at the start of 1970.
            assert_eq!(is_valid(&signed), expires > 0, "{signed:?}");
            assert!(!is_valid(&format!("{signed}&a")), "{signed:?}");
        }
        Err(error) => assert_short(&error.to_string()),
    }
}

/// Finds the client of a request behind proxies. Each line is a value of the header. The client is the last address,
/// read from the end, that is not a trusted proxy, so that no address before it matters.
pub(super) fn forwarded(bytes: &[u8]) {
    let text = String::from_utf8_lossy(bytes);
    let values: Vec<&str> = text.lines().collect();
    let forged: Vec<&str> = ["203.0.113.77"].into_iter().chain(values.iter().copied()).collect();
    let client = fuzzing::forwarded(&values);
    let is_proxy = fuzzing::is_trusted_proxy(client);
    assert!(is_proxy || !text.is_empty(), "an address that nobody named: {client}");
    if !is_proxy {
        assert_eq!(fuzzing::forwarded(&forged), client, "an earlier value changes the client");
    }
}

/// Reads the record of a job, which does not change when it is written and read again.
pub(super) fn record(bytes: &[u8]) {
    match fuzzing::record(bytes) {
        Ok(written) => assert_eq!(fuzzing::record(&written).as_ref(), Ok(&written)),
        // Errors quote the record.
        Err(error) => assert!(!error.is_empty()),
    }
}

/// Looks up an entry whose copy on disk has this metadata: the stored bytes or nothing.
pub(super) fn archive_copy(bytes: &[u8]) {
    static COPY: LazyLock<Copy> = LazyLock::new(|| {
        let copy = Copy::new();
        let sound = fs::read(crate::corpus("archive_copy").join("sound")).expect("the seed exists");
        assert!(copy.is_found(&sound), "a sound copy is not found");
        copy
    });
    COPY.is_found(bytes);
}

/// Copy of an entry in a folder of its own.
struct Copy {
    config: Config,
    folder: TempDir,
    body: Vec<u8>,
    runtime: Runtime,
}

impl Copy {
    fn new() -> Self {
        let (folder, mut config) = (folder(), Config::default());
        folder.path().clone_into(&mut config.server.data_dir);
        config.archive.url = None;
        fs::create_dir_all(folder.path().join("cache/archive/pt")).expect("the temporary folder is writable");
        let body = fs::read(crate::corpus("pdb").join("plain.pdb")).expect("the seed exists");
        Self { config, folder, body, runtime: runtime() }
    }

    /// Returns true if the entry is found with this metadata.
    fn is_found(&self, metadata: &[u8]) -> bool {
        let path = |name: &str| self.folder.path().join("cache/archive/pt").join(name);
        fs::write(path("4pti.body"), &self.body).expect("the folder is writable");
        fs::write(path("4pti.json"), metadata).expect("the folder is writable");
        let id = "4pti".parse().expect("a valid id");
        match self.runtime.block_on(Archive::new(&self.config, Budget::unlimited()).fetch(&id)) {
            Ok(entry) => assert_eq!(entry.bytes, self.body, "the copy changed"),
            Err(error) => {
                assert_short(&error.to_string());
                return false;
            }
        }
        true
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
