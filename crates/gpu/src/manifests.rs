//! Manifests of Vulkan drivers that the loader would read. If no device is found, they distinguish a machine without a
//! driver from one whose driver does not start. This module loads no driver.

use std::env;
use std::fmt;
use std::path::{Path, PathBuf};

use serde_json::Value;

/// Manifest of a driver.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Manifest {
    /// Path of the manifest.
    pub path: PathBuf,
    /// Library that the manifest names, or the reason why it names none.
    pub library: Result<String, String>,
}

impl fmt::Display for Manifest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let path = self.path.display();
        match &self.library {
            Ok(name) => write!(f, "{path} names {name}"),
            Err(why) => write!(f, "{path} {why}"),
        }
    }
}

/// Variables with manifests that replace those of the system; the second is the older name, used if the first is unset.
const REPLACING: [&str; 2] = ["VK_DRIVER_FILES", "VK_ICD_FILENAMES"];
/// Variable with manifests that come before those of the system.
const ADDITIONAL: &str = "VK_ADD_DRIVER_FILES";
/// Subfolder of the search folders.
const SUBFOLDER: &str = "vulkan/icd.d";
/// Variables with search folders separated by `:`, and their defaults, in the order of the loader.
const FOLDERS: [(&str, &str); 4] = [
    ("XDG_CONFIG_HOME", "$HOME/.config"),
    ("XDG_CONFIG_DIRS", "/etc/xdg:/etc"),
    ("XDG_DATA_HOME", "$HOME/.local/share"),
    ("XDG_DATA_DIRS", "/usr/local/share:/usr/share"),
];

/// Returns the manifests that a Vulkan loader on Linux would read, in its order. Empty on other systems.
#[must_use]
pub fn manifests() -> Vec<Manifest> {
    if cfg!(target_os = "linux") { under(Path::new("/"), |name| env::var(name).ok()) } else { Vec::new() }
}

fn under(root: &Path, variable: impl Fn(&str) -> Option<String>) -> Vec<Manifest> {
    let set = |name: &str| variable(name).filter(|value| !value.is_empty());
    let listed = |value: String| value.split(':').map(|path| inside(root, path)).collect::<Vec<_>>();
    let replacing = REPLACING.into_iter().find_map(set);
    let system_paths = || {
        let mut paths = set(ADDITIONAL).map(listed).unwrap_or_default();
        let home = set("HOME").unwrap_or_default();
        for (name, default) in FOLDERS {
            let value = set(name).unwrap_or_else(|| default.replace("$HOME", &home));
            // The loader searches /etc regardless of the variable.
            let own = if name == "XDG_CONFIG_DIRS" { "/etc" } else { "" };
            let folders = value.split(':').chain([own]).filter(|folder| !folder.is_empty());
            paths.extend(folders.map(|folder| inside(root, folder).join(SUBFOLDER)));
        }
        paths
    };
    let paths = replacing.map_or_else(system_paths, listed);
    let mut found: Vec<Manifest> = Vec::new();
    for path in paths.iter().flat_map(|path| files(path)) {
        if !found.iter().any(|other| other.path == path) {
            let library = library(&path);
            found.push(Manifest { path, library });
        }
    }
    found
}

/// Maps an absolute path to one below `root`.
fn inside(root: &Path, path: &str) -> PathBuf {
    root.join(path.trim_start_matches('/'))
}

/// Returns `path` if it is a file, or the manifests in it, sorted by name, if it is a folder.
fn files(path: &Path) -> Vec<PathBuf> {
    let Ok(entries) = path.read_dir() else {
        return if path.is_file() { vec![path.to_owned()] } else { Vec::new() };
    };
    let json = |path: &PathBuf| path.extension().is_some_and(|extension| extension == "json");
    let mut files: Vec<PathBuf> = entries.flatten().map(|entry| entry.path()).filter(json).collect();
    files.sort();
    files
}

fn library(path: &Path) -> Result<String, String> {
    let text = std::fs::read_to_string(path).map_err(|e| format!("cannot be read: {e}"))?;
    let document: Value = serde_json::from_str(&text).map_err(|e| format!("is not JSON: {e}"))?;
    let named = document.pointer("/ICD/library_path").and_then(Value::as_str);
    named.map(str::to_owned).ok_or_else(|| "names no library".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn write(root: &Path, path: &str, text: &str) {
        let path = root.join(path);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, text).unwrap();
    }

    #[test]
    fn folders_are_searched_in_the_order_of_the_loader() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path();
        let named = |set: &[(&str, &str)]| -> Vec<String> {
            let value = |name: &str| set.iter().find(|(n, _)| *n == name).map(|(_, v)| (*v).to_owned());
            let root = format!("{}/", root.display());
            under(root.as_ref(), value).iter().map(|m| m.to_string().replace(&root, "/")).collect()
        };
        assert_eq!(named(&[]), [""; 0]);
        write(root, "usr/share/vulkan/icd.d/b.json", r#"{"ICD": {"library_path": "libb.so"}}"#);
        write(root, "usr/share/vulkan/icd.d/a.json", r#"{"ICD": {"library_path": "liba.so"}}"#);
        write(root, "usr/share/vulkan/icd.d/README", "no manifest");
        write(root, "etc/vulkan/icd.d/c.json", r#"{"ICD": {}}"#);
        write(root, "home/x/.config/vulkan/icd.d/d.json", "{");
        write(root, "opt/e.json", r#"{"ICD": {"library_path": "../libe.so"}}"#);
        let [a, b, c, e] = [
            "/usr/share/vulkan/icd.d/a.json names liba.so",
            "/usr/share/vulkan/icd.d/b.json names libb.so",
            "/etc/vulkan/icd.d/c.json names no library",
            "/opt/e.json names ../libe.so",
        ];
        assert_eq!(named(&[]), [c, a, b]);
        assert!(named(&[("HOME", "/home/x")])[0].starts_with("/home/x/.config/vulkan/icd.d/d.json is not JSON"));
        assert_eq!(named(&[("XDG_DATA_DIRS", "/nowhere"), ("XDG_CONFIG_DIRS", "/nowhere")]), [c]);
        assert_eq!(named(&[("VK_ADD_DRIVER_FILES", "/opt/e.json")]), [e, c, a, b]);
        for name in REPLACING {
            assert_eq!(named(&[(name, "/opt/e.json:/opt/none.json"), ("HOME", "/home/x")]), [e]);
        }
        assert_eq!(named(&[("VK_DRIVER_FILES", ""), ("VK_ICD_FILENAMES", "/usr/share/vulkan/icd.d")]), [a, b]);
    }
}
