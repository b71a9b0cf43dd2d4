//! Inputs of a batch: names on the command line, the files of folders and the lines of lists, with their output names.

use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use molmesh::structure::ReadLimits;
use molmesh::surface::Limit;

use super::super::args::BatchArgs;
use super::super::error::CliError;
use super::super::job::{self, name_of};
use super::super::output::{self, is_stdio};

/// Extensions of the structure files in a folder.
const STRUCTURES: [&str; 7] = ["pdb", "ent", "cif", "mmcif", "bcif", "pqr", "xyz"];
/// Extensions of compressed files, after those of their content.
const COMPRESSED: [&str; 3] = ["gz", "zst", "zstd"];

/// Input of a batch.
#[derive(Debug, PartialEq)]
pub(crate) struct BatchItem {
    pub(crate) input: PathBuf,
    /// Path of the output files without their extension, relative to the folder of the batch.
    stem: PathBuf,
}

impl BatchItem {
    /// Returns the item of the file `input`, whose output is in the subfolder `place`.
    fn new(input: PathBuf, place: &Path) -> Self {
        let stem = place.join(stem(&input));
        Self { input, stem }
    }

    /// Returns the path of the output with this extension.
    pub(crate) fn output(&self, folder: &Path, extension: &str) -> PathBuf {
        let mut path = folder.join(&self.stem).into_os_string();
        path.push(".");
        path.push(extension);
        path.into()
    }
}

/// Returns true if the flags name several inputs, or a folder for the outputs. `is_extended` is true if other flags
/// need a folder, and `is_file` if the name of an output is that of a file.
pub(crate) fn is_batch(
    inputs: &[PathBuf],
    args: &BatchArgs,
    is_extended: bool,
    output: &Path,
    is_file: impl Fn(&Path) -> bool,
) -> bool {
    let names_folder = || output::ends_in_slash(output) || (output.is_dir() && !is_file(output));
    args.is_given() || is_extended || inputs.len() != 1 || inputs[0].is_dir() || names_folder()
}

/// Returns all inputs, those of each folder sorted by name.
///
/// # Errors
/// Returns [`CliError::Input`] if a list or a folder cannot be read, or there are no inputs, and [`CliError::Usage`]
/// for stdin as an input.
pub(crate) fn collect(inputs: &[PathBuf], list: Option<&Path>) -> Result<Vec<BatchItem>, CliError> {
    let listed = list.map(read_list).transpose()?.unwrap_or_default();
    let mut items = Vec::new();
    for input in inputs.iter().chain(&listed) {
        if is_stdio(input) {
            let message = "stdin is a single structure, which is written to one file";
            return Err(CliError::usage_with_hint(message, "name a file with -o, without options for several files"));
        }
        if input.is_dir() {
            let before = items.len();
            add_folder(input, Path::new(""), &mut items)?;
            if items.len() == before {
                let expected = format!("no file has one of the extensions {}", STRUCTURES.join(", "));
                return Err(CliError::Input { name: name_of(input), source: io::Error::other(expected) });
            }
        } else {
            // A missing file is an error of this file only.
            items.push(BatchItem::new(input.clone(), Path::new("")));
        }
    }
    match list {
        Some(list) if items.is_empty() => {
            Err(CliError::Input { name: name_of(list), source: io::Error::other("the list is empty") })
        }
        _ => Ok(items),
    }
}

/// Reads a list of paths, one per line.
fn read_list(list: &Path) -> Result<Vec<PathBuf>, CliError> {
    let bytes = job::read(list, Limit::InflatedBytes, ReadLimits::default().max_inflated_bytes)?;
    let text = String::from_utf8(bytes).map_err(|error| {
        let source = io::Error::new(io::ErrorKind::InvalidData, error);
        CliError::Input { name: name_of(list), source }
    })?;
    let text = text.strip_prefix('\u{feff}').unwrap_or(&text);
    let paths = text.lines().map(|line| line.trim_end_matches('\r')).filter(|line| !line.trim().is_empty());
    Ok(paths.map(PathBuf::from).collect())
}

/// Adds the structure files of a folder and of its subfolders, which are `place` below the named folder. Hidden
/// entries, links to folders, which may form a cycle, and pipes are left out.
fn add_folder(folder: &Path, place: &Path, items: &mut Vec<BatchItem>) -> Result<(), CliError> {
    let failed = |source| CliError::Input { name: name_of(folder), source };
    let mut entries = fs::read_dir(folder).and_then(Iterator::collect::<io::Result<Vec<_>>>).map_err(failed)?;
    entries.sort_by_key(fs::DirEntry::file_name);
    for entry in entries {
        let (path, name) = (entry.path(), entry.file_name());
        if name.as_encoded_bytes().starts_with(b".") {
            continue;
        }
        if entry.file_type().map_err(failed)?.is_dir() {
            add_folder(&path, &place.join(name), items)?;
        } else if is_structure(&path) && path.is_file() {
            items.push(BatchItem::new(path, place));
        }
    }
    Ok(())
}

fn has_extension(path: &Path, extensions: &[&str]) -> bool {
    path.extension().is_some_and(|found| extensions.iter().any(|known| found.eq_ignore_ascii_case(known)))
}

