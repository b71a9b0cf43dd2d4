//! Text of a key, `mm_<id>_<secret>`, and the hash that is stored instead.
//!
//! The secret is 256 random bits and cannot be guessed, so a plain SHA-256 of the text is as safe as a slow password
//! hash, which would only make every request expensive.

use std::fmt;
use std::str::FromStr;

use sha2::{Digest as _, Sha256};
use subtle::ConstantTimeEq as _;

/// Prefix of every key, by which secret scanners recognise keys.
const PREFIX: &str = "mm_";
/// Length of a secret: 256 bits in lower-case hexadecimal digits.
const SECRET_CHARS: usize = 64;
/// Maximum length of an id.
const MAX_ID: usize = 32;

/// Returns true if `id` is a valid key id: 1 to 32 lower-case letters, digits and hyphens.
#[must_use]
pub fn is_id(id: &str) -> bool {
    let allowed = |b: u8| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'-';
    (1..=MAX_ID).contains(&id.len()) && id.bytes().all(allowed)
}

/// New key.
pub struct NewKey {
    /// Text, which is not stored.
    pub text: String,
    /// Hash of the text, which is stored.
    pub hash: Hash,
}

/// Creates a key. `id` must have passed [`is_id`].
///
/// # Errors
/// Returns the error of the system's random number generator.
pub fn mint(id: &str) -> Result<NewKey, getrandom::Error> {
    let text = format!("{PREFIX}{id}_{}", random_hex()?);
    let hash = Hash::of(&text);
    Ok(NewKey { text, hash })
}

/// Returns 256 random bits in hexadecimal digits.
pub(super) fn random_hex() -> Result<String, getrandom::Error> {
    let mut bytes = [0; SECRET_CHARS / 2];
    getrandom::fill(&mut bytes)?;
    Ok(hex(&bytes))
}

/// Returns the id in the text of a key, or `None` if the text is malformed.
pub(super) fn id_of(text: &str) -> Option<&str> {
    let (id, secret) = text.strip_prefix(PREFIX)?.split_once('_')?;
    let digit = |b: u8| b.is_ascii_digit() || (b'a'..=b'f').contains(&b);
    (is_id(id) && secret.len() == SECRET_CHARS && secret.bytes().all(digit)).then_some(id)
}

fn hex(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 16] = b"0123456789abcdef";
    let digit = |n: u8| char::from(DIGITS[usize::from(n)]);
    bytes.iter().flat_map(|byte| [digit(byte >> 4), digit(byte & 15)]).collect()
}

/// SHA-256 of the text of a key. Comparison is in constant time only, hence no `PartialEq`.
#[derive(Clone)]
pub struct Hash([u8; 32]);

impl Hash {
    /// Returns the hash of a text.
    #[must_use]
    pub fn of(text: &str) -> Self {
        Self(Sha256::digest(text.as_bytes()).into())
    }

    /// Returns true if both hashes are equal, in constant time.
    #[must_use]
    pub fn same(&self, other: &Self) -> bool {
        self.0.ct_eq(&other.0).into()
    }
}

impl fmt::Display for Hash {
    /// Writes `sha256:` and 64 digits, as in the key file.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "sha256:{}", hex(&self.0))
    }
}

impl fmt::Debug for Hash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Hash(…)")
    }
}

impl FromStr for Hash {
    type Err = &'static str;

    /// Parses `sha256:` and 64 digits. The error states the expected form.
    fn from_str(text: &str) -> Result<Self, &'static str> {
        const EXPECTED: &str = "`sha256:` and 64 lower-case hexadecimal digits";
        let digits = text.strip_prefix("sha256:").ok_or(EXPECTED)?.as_bytes();
        let value = |b: u8| match b {
            b'0'..=b'9' => Some(b - b'0'),
            b'a'..=b'f' => Some(b - b'a' + 10),
            _ => None,
        };
        let mut bytes = [0; 32];
        if digits.len() != 2 * bytes.len() {
            return Err(EXPECTED);
        }
        for (byte, pair) in bytes.iter_mut().zip(digits.chunks_exact(2)) {
            let [high, low] = [value(pair[0]).ok_or(EXPECTED)?, value(pair[1]).ok_or(EXPECTED)?];
            *byte = high << 4 | low;
        }
        Ok(Self(bytes))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn new_keys_are_well_formed_and_unique() {
        let [a, b] = [mint("viewer-1").unwrap(), mint("viewer-1").unwrap()];
        assert_eq!(id_of(&a.text), Some("viewer-1"));
        assert!(a.text != b.text && !a.hash.same(&b.hash) && a.hash.same(&Hash::of(&a.text)));
        assert!(a.hash.to_string().parse::<Hash>().unwrap().same(&a.hash));
        assert_eq!(format!("{:?}", a.hash), "Hash(…)");
    }

    #[test]
    fn malformed_keys_have_no_id() {
        let good = mint("a").unwrap().text;
        let secret = &good[5..];
        for bad in [
            String::new(),
            "mm_".to_owned(),
            format!("mm__{secret}"),
            format!("xx_a_{secret}"),
            format!("mm_A_{secret}"),
            format!("mm_{}_{secret}", "a".repeat(33)),
            format!("mm_a_{}", &secret[1..]),
            format!("mm_a_{secret}0"),
            format!("mm_a_{}g", &secret[1..]),
            good.to_uppercase(),
        ] {
            assert_eq!(id_of(&bad), None, "{bad}");
        }
        for bad in ["", "sha256:", "sha256:00", &format!("sha256:{}", "G".repeat(64)), &"0".repeat(71)] {
            assert!(bad.parse::<Hash>().is_err(), "{bad}");
        }
    }

    #[test]
    fn the_hash_is_sha_256() {
        let abc = "sha256:ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
        assert_eq!(Hash::of("abc").to_string(), abc);
    }
}
