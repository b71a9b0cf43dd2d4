//! Completeness check of gzip files. A truncated HTTP/1.1 body may look complete, but gzip carries a length and a
//! checksum, and a damaged file must not be cached for a day.

use std::io::{self, Read as _};

use flate2::bufread::MultiGzDecoder;

/// Returns true if `bytes` inflate without an error. Stops after `limit` inflated bytes, since the reader rejects
/// larger files. Blocks for a few milliseconds per megabyte.
pub(super) fn is_complete_gzip(bytes: &[u8], limit: u64) -> bool {
    io::copy(&mut MultiGzDecoder::new(bytes).take(limit), &mut io::sink()).is_ok()
}

#[cfg(test)]
mod tests {
    use std::io::Write as _;

    use super::*;

    #[test]
    fn truncated_and_changed_files_are_detected() {
        let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
        encoder.write_all(&[b'x'; 10_000]).unwrap();
        let good = encoder.finish().unwrap();
        assert!(is_complete_gzip(&good, 1 << 20));
        assert!(is_complete_gzip(&[good.clone(), good.clone()].concat(), 1 << 20));
        for cut in 0..good.len() {
            assert!(!is_complete_gzip(&good[..cut], 1 << 20), "{cut}");
        }
        let mut changed = good.clone();
        changed[good.len() - 6] ^= 1;
        assert!(!is_complete_gzip(&changed, 1 << 20));
        assert!(!is_complete_gzip(b"<html>", 1 << 20));
        // Inflating stops at the limit, before the changed end.
        assert!(is_complete_gzip(&changed, 5_000));
    }
}
