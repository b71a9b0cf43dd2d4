//! Who may ask for what, and how much of it: keys, quotas, signed addresses, and who a client behind a proxy is.
//!
//! Everything here is decided from values: a key's text, an address, a time. It knows no HTTP library and starts nothing;
//! [`crate::http`] asks it once per request. [`Access`] is what is asked, the other files are its parts.

mod account;
mod door;
mod error;
mod fields;
mod file;
mod forwarded;
mod keys;
mod meter;
mod sign;
mod token;

pub use account::{Account, Exceeded, Quota, Standing};
pub use door::Access;
pub use error::{AccessError, KeyFileError};
pub use fields::{limits, policies};
pub use file::{entry, parse};
pub use forwarded::client;
pub use keys::{Denied, Key, KeyRing, Scope};
pub use meter::{Meter, Running};
pub use sign::{EXPIRES, KEY_ID, SIGNATURE, SignError, Signed, SigningKeys, new_secret, without};
pub use token::{Hash, Minted, is_id, mint};
