//! What is asked once per request: keys, signatures, quotas, as they are configured.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError, RwLock};
use std::time::{Instant, SystemTime};

use super::account::Quota;
use super::error::AccessError;
use super::keys::{Denied, Key, KeyRing};
use super::meter::Meter;
use super::sign::{Signed, SigningKeys};
use super::{file, forwarded};
use crate::config::{AccessConfig, Config, Origins, ServerConfig};

/// Access as it is configured.
#[derive(Debug)]
pub struct Access {
    keys: Option<Keys>,
    signing: Option<SigningKeys>,
    /// The quota of those who present no key; none: there is no limit.
    address_quota: Option<Arc<Quota>>,
    meter: Arc<Meter>,
    config: AccessConfig,
    server: ServerConfig,
}

/// Keys from a file.
#[derive(Debug)]
struct Keys {
    path: PathBuf,
    ring: RwLock<Arc<KeyRing>>,
    /// What the file looked like when it was read last, well or not.
    seen: Mutex<Option<Stamp>>,
}

/// A file's time and length.
type Stamp = (SystemTime, u64);

fn stamp(path: &Path) -> Option<Stamp> {
    let meta = fs::metadata(path).ok()?;
    Some((meta.modified().ok()?, meta.len()))
}

impl Access {
    /// Sets access up. Reads the file of keys, if there is one.
    ///
    /// # Errors
    /// [`AccessError`].
    pub fn open(config: &Config) -> Result<Self, AccessError> {
        let (config, server) = (config.access.clone(), config.server.clone());
        if config.cors_credentials && config.cors_origins == Some(Origins::Any) {
            return Err(AccessError::CredentialsForAll);
        }
        let keys = config.keys_file.clone().map(|path| {
            let seen = Mutex::new(stamp(&path));
            let ring = RwLock::new(Arc::new(read(&path, config.window_s)?));
            Ok::<_, AccessError>(Keys { path, ring, seen })
        });
        let signing = config.signing_secret.as_ref().map(|secret| SigningKeys::parse(secret.reveal()));
        let quota = Quota {
            requests: config.address_requests,
            work_s: config.address_work_s,
            concurrent: config.address_concurrent,
            window_s: config.window_s,
        };
        Ok(Self {
            keys: keys.transpose()?,
            signing: signing.transpose().map_err(AccessError::Signing)?,
            address_quota: (!quota.is_unlimited()).then(|| Arc::new(quota)),
            meter: Arc::new(Meter::new(config.clients)),
            config,
            server,
        })
    }

    /// Whether a key or a signature is asked for. Where only signatures are configured, nothing else opens.
    #[must_use]
    pub fn is_closed(&self) -> bool {
        self.keys.is_some() || self.signing.is_some()
    }

    /// Whether there are keys, so that looking for other ones is worth it.
    #[must_use]
    pub fn has_keys(&self) -> bool {
        self.keys.is_some()
    }

    /// The key whose text this is.
    ///
    /// # Errors
    /// [`Denied`].
    pub fn verify(&self, text: &str, now: SystemTime) -> Result<Arc<Key>, Denied> {
        let ring = self.keys.as_ref().map(|keys| Arc::clone(&keys.ring.read().unwrap_or_else(PoisonError::into_inner)));
        ring.map_or(Err(Denied::Unknown), |ring| ring.verify(text, now))
    }

    /// What the signature of a path and query is worth; [`Signed::No`] where signatures are off.
    #[must_use]
    pub fn signed(&self, path: &str, query: Option<&str>, now: SystemTime) -> Signed {
        self.signing.as_ref().map_or(Signed::No, |keys| keys.check(path, query, now))
    }

    /// The quota of those who present no key.
    #[must_use]
    pub fn address_quota(&self) -> Option<&Arc<Quota>> {
        self.address_quota.as_ref()
    }

    /// What clients have used.
    #[must_use]
    pub fn meter(&self) -> &Arc<Meter> {
        &self.meter
    }

    /// The configuration.
    #[must_use]
    pub fn config(&self) -> &AccessConfig {
        &self.config
    }

