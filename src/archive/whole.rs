//! Whether a compressed file is whole. HTTP/1.1 cannot tell a file that was cut and announced as cut from a shorter one,
//! but gzip carries a length and a checksum, and a damaged file must not be kept for a day.

use std::io::{self, Read as _};

use flate2::bufread::MultiGzDecoder;

/// Inflates `bytes` to nowhere, up to `limit` bytes: what is larger is the reader's to refuse. Blocks, for a few
/// milliseconds a megabyte.
pub(super) fn is_whole_gzip(bytes: &[u8], limit: u64) -> bool {
    io::copy(&mut MultiGzDecoder::new(bytes).take(limit), &mut io::sink()).is_ok()
}

#[cfg(test)]
mod tests {
    use std::io::Write as _;

    use super::*;

    #[test]
    fn cut_and_changed_files_are_seen() {
        let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
        encoder.write_all(&[b'x'; 10_000]).unwrap();
        let good = encoder.finish().unwrap();
        assert!(is_whole_gzip(&good, 1 << 20));
        assert!(is_whole_gzip(&[good.clone(), good.clone()].concat(), 1 << 20));
        for cut in 0..good.len() {
            assert!(!is_whole_gzip(&good[..cut], 1 << 20), "{cut}");
        }
        let mut changed = good.clone();
        changed[good.len() - 6] ^= 1;
        assert!(!is_whole_gzip(&changed, 1 << 20));
        assert!(!is_whole_gzip(b"<html>", 1 << 20));
        // A bomb is not followed to its end, where this one is broken.
        assert!(is_whole_gzip(&changed, 5_000));
    }
}
