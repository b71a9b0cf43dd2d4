//! A local folder of structure files: entry id in, bytes out.
//!
//! Layouts: flat (`1abc.cif`, `1abc.pdb`, `pdb1abc.ent`, `1abc.bcif`), and that of the wwPDB's mirrors, divided by the two middle
//! characters (`ab/1abc.cif.gz`, `ab/pdb1abc.ent.gz`, also under `divided/mmCIF` and `divided/pdb`); every file with
//! `.gz` or without, mmCIF first, BinaryCIF last. Only a validated id ever becomes part of a path, and a file whose real place is not
//! in the folder (a link that leads out) does not exist here. Errors name ids, never paths.

use std::fs::File;
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::time::SystemTime;

use thiserror::Error;

/// Why an entry cannot be had.
#[derive(Debug, Error)]
pub enum ArchiveError {
    /// Not an entry's id.
    #[error("`{id}` is no PDB id; expected four characters such as 4pti, or pdb_ and eight such as pdb_00004pti")]
    BadId {
        /// What was given.
        id: String,
    },
    /// The folder has no such entry.
    #[error("entry {id} is not in the archive")]
    NotFound {
        /// The entry.
        id: EntryId,
    },
    /// The file is larger than allowed.
    #[error("entry {id} has {bytes} bytes, the limit is {limit}")]
    TooLarge {
        /// The entry.
        id: EntryId,
        /// Bytes of the file.
        bytes: u64,
        /// Bytes allowed.
        limit: u64,
    },
    /// The folder or the file cannot be read.
    #[error("the archive cannot be read")]
    Io(#[from] io::Error),
}

/// A valid id of a PDB entry, in lower case: `4pti`, or `pdb_00004pti` where four characters do not say it.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct EntryId(String);

impl EntryId {
    /// The id.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.0
    }

    /// The two characters by which mirrors divide: those before the last one, for ids of four the middle ones.
    #[must_use]
    pub fn middle(&self) -> &str {
        &self.0[self.0.len() - 3..self.0.len() - 1]
    }
}

impl std::fmt::Display for EntryId {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.0)
    }
}

impl FromStr for EntryId {
    type Err = ArchiveError;

    /// Accepts `^(?:[0-9][a-z0-9]{3}|pdb_[a-z0-9]{8})$` in any case. `pdb_00001abc` is `1abc`.
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let id = if text.len() <= 12 { text.to_ascii_lowercase() } else { String::new() };
        let plain = |s: &str| s.bytes().all(|b| b.is_ascii_digit() || b.is_ascii_lowercase());
        let short = |s: &str| s.len() == 4 && s.as_bytes()[0].is_ascii_digit() && plain(s);
        if short(&id) {
            return Ok(Self(id));
        }
        match id.strip_prefix("pdb_") {
            Some(rest) if rest.len() == 8 && plain(rest) => match rest.strip_prefix("0000") {
                Some(old) if short(old) => Ok(Self(old.to_owned())),
                _ => Ok(Self(id)),
            },
            _ => Err(ArchiveError::BadId { id: text.chars().take(40).collect() }),
        }
    }
}

/// A folder of structure files.
#[derive(Debug, Clone)]
pub struct Archive {
    dir: PathBuf,
    max_bytes: u64,
}

/// Largest file that is read if nothing else is said: the largest entries are below 1 GiB as text.
pub const MAX_BYTES: u64 = 4 << 30;

impl Archive {
    /// The folder `dir`, which may appear, vanish or change at any time.
    #[must_use]
    pub fn new(dir: impl Into<PathBuf>) -> Self {
        Self { dir: dir.into(), max_bytes: MAX_BYTES }
    }

    /// Refuses files of more than `bytes`, as they are on disk.
    #[must_use]
    pub fn with_max_bytes(self, bytes: u64) -> Self {
        Self { max_bytes: bytes, ..self }
    }

    /// The bytes of an entry's file as they are on disk, compressed or not. Blocks.
    ///
    /// # Errors
    /// Any [`ArchiveError`].
    pub fn fetch(&self, id: &EntryId) -> Result<Vec<u8>, ArchiveError> {
        let (file, stamp) = self.open(id)?;
        self.read(file, stamp.bytes, id)
    }

