//! Parsers of the deployment: Dockerfile, `.dockerignore`, manifests, sizes.

use std::path::{Component, Path, PathBuf};

use serde::Deserialize;
use serde_json::Value;

use crate::tools;

pub(crate) fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// Reads a file of the repository.
#[track_caller]
pub(crate) fn read(path: &str) -> String {
    std::fs::read_to_string(root().join(path)).unwrap_or_else(|e| panic!("{path}: {e}"))
}

/// Dockerfile: arguments before the first stage, then stages.
pub(crate) struct Recipe {
    arguments: Vec<String>,
    pub(crate) stages: Vec<Stage>,
}

/// Stage with its instructions, continued lines joined.
pub(crate) struct Stage {
    pub(crate) name: String,
    pub(crate) from: String,
    instructions: Vec<(String, String)>,
}

impl Recipe {
    pub(crate) fn parse(text: &str) -> Self {
        let mut recipe = Self { arguments: Vec::new(), stages: Vec::new() };
        let lines: Vec<&str> = text.lines().map(str::trim).filter(|line| !line.starts_with('#')).collect();
        for line in lines.join("\n").replace("\\\n", " ").lines() {
            let words: Vec<&str> = line.split_whitespace().collect();
            let Some((name, rest)) = words.split_first() else { continue };
            match (*name, recipe.stages.last_mut()) {
                ("FROM", _) => recipe.stages.push(Stage {
                    name: rest.last().unwrap().to_string(),
                    from: rest[0].to_owned(),
                    instructions: Vec::new(),
                }),
                ("ARG", None) => recipe.arguments.push(rest.join(" ")),
                (name, Some(stage)) => stage.instructions.push((name.to_owned(), rest.join(" "))),
                (name, None) => panic!("{name} before the first stage"),
            }
        }
        recipe
    }

    /// Returns the default of an argument before the first stage.
    pub(crate) fn argument(&self, name: &str) -> Option<String> {
        let pair = self.arguments.iter().find_map(|pair| pair.split_once('=').filter(|(n, _)| *n == name));
        pair.map(|(_, value)| value.to_owned())
    }

    #[track_caller]
    pub(crate) fn stage(&self, name: &str) -> &Stage {
        self.stages.iter().find(|stage| stage.name == name).unwrap_or_else(|| panic!("no stage {name}"))
    }
}

impl Stage {
    /// Returns the arguments of all instructions with this name.
    pub(crate) fn all<'a>(&'a self, name: &'a str) -> impl Iterator<Item = &'a String> {
        self.instructions.iter().filter(move |(n, _)| n == name).map(|(_, rest)| rest)
    }

    pub(crate) fn last<'a>(&'a self, name: &'a str) -> Option<&'a String> {
        self.all(name).last()
    }
}

/// Returns true if a `.dockerignore` does not exclude a file. The last pattern that matches the path or a parent
/// applies.
pub(crate) fn sent(ignore: &str, path: &Path) -> bool {
    let mut sent = true;
    for line in ignore.lines().map(str::trim).filter(|line| !line.is_empty() && !line.starts_with('#')) {
        let (keeps, pattern) = line.strip_prefix('!').map_or((false, line), |pattern| (true, pattern));
        if pattern == "*" || path.starts_with(pattern) {
            sent = keeps;
        }
    }
    sent
}

/// Returns all files below a folder, relative to the root.
pub(crate) fn files(folder: &str) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut folders = vec![PathBuf::from(folder)];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(root().join(&folder)).unwrap().map(Result::unwrap) {
            let path = folder.join(entry.file_name());
            if entry.file_type().unwrap().is_dir() { folders.push(path) } else { found.push(path) }
        }
    }
    found
}

/// Resolves `..` in a path.
pub(crate) fn plain(path: &Path) -> PathBuf {
    let mut plain = PathBuf::new();
    for part in path.components() {
        if part == Component::ParentDir {
            plain.pop();
        } else {
            plain.push(part);
        }
    }
    plain
}

