//! The GPU room: the only module that may name a graphics API. It has no device yet, and says so.

/// Why no GPU can be used, for the banner, reports and logs.
#[must_use]
pub const fn unavailable() -> &'static str {
    "this version has no GPU stages"
}
