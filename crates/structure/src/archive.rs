//! Local folder of structure files, read by entry id.
//!
//! Supported layouts: flat (`1abc.cif`, `1abc.pdb`, `pdb1abc.ent`, `1abc.bcif`), and that of wwPDB mirrors, divided by
//! the two middle characters (`ab/1abc.cif.gz`, `ab/pdb1abc.ent.gz`, also under `divided/mmCIF` and `divided/pdb`).
//! Every file may have the suffix `.gz`. mmCIF is preferred, BinaryCIF comes last. Only a validated id becomes part of
//! a path. A symbolic link that points outside the folder is treated as absent. Errors name ids, never paths.

use std::fs::File;
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::time::SystemTime;

use molmesh_surface::{Exceeded, Limit};
use thiserror::Error;

/// Errors of fetching an entry.
#[derive(Debug, Error)]
pub enum ArchiveError {
    /// The text is not an entry id.
    #[error(
        "`{id}` is not a PDB id; expected a digit and three letters or digits such as 4pti, or pdb_ and eight such as pdb_00004pti"
    )]
    BadId {
        /// The text that was given.
        id: String,
    },
    /// The file is larger than allowed.
    #[error(transparent)]
    Limit(#[from] Box<Exceeded>),
    /// The folder or the file cannot be read.
    #[error("the archive cannot be read")]
    Io(#[from] io::Error),
}

/// A valid PDB entry id in lower case: `4pti`, or the extended form `pdb_1abc2def` if there is no short one.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct EntryId(String);

impl EntryId {
    /// Returns the id.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.0
    }

    /// Returns the two characters before the last one, by which mirrors divide their folders.
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

    /// Accepts `^(?:[0-9][a-z0-9]{3}|pdb_[a-z0-9]{8})$` in any case. `pdb_00001abc` becomes `1abc`.
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

/// Bytes that are read at once.
const READ_BYTES: usize = 1 << 18;
/// Default limit of file sizes. The largest entries are below 1 GiB as text.
const MAX_BYTES: u64 = 4 << 30;

impl Archive {
    /// Creates an archive over the folder `dir`, which may appear, vanish or change at any time.
    #[must_use]
    pub fn new(dir: impl Into<PathBuf>) -> Self {
        Self { dir: dir.into(), max_bytes: MAX_BYTES }
    }

    /// Sets the maximum file size on disk, bytes.
    #[must_use]
    pub fn with_max_bytes(self, bytes: u64) -> Self {
        Self { max_bytes: bytes, ..self }
    }

    /// Reads the file of an entry, without decompressing it, and its stamp. Returns `None` if the folder or the entry
    /// does not exist. Blocks.
    ///
    /// # Errors
    /// [`ArchiveError::Limit`] and [`ArchiveError::Io`].
    pub fn fetch(&self, id: &EntryId) -> Result<Option<(Vec<u8>, Stamp)>, ArchiveError> {
        let Some(mut opened) = self.open(id)? else { return Ok(None) };
        let bytes = opened.read_all()?;
        Ok(Some((bytes, opened.stamp)))
    }

    /// Returns the stamp of an entry's file without reading it, or `None` if it does not exist. Blocks.
    ///
    /// # Errors
    /// [`ArchiveError::Io`].
    pub fn stamp(&self, id: &EntryId) -> Result<Option<Stamp>, ArchiveError> {
        Ok(self.find(id)?.map(|opened| opened.stamp))
    }

    /// Opens the file of an entry, or returns `None` if it does not exist. Blocks.
    ///
    /// # Errors
    /// [`ArchiveError::Limit`] and [`ArchiveError::Io`].
    pub fn open(&self, id: &EntryId) -> Result<Option<Opened>, ArchiveError> {
        let (found, limit) = (self.find(id)?, self.max_bytes);
        match found.as_ref().map(|opened| opened.stamp.bytes).filter(|bytes| *bytes > limit) {
            Some(bytes) => {
                let (subject, actual) = (format!("entry {id}").into(), Some(bytes));
                Err(Exceeded { subject, actual, ..Exceeded::new(Limit::InflatedBytes, limit) }.error())
            }
            None => Ok(found),
        }
    }

    fn find(&self, id: &EntryId) -> io::Result<Option<Opened>> {
        let root = match self.dir.canonicalize() {
            Err(e) if is_absent(&e) => return Ok(None),
            root => root?,
        };
        for path in candidates(id) {
            if let Some(file) = open_inside(&root, &path)? {
                let data = file.metadata()?;
                let stamp = Stamp { path, bytes: data.len(), modified: data.modified().ok() };
                return Ok(Some(Opened { file, stamp }));
            }
        }
        Ok(None)
    }
}

/// Open file of an entry.
#[derive(Debug)]
pub struct Opened {
    file: File,
    /// Stamp when the file was opened.
    pub stamp: Stamp,
}

impl Opened {
    /// Reads the whole file, whose length is that of the stamp. Blocks.
    ///
    /// # Errors
    /// [`ArchiveError::Io`], including if the length has changed.
    pub fn read_all(&mut self) -> Result<Vec<u8>, ArchiveError> {
        let mut bytes = Vec::with_capacity(usize::try_from(self.stamp.bytes).unwrap_or(0));
        self.read_in_parts(|part| bytes.extend_from_slice(part))?;
        Ok(bytes)
    }

    /// Reads the file like [`Self::read_all`], but part by part.
    ///
    /// # Errors
    /// Those of [`Self::read_all`].
    pub fn read_in_parts(&mut self, mut use_part: impl FnMut(&[u8])) -> Result<(), ArchiveError> {
        let (mut buffer, mut left) = (vec![0; READ_BYTES], self.stamp.bytes);
        loop {
            let n = match self.file.read(&mut buffer) {
                Err(e) if e.kind() == io::ErrorKind::Interrupted => continue,
                n => n?,
            };
            // The file may change while it is read. Memory is reserved for the length in the stamp.
            left = match left.checked_sub(n as u64) {
                Some(0) if n == 0 => return Ok(()),
                Some(left) if n > 0 => left,
                _ => return Err(io::Error::other("the file changed while it was read").into()),
            };
            use_part(&buffer[..n]);
        }
    }
}

/// Identity of an entry's file: path, length and modification time. Equal stamps are assumed to mean equal content.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Stamp {
    path: PathBuf,
    bytes: u64,
    modified: Option<SystemTime>,
}