    /// The client of a request from `peer`, with the values of the header in which proxies name him.
    pub fn client<'a>(
        &self,
        peer: std::net::IpAddr,
        values: impl DoubleEndedIterator<Item = &'a str>,
    ) -> std::net::IpAddr {
        forwarded::client(peer, self.server.forwarded_header, values, self.server.trusted_proxies.as_ref())
    }

    /// The name of that header.
    #[must_use]
    pub fn forwarded_header(&self) -> &'static str {
        self.server.forwarded_header.name()
    }

    /// Reads the file of keys again if it has changed, or if it `must`. How many keys there are now; none: nothing was read.
    ///
    /// # Errors
    /// [`AccessError`]; the keys stay as they were. A file that stays wrong is an error once.
    pub fn refresh(&self, must: bool) -> Result<Option<usize>, AccessError> {
        let Some(keys) = &self.keys else { return Ok(None) };
        let now = stamp(&keys.path);
        let mut seen = keys.seen.lock().unwrap_or_else(PoisonError::into_inner);
        if *seen == now && !must {
            return Ok(None);
        }
        *seen = now;
        let ring = read(&keys.path, self.config.window_s)?;
        let n = ring.len();
        *keys.ring.write().unwrap_or_else(PoisonError::into_inner) = Arc::new(ring);
        self.meter.forget_keys(Instant::now());
        Ok(Some(n))
    }
}

fn read(path: &Path, window_s: u64) -> Result<KeyRing, AccessError> {
    let text = fs::read_to_string(path).map_err(|error| AccessError::Read { path: path.to_owned(), error })?;
    file::parse(&text, window_s).map_err(|error| AccessError::Keys { path: path.to_owned(), error })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::access::keys::Scope;
    use crate::access::token;
    use crate::config::Secret;

    fn open(change: impl FnOnce(&mut AccessConfig)) -> Result<Access, AccessError> {
        let mut config = Config::default();
        change(&mut config.access);
        Access::open(&config)
    }

    fn written(id: &str) -> (String, String) {
        let token::Minted { text, hash } = token::mint(id).unwrap();
        let key =
            Key { id: id.into(), hash, scopes: vec![Scope::Read], quota: Arc::default(), expires: None, note: None };
        (text, file::entry(&key))
    }

    #[test]
    fn by_default_nothing_is_asked_for() {
        let access = open(|_| {}).unwrap();
        assert!(!access.is_closed() && access.address_quota().is_none());
        assert_eq!(access.signed("/", Some("signature=x"), SystemTime::now()), Signed::No);
        assert_eq!(access.refresh(true).unwrap(), None);
    }

    #[test]
    fn keys_are_read_again_and_a_broken_file_changes_nothing() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("keys.toml");
        let [(a, lines_a), (b, lines_b)] = [written("a"), written("b")];
        fs::write(&path, &lines_a).unwrap();
        let access = open(|c| c.keys_file = Some(path.clone())).unwrap();
        let knows = |text: &str| access.verify(text, SystemTime::now()).is_ok();
        assert!(access.is_closed() && knows(&a) && !knows(&b));
        assert_eq!(access.refresh(false).unwrap(), None);
        fs::write(&path, format!("{lines_a}{lines_b}")).unwrap();
        assert_eq!(access.refresh(false).unwrap(), Some(2));
        assert!(knows(&a) && knows(&b));
        fs::write(&path, "[[key]]\nidd = 1").unwrap();
        let said = access.refresh(false).unwrap_err().to_string();
        assert!(said.contains("keys.toml, line 2: unknown name `idd`; did you mean `id`?"), "{said}");
        assert!(knows(&a) && access.refresh(false).unwrap().is_none(), "it is said once");
        fs::write(&path, &lines_b).unwrap();
        assert_eq!(access.refresh(true).unwrap(), Some(1));
        assert!(!knows(&a) && knows(&b));
        fs::remove_file(&path).unwrap();
        assert!(access.refresh(false).unwrap_err().to_string().contains("cannot read"));
        assert!(knows(&b));
    }

    #[test]
    fn what_cannot_be_is_refused() {
        assert!(matches!(open(|c| c.cors_credentials = true), Err(AccessError::CredentialsForAll)));
        assert!(open(|c| c.keys_file = Some("/no/such".into())).is_err());
        let said = open(|c| c.signing_secret = Some(Secret::new("a:geheim"))).unwrap_err().to_string();
        assert!(said.contains("access.signing_secret") && !said.contains("geheim"), "{said}");
        let listed = open(|c| (c.cors_credentials, c.cors_origins) = (true, "https://a.b".parse().ok()));
        assert!(listed.is_ok());
    }
}
