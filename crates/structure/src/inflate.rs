//! Decompression of gzip (all members) and zstd (all frames), detected by their magic numbers.
//!
//! Declared sizes are not trusted. The output buffer at most doubles (or grows by 1 MiB) at a time, and never exceeds
//! the limit by more than one byte.

use std::borrow::Cow;
use std::io::{self, Read};

use molmesh_surface::{Control, MemoryMeter as _, OutOfMemory, Reservation};

use super::error::StructureError;
use super::read::{ReadLimits, Reading};

const GZIP: &[u8] = b"\x1f\x8b";
const ZSTD: &[u8] = b"\x28\xb5\x2f\xfd";
/// Maximum zstd window, bytes. The sender chooses the window, so it must be bounded. 32 MiB covers all levels of the
/// usual tools except `--ultra --long`.
pub(super) const MAX_ZSTD_WINDOW: u64 = 32 << 20;

/// Returns the name of the compression whose magic number the bytes begin with, if it is supported.
pub(super) fn encoding(bytes: &[u8]) -> Option<&'static str> {
    if bytes.starts_with(GZIP) {
        Some("gzip")
    } else if bytes.starts_with(ZSTD) || skippable_frame(bytes) {
        Some("zstd")
    } else {
        None
    }
}

/// Check of the bytes that are decompressed so far.
pub(super) type PrefixCheck<'a> = dyn Fn(&[u8]) -> Result<(), StructureError> + 'a;

/// Returns the decompressed bytes, or the input itself if it is not compressed. Calls `check` with the bytes so far
/// whenever their number has doubled. An error of `check` ends the decompression.
pub(super) fn inflate<'a>(
    bytes: &'a [u8],
    limit: u64,
    reading: &Reading<'_>,
    check: &PrefixCheck<'_>,
) -> Result<Cow<'a, [u8]>, StructureError> {
    let plain = match encoding(bytes) {
        None if bytes.len() as u64 > limit => return Err(StructureError::InflatedTooLarge { limit }),
        None => return Ok(Cow::Borrowed(bytes)),
        Some("gzip") => gzip(bytes, limit, reading, check)?,
        Some(_) => zstd(bytes, limit, reading, check)?,
    };
    Ok(Cow::Owned(plain))
}

/// Decompressed bytes with the memory that they are charged to.
pub(super) struct Inflated<'a> {
    bytes: Cow<'a, [u8]>,
    _memory: Reservation,
}

impl Inflated<'_> {
    pub(super) fn bytes(&self) -> &[u8] {
        &self.bytes
    }
}

/// Decompresses a file as [`inflate`] does, without checking the decompressed data.
pub(super) fn inflate_once<'a>(
    bytes: &'a [u8],
    limit: u64,
    control: &Control<'_>,
) -> Result<Inflated<'a>, StructureError> {
    let limits = ReadLimits::default();
    let reading = Reading::new(&limits, control);
    let bytes = inflate(bytes, limit, &reading, &|_| Ok(()))?;
    Ok(Inflated { bytes, _memory: reading.text })
}

fn gzip(
    mut rest: &[u8],
    limit: u64,
    reading: &Reading<'_>,
    check: &PrefixCheck<'_>,
) -> Result<Vec<u8>, StructureError> {
    let broken = |e: io::Error| StructureError::Decompress { encoding: "gzip", reason: e.to_string() };
    let mut out = Vec::new();
    while !rest.is_empty() {
        if !rest.starts_with(GZIP) {
            // Tapes and block devices pad with zeros, which the gzip tool ignores too.
            if rest.iter().all(|&b| b == 0) {
                break;
            }
            let reason = format!("{} bytes after the last member are not gzip data", rest.len());
            return Err(StructureError::Decompress { encoding: "gzip", reason });
        }
        let mut decoder = flate2::bufread::GzDecoder::new(rest);
        append(&mut decoder, &mut out, limit, reading, check, broken)?;
        rest = decoder.into_inner();
    }
    Ok(out)
}

