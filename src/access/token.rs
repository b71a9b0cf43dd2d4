//! Text of a key, `mm_<id>_<secret>`, and the hash that is stored instead.
//!
//! The secret is 256 random bits and cannot be guessed, so a plain SHA-256 of the text is as safe as a slow password
//! hash, which would only make every request expensive.

use std::fmt;
use std::str::FromStr;

use sha2::{Digest as _, Sha256};
use subtle::ConstantTimeEq as _;

/// Prefix of every key, by which secret scanners recognize keys.
const PREFIX: &str = "mm_";
/// Length of a secret: 256 bits in lower-case hexadecimal digits.
const SECRET_CHARS: usize = 64;
/// Prefix of a hash in the key file.
const HASH_PREFIX: &str = "sha256:";
/// Maximum length of an id.
const MAX_ID: usize = 32;

/// Returns true if `id` is a valid key id: 1 to 32 lower-case letters, digits and hyphens.
#[must_use]
pub fn is_id(id: &str) -> bool {
    let allowed = |b: u8| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'-';
    (1..=MAX_ID).contains(&id.len()) && id.bytes().all(allowed)
}

/// Creates the text of a key, of which only the [`struct@Hash`] is stored. `id` must have passed [`is_id`].
///
/// # Errors
/// Returns the error of the system's random number generator.
pub fn new_key(id: &str) -> Result<String, getrandom::Error> {
    Ok(format!("{PREFIX}{id}_{}", new_secret()?))
}

/// Returns a new secret, 256 random bits in hexadecimal.
///
/// # Errors
/// Returns the error of the system's random number generator.
pub fn new_secret() -> Result<String, getrandom::Error> {
    let mut bytes = [0; SECRET_CHARS / 2];
    getrandom::fill(&mut bytes)?;
    Ok(hex(&bytes))
}

/// Returns the id in the text of a key, or `None` if the text is malformed.
pub(super) fn id_of(text: &str) -> Option<&str> {
    let (id, secret) = text.strip_prefix(PREFIX)?.split_once('_')?;
    (is_id(id) && is_256_bits(secret)).then_some(id)
}

/// Returns true if `text` is 256 bits in lower-case hexadecimal digits.
fn is_256_bits(text: &str) -> bool {
    text.len() == SECRET_CHARS && text.bytes().all(|b| b.is_ascii_digit() || (b'a'..=b'f').contains(&b))
}

fn hex(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 16] = b"0123456789abcdef";
    let digit = |n: u8| char::from(DIGITS[usize::from(n)]);
    bytes.iter().flat_map(|byte| [digit(byte >> 4), digit(byte & 15)]).collect()
}

/// SHA-256 of the text of a key, as in the key file: `sha256:` and 64 digits. Comparison is in constant time only,
/// hence no `PartialEq`.
#[derive(Clone)]
pub struct Hash(String);

impl Hash {
    /// Returns the hash of a text.
    #[must_use]
    pub fn of(text: &str) -> Self {
        Self(format!("{HASH_PREFIX}{}", hex(&Sha256::digest(text.as_bytes()))))
    }

    /// Returns true if both hashes are equal, in constant time.
    #[must_use]
    pub fn same(&self, other: &Self) -> bool {
        self.0.as_bytes().ct_eq(other.0.as_bytes()).into()
    }
}

impl fmt::Display for Hash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl fmt::Debug for Hash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Hash(…)")
    }
}

impl FromStr for Hash {
    type Err = &'static str;

    /// Parses the form of the key file. The error states the expected form.
    fn from_str(text: &str) -> Result<Self, &'static str> {
        let digits = text.strip_prefix(HASH_PREFIX).filter(|digits| is_256_bits(digits));
        digits.map(|_| Self(text.to_owned())).ok_or("`sha256:` and 64 lower-case hexadecimal digits")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn new_keys_are_well_formed_and_unique() {
        let [a, b] = [new_key("viewer-1").unwrap(), new_key("viewer-1").unwrap()];
        assert_eq!(id_of(&a), Some("viewer-1"));
        let hash = Hash::of(&a);
        assert!(a != b && !hash.same(&Hash::of(&b)) && hash.same(&Hash::of(&a)));
        assert!(hash.to_string().parse::<Hash>().unwrap().same(&hash));
        assert_eq!(format!("{hash:?}"), "Hash(…)");
    }

    #[test]
    fn malformed_keys_have_no_id() {
        let good = new_key("a").unwrap();
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
