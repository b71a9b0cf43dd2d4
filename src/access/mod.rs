//! Access control: API keys, quotas, signed URLs and the addresses of clients behind proxies.
//!
//! Decisions depend on values only: the text of a key, an address, a time. The module uses no HTTP library and starts
//! no task. [`crate::http`] consults [`Access`] once per request.

mod account;
mod authorizer;
mod error;
mod fields;
mod file;
mod forwarded;
mod keys;
mod meter;
mod sign;
mod token;

pub use account::{Account, Exceeded, Quota, QuotaUsage};
pub use authorizer::Access;
pub use error::{AccessError, KeyFileError};
pub use fields::{limits, policies};
pub use file::{entry, parse};
pub use forwarded::client;
pub use keys::{Denied, Key, KeyRing, Scope};
pub use meter::{Meter, Running};
pub use sign::{EXPIRES, KEY_ID, SIGNATURE, SignError, Signed, SigningKeys, new_secret, without};
pub use token::{Hash, NewKey, is_id, mint};
