//! Validated object names. Every path that depends on client input is built here.

use std::fmt;
use std::sync::Arc;

use object_store::path::Path;
use thiserror::Error;

use super::{Digest, Namespace};

/// Error for a name that is too long or has invalid characters.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
#[error("not a valid object name: {0}")]
pub struct BadName(&'static str);

/// Folder of an object, which determines its time to live.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Folder {
    /// Uploaded structure files, by digest.
    Inputs,
    /// Records of jobs and batches, by id. The records of ended jobs have names of their own.
    Jobs,
    /// Mesh files and reports, by content key.
    Results,
}

impl Folder {
    /// All folders.
    pub const ALL: [Self; 3] = [Self::Inputs, Self::Jobs, Self::Results];

    /// Returns the name of the folder, which is also a metric label.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Inputs => "inputs",
            Self::Jobs => "jobs",
            Self::Results => "results",
        }
    }

    /// Returns true if its objects count against `store.max_bytes`.
    pub(super) fn is_capped(self) -> bool {
        self != Self::Jobs
    }
}

/// End of the file name of an open job's record.
const OPEN: &str = ".json";
/// End of the file name of an ended job's record.
const ENDED: &str = ".ended.json";
/// End of the file name of a batch's record.
const BATCH: &str = ".batch.json";
/// Digits of a job id that name its client.
pub(crate) const OWNER_DIGITS: usize = 8;

/// Name of an object: a folder, and a file name of lower-case letters, digits, `-` and `.`.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Name {
    folder: Folder,
    /// Shared, because the index holds each name several times.
    file: Arc<str>,
}

impl Name {
    /// Returns the name of an uploaded structure file.
    #[must_use]
    pub fn input(digest: &Digest) -> Self {
        Self { folder: Folder::Inputs, file: digest.to_string().into() }
    }

    /// Returns the name of a job record.
    ///
    /// # Errors
    /// Returns [`BadName`] unless the id has 1 to 64 lower-case hexadecimal digits.
    pub fn job(id: &str) -> Result<Self, BadName> {
        Self::job_record(id, OPEN)
    }

    /// Returns the name of the record of an ended job, which replaces the other one.
    ///
    /// # Errors
    /// As for [`job`](Self::job).
    pub fn ended_job(id: &str) -> Result<Self, BadName> {
        Self::job_record(id, ENDED)
    }

    /// Returns the name of the record of a batch of jobs.
    ///
    /// # Errors
    /// As for [`job`](Self::job).
    pub fn batch(id: &str) -> Result<Self, BadName> {
        Self::job_record(id, BATCH)
    }

    fn job_record(id: &str, extension: &str) -> Result<Self, BadName> {
        let good = |c: u8| matches!(c, b'0'..=b'9' | b'a'..=b'f');
        if id.is_empty() || id.len() > 64 || !id.bytes().all(good) {
            return Err(BadName("a job's id has 1 to 64 hexadecimal digits in lower case"));
        }
        Ok(Self { folder: Folder::Jobs, file: format!("{id}{extension}").into() })
    }

    /// Returns true for the record of an ended job.
    pub(crate) fn is_ended_job(&self) -> bool {
        self.folder == Folder::Jobs && self.file.ends_with(ENDED)
    }

    /// Returns true for the record of a batch.
    pub(crate) fn is_batch(&self) -> bool {
        self.folder == Folder::Jobs && self.file.ends_with(BATCH)
    }

    /// Returns the file name up to its first dot: the id of a job, or the key of a result.
    pub(crate) fn stem(&self) -> &str {
        self.file.split('.').next().unwrap_or_default()
    }

    /// Returns the number of the client of a job: the last eight digits of its id.
    pub(super) fn owner(&self) -> u32 {
        let id = self.stem();
        u32::from_str_radix(&id[id.len().saturating_sub(OWNER_DIGITS)..], 16).unwrap_or_default()
    }

    /// Returns the name of a result, by content key (64 lower-case hexadecimal digits) and extension.
    ///
    /// # Errors
    /// Returns [`BadName`] unless the extension has 1 to 16 lower-case letters and digits, with single dots or
    /// hyphens between them.
    pub fn result(key: &str, extension: &str) -> Result<Self, BadName> {
        let _digest: Digest = key.parse().map_err(|_bad| BadName("a key has 64 hexadecimal digits in lower case"))?;
        let good =
            |part: &str| !part.is_empty() && part.bytes().all(|c: u8| c.is_ascii_digit() || c.is_ascii_lowercase());
        if extension.len() > 16 || !extension.split(['.', '-']).all(good) {
            return Err(BadName(
                "an extension has 1 to 16 lower-case letters and digits, with single dots or hyphens between",
            ));
        }
        Ok(Self { folder: Folder::Results, file: format!("{key}.{extension}").into() })
    }

    /// Returns the name of an input or a result in a namespace. Job records hold the namespace of their job.
    #[must_use]
    pub fn within(self, namespace: Namespace) -> Self {
        let (stem, rest) = self.file.split_at(self.file.find('.').unwrap_or(self.file.len()));
        Self { folder: self.folder, file: format!("{}{rest}", namespace.stem(stem)).into() }
    }

    /// Returns a name before those of all objects of a folder.
    pub(super) fn before(folder: Folder) -> Self {
        Self { folder, file: "".into() }
    }

    /// Returns the folder.
    #[must_use]
    pub fn folder(&self) -> Folder {
        self.folder
    }

    /// Returns the name of the group of objects that are used, pinned and removed together: a mesh and its report, or
    /// the records of a job. An input is a group of its own.
    pub(super) fn group(&self) -> Self {
        Self { folder: self.folder, file: self.stem().into() }
    }

    /// Returns the path relative to the root of the store.
    pub(super) fn path(&self) -> Path {
        Path::from_iter([self.folder.as_str(), &self.file])
    }

    /// Parses a file name in a folder. Returns `None` for files that the store does not write.
    pub(super) fn from_file_name(folder: Folder, file: &str) -> Option<Self> {
        match folder {
            Folder::Inputs => file.parse().ok().map(|digest| Self::input(&digest)),
            Folder::Jobs => match (file.strip_suffix(ENDED), file.strip_suffix(BATCH)) {
                (Some(id), _) => Self::ended_job(id).ok(),
                (None, Some(id)) => Self::batch(id).ok(),
                (None, None) => Self::job(file.strip_suffix(OPEN)?).ok(),
            },
            Folder::Results => file.split_once('.').and_then(|(key, extension)| Self::result(key, extension).ok()),
        }
    }

    /// Parses a path relative to the root of the store.
    pub(super) fn from_path(path: &str) -> Option<Self> {
        let (folder, file) = path.split_once('/')?;
        Folder::ALL.into_iter().find(|f| f.as_str() == folder).and_then(|folder| Self::from_file_name(folder, file))
    }
}

impl fmt::Display for Name {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.folder.as_str(), self.file)
    }
}