/// Documents of a YAML file and the errors of its schema.
#[derive(Debug, Deserialize)]
pub(crate) struct Manifest {
    pub(crate) documents: Vec<Value>,
    pub(crate) errors: Vec<String>,
}

/// Returns the single document of each file.
#[track_caller]
pub(crate) fn only<const N: usize>(found: &[Manifest]) -> [&Value; N] {
    assert!(found.iter().all(|manifest| manifest.documents.len() == 1), "{found:?}");
    let documents: Vec<&Value> = found.iter().map(|manifest| &manifest.documents[0]).collect();
    documents.try_into().unwrap()
}

/// Reads YAML files by their paths relative to the root.
pub(crate) fn yaml(paths: &[impl AsRef<Path>]) -> Option<Vec<Manifest>> {
    let paths: Vec<PathBuf> = paths.iter().map(|path| root().join(path)).collect();
    tools::python("check_manifest.py", &paths)
}

/// Returns the results of `files` for the kustomizations of all folders below `folder`.
pub(crate) fn under(folder: &str, files: impl Fn(&Value, &Path) -> Vec<PathBuf>) -> Option<Vec<PathBuf>> {
    let mut folders: Vec<PathBuf> =
        std::fs::read_dir(root().join(folder)).unwrap().map(|e| e.unwrap().path()).filter(|p| p.is_dir()).collect();
    folders.sort();
    let found = yaml(&folders.iter().map(|folder| folder.join("kustomization.yaml")).collect::<Vec<_>>())?;
    let each = folders
        .iter()
        .zip(&found)
        .flat_map(|(folder, manifest)| files(&manifest.documents[0], folder.strip_prefix(root()).unwrap()));
    Some(each.collect())
}

/// Returns kind and name of every document in a folder, except kustomizations.
pub(crate) fn kinds(folder: &str) -> Option<Vec<(String, String)>> {
    let files: Vec<PathBuf> = std::fs::read_dir(root().join(folder)).unwrap().map(|e| e.unwrap().path()).collect();
    let files: Vec<PathBuf> = files
        .into_iter()
        .filter(|path| path.extension().is_some_and(|e| e == "yaml") && !path.ends_with("kustomization.yaml"))
        .collect();
    let text = |value: &Value| value.as_str().unwrap().to_owned();
    let found = yaml(&files)?;
    Some(found.iter().flat_map(|m| &m.documents).map(|d| (text(&d["kind"]), text(&d["metadata"]["name"]))).collect())
}

/// Returns the strings of a list, or none if the value is not a list.
pub(crate) fn strings(value: &Value) -> Vec<String> {
    value.as_array().into_iter().flatten().map(|v| v.as_str().unwrap().to_owned()).collect()
}

/// Parses a quantity of Kubernetes or Compose such as `5376Mi` or `10G`.
#[track_caller]
pub(crate) fn bytes(text: &str) -> u64 {
    let at = text.find(|c: char| !c.is_ascii_digit()).unwrap_or(text.len());
    let unit = match &text[at..] {
        "Ki" => 1 << 10,
        "Mi" => 1 << 20,
        "Gi" => 1 << 30,
        "G" => 1_000_000_000,
        other => panic!("{text}: unknown unit {other}"),
    };
    text[..at].parse::<u64>().unwrap() * unit
}

/// Returns the words in backticks that look like configuration keys: `section.key` with an existing section.
pub(crate) fn sections(text: &str, defaults: &Value) -> Vec<String> {
    let marked = text.split('`').skip(1).step_by(2).filter(|word| !word.contains(['/', ' ', '\n']));
    let keys = marked.filter(|word| word.split_once('.').is_some_and(|(section, _)| defaults.get(section).is_some()));
    keys.map(str::to_owned).collect()
}

/// Returns the value of `section.key`.
pub(crate) fn at<'a>(defaults: &'a Value, key: &str) -> Option<&'a Value> {
    let (section, key) = key.split_once('.')?;
    defaults.get(section)?.get(key)
}