impl Stamp {
    /// Returns the length of the file, bytes.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        self.bytes
    }
}

/// Returns candidate paths of an entry's file, relative to the folder, in order of preference.
fn candidates(id: &EntryId) -> Vec<PathBuf> {
    let (id, middle) = (id.as_str(), id.middle());
    let long = id.strip_prefix("pdb_");
    let mut names = vec![(format!("{id}.cif"), "mmCIF")];
    if long.is_none() {
        names.push((format!("pdb_0000{id}.cif"), "mmCIF"));
        // Entries with an extended id have no file in PDB format.
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

/// Opens `root/candidate` if it is a regular file whose canonical path is inside `root`.
fn open_inside(root: &Path, candidate: &Path) -> io::Result<Option<File>> {
    let real = match root.join(candidate).canonicalize() {
        Ok(real) => real,
        Err(e) if is_absent(&e) => return Ok(None),
        Err(e) => return Err(e),
    };
    if !real.starts_with(root) {
        return Ok(None);
    }
    // Checked before opening, because opening a named pipe blocks.
    match std::fs::metadata(&real).and_then(|data| if data.is_file() { File::open(&real).map(Some) } else { Ok(None) })
    {
        Err(e) if is_absent(&e) => Ok(None),
        file => file,
    }
}

/// Returns true for errors that mean "not found": a missing file, a file in place of a folder, a dangling link.
fn is_absent(e: &io::Error) -> bool {
    matches!(e.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory)
}