/// Returns the path without the extension of a compression.
fn inflated(path: &Path) -> PathBuf {
    if has_extension(path, &COMPRESSED) { path.with_extension("") } else { path.to_owned() }
}

fn is_structure(path: &Path) -> bool {
    has_extension(&inflated(path), &STRUCTURES)
}

/// Returns the name of a file without its folder and extensions.
fn stem(input: &Path) -> PathBuf {
    inflated(input).file_stem().map_or_else(PathBuf::new, PathBuf::from)
}

/// Rejects inputs whose outputs are the same file, and outputs that would replace an input. `others` are the other
/// outputs of the command.
pub(crate) fn check_outputs(
    items: &[BatchItem],
    folder: Option<&Path>,
    extensions: &[&str],
    others: &[&Path],
) -> Result<(), CliError> {
    let mut writers: HashMap<PathBuf, &Path> = HashMap::new();
    // There may be many files, but few folders.
    let mut folders: HashMap<PathBuf, PathBuf> = HashMap::new();
    let mut place = |path: &Path| match (path.parent(), path.file_name()) {
        (Some(parent), Some(name)) if !path.is_symlink() => {
            let parent = folders.entry(parent.to_owned()).or_insert_with(|| output::place(parent));
            output::fold_case(parent.join(name))
        }
        _ => output::place(path),
    };
    for item in items {
        for other in others {
            output::refuse_input(&item.input, other)?;
        }
        let Some(folder) = folder else { continue };
        for extension in extensions {
            let path = item.output(folder, extension);
            output::refuse_input(&item.input, &path)?;
            match writers.entry(place(&path)) {
                Entry::Vacant(entry) => drop(entry.insert(&item.input)),
                Entry::Occupied(entry) => {
                    let (first, second) = (entry.get(), &item.input);
                    let (output, is_same) = (path.display(), output::place(first) == output::place(second));
                    let (first, second) = (first.display(), second.display());
                    let message = format!("`{first}` and `{second}` would both be written to `{output}`");
                    let hint = if is_same {
                        "name each file once"
                    } else {
                        "name the folder that contains both, whose subfolders are kept, or run them separately"
                    };
                    return Err(CliError::usage_with_hint(message, hint));
                }
            }
        }
    }
    let is_written = |other: &&&Path| !is_stdio(other) && writers.contains_key(&output::place(other));
    others.iter().find(is_written).map_or(Ok(()), |other| Err(output::same_outputs(other)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn item(input: &str, place: &str) -> BatchItem {
        BatchItem::new(input.into(), Path::new(place))
    }

    #[test]
    fn outputs_have_the_stem_of_their_input() {
        for (input, place, expected) in [
            ("a/1crn.cif", "", "out/1crn.glb"),
            ("1crn.cif.gz", "", "out/1crn.glb"),
            ("1crn.PDB.ZST", "sub", "out/sub/1crn.glb"),
            ("AF-P1-F1-model_v4.1.cif", "", "out/AF-P1-F1-model_v4.1.glb"),
            ("plain", "", "out/plain.glb"),
        ] {
            assert_eq!(item(input, place).output(Path::new("out"), "glb"), Path::new(expected), "{input}");
        }
    }

    #[test]
    fn folders_are_searched_for_structures() {
        let folder = tempfile::tempdir().unwrap();
        fs::create_dir_all(folder.path().join("b/c")).unwrap();
        for name in ["z.pdb", "a.cif.gz", "b/c/a.bcif", "README.md", "b/x.glb", ".hidden.pdb", "y.gz"] {
            fs::write(folder.path().join(name), "").unwrap();
        }
        let items = collect(&[folder.path().to_owned()], None).unwrap();
        let names: Vec<_> = items.iter().map(|item| item.output(Path::new("out"), "ply")).collect();
        assert_eq!(names, ["out/a.ply", "out/b/c/a.ply", "out/z.ply"].map(PathBuf::from));
        let twice = [folder.path().join("z.pdb"), folder.path().join("b/../z.pdb")];
        let twice = collect(&twice, None).unwrap();
        let error = check_outputs(&twice, Some(Path::new("out")), &["ply"], &[]).unwrap_err();
        assert_eq!(error.hint().as_deref(), Some("name each file once"));
        let empty = folder.path().join("b/d");
        fs::create_dir(&empty).unwrap();
        assert_eq!(collect(&[empty], None).unwrap_err().code(), 3);
    }

    #[test]
    fn equal_names_are_rejected() {
        let check = |items: &[BatchItem], others: &[&str]| {
            let others: Vec<&Path> = others.iter().map(Path::new).collect();
            check_outputs(items, Some(Path::new("out")), &["glb", "csv"], &others)
        };
        assert!(check(&[item("a.pdb", ""), item("b/a.pdb", "b")], &["out/all.csv"]).is_ok());
        let error = check(&[item("a.pdb", ""), item("b/a.cif.gz", "")], &[]).unwrap_err();
        assert!(error.to_string().contains("`a.pdb` and `b/a.cif.gz` would both be written to `out/a.glb`"), "{error}");
        for other in ["out/a.csv", "./out/a.csv", "out//a.csv"] {
            assert_eq!(check(&[item("a.pdb", "")], &[other]).unwrap_err().code(), 2, "{other}");
        }
    }
}
