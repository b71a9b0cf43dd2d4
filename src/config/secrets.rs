//! Secrets: their keys, reading them from files, and values that are never printed.

use std::fs::File;
use std::io::Read;
use std::path::Path;

/// Keys whose values are secret. For each there is a key with the suffix `_file`.
pub(super) const SECRETS: [&str; 4] =
    ["broker.password", "store.secret_access_key", "access.signing_secret", "telemetry.secret_headers"];

/// Maximum size of a secret, bytes: keys and tokens have a few hundred.
const MAX_BYTES: u64 = 64 << 10;

/// Returns the key that names the file of a secret.
pub(super) fn file_key(key: &str) -> String {
    format!("{key}_file")
}

/// Returns true if a value must not be printed: it belongs to a secret key or is a URL with user information.
pub(super) fn is_hidden(key: &str, text: &str) -> bool {
    let userinfo = |text: &str| {
        let rest = text.split_once("://").map(|(_, rest)| rest)?;
        Some(rest.split(['/', '?', '#']).next()?.contains('@'))
    };
    SECRETS.contains(&key) || userinfo(text) == Some(true)
}

/// Secret from a file.
pub(super) struct FromFile {
    /// Secret.
    pub(super) text: String,
    /// Warning if all users can read the file.
    pub(super) warning: Option<String>,
}

/// Reads a secret, without one line break at its end.
///
/// # Errors
/// Returns the cause, without the secret.
pub(super) fn read(path: &Path) -> Result<FromFile, String> {
    let message = |e: std::io::Error| e.to_string();
    let file = File::open(path).map_err(message)?;
    let data = file.metadata().map_err(message)?;
    if data.is_dir() {
        return Err("it is a folder".to_owned());
    }
    let mut bytes = Vec::new();
    file.take(MAX_BYTES + 1).read_to_end(&mut bytes).map_err(message)?;
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
    let warning = || format!("all users can read {} (mode {mode:03o}); mode 0400 is sufficient", path.display());
    (mode & 0o004 != 0).then(warning)
}

#[cfg(not(unix))]
fn readable_by_others(_path: &Path, _data: &std::fs::Metadata) -> Option<String> {
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn urls_with_user_information_are_hidden() {
        for text in ["http://u:p@proxy:3128", "https://token@h/x", "s3://a@b"] {
            assert!(is_hidden("archive.proxy", text), "{text}");
        }
        for text in ["http://proxy:3128", "https://h/{id}?mail=a@b", "a@b", "", "none"] {
            assert!(!is_hidden("archive.url", text), "{text}");
        }
        assert!(is_hidden("store.secret_access_key", "x"));
    }
}
