//! Names of what is kept. There is no way from a text of a client to a path that does not lead through here.

use std::fmt;

use object_store::path::Path;
use thiserror::Error;

use super::Digest;

/// Not a name: it would be too long, or have characters that names do not have.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
#[error("not the name of anything that is kept: {0}")]
pub struct BadName(&'static str);

/// Where an object lies, and so how long it is kept.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Folder {
    /// Structure files as they came, by their digest.
    Inputs,
    /// Documents of jobs, by the job's id.
    Jobs,
    /// Mesh files and reports, by their content key.
    Results,
}

impl Folder {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::Inputs, Self::Jobs, Self::Results];

    /// The name of the folder, also the label of metrics.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Inputs => "inputs",
            Self::Jobs => "jobs",
            Self::Results => "results",
        }
    }

    /// Whether its bytes count against `store.max_bytes`.
    #[must_use]
    pub fn is_capped(self) -> bool {
        self != Self::Jobs
    }
}

/// The name of an object: a folder, and a file name of lower-case letters, digits, `-` and `.`.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Name {
    folder: Folder,
    file: Box<str>,
}

impl Name {
    /// A structure file as it came.
    #[must_use]
    pub fn input(digest: &Digest) -> Self {
        Self { folder: Folder::Inputs, file: digest.to_string().into() }
    }

    /// The document of a job.
    ///
    /// # Errors
    /// An id has 1 to 64 characters: lower-case hexadecimal digits and dashes.
    pub fn job(id: &str) -> Result<Self, BadName> {
        let good = |c: u8| matches!(c, b'0'..=b'9' | b'a'..=b'f' | b'-');
        if id.is_empty() || id.len() > 64 || !id.bytes().all(good) {
            return Err(BadName("a job's id has 1 to 64 hexadecimal digits in lower case, or dashes"));
        }
        Ok(Self { folder: Folder::Jobs, file: format!("{id}.json").into() })
    }

    /// A file that was computed, by its content key (64 hexadecimal digits in lower case) and its extension.
    ///
    /// # Errors
    /// An extension has 1 to 16 characters: lower-case letters and digits, with single dots between them.
    pub fn result(key: &str, extension: &str) -> Result<Self, BadName> {
        let _digest: Digest = key.parse().map_err(|_bad| BadName("a key has 64 hexadecimal digits in lower case"))?;
        let good =
            |part: &str| !part.is_empty() && part.bytes().all(|c: u8| c.is_ascii_digit() || c.is_ascii_lowercase());
        if extension.len() > 16 || !extension.split('.').all(good) {
            return Err(BadName("an extension has 1 to 16 lower-case letters and digits, with single dots between"));
        }
        Ok(Self { folder: Folder::Results, file: format!("{key}.{extension}").into() })
    }

    /// Where it lies.
    #[must_use]
    pub fn folder(&self) -> Folder {
        self.folder
    }

    /// Without its folder.
    #[must_use]
    pub fn file(&self) -> &str {
        &self.file
    }

    /// Its path from the root of the store.
    pub(super) fn path(&self) -> Path {
        Path::from_iter([self.folder.as_str(), &self.file])
    }

    /// The name that has this file name in this folder. `None`: nothing that we would have written.
    pub(super) fn read(folder: Folder, file: &str) -> Option<Self> {
        match folder {
            Folder::Inputs => file.parse().ok().map(|digest| Self::input(&digest)),
            Folder::Jobs => Self::job(file.strip_suffix(".json")?).ok(),
            Folder::Results => file.split_once('.').and_then(|(key, extension)| Self::result(key, extension).ok()),
        }
    }

    /// The name at a path from the root of the store.
    pub(super) fn at(path: &str) -> Option<Self> {
        let (folder, file) = path.split_once('/')?;
        Folder::ALL.into_iter().find(|f| f.as_str() == folder).and_then(|folder| Self::read(folder, file))
    }
}

impl fmt::Display for Name {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.folder.as_str(), self.file)
    }
}
