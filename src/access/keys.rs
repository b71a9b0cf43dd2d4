//! API keys and their scopes.

use std::collections::BTreeMap;
use std::sync::{Arc, LazyLock};
use std::time::SystemTime;

use super::account::Quota;
use super::token::{self, Hash};

/// Permission of a key.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Scope {
    /// Compute: meshes, estimates, uploads and the cancellation of jobs.
    Mesh,
    /// Read: results, jobs, structures and capabilities.
    Read,
}

impl Scope {
    /// All scopes.
    pub const ALL: [Self; 2] = [Self::Mesh, Self::Read];

    /// Returns the name in files and documents.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Mesh => "mesh",
            Self::Read => "read",
        }
    }

    /// Returns the scope with this name.
    #[must_use]
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|scope| scope.name() == name)
    }
}

/// API key as stored in the key file.
#[derive(Debug, Clone)]
pub struct Key {
    /// Public name, which also appears in logs.
    pub id: String,
    /// Group whose keys share structures, results and jobs. Default: the id.
    pub group: String,
    /// Hash of the text.
    pub hash: Hash,
    /// Permissions.
    pub scopes: Vec<Scope>,
    /// Limits.
    pub quota: Arc<Quota>,
    /// Time of expiry; `None` means never.
    pub expires: Option<SystemTime>,
    /// Remark for the operator.
    pub note: Option<String>,
}

impl Key {
    /// Returns true if the key has `scope`.
    pub(crate) fn allows(&self, scope: Scope) -> bool {
        self.scopes.contains(&scope)
    }
}

/// Reason to reject a key.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Denied {
    /// The key does not exist. The wrong part is not revealed.
    Unknown,
    /// The key expired at this time.
    Expired(SystemTime),
}

/// All keys, by id.
#[derive(Debug, Clone, Default)]
pub(crate) struct KeyRing(pub(super) BTreeMap<String, Arc<Key>>);

impl KeyRing {
    /// Returns the key with this text. Reports expiry only for the correct secret.
    pub(super) fn verify(&self, text: &str, now: SystemTime) -> Result<Arc<Key>, Denied> {
        // Unknown ids take as long as known ones.
        static UNKNOWN: LazyLock<Hash> = LazyLock::new(|| Hash::of(""));
        let key = token::id_of(text).and_then(|id| self.0.get(id));
        let same = Hash::of(text).same(key.map_or(&*UNKNOWN, |key| &key.hash));
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
    fn a_key_is_valid_until_its_expiry() {
        let minted = token::new_key("a").unwrap();
        let end = SystemTime::UNIX_EPOCH + Duration::from_secs(100);
        let key = Key {
            id: "a".into(),
            group: "a".into(),
            hash: Hash::of(&minted),
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
        assert_eq!(verify(&minted, 99), Ok("a".into()));
        assert_eq!(verify(&minted, 100), Err(Denied::Expired(end)));
        // Every character is compared, and a wrong secret does not reveal the expiry.
        for at in 0..minted.len() {
            let mut other = minted.clone().into_bytes();
            other[at] = if other[at] == b'0' { b'1' } else { b'0' };
            let other = String::from_utf8(other).unwrap();
            assert_eq!(verify(&other, 100), Err(Denied::Unknown), "{at}");
        }
        assert_eq!(verify("", 0), Err(Denied::Unknown));
    }
}
