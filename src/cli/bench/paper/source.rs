//! Where a structure comes from: the user's folder, the sample that is built in, or made up.

use std::fs;
use std::path::{Path, PathBuf};

use molmesh::pipeline::JobError;
use molmesh::structure::{self, ReadLimits, Selection};
use molmesh::surface::Spheres;

use super::super::super::error::CliError;
use super::entries::Entry;
use super::standin;

/// The structure that is built in.
pub(super) const SAMPLE: &[u8] = include_bytes!("../../../../samples/4pti.pdb");
/// Its id.
const SAMPLE_ID: &str = "4PTI";
/// Extensions in order of preference.
const EXTENSIONS: [&str; 4] = ["pdb", "ent", "cif", "bcif"];

/// A structure of the tables, or what stands in for it.
#[derive(Debug)]
pub(super) struct Found {
    pub(super) spheres: Spheres,
    /// Where it comes from, in words.
    pub(super) source: String,
    /// Whether it is another structure than the row says.
    pub(super) stand_in: bool,
}

/// The structure of a row: its file in `folder`, the sample, or a stand-in.
///
/// # Errors
/// [`CliError`] where a file is there but holds no structure, or the folder cannot be read.
pub(super) fn find(entry: &Entry, folder: Option<&Path>) -> Result<Found, CliError> {
    if let Some(path) = file(folder, entry.id)? {
        let source = format!("file {}", name(&path));
        return Ok(Found { spheres: read(&path)?, source, stand_in: false });
    }
    if entry.id == SAMPLE_ID {
        let spheres = sample()?;
        return Ok(Found { spheres, source: "the built-in sample".to_owned(), stand_in: false });
    }
    // Haemoglobin as well, three atoms fewer.
    if entry.id == "1BIJ"
        && let Some(path) = file(folder, "2HHB")?
    {
        let source = format!("stand-in: 2HHB, file {}", name(&path));
        return Ok(Found { spheres: read(&path)?, source, stand_in: true });
    }
    let made = standin::sides(entry.cubes[0])
        .ok_or_else(|| format!("{} cubes are no box", entry.cubes[0]))
        .and_then(|sides| standin::spheres(entry.atoms, sides))
        .map_err(CliError::Internal)?;
    Ok(Found { spheres: made, source: "stand-in: made up".to_owned(), stand_in: true })
}

/// The atoms of the built-in sample.
///
/// # Errors
/// None that could be met: it is a good one.
pub(super) fn sample() -> Result<Spheres, CliError> {
    atoms("the built-in sample", SAMPLE)
}

fn read(path: &Path) -> Result<Spheres, CliError> {
    let shown = path.display().to_string();
    let bytes = fs::read(path).map_err(|source| CliError::Input { name: shown.clone(), source })?;
    atoms(&shown, &bytes)
}

/// ATOM records, as the paper counted.
fn atoms(name: &str, bytes: &[u8]) -> Result<Spheres, CliError> {
    let failed = |source: JobError| CliError::Job { name: name.to_owned(), source, opinion: None };
    let structure = structure::read(bytes, &ReadLimits::default()).map_err(|e| failed(e.into()))?;
    let selected = structure::select(&structure, &Selection::default()).map_err(|e| failed(e.into()))?;
    selected.spheres(&structure).map_err(|e| failed(e.into()))
}

fn name(path: &Path) -> String {
    path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default()
}

/// The file of an entry: `1abc`, `pdb1abc` or `pdb_00001abc` with an extension of ours, compressed or not, in any case.
pub(super) fn file(folder: Option<&Path>, id: &str) -> Result<Option<PathBuf>, CliError> {
    let Some(folder) = folder else { return Ok(None) };
    let failed = |source| CliError::Input { name: folder.display().to_string(), source };
    let id = id.to_lowercase();
    let stems = [id.clone(), format!("pdb{id}"), format!("pdb_0000{id}")];
    let mut found: Vec<(usize, PathBuf)> = Vec::new();
    for entry in fs::read_dir(folder).map_err(failed)? {
        let path = entry.map_err(failed)?.path();
        let name = name(&path).to_lowercase();
        let plain = name.strip_suffix(".gz").unwrap_or(&name);
        let Some((stem, extension)) = plain.rsplit_once('.') else { continue };
        let rank = EXTENSIONS.iter().position(|known| *known == extension);
        if let Some(rank) = rank.filter(|_| stems.iter().any(|s| s == stem)) {
            found.push((rank, path));
        }
    }
    Ok(found.into_iter().min().map(|(_, path)| path))
}

#[cfg(test)]
mod tests {
    use super::super::entries::ENTRIES;
    use super::*;

    fn of(id: &str) -> &'static Entry {
        ENTRIES.iter().find(|e| e.id == id).unwrap()
    }

    #[test]
    fn files_come_before_samples_and_samples_before_stand_ins() {
        let folder = tempfile::tempdir().unwrap();
        let found = |id: &str| find(of(id), Some(folder.path())).unwrap();
        assert_eq!((found("4PTI").spheres.len(), found("4PTI").stand_in), (454, false));
        assert_eq!((found("1BK2").spheres.len(), found("1BK2").stand_in), (468, true));
        assert_eq!((found("1BIJ").spheres.len(), found("1BIJ").source.as_str()), (4387, "stand-in: made up"));
        // What is in the file is taken for what its name says.
        for name in ["PDB1BK2.ENT", "2hhb.pdb", "pdb_00004pti.cif.txt", "1ql2_old.pdb"] {
            fs::write(folder.path().join(name), SAMPLE).unwrap();
        }
        assert_eq!((found("1BK2").source.as_str(), found("1BK2").stand_in), ("file PDB1BK2.ENT", false));
        assert_eq!((found("1BIJ").source.as_str(), found("1BIJ").stand_in), ("stand-in: 2HHB, file 2hhb.pdb", true));
        assert_eq!(found("4PTI").source, "the built-in sample");
        assert!(found("1QL2").stand_in);
        fs::write(folder.path().join("1bij.pdb"), SAMPLE).unwrap();
        assert!(!found("1BIJ").stand_in);
    }

    #[test]
    fn a_broken_file_and_a_missing_folder_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("1bk2.pdb.gz"), "no structure").unwrap();
        let code = |found: Result<Found, CliError>| found.unwrap_err().code();
        assert_eq!(code(find(of("1BK2"), Some(folder.path()))), 4);
        assert_eq!(code(find(of("1BK2"), Some(&folder.path().join("none")))), 3);
    }
}
