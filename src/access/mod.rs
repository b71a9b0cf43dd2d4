//! Access control: API keys, quotas, signed URLs and the addresses of clients behind proxies.
//!
//! Decisions depend on values only: the text of a key, an address, a time. The module uses no HTTP library and starts
//! no task. [`crate::http`] consults `Access` once per request.

mod account;
mod authorizer;
mod error;
mod fields;
mod file;
mod forwarded;
mod keys;
mod meter;
mod sign;
mod sites;
mod token;

pub(crate) use account::{Account, QuotaExceeded};
pub(crate) use authorizer::Access;
pub(crate) use fields::{rate_limit, rate_limit_policy};
pub(crate) use file::parse as parse_key_file;
pub(crate) use forwarded::client as forwarded_client;
pub(crate) use keys::Denied;
pub(crate) use sign::{Signature, SignatureCheck, remove_signature};
pub(crate) use sites::{Sites, authority};

pub use account::Quota;
pub use error::{AccessError, KeyFileError};
pub use file::format_key;
pub use keys::{Key, Scope};
pub use sign::{SignError, SigningKeys};
pub use token::{Hash, is_id, new_key, new_secret};
