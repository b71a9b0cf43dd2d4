//! Keys, signing keys and quotas of a configuration.

use std::fs;
use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError, RwLock};
use std::time::{Instant, SystemTime};

use super::account::{Quota, WINDOW_S};
use super::error::AccessError;
use super::keys::{Denied, Key, KeyRing};
use super::meter::QuotaMeter;
use super::sign::{Signature, SignatureCheck, SigningKeys};
use super::sites::Sites;
use super::{file, forwarded};
use crate::config::{Config, Origins, Proxies};

/// Number of addresses with a separate quota, about 2 MB. Further addresses share one quota, because forgetting an
/// address would give it a new one.
const MAX_ADDRESSES: usize = 10_000;

/// Access control of a configuration.
#[derive(Debug)]
pub(crate) struct Access {
    keys: Option<Keys>,
    signing: Option<SigningKeys>,
    /// Quota per address of clients without a key; `None` means unlimited.
    pub(crate) address_quota: Option<Arc<Quota>>,
    /// Usage of quotas.
    pub(crate) meter: Arc<QuotaMeter>,
    /// Origins and host names of the service.
    pub(crate) sites: Sites,
    /// True if pages of other origins may send credentials.
    pub(crate) allows_credentials: bool,
    trusted_proxies: Option<Proxies>,
}

/// Keys of a key file.
#[derive(Debug)]
struct Keys {
    path: PathBuf,
    ring: RwLock<Arc<KeyRing>>,
    /// Stamp of the file at the last attempt to read it.
    seen: Mutex<Option<FileStamp>>,
}

/// Modification time and length of a file.
type FileStamp = (SystemTime, u64);

fn stamp(path: &Path) -> Option<FileStamp> {
    let meta = fs::metadata(path).ok()?;
    Some((meta.modified().ok()?, meta.len()))
}

impl Access {
    /// Creates the access control and reads the key file, if one is configured.
    pub(crate) fn open(config: &Config) -> Result<Self, AccessError> {
        let sites = Sites::new(config);
        let (config, trusted_proxies) = (&config.access, config.server.trusted_proxies.clone());
        if config.cors_credentials && config.cors_origins == Some(Origins::Any) {
            return Err(AccessError::CredentialsForAll);
        }
        let keys = config.keys_file.clone().map(|path| {
            let seen = Mutex::new(stamp(&path));
            let ring = RwLock::new(Arc::new(read(&path)?));
            Ok::<_, AccessError>(Keys { path, ring, seen })
        });
        let signing = config.signing_secret.as_ref().map(|secret| SigningKeys::parse(secret.reveal()));
        let quota = Quota {
            requests: config.address_requests,
            work_s: config.address_work_s,
            concurrent: None,
            window_s: WINDOW_S,
        };
        Ok(Self {
            keys: keys.transpose()?,
            signing: signing.transpose().map_err(AccessError::Signing)?,
            address_quota: (!quota.is_unlimited()).then(|| Arc::new(quota)),
            meter: Arc::new(QuotaMeter::new(MAX_ADDRESSES)),
            sites,
            allows_credentials: config.cors_credentials,
            trusted_proxies,
        })
    }

    /// Returns true if requests need a key or a signature. If only signatures are configured, no key is accepted.
    pub(crate) fn is_closed(&self) -> bool {
        self.keys.is_some() || self.signing.is_some()
    }

    /// Returns true if a key file is configured.
    pub(crate) fn has_keys(&self) -> bool {
        self.keys.is_some()
    }

    /// Returns the key with this text. Fails if the key is unknown or has expired at `now`.
    pub(crate) fn verify(&self, text: &str, now: SystemTime) -> Result<Arc<Key>, Denied> {
        let ring = self.keys.as_ref().map(|keys| Arc::clone(&keys.ring.read().unwrap_or_else(PoisonError::into_inner)));
        ring.map_or(Err(Denied::Unknown), |ring| ring.verify(text, now))
    }

    /// Checks the signature of a path and query. Returns [`SignatureCheck::Absent`] if no signing key is configured.
    pub(crate) fn check_signature(&self, path: &str, query: Option<&str>, now: SystemTime) -> SignatureCheck {
        self.signing.as_ref().map_or(SignatureCheck::Absent, |keys| keys.check(path, query, now))
    }

    /// Signs a target of this service with the key and expiry of `signature`. Returns `None` without signing keys.
    pub(crate) fn sign(&self, target: &str, signature: &Signature) -> Option<String> {
        self.signing.as_ref()?.sign(Some(&signature.key_id), target, signature.until).ok()
    }

