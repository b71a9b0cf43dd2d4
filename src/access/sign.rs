//! Signed URLs, which allow GET without a key until they expire.
//!
//! The signature covers the path and all query parameters as sent, sorted by their bytes: no parameter can be added,
//! removed or rewritten. The signature of a job covers its events and its result as well. Three parameters carry it:
//! [`EXPIRES`] in seconds of Unix time, [`KEY_ID`], and [`SIGNATURE`], an HMAC-SHA-256 in base64url. The host is not
//! signed, because a service behind proxies does not know its own.

use std::time::{Duration, SystemTime, UNIX_EPOCH};

use base64::Engine as _;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use hmac::{Hmac, KeyInit as _, Mac as _};
use sha2::Sha256;
use thiserror::Error;

use super::token;

/// Query parameter of the expiry, s of Unix time.
pub(crate) const EXPIRES: &str = "expires";
/// Query parameter of the signing key's id.
pub(crate) const KEY_ID: &str = "key_id";
/// Query parameter of the signature.
pub(crate) const SIGNATURE: &str = "signature";

/// Path of all jobs.
const JOBS: &str = "/v1/jobs/";
/// Prefix of the signed message, which separates it from messages of other kinds.
const DOMAIN: &str = "molmesh-address-1\n";
/// Minimum length of a secret, characters: 128 bits in hexadecimal. [`token::new_secret`] returns twice as many.
const MIN_SECRET: usize = 32;

/// Errors of signing a URL.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum SignError {
    /// The target does not begin with `/`.
    #[error("expected a path that begins with `/`")]
    NoPath,
    /// Browsers would escape this character.
    #[error("`{0}` must be escaped as %XX in a URL")]
    Character(char),
    /// The query contains a parameter of a signature.
    #[error("the query contains the parameter `{0}` already")]
    Signed(&'static str),
    /// No signing key has this id.
    #[error("no signing key has the id `{requested}`; expected one of {available}")]
    UnknownKey {
        /// Requested id.
        requested: String,
        /// Existing ids.
        available: String,
    },
}

/// Valid signature.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Signature {
    /// Expiry, s of Unix time.
    pub(crate) until: u64,
    /// Key that signed.
    pub(crate) key_id: String,
    /// Group of the key.
    pub(crate) group: String,
}

/// Result of checking a signature.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum SignatureCheck {
    /// The query has no signature.
    Absent,
    /// The signature is valid.
    Valid(Signature),
    /// The signature is invalid. The wrong part is not revealed.
    Invalid,
    /// The signature is correct but expired at this time, s of Unix time.
    Expired(u64),
}

/// Signing keys. The first one signs, all are accepted.
#[derive(Clone)]
pub struct SigningKeys(Vec<SigningKey>);

#[derive(Clone)]
struct SigningKey {
    id: String,
    /// Group of API keys whose structures, results and jobs its signatures open.
    group: String,
    mac: Hmac<Sha256>,
}

impl std::fmt::Debug for SigningKeys {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_list().entries(self.0.iter().map(|key| &key.id)).finish()
    }
}

impl SigningKeys {
    /// Parses one or more `ID:SECRET` or `ID@GROUP:SECRET`, separated by white space. The default group is the id.
    ///
    /// # Errors
    /// Returns the expected form, without the text.
    pub fn parse(text: &str) -> Result<Self, String> {
        let mut keys: Vec<SigningKey> = Vec::new();
        for (n, word) in text.split_whitespace().enumerate() {
            let nth = n + 1;
            let expected = || {
                format!(
                    "key {nth} is not ID:SECRET or ID@GROUP:SECRET with names of lower-case letters, digits and `-`"
                )
            };
            let (name, secret) = word.split_once(':').ok_or_else(expected)?;
            let (id, group) = name.split_once('@').unwrap_or((name, name));
            if !token::is_id(id) || !token::is_id(group) {
                return Err(expected());
            }
            if secret.len() < MIN_SECRET {
                return Err(format!(
                    "the secret of `{id}` has fewer than {MIN_SECRET} characters; `molmesh key signing` prints a new one"
                ));
            }
            if keys.iter().any(|other| other.id == id) {
                return Err(format!("duplicate key `{id}`"));
            }
            // HMAC takes keys of any length.
            let mac = Hmac::new_from_slice(secret.as_bytes()).map_err(|error| error.to_string())?;
            keys.push(SigningKey { id: id.to_owned(), group: group.to_owned(), mac });
        }
        if keys.is_empty() { Err("there is no key; expected ID:SECRET".to_owned()) } else { Ok(Self(keys)) }
    }