fn zstd(
    mut rest: &[u8],
    limit: u64,
    reading: &Reading<'_>,
    check: &PrefixCheck<'_>,
) -> Result<Vec<u8>, StructureError> {
    let broken = |reason: String| StructureError::Decompress { encoding: "zstd", reason };
    let mut out = Vec::new();
    while !rest.is_empty() {
        if skippable_frame(rest) {
            let size = rest.get(4..8).and_then(|b| b.first_chunk()).map_or(0, |&b| u32::from_le_bytes(b) as usize);
            rest = rest.get(8..).and_then(|r| r.get(size..)).ok_or_else(|| broken("truncated frame".to_owned()))?;
            continue;
        }
        let _window = reading.reserve(zstd_window(rest).min(MAX_ZSTD_WINDOW))?;
        let mut decoder = ruzstd::decoding::StreamingDecoder::new_with_max_window_size(rest, MAX_ZSTD_WINDOW)
            .map_err(|e| broken(e.to_string()))?;
        append(&mut decoder, &mut out, limit, reading, check, |e| broken(e.to_string()))?;
        // The frame may end with a checksum of the decompressed data.
        let frame = &decoder.decoder;
        if let (Some(said), Some(computed)) = (frame.get_checksum_from_data(), frame.get_calculated_checksum())
            && said != computed
        {
            return Err(broken(format!("checksum {computed:08x}, but the frame declares {said:08x}")));
        }
        rest = decoder.into_inner();
    }
    Ok(out)
}

/// Returns the size of the window that a frame declares (RFC 8878, 3.1.1.1), bytes; 0 if its header is incomplete. A
/// frame of a single segment has a window of its content.
fn zstd_window(frame: &[u8]) -> u64 {
    let Some(&flags) = frame.get(ZSTD.len()) else { return 0 };
    let fields = &frame[ZSTD.len() + 1..];
    if flags & 0x20 == 0 {
        let descriptor = u64::from(fields.first().copied().unwrap_or_default());
        let base = 1 << (10 + (descriptor >> 3));
        return base + base / 8 * (descriptor & 7);
    }
    let (dictionary, size) = ([0, 1, 2, 4][usize::from(flags & 3)], 1 << (flags >> 6));
    let content = fields.get(dictionary..).unwrap_or_default().iter().take(size);
    let length = content.rev().fold(0, |length, byte| length << 8 | u64::from(*byte));
    if size == 2 { length + 256 } else { length }
}

/// Bytes decompressed between two checks of the cancellation flag: a few milliseconds.
const BYTES_PER_CHECK: u64 = 1 << 20;

/// Reads `decoder` to its end into a buffer that doubles when it is full, so that the time of many members is linear.
/// Reserves memory before the buffer grows; the old buffer counts until it has been copied.
fn append(
    decoder: &mut dyn Read,
    out: &mut Vec<u8>,
    limit: u64,
    reading: &Reading<'_>,
    check: &PrefixCheck<'_>,
    broken: impl Fn(io::Error) -> StructureError,
) -> Result<(), StructureError> {
    let limit_len = usize::try_from(limit).unwrap_or(usize::MAX - 1);
    loop {
        let remaining = limit_len.saturating_sub(out.len()).saturating_add(1);
        let (start, space) = (out.len(), out.capacity() - out.len());
        let step = if space > 0 { space } else { start.max(1 << 20) }.min(remaining);
        if space == 0 {
            let (old, new) = (out.capacity() as u64, (start + step) as u64);
            reading.text.grow(new)?;
            out.try_reserve_exact(step).map_err(|_refused| OutOfMemory::System { needed: new })?;
            reading.text.shrink(old);
        }
        let mut left = step as u64;
        while left > 0 {
            reading.check()?;
            let part = left.min(BYTES_PER_CHECK);
            let n = decoder.take(part).read_to_end(out).map_err(&broken)? as u64;
            left = if n < part { 0 } else { left - n };
        }
        if out.len() > limit_len {
            return Err(StructureError::InflatedTooLarge { limit });
        }
        if out.len() - start < step {
            return Ok(());
        }
        check(out)?;
    }
}

/// Returns true for a skippable frame, which zstd allows between data frames.
pub(super) fn skippable_frame(bytes: &[u8]) -> bool {
    matches!(bytes, [0x50..=0x5F, 0x2A, 0x4D, 0x18, ..])
}

