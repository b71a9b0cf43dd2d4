//! Integers of the configuration and of the command line: underscores, and binary suffixes of sizes.

/// Describes the values that [`parse_integer`] accepts.
#[must_use]
pub fn whole_number(is_size: bool) -> String {
    if is_size { "a whole number, or a size such as 64MiB".to_owned() } else { "a whole number".to_owned() }
}

/// Parses an integer with optional underscores and, for sizes, an optional binary suffix.
#[must_use]
pub fn parse_integer(text: &str, is_size: bool) -> Option<u64> {
    let text = text.trim();
    let (digits, factor) = [("KiB", 1 << 10), ("MiB", 1 << 20), ("GiB", 1u64 << 30)]
        .into_iter()
        .find_map(|(suffix, factor)| Some((text.strip_suffix(suffix).filter(|_| is_size)?, factor)))
        .unwrap_or((text, 1));
    digits.trim().replace('_', "").parse::<u64>().ok()?.checked_mul(factor)
}