    /// Returns the client address of a request from `peer`, given the values of `X-Forwarded-For`.
    pub(crate) fn client<'a>(&self, peer: IpAddr, values: impl DoubleEndedIterator<Item = &'a str>) -> IpAddr {
        forwarded::client(peer, values, self.trusted_proxies.as_ref())
    }

    /// Returns true if the address that [`client`](Self::client) returns is that of one client; see
    /// [`forwarded::is_single`].
    pub(crate) fn is_single_client<'a>(
        &self,
        peer: IpAddr,
        values: impl DoubleEndedIterator<Item = &'a str>,
        is_forwarded: bool,
    ) -> bool {
        let trusted = self.trusted_proxies.as_ref();
        forwarded::is_single(peer, forwarded::client(peer, values, trusted), is_forwarded, trusted)
    }

    /// Reads the key file again if it has changed, or always with `force`. Returns the number of keys, or `None` if the
    /// file was not read. An error keeps the previous keys; an invalid file is reported once until it changes.
    pub(crate) fn refresh(&self, force: bool) -> Result<Option<usize>, AccessError> {
        let Some(keys) = &self.keys else { return Ok(None) };
        let now = stamp(&keys.path);
        let mut seen = keys.seen.lock().unwrap_or_else(PoisonError::into_inner);
        if *seen == now && !force {
            return Ok(None);
        }
        *seen = now;
        let ring = read(&keys.path)?;
        let n = ring.0.len();
        *keys.ring.write().unwrap_or_else(PoisonError::into_inner) = Arc::new(ring);
        self.meter.forget_keys(Instant::now());
        Ok(Some(n))
    }
}

fn read(path: &Path) -> Result<KeyRing, AccessError> {
    let text = fs::read_to_string(path).map_err(|error| AccessError::Read { path: path.to_owned(), error })?;
    file::parse(&text).map_err(|error| AccessError::Keys { path: path.to_owned(), error })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::access::keys::Scope;
    use crate::access::token;
    use crate::config::{AccessConfig, Secret};

    fn open(change: impl FnOnce(&mut AccessConfig)) -> Result<Access, AccessError> {
        let mut config = Config::default();
        change(&mut config.access);
        Access::open(&config)
    }

    fn new_key(id: &str) -> (String, String) {
        let text = token::new_key(id).unwrap();
        let hash = token::Hash::of(&text);
        let key = Key {
            id: id.into(),
            group: id.into(),
            hash,
            scopes: vec![Scope::Read],
            quota: Arc::default(),
            expires: None,
            note: None,
        };
        (text, file::format_key(&key))
    }

    #[test]
    fn default_configuration_requires_no_key() {
        let access = open(|_| {}).unwrap();
        assert!(!access.is_closed() && access.address_quota.is_none());
        assert_eq!(access.check_signature("/", Some("signature=x"), SystemTime::now()), SignatureCheck::Absent);
        assert_eq!(access.refresh(true).unwrap(), None);
    }

    #[test]
    fn key_file_is_reloaded_and_an_invalid_file_keeps_the_keys() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("keys.toml");
        let [(a, lines_a), (b, lines_b)] = [new_key("a"), new_key("b")];
        fs::write(&path, &lines_a).unwrap();
        let access = open(|c| c.keys_file = Some(path.clone())).unwrap();
        let knows = |text: &str| access.verify(text, SystemTime::now()).is_ok();
        assert!(access.is_closed() && knows(&a) && !knows(&b));
        assert_eq!(access.refresh(false).unwrap(), None);
        fs::write(&path, format!("{lines_a}{lines_b}")).unwrap();
        assert_eq!(access.refresh(false).unwrap(), Some(2));
        assert!(knows(&a) && knows(&b));
        fs::write(&path, "[[key]]\nidd = 1").unwrap();
        let message = access.refresh(false).unwrap_err().to_string();
        assert!(message.contains("keys.toml, line 2: unknown name `idd`; did you mean `id`?"), "{message}");
        assert!(knows(&a) && access.refresh(false).unwrap().is_none(), "reported once");
        fs::write(&path, &lines_b).unwrap();
        assert_eq!(access.refresh(true).unwrap(), Some(1));
        assert!(!knows(&a) && knows(&b));
        fs::remove_file(&path).unwrap();
        assert!(access.refresh(false).unwrap_err().to_string().contains("cannot read"));
        assert!(knows(&b));
    }

    #[test]
    fn invalid_configurations_are_rejected() {
        let any = open(|c| (c.cors_credentials, c.cors_origins) = (true, "*".parse().ok()));
        assert!(matches!(any, Err(AccessError::CredentialsForAll)));
        assert!(open(|c| c.keys_file = Some("/no/such".into())).is_err());
        let message = open(|c| c.signing_secret = Some(Secret::new("a:hush"))).unwrap_err().to_string();
        assert!(message.contains("access.signing_secret") && !message.contains("hush"), "{message}");
        let listed = open(|c| (c.cors_credentials, c.cors_origins) = (true, "https://a.b".parse().ok()));
        assert!(listed.is_ok());
    }
}