    /// Signs `target`, a path with or without a query, until `expires` (s of Unix time). Uses the key `key_id`, by
    /// default the first one. Returns the target followed by the three parameters.
    ///
    /// # Errors
    /// [`SignError`].
    pub fn sign(&self, key_id: Option<&str>, target: &str, expires: u64) -> Result<String, SignError> {
        if !target.starts_with('/') {
            return Err(SignError::NoPath);
        }
        let unescaped = |c: &char| c.is_ascii_alphanumeric() || "-._~:/?@!$&()*+,;=%".contains(*c);
        if let Some(other) = target.chars().find(|c| !unescaped(c)) {
            return Err(SignError::Character(other));
        }
        let (path, query) = target.split_once('?').map_or((target, None), |(path, query)| (path, Some(query)));
        let mut parameters: Vec<&str> = query.into_iter().flat_map(|query| query.split('&')).collect();
        let own = [EXPIRES, KEY_ID, SIGNATURE];
        if let Some(name) = own.into_iter().find(|own| parameters.iter().any(|p| name_of(p) == *own)) {
            return Err(SignError::Signed(name));
        }
        let SigningKey { id, mac, .. } = match key_id {
            None => self.0.first(),
            Some(requested) => self.0.iter().find(|key| key.id == requested),
        }
        .ok_or_else(|| SignError::UnknownKey {
            requested: key_id.unwrap_or_default().to_owned(),
            available: self.0.iter().map(|key| key.id.as_str()).collect::<Vec<_>>().join(", "),
        })?;
        let own = format!("{EXPIRES}={expires}&{KEY_ID}={id}");
        let separator = if query.is_none() { '?' } else { '&' };
        parameters.extend(own.split('&'));
        let tag = message(mac, path, parameters).finalize().into_bytes();
        Ok(format!("{target}{separator}{own}&{SIGNATURE}={}", URL_SAFE_NO_PAD.encode(tag)))
    }

    /// Checks the signature of a path and query at `now`. Compares in constant time.
    pub(crate) fn check(&self, path: &str, query: Option<&str>, now: SystemTime) -> SignatureCheck {
        let parameters: Vec<&str> = query.into_iter().flat_map(|query| query.split('&')).collect();
        if !parameters.iter().any(|parameter| name_of(parameter) == SIGNATURE) {
            return SignatureCheck::Absent;
        }
        let [Some(expires), Some(key_id), Some(signature)] =
            [EXPIRES, KEY_ID, SIGNATURE].map(|name| only(&parameters, name))
        else {
            return SignatureCheck::Invalid;
        };
        let Ok(tag) = URL_SAFE_NO_PAD.decode(signature) else { return SignatureCheck::Invalid };
        let signed = parameters.iter().copied().filter(|parameter| name_of(parameter) != SIGNATURE).collect();
        // Unknown ids take as long as known ones.
        let found = self.0.iter().find(|key| key.id == key_id);
        let Some(key) = found.or(self.0.first()) else { return SignatureCheck::Invalid };
        let matches = message(&key.mac, path, signed).verify_slice(&tag).is_ok();
        if !matches || found.is_none() {
            return SignatureCheck::Invalid;
        }
        // `sign` writes numbers only.
        let Ok(end) = expires.parse::<u64>() else { return SignatureCheck::Invalid };
        if UNIX_EPOCH.checked_add(Duration::from_secs(end)).is_some_and(|end| end <= now) {
            return SignatureCheck::Expired(end);
        }
        SignatureCheck::Valid(Signature { until: end, key_id: key.id.clone(), group: key.group.clone() })
    }
}

/// Removes the three parameters from a query. Returns `None` if nothing else remains.
pub(crate) fn remove_signature(query: &str) -> Option<String> {
    let own = [EXPIRES, KEY_ID, SIGNATURE];
    let rest: Vec<&str> = query.split('&').filter(|p| !own.contains(&name_of(p))).collect();
    (!rest.is_empty()).then(|| rest.join("&"))
}

