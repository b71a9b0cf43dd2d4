//! Completeness check of gzip files. A truncated HTTP/1.1 body may look complete, but gzip carries a length and a
//! checksum, and a damaged file must not be cached for a day.

use std::io::{self, Read as _};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use flate2::bufread::MultiGzDecoder;

/// Bytes inflated between two checks of the flag: less than a millisecond.
const PART: usize = 1 << 18;

/// Sets its flag when it is dropped.
#[derive(Debug, Default)]
pub(super) struct StopOnDrop(pub(super) Arc<AtomicBool>);

impl Drop for StopOnDrop {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// Returns true if `bytes` inflate without an error. Stops after `limit` inflated bytes, since the reader rejects
/// larger files, or soon after `stop` is set. Blocks for a few milliseconds per megabyte.
pub(super) fn is_complete_gzip(bytes: &[u8], limit: u64, stop: &AtomicBool) -> bool {
    let (mut inflated, mut part) = (MultiGzDecoder::new(bytes).take(limit), vec![0; PART]);
    while !stop.load(Ordering::Relaxed) {
        match inflated.read(&mut part) {
            Ok(0) => return true,
            Err(e) if e.kind() != io::ErrorKind::Interrupted => return false,
            _ => {}
        }
    }
    false
}

#[cfg(test)]
mod tests {
    use std::io::Write as _;

    use super::*;

    fn is_complete_gzip(bytes: &[u8], limit: u64) -> bool {
        super::is_complete_gzip(bytes, limit, &AtomicBool::new(false))
    }

    #[test]
    fn the_check_ends_with_the_request() {
        let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
        encoder.write_all(&vec![0; 1 << 20]).unwrap();
        let good = encoder.finish().unwrap();
        let request = StopOnDrop::default();
        let stop = Arc::clone(&request.0);
        assert!(super::is_complete_gzip(&good, u64::MAX, &stop), "the control");
        drop(request);
        assert!(!super::is_complete_gzip(&good, u64::MAX, &stop));
    }

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
