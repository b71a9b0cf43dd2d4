//! Key files for tests.
#![allow(dead_code, reason = "each test binary uses a part")]
#![allow(clippy::unwrap_used, clippy::panic, reason = "tests fail by panicking")]

use std::collections::BTreeMap;
use std::path::PathBuf;

use molmesh::access::{Hash, new_key};

/// Key file and the texts of its keys.
pub(crate) struct Keys {
    dir: tempfile::TempDir,
    texts: BTreeMap<String, String>,
}

impl Keys {
    /// Creates keys from ids, scopes and further lines.
    pub(crate) fn new(keys: &[(&str, &str, &str)]) -> Self {
        let mut created = Self { dir: tempfile::tempdir().unwrap(), texts: BTreeMap::new() };
        created.write(keys);
        created
    }

    /// Rewrites the file. Existing keys keep their text.
    pub(crate) fn write(&mut self, keys: &[(&str, &str, &str)]) {
        let lines = keys.iter().map(|(id, scopes, more)| {
            let text = self.texts.entry((*id).to_owned()).or_insert_with(|| new_key(id).unwrap());
            let scopes: Vec<String> = scopes.split(',').map(|scope| format!("\"{scope}\"")).collect();
            format!("[[key]]\nid = \"{id}\"\nhash = \"{}\"\nscopes = [{}]\n{more}\n", Hash::of(text), scopes.join(", "))
        });
        let lines: Vec<String> = lines.collect();
        std::fs::write(self.path(), lines.concat()).unwrap();
    }

    pub(crate) fn path(&self) -> PathBuf {
        self.dir.path().join("keys.toml")
    }

    /// Returns the text of a key.
    pub(crate) fn text(&self, id: &str) -> &str {
        &self.texts[id]
    }
}