fn name_of(parameter: &str) -> &str {
    parameter.split('=').next().unwrap_or_default()
}

/// Returns the value of a parameter that occurs exactly once.
fn only<'a>(parameters: &[&'a str], name: &str) -> Option<&'a str> {
    let mut values = parameters.iter().filter(|parameter| name_of(parameter) == name);
    let (first, more) = (values.next()?, values.next());
    first.split_once('=').map(|(_, value)| value).filter(|_| more.is_none())
}

/// Returns the path that a signature of `path` covers: for the events and the result of a job, that of the job.
fn covered(path: &str) -> &str {
    let job_path = path.strip_prefix(JOBS).and_then(|rest| rest.split_once('/'));
    match job_path {
        Some((id, "events" | "result")) => &path[..JOBS.len() + id.len()],
        _ => path,
    }
}

/// Returns the MAC of a path and its parameters. Neither can contain a line break, so the message is unambiguous.
fn message(mac: &Hmac<Sha256>, path: &str, mut parameters: Vec<&str>) -> Hmac<Sha256> {
    parameters.sort_unstable();
    let mut mac = mac.clone();
    for part in [DOMAIN, covered(path), "\n", &parameters.join("&")] {
        mac.update(part.as_bytes());
    }
    mac
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn keys() -> SigningKeys {
        let secrets = [("new", "new"), ("old@lab", "old")].map(|(name, word)| format!("{name}:{}", word.repeat(11)));
        SigningKeys::parse(&secrets.join("\n ")).unwrap()
    }

    fn check(keys: &SigningKeys, target: &str, now: u64) -> SignatureCheck {
        let (path, query) = target.split_once('?').map_or((target, None), |(path, query)| (path, Some(query)));
        keys.check(path, query, UNIX_EPOCH + Duration::from_secs(now))
    }

    /// Returns the result for a signature of a key until 100 s.
    fn valid(key_id: &str) -> SignatureCheck {
        let group = if key_id == "old" { "lab" } else { key_id };
        SignatureCheck::Valid(Signature { until: 100, key_id: key_id.to_owned(), group: group.to_owned() })
    }

    #[test]
    fn the_hash_is_hmac_sha_256() {
        // RFC 4231, test case 2.
        let mut mac: Hmac<Sha256> = Hmac::new_from_slice(b"Jefe").unwrap();
        mac.update(b"what do ya want for nothing?");
        let tag = mac.finalize().into_bytes();
        assert_eq!(tag[..4], [0x5b, 0xdc, 0xc1, 0x46]);
        assert_eq!(tag[28..], [0x64, 0xec, 0x38, 0x43]);
    }

    #[test]
    fn a_signature_is_valid_until_its_expiry() {
        let keys = keys();
        for (target, rest) in [
            ("/v1/pdb/4pti/surface.glb", None),
            ("/v1/pdb/4pti/surface.glb?resolution=1&chains=A,B", Some("resolution=1&chains=A,B")),
            ("/x?", Some("")),
            ("/x?a", Some("a")),
        ] {
            let signed = keys.sign(None, target, 100).unwrap();
            assert!(signed.starts_with(target) && signed.contains("expires=100&key_id=new&signature="), "{signed}");
            assert_eq!(check(&keys, &signed, 99), valid("new"), "{signed}");
            assert_eq!(remove_signature(signed.split_once('?').unwrap().1).as_deref(), rest);
            assert_eq!(check(&keys, &signed, 100), SignatureCheck::Expired(100));
            assert_eq!(check(&keys, target, 99), SignatureCheck::Absent);
        }
        // The order of parameters is irrelevant.
        let signed = keys.sign(None, "/x?b=1&a=2", 100).unwrap();
        let (_, query) = signed.split_once('?').unwrap();
        let reversed: Vec<&str> = query.split('&').rev().collect();
        assert_eq!(check(&keys, &format!("/x?{}", reversed.join("&")), 0), valid("new"));
    }

    #[test]
    fn the_signature_of_a_job_covers_its_events_and_result() {
        let keys = keys();
        let signed = keys.sign(None, "/v1/jobs/7", 100).unwrap();
        let at = |path: &str| check(&keys, &signed.replace("/v1/jobs/7", path), 0);
        for path in ["/v1/jobs/7", "/v1/jobs/7/events", "/v1/jobs/7/result"] {
            assert_eq!(at(path), valid("new"), "{path}");
        }
        for path in
            ["/v1/jobs/8", "/v1/jobs/8/result", "/v1/jobs/7/x", "/v1/jobs/7/events/result", "/v1/jobs", "/v1/jobs/"]
        {
            assert_eq!(at(path), SignatureCheck::Invalid, "{path}");
        }
    }

    #[test]
    fn signing_keys_can_be_rotated() {
        let both = keys();
        let signed = both.sign(Some("old"), "/x", 100).unwrap();
        assert_eq!(check(&both, &signed, 0), valid("old"));
        let only_new = SigningKeys::parse(&format!("new:{}", "new".repeat(11))).unwrap();
        assert_eq!(check(&only_new, &signed, 0), SignatureCheck::Invalid);
        assert_eq!(check(&only_new, &both.sign(None, "/x", 100).unwrap(), 0), valid("new"));
        let renamed = signed.replace("key_id=old", "key_id=new");
        assert_eq!(check(&both, &renamed, 0), SignatureCheck::Invalid);
        assert!(
            matches!(both.sign(Some("x"), "/x", 1), Err(SignError::UnknownKey { available, .. }) if available == "new, old")
        );
    }

    #[test]
    fn added_removed_and_repeated_parameters_are_rejected() {
        let keys = keys();
        let signed = keys.sign(None, "/x?a=1&b=2", 100).unwrap();
        for other in [
            format!("{signed}&c=3"),
            format!("{signed}&"),
            format!("{signed}&signature=x"),
            format!("{signed}&expires=200"),
            signed.replace("b=2&", ""),
            signed.replace("a=1&b=2", "a=1&b=2&b=2"),
            signed.replace("expires=100", "expires=200"),
            signed.replace("expires=100&", ""),
            signed.replace("key_id=new&", ""),
            signed.replace("/x", "/y"),
            signed.replace("a=1", "%61=1"),
            format!("{}signature", signed.split("signature=").next().unwrap()),
        ] {
            assert_eq!(check(&keys, &other, 0), SignatureCheck::Invalid, "{other}");
        }
        // Expiry is reported only for a correct signature.
        assert_eq!(check(&keys, &signed.replace("a=1", "a=2"), 200), SignatureCheck::Invalid);
    }

    proptest! {
        #[test]
        fn every_character_is_signed(at in 0_usize..200, to in "[!-~]") {
            let keys = keys();
            let signed = keys.sign(None, "/v1/pdb/4pti/surface.glb?resolution=1&chains=A,B", 100).unwrap();
            let at = at % signed.len();
            let other = format!("{}{to}{}", &signed[..at], &signed[at + 1..]);
            prop_assume!(other != signed);
            let result = check(&keys, &other, 0);
            // With a changed name of the signature parameter, the URL is unsigned.
            prop_assert!(matches!(result, SignatureCheck::Invalid | SignatureCheck::Absent), "{other}: {result:?}");
        }
    }

    #[test]
    fn secrets_are_long_and_named_and_hidden() {
        for (bad, why) in [
            ("", "no key"),
            ("justasecretjustasecretjustasecret", "key 1"),
            ("A:justasecretjustasecretjustasecret", "key 1"),
            ("a@:justasecretjustasecretjustasecret", "key 1"),
            ("a:short", "fewer than 32"),
            ("a:justasecretjustasecretjustasecret a:justasecretjustasecretjustasecret", "duplicate key `a`"),
        ] {
            let message = SigningKeys::parse(bad).unwrap_err();
            assert!(message.contains(why), "{message}");
            assert!(!message.contains("justasecret") && !message.contains("short"), "{message}");
        }
        assert_eq!(format!("{:?}", keys()), "[\"new\", \"old\"]");
        assert_eq!(token::new_secret().unwrap().len(), 64);
        for bad in ["x", "", "http://h/x", "/a b", "/x#y", "/x?é", "/x?a=1&signature=2"] {
            assert!(keys().sign(None, bad, 1).is_err(), "{bad}");
        }
    }
}
