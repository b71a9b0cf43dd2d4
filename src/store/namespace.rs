//! Namespaces of stored objects. Clients of different namespaces cannot find each other's objects.

use std::fmt;

use hmac::{Hmac, KeyInit as _, Mac as _};
use serde::{Deserialize, Serialize};
use sha2::Sha256;
use thiserror::Error;

use super::{Digest, Secret};

/// Returns the HMAC-SHA-256 of `text` under a secret.
pub(crate) fn derive(secret: &Secret, text: &str) -> [u8; 32] {
    // HMAC pads a key to the block length with zeros.
    let mut block = [0; 64];
    block[..secret.len()].copy_from_slice(secret);
    let mut mac = Hmac::<Sha256>::new(&block.into());
    mac.update(text.as_bytes());
    mac.finalize().into_bytes().into()
}

/// Namespace of objects. The default is the common one, in which objects have their plain names.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(into = "String", try_from = "String")]
pub struct Namespace(Option<u128>);

/// Error of a text that is not a namespace.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
#[error("a namespace has 32 hexadecimal digits")]
pub struct BadNamespace;

impl Namespace {
    /// Returns the namespace of a group of keys. `secret` is the secret of the store: the group alone does not reveal
    /// the names of its objects.
    pub(crate) fn from_group(secret: &Secret, group: &str) -> Self {
        let digest = derive(secret, &format!("namespace\n{group}"));
        Self(Some(digest.iter().take(16).fold(0, |bits, byte| bits << 8 | u128::from(*byte))))
    }

    /// Returns true for the common namespace.
    #[must_use]
    pub fn is_common(&self) -> bool {
        self.0.is_none()
    }

    /// Returns the stem of a file name in this namespace, of 64 hexadecimal digits unless it is the common one.
    pub(super) fn stem(self, stem: &str) -> String {
        if self.is_common() { stem.to_owned() } else { Digest::of(format!("{self}\n{stem}").as_bytes()).to_string() }
    }
}

impl fmt::Display for Namespace {
    /// Writes the hexadecimal digits; nothing for the common namespace.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.map_or(Ok(()), |id| write!(f, "{id:032x}"))
    }
}

impl From<Namespace> for String {
    fn from(namespace: Namespace) -> Self {
        namespace.to_string()
    }
}

impl TryFrom<String> for Namespace {
    type Error = BadNamespace;

    fn try_from(text: String) -> Result<Self, BadNamespace> {
        match text.len() {
            0 => Ok(Self(None)),
            32 => u128::from_str_radix(&text, 16).map(|id| Self(Some(id))).map_err(|_bad| BadNamespace),
            _ => Err(BadNamespace),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::{Folder, Name};

    #[test]
    fn names_differ_between_namespaces_and_stay_valid() {
        let digest = Digest::of(b"a");
        let of = |secret: u8, group| Namespace::from_group(&[secret; 32], group);
        let spaces = [Namespace::default(), of(1, "a"), of(1, "b"), of(2, "a")];
        let names = |space: Namespace| {
            [Name::input(&digest), Name::result(&digest.to_string(), "glb").unwrap()].map(|name| name.within(space))
        };
        for (i, space) in spaces.iter().enumerate() {
            for name in names(*space) {
                let (_, file) = name.to_string().split_once('/').map(|(a, b)| (a.to_owned(), b.to_owned())).unwrap();
                assert_eq!(Name::from_file_name(name.folder(), &file), Some(name.clone()));
                assert!(spaces[..i].iter().all(|other| !names(*other).contains(&name)));
            }
            assert_eq!(Namespace::try_from(String::from(*space)), Ok(*space));
        }
        assert_eq!(names(Namespace::default())[0], Name::input(&digest));
        // A mesh and its report stay one group.
        let [mesh, report] = ["glb", "json"].map(|end| Name::result(&digest.to_string(), end).unwrap());
        assert_eq!(mesh.within(spaces[1]).group(), report.within(spaces[1]).group());
        assert_eq!(names(spaces[1])[1].folder(), Folder::Results);
        assert!(Namespace::try_from("x".repeat(32)).is_err() && Namespace::try_from("0".to_owned()).is_err());
    }
}
