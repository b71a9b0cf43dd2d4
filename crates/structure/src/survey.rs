//! Count of the entries in a folder of structure files, by file names.

use std::collections::BTreeSet;
use std::io;
use std::path::{Path, PathBuf};

use super::archive::EntryId;

/// Entries of a folder.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Survey {
    /// Number of entries with at least one file.
    pub entries: usize,
    /// True if counting stopped at the limit, so there may be more.
    pub more: bool,
    /// First entry in the order of ids.
    pub first: Option<EntryId>,
}

/// Counts the entries of a folder in any supported layout, at most `most`. Reads only file names. Blocks.
///
/// # Errors
/// Returns the path of the first folder that cannot be listed, and the system error.
pub fn survey(dir: &Path, most: usize) -> Result<Survey, (PathBuf, io::Error)> {
    let mut found = BTreeSet::new();
    let mut folders = files(dir, &mut found, most)?;
    let divided = dir.join("divided");
    for kind in ["mmCIF", "pdb"].map(|kind| divided.join(kind)).into_iter().filter(|kind| kind.is_dir()) {
        folders.extend(files(&kind, &mut BTreeSet::new(), most)?);
    }
    for folder in folders {
        if found.len() >= most {
            break;
        }
        files(&folder, &mut found, most)?;
    }
    Ok(Survey { entries: found.len(), more: found.len() >= most, first: found.into_iter().next() })
}

/// Adds the entries whose files are in `dir`. Returns the subfolders with names of two characters.
fn files(dir: &Path, found: &mut BTreeSet<EntryId>, most: usize) -> Result<Vec<PathBuf>, (PathBuf, io::Error)> {
    let fail = |e| (dir.to_owned(), e);
    let mut folders = Vec::new();
    for entry in std::fs::read_dir(dir).map_err(fail)? {
        let entry = entry.map_err(fail)?;
        let name = entry.file_name();
        let Some(name) = name.to_str() else { continue };
        if name.len() == 2 && entry.path().is_dir() {
            folders.push(entry.path());
        } else if let Some(id) = entry_of(name)
            && found.len() < most
        {
            found.insert(id);
        }
    }
    Ok(folders)
}

/// Returns the entry id of a file name.
fn entry_of(name: &str) -> Option<EntryId> {
    let plain = name.strip_suffix(".gz").unwrap_or(name);
    let old = |id: &str| (id.len() == 4).then(|| id.parse().ok()).flatten();
    let id = match plain.rsplit_once('.')? {
        (id, "cif") => id.parse().ok(),
        (id, "pdb") => old(id),
        (rest, "ent") => old(rest.strip_prefix("pdb")?),
        _ => None,
    }?;
    // The archive looks up only lower-case names.
    (!plain.bytes().any(|b| b.is_ascii_uppercase())).then_some(id)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_those_that_are_looked_for() {
        let id = |name: &str| entry_of(name).map(|id| id.to_string());
        for name in ["4pti.cif", "4pti.cif.gz", "4pti.pdb", "pdb4pti.ent.gz", "pdb_00004pti.cif"] {
            assert_eq!(id(name).as_deref(), Some("4pti"), "{name}");
        }
        assert_eq!(id("pdb_12345678.cif").as_deref(), Some("pdb_12345678"));
        for name in
            ["4pti", "4pti.ent", "pdb4pti.pdb", "README.md", "4PTI.cif", "4pti.cif.bz2", ".cif", "pdb_12345678.pdb"]
        {
            assert_eq!(id(name), None, "{name}");
        }
    }

    #[test]
    fn every_layout_is_counted_and_an_entry_once() {
        let dir = tempfile::tempdir().unwrap();
        let file = |path: &str| {
            let path = dir.path().join(path);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, "").unwrap();
        };
        assert_eq!(survey(dir.path(), 9).unwrap(), Survey::default());
        for path in
            ["4pti.cif", "pt/4pti.cif.gz", "cr/1crn.cif", "divided/pdb/gb/pdb1gbt.ent.gz", "notes.txt", "ab/x/2abc.cif"]
        {
            file(path);
        }
        let found = survey(dir.path(), 9).unwrap();
        assert_eq!((found.entries, found.more, found.first.unwrap().as_str()), (3, false, "1crn"));
        assert!(survey(dir.path(), 2).unwrap().more);
        let (path, error) = survey(&dir.path().join("none"), 9).unwrap_err();
        assert!(path.ends_with("none") && error.kind() == io::ErrorKind::NotFound);
    }
}