    /// The bytes of an entry's file and its stamp; none if the folder, or the entry in it, is not there. Blocks.
    ///
    /// # Errors
    /// [`ArchiveError::TooLarge`] and [`ArchiveError::Io`].
    pub fn fetch_stamped(&self, id: &EntryId) -> Result<Option<(Vec<u8>, Stamp)>, ArchiveError> {
        let Some((file, stamp)) = present(self.open(id))? else { return Ok(None) };
        Ok(Some((self.read(file, stamp.bytes, id)?, stamp)))
    }

    /// Which file is an entry's now, and how it looks, without reading it; none if it is not there. Blocks.
    ///
    /// # Errors
    /// [`ArchiveError::Io`].
    pub fn stamp(&self, id: &EntryId) -> Result<Option<Stamp>, ArchiveError> {
        Ok(present(self.open(id))?.map(|(_file, stamp)| stamp))
    }

    fn open(&self, id: &EntryId) -> Result<(File, Stamp), ArchiveError> {
        let root = self.dir.canonicalize()?;
        for path in candidates(id) {
            if let Some(file) = open_inside(&root, &path)? {
                let data = file.metadata()?;
                let stamp = Stamp { path, bytes: data.len(), modified: data.modified().ok() };
                return Ok((file, stamp));
            }
        }
        Err(ArchiveError::NotFound { id: id.clone() })
    }

    fn read(&self, file: File, bytes: u64, id: &EntryId) -> Result<Vec<u8>, ArchiveError> {
        let too_large = |bytes| ArchiveError::TooLarge { id: id.clone(), bytes, limit: self.max_bytes };
        if bytes > self.max_bytes {
            return Err(too_large(bytes));
        }
        let mut out = Vec::with_capacity(usize::try_from(bytes).unwrap_or(0));
        // The file may grow while it is read.
        file.take(self.max_bytes.saturating_add(1)).read_to_end(&mut out)?;
        if out.len() as u64 > self.max_bytes {
            return Err(too_large(out.len() as u64));
        }
        Ok(out)
    }
}

/// Which file an entry's bytes came from, and how it looked: its place, length and time of change. While that stays
/// the same, so do the bytes, for all that the system says.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Stamp {
    path: PathBuf,
    bytes: u64,
    modified: Option<SystemTime>,
}

/// None in place of the errors that say no more than that nothing is there.
fn present<T>(found: Result<T, ArchiveError>) -> Result<Option<T>, ArchiveError> {
    match found {
        Ok(found) => Ok(Some(found)),
        Err(ArchiveError::NotFound { .. }) => Ok(None),
        Err(ArchiveError::Io(e)) if is_absent(&e) => Ok(None),
        Err(error) => Err(error),
    }
}

/// Places where an entry's file may be, relative to the folder, in order of preference.
fn candidates(id: &EntryId) -> Vec<PathBuf> {
    let (id, middle) = (id.as_str(), id.middle());
    let long = id.strip_prefix("pdb_");
    let mut names = vec![(format!("{id}.cif"), "mmCIF")];
    if long.is_none() {
        names.push((format!("pdb_0000{id}.cif"), "mmCIF"));
        // Extended ids have no file in the PDB format.
        names.push((format!("{id}.pdb"), "pdb"));
        names.push((format!("pdb{id}.ent"), "pdb"));
    }
    names.push((format!("{id}.bcif"), "bcif"));
    if long.is_none() {
        names.push((format!("pdb_0000{id}.bcif"), "bcif"));
    }
    let mut out = Vec::new();
    for (name, kind) in names {
        for suffix in ["", ".gz"] {
            let file = format!("{name}{suffix}");
            out.push(PathBuf::from(&file));
            out.push(Path::new(middle).join(&file));
            out.push(Path::new("divided").join(kind).join(middle).join(&file));
        }
    }
    out
}

/// Opens `root/candidate` if it is a file whose real place is inside `root`.
fn open_inside(root: &Path, candidate: &Path) -> io::Result<Option<File>> {
    let real = match root.join(candidate).canonicalize() {
        Ok(real) => real,
        Err(e) if is_absent(&e) => return Ok(None),
        Err(e) => return Err(e),
    };
    if !real.starts_with(root) {
        return Ok(None);
    }
    // Asked before it is opened: opening a pipe waits for its other end.
    match std::fs::metadata(&real).and_then(|data| if data.is_file() { File::open(&real).map(Some) } else { Ok(None) })
    {
        Err(e) if is_absent(&e) => Ok(None),
        file => file,
    }
}

/// A missing file, a file where a folder would have to be, a link that leads nowhere.
fn is_absent(e: &io::Error) -> bool {
    matches!(e.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory)
}
