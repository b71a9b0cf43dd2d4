//! Files of keys for tests, and waiting for what may take a while.
#![allow(dead_code, reason = "every test binary uses its own part")]
#![allow(clippy::unwrap_used, clippy::panic, reason = "tests say what they expect by panicking")]

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use molmesh::access::{Hash, mint};

/// A file of keys, and the keys.
pub(crate) struct Keys {
    dir: tempfile::TempDir,
    texts: BTreeMap<String, String>,
}

impl Keys {
    /// Keys by id, with their scopes and more lines.
    pub(crate) fn new(keys: &[(&str, &str, &str)]) -> Self {
        let mut made = Self { dir: tempfile::tempdir().unwrap(), texts: BTreeMap::new() };
        made.write(keys);
        made
    }

    /// Writes the file anew. Keys that there were before keep their text.
    pub(crate) fn write(&mut self, keys: &[(&str, &str, &str)]) {
        let lines = keys.iter().map(|(id, scopes, more)| {
            let text = self.texts.entry((*id).to_owned()).or_insert_with(|| mint(id).unwrap().text);
            let scopes: Vec<String> = scopes.split(',').map(|scope| format!("\"{scope}\"")).collect();
            format!("[[key]]\nid = \"{id}\"\nhash = \"{}\"\nscopes = [{}]\n{more}\n", Hash::of(text), scopes.join(", "))
        });
        let lines: Vec<String> = lines.collect();
        std::fs::write(self.path(), lines.concat()).unwrap();
    }

    pub(crate) fn path(&self) -> PathBuf {
        self.dir.path().join("keys.toml")
    }

    /// The text of a key.
    pub(crate) fn text(&self, id: &str) -> &str {
        &self.texts[id]
    }
}

/// Waits for something to become true, a minute at most.
#[track_caller]
pub(crate) fn eventually(what: &str, mut is: impl FnMut() -> bool) {
    let end = Instant::now() + Duration::from_mins(1);
    while !is() {
        assert!(Instant::now() < end, "waited too long for: {what}");
        std::thread::sleep(Duration::from_millis(20));
    }
}