#[cfg(test)]
#[allow(clippy::pedantic, clippy::unwrap_used, reason = "tests fail by panicking")]
mod tests {
    use std::io::Write;
    use std::sync::Arc;
    use std::sync::atomic::{AtomicUsize, Ordering};

    use molmesh_surface::{Control, MemoryMeter};

    use super::*;

    fn inflated(bytes: &[u8], limit: u64) -> Result<Cow<'_, [u8]>, StructureError> {
        let control = Control::default();
        inflate(bytes, limit, &Reading::new(&super::super::ReadLimits::default(), &control), &|_| Ok(()))
    }

    fn gz(data: &[u8]) -> Vec<u8> {
        let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
        encoder.write_all(data).unwrap();
        encoder.finish().unwrap()
    }

    fn zst(data: &[u8]) -> Vec<u8> {
        ruzstd::encoding::compress_to_vec(data, ruzstd::encoding::CompressionLevel::Fastest)
    }

    #[test]
    fn all_members_and_frames() {
        for (packed, encoding) in [
            ([gz(b"ab"), gz(b""), gz(b"cd")].concat(), "gzip"),
            ([zst(b"ab"), b"\x53\x2a\x4d\x18\x03\0\0\0xyz".to_vec(), zst(b"cd")].concat(), "zstd"),
        ] {
            assert_eq!(super::encoding(&packed), Some(encoding));
            assert_eq!(inflated(&packed, 4).unwrap(), &b"abcd"[..]);
            assert_eq!(inflated(&packed, 3), Err(StructureError::InflatedTooLarge { limit: 3 }));
        }
        assert_eq!(inflated(&[gz(b"ab"), vec![0; 512]].concat(), 9).unwrap(), &b"ab"[..]);
    }

    /// Counts how often memory is reserved.
    #[derive(Debug, Default)]
    struct Counter(AtomicUsize);

    impl MemoryMeter for Counter {
        fn grow(&self, _bytes: u64) -> Result<(), OutOfMemory> {
            self.0.fetch_add(1, Ordering::Relaxed);
            Ok(())
        }

        fn shrink(&self, _bytes: u64) {}
    }

    #[test]
    fn many_small_members_are_copied_as_rarely_as_one() {
        let control = |memory: &Arc<Counter>| Control { memory: Arc::clone(memory) as _, ..Control::default() };
        let plain = vec![b'x'; 5 << 20];
        let members: Vec<u8> = plain.chunks(1 << 10).flat_map(|piece| [gz(piece), gz(b"")].concat()).collect();
        for packed in [gz(&plain), members] {
            let count = Arc::default();
            let control = control(&count);
            let limits = super::super::ReadLimits::default();
            assert!(inflate(&packed, u64::MAX, &Reading::new(&limits, &control), &|_| Ok(())).unwrap() == plain);
            // 1, 2, 4 and 8 MiB.
            assert_eq!(count.0.load(Ordering::Relaxed), 4);
        }
    }

    #[test]
    fn a_bomb_stops_at_the_limit() {
        let zeros = vec![b' '; 64 << 20];
        for bomb in [gz(&zeros), zst(&zeros)] {
            assert_eq!(inflated(&bomb, 1 << 20), Err(StructureError::InflatedTooLarge { limit: 1 << 20 }));
            assert_eq!(inflated(&bomb, 64 << 20).unwrap().len(), 64 << 20);
        }
    }

    #[test]
    fn broken_data_is_an_error() {
        for (packed, encoding) in [(gz(&[7; 5000]), "gzip"), (zst(&[7; 5000]), "zstd")] {
            for cut in 4..packed.len() {
                let error = inflated(&packed[..cut], 1 << 20).unwrap_err();
                assert!(
                    matches!(error, StructureError::Decompress { encoding: e, .. } if e == encoding),
                    "{cut}: {error}"
                );
            }
        }
        assert!(inflated(&[gz(b"ab"), b"junk".to_vec()].concat(), 100).is_err());
        // A zstd frame header with a window of 2 GiB.
        let huge = [ZSTD, &[0x00, 0xA8, 0, 0, 0][..]].concat();
        assert!(matches!(inflated(&huge, u64::MAX), Err(StructureError::Decompress { .. })));
    }
}
