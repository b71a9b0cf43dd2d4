//! Keys and what each may do.

use std::collections::BTreeMap;
use std::sync::{Arc, LazyLock};
use std::time::SystemTime;

use super::account::Quota;
use super::token::{self, Hash};

/// What a key may be for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Scope {
    /// To compute: meshes, estimates, uploads, and the end of a job.
    Mesh,
    /// To read what there is: results, jobs, what structures hold, what the service can do.
    Read,
}

impl Scope {
    /// All of them.
    pub const ALL: [Self; 2] = [Self::Mesh, Self::Read];

    /// Its name in files and documents.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Mesh => "mesh",
            Self::Read => "read",
        }
    }

    /// The scope with a name.
    #[must_use]
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|scope| scope.name() == name)
    }
}

/// A key as it is kept.
#[derive(Debug, Clone)]
pub struct Key {
    /// Its name, which is no secret: it stands in logs.
    pub id: String,
    /// The hash of its text.
    pub hash: Hash,
    /// What it is for.
    pub scopes: Vec<Scope>,
    /// How much of it.
    pub quota: Arc<Quota>,
    /// When it ends; none: never.
    pub expires: Option<SystemTime>,
    /// For whom reads the file.
    pub note: Option<String>,
}

impl Key {
    /// Whether it is for `scope`.
    #[must_use]
    pub fn allows(&self, scope: Scope) -> bool {
        self.scopes.contains(&scope)
    }
}

/// Why a key is of no use.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Denied {
    /// It is none of ours: which part of it is wrong is not said.
    Unknown,
    /// It was one of ours until then.
    Expired(SystemTime),
}

/// All keys, by id.
#[derive(Debug, Clone, Default)]
pub struct KeyRing(pub(super) BTreeMap<String, Arc<Key>>);

impl KeyRing {
    /// How many there are.
    #[must_use]
    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// Whether there are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// The key whose text this is.
    ///
    /// # Errors
    /// [`Denied`]; that a key has expired is told to its owner alone.
    pub fn verify(&self, text: &str, now: SystemTime) -> Result<Arc<Key>, Denied> {
        // An id that nobody has takes as long as one that somebody has.
        static NOBODY: LazyLock<Hash> = LazyLock::new(|| Hash::of(""));
        let key = token::id_of(text).and_then(|id| self.0.get(id));
        let same = Hash::of(text).same(key.map_or(&*NOBODY, |key| &key.hash));
        let key = key.filter(|_| same).ok_or(Denied::Unknown)?;
        match key.expires {
            Some(end) if end <= now => Err(Denied::Expired(end)),
            _ => Ok(Arc::clone(key)),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn a_key_opens_with_its_text_until_its_end() {
        let minted = token::mint("a").unwrap();
        let end = SystemTime::UNIX_EPOCH + Duration::from_secs(100);
        let key = Key {
            id: "a".into(),
            hash: minted.hash,
            scopes: vec![Scope::Read],
            quota: Arc::default(),
            expires: Some(end),
            note: None,
        };
        assert!(key.allows(Scope::Read) && !key.allows(Scope::Mesh));
        let ring = KeyRing([("a".to_owned(), Arc::new(key))].into());
        let verify = |text: &str, at: u64| {
            ring.verify(text, SystemTime::UNIX_EPOCH + Duration::from_secs(at)).map(|key| key.id.clone())
        };
        assert_eq!(verify(&minted.text, 99), Ok("a".into()));
        assert_eq!(verify(&minted.text, 100), Err(Denied::Expired(end)));
        // Every single character counts, and whoever has another secret does not learn of the end.
        for at in 0..minted.text.len() {
            let mut other = minted.text.clone().into_bytes();
            other[at] = if other[at] == b'0' { b'1' } else { b'0' };
            let other = String::from_utf8(other).unwrap();
            assert_eq!(verify(&other, 100), Err(Denied::Unknown), "{at}");
        }
        assert_eq!(verify("", 0), Err(Denied::Unknown));
    }
}
