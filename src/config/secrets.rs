//! Secrets: which keys they are, how they come from files, and what of other values is never shown.

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

/// Keys whose values are secret. Each has a namesake that ends in `_file`.
pub(super) const SECRETS: [&str; 3] = ["store.secret_access_key", "access.signing_secret", "telemetry.secret_headers"];

/// Bytes of a secret at most: keys and tokens have a few hundred.
const MAX_BYTES: u64 = 64 << 10;

/// The key that names the file of a secret.
pub(super) fn file_key(key: &str) -> String {
    format!("{key}_file")
}

/// Whether a value must not be shown: it belongs to a secret key, or is an address with a password in it.
pub(super) fn is_hidden(key: &str, text: &str) -> bool {
    let userinfo = |text: &str| {
        let rest = text.split_once("://").map(|(_, rest)| rest)?;
        Some(rest.split(['/', '?', '#']).next()?.contains('@'))
    };
    SECRETS.contains(&key) || userinfo(text) == Some(true)
}

/// A secret from a file, and what is to be said about the file.
pub(super) struct FromFile {
    /// The secret.
    pub(super) text: String,
    /// That others may read the file, if they may.
    pub(super) warning: Option<String>,
}

/// Reads a secret; one line break at its end is not part of it.
///
/// # Errors
/// Why not, in words that do not hold the secret.
pub(super) fn read(path: &Path) -> Result<FromFile, String> {
    let words = |e: std::io::Error| e.to_string();
    let file = File::open(path).map_err(words)?;
    let data = file.metadata().map_err(words)?;
    if data.is_dir() {
        return Err("it is a folder".to_owned());
    }
    let mut bytes = Vec::new();
    file.take(MAX_BYTES + 1).read_to_end(&mut bytes).map_err(words)?;
    if bytes.len() as u64 > MAX_BYTES {
        return Err(format!("it has more than {MAX_BYTES} bytes"));
    }
    let mut text = String::from_utf8(bytes).map_err(|_bytes| "it is not UTF-8".to_owned())?;
    if text.ends_with('\n') {
        text.pop();
        if text.ends_with('\r') {
            text.pop();
        }
    }
    if text.is_empty() {
        return Err("it is empty".to_owned());
    }
    Ok(FromFile { text, warning: readable_by_others(path, &data) })
}

#[cfg(unix)]
fn readable_by_others(path: &Path, data: &std::fs::Metadata) -> Option<String> {
    use std::os::unix::fs::PermissionsExt as _;
    let mode = data.permissions().mode() & 0o777;
    let says = || format!("every user of this machine can read {} (mode {mode:03o}); 0400 is enough", path.display());
    (mode & 0o004 != 0).then(says)
}

#[cfg(not(unix))]
fn readable_by_others(_path: &Path, _data: &std::fs::Metadata) -> Option<String> {
    None
}

/// A path of the tree of values.
pub(super) fn path_of(value: Option<&serde_json::Value>) -> Option<PathBuf> {
    value?.as_str().map(PathBuf::from)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn passwords_in_addresses_are_hidden_and_nothing_else() {
        for text in ["http://u:p@proxy:3128", "https://token@h/x", "s3://a@b"] {
            assert!(is_hidden("archive.proxy", text), "{text}");
        }
        for text in ["http://proxy:3128", "https://h/{id}?mail=a@b", "a@b", "", "none"] {
            assert!(!is_hidden("archive.url", text), "{text}");
        }
        assert!(is_hidden("store.secret_access_key", "x"));
    }
}
