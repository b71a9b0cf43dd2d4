//! Decompression of gzip (all members) and zstd (all frames), detected by their magic numbers.
//!
//! Input in memory and input that is streamed take the same path. Declared sizes are not trusted: the output never
//! exceeds its limit by more than one byte. Only zeros may follow the last gzip member, nothing the last zstd frame.

use std::borrow::Cow;
use std::io::{self, BufRead, Chain, Cursor, Read};
use std::sync::Arc;

use flate2::bufread::GzDecoder;
use molmesh_surface::{CancelToken, Control, Exceeded, Limit, MemoryMeter, OutOfMemory, Reservation};
use ruzstd::decoding::{FrameDecoder, StreamingDecoder};

use super::error::StructureError;
use super::read::check;

/// First bytes of a gzip member.
pub const GZIP_MAGIC: &[u8] = b"\x1f\x8b";
/// First bytes of a zstd data frame.
pub const ZSTD_MAGIC: &[u8] = b"\x28\xb5\x2f\xfd";
/// Maximum length of a header of a zstd frame (RFC 8878, 3.1.1), bytes.
const MAX_HEADER: usize = 18;
/// Length of the header of a skippable zstd frame: magic number and length of the content, bytes.
const SKIPPABLE_HEADER: u64 = 8;
/// Maximum zstd window, bytes. The sender chooses the window, so it must be bounded. 32 MiB covers all levels of the
/// usual tools except `--ultra --long`.
const MAX_ZSTD_WINDOW: u64 = 32 << 20;
/// Bytes decompressed between two checks of the cancellation flag: a few milliseconds.
const STEP: usize = 1 << 20;
/// Bytes that the check of a gzip file inflates at a time.
const CHECK_BYTES: u64 = 1 << 18;

/// Returns the name of the compression whose magic number the bytes begin with, if it is supported.
pub(super) fn encoding(bytes: &[u8]) -> Option<&'static str> {
    if bytes.starts_with(GZIP_MAGIC) {
        Some("gzip")
    } else if bytes.starts_with(ZSTD_MAGIC) || is_skippable(bytes) {
        Some("zstd")
    } else {
        None
    }
}

/// Returns true for a skippable frame, which zstd allows between data frames.
fn is_skippable(bytes: &[u8]) -> bool {
    matches!(bytes, [0x50..=0x5F, 0x2A, 0x4D, 0x18, ..])
}

/// Returns true if `bytes` are gzip members that inflate without an error, and at most zeros follow. Stops after
/// `limit` inflated bytes, since the reader rejects larger files. Returns false soon after a cancellation. Blocks for a
/// few milliseconds per megabyte.
#[must_use]
pub fn is_complete_gzip(bytes: &[u8], limit: u64, cancel: &CancelToken) -> bool {
    let control = Control { cancel: cancel.clone(), ..Control::default() };
    let inflate_all = || {
        let (mut decoder, mut part) = (Decoder::new(Box::new(bytes), limit, &control)?, Vec::new());
        while !decoder.at_end() {
            part.clear();
            decoder.read(CHECK_BYTES, &mut part, &control)?;
        }
        Ok(())
    };
    bytes.starts_with(GZIP_MAGIC) && matches!(inflate_all(), Ok(()) | Err(StructureError::Limit(_)))
}

/// Returns the decompressed bytes and adds them to `memory`, or returns the input itself if it is not compressed. Calls
/// `check_prefix` with the bytes so far whenever their number has doubled. An error of it ends the decompression.
pub(super) fn inflate<'a>(
    bytes: &'a [u8],
    limit: u64,
    memory: &Reservation,
    control: &Control<'_>,
    check_prefix: &dyn Fn(&[u8]) -> Result<(), StructureError>,
) -> Result<Cow<'a, [u8]>, StructureError> {
    match encoding(bytes) {
        None if bytes.len() as u64 > limit => return Err(Exceeded::new(Limit::InflatedBytes, limit).error()),
        None => return Ok(Cow::Borrowed(bytes)),
        Some(_) => {}
    }
    let (mut decoder, mut out) = (Decoder::new(Box::new(bytes), limit, control)?, Vec::new());
    loop {
        decoder.fill(STEP.max(2 * out.len()), &mut out, memory, control)?;
        if decoder.at_end() {
            return Ok(Cow::Owned(out));
        }
        check_prefix(&out)?;
    }
}

/// Input whose first bytes have been read.
type Peeked<'a> = Chain<Cursor<Vec<u8>>, Box<dyn BufRead + Send + 'a>>;

/// Part of the input that is being decompressed.
enum DecoderState<'a> {
    /// Input that is not compressed.
    Plain(Peeked<'a>),
    /// Gzip member.
    Member(Box<GzDecoder<Peeked<'a>>>),
    /// Data frame of zstd, with the memory of its window.
    Frame(Box<StreamingDecoder<Peeked<'a>, FrameDecoder>>, Reservation),
    End,
}

/// Decompressed bytes of an input.
pub(super) struct Decoder<'a> {
    state: DecoderState<'a>,
    /// Meter of the windows. A frame may outlive the control of the call that begins it.
    memory: Arc<dyn MemoryMeter>,
    /// Maximum number of decompressed bytes.
    limit: u64,
    /// Number of decompressed bytes so far.
    n_read: u64,
}

impl<'a> Decoder<'a> {
    /// Begins to decompress an input to at most `limit` bytes. Adds the memory of windows to the meter of `control`.
    ///
    /// # Errors
    /// Returns the errors of [`Self::read`].
    pub(super) fn new(
        input: Box<dyn BufRead + Send + 'a>,
        limit: u64,
        control: &Control<'_>,
    ) -> Result<Self, StructureError> {
        let memory = Arc::clone(&control.memory);
        Ok(Self { state: begin(Cursor::default().chain(input), None, &memory, control)?, memory, limit, n_read: 0 })
    }

    /// Returns true after the end of the input has been read.
    pub(super) const fn at_end(&self) -> bool {
        matches!(self.state, DecoderState::End)
    }

    /// Appends at most `most` bytes to `out`, less only at the end of the input.
    ///
    /// # Errors
    /// Returns [`StructureError::Input`], [`StructureError::Decompress`], [`StructureError::Limit`] and the errors of
    /// memory and cancellation.
    pub(super) fn read(&mut self, most: u64, out: &mut Vec<u8>, control: &Control<'_>) -> Result<(), StructureError> {
        let mut left = most.min(self.remaining());
        while left > 0 && !self.at_end() {
            check(control)?;
            let n = match &mut self.state {
                DecoderState::Plain(input) => input.take(left).read_to_end(out).map_err(|error| failure(&error)),
                DecoderState::Member(member) => {
                    member.take(left).read_to_end(out).map_err(|error| broken("gzip", &error))
                }
                DecoderState::Frame(frame, _) => {
                    frame.take(left).read_to_end(out).map_err(|error| broken("zstd", &error))
                }
                DecoderState::End => Ok(0),
            }? as u64;
            if n < left {
                self.state = std::mem::replace(&mut self.state, DecoderState::End).next(&self.memory, control)?;
            }
            left -= n;
            self.n_read += n;
        }
        if self.n_read > self.limit { Err(Exceeded::new(Limit::InflatedBytes, self.limit).error()) } else { Ok(()) }
    }

    /// Appends bytes to `out` until it has at least `size`, or the input ends. `out` doubles when it is full, so that
    /// the time of many members is linear. Reserves memory before `out` grows; the old buffer counts until it has been
    /// copied.
    ///
    /// # Errors
    /// Returns the errors of [`Self::read`].
    pub(super) fn fill(
        &mut self,
        size: usize,
        out: &mut Vec<u8>,
        memory: &Reservation,
        control: &Control<'_>,
    ) -> Result<(), StructureError> {
        while !self.at_end() && out.len() < size {
            let (len, old) = (out.len(), out.capacity());
            let most = usize::try_from(self.remaining()).unwrap_or(usize::MAX);
            let needed = len + STEP.min(most);
            if needed > old {
                let new = needed.max(2 * old).min(len.saturating_add(most));
                memory.grow(new as u64)?;
                out.try_reserve_exact(new - len).map_err(|_refused| OutOfMemory::System { needed: new as u64 })?;
                memory.shrink(old as u64);
            }
            self.read(STEP as u64, out, control)?;
        }
        Ok(())
    }

    /// Returns the number of bytes that may be read: one more than the limit, which shows that the input exceeds it.
    const fn remaining(&self) -> u64 {
        self.limit.saturating_sub(self.n_read).saturating_add(1)
    }
}

impl DecoderState<'_> {
    /// Ends a part whose bytes have been read, and begins the next one.
    fn next(self, memory: &Arc<dyn MemoryMeter>, control: &Control<'_>) -> Result<Self, StructureError> {
        match self {
            Self::Plain(_) | Self::End => Ok(Self::End),
            Self::Member(member) => begin(member.into_inner(), Some("gzip"), memory, control),
            Self::Frame(frame, window) => {
                // The frame may end with a checksum of the decompressed data.
                let declared = frame.decoder.get_checksum_from_data();
                if let (Some(declared), Some(computed)) = (declared, frame.decoder.get_calculated_checksum())
                    && declared != computed
                {
                    let reason = format!("checksum {computed:08x}, but the frame declares {declared:08x}");
                    return Err(broken("zstd", &reason));
                }
                let input = frame.into_inner();
                drop(window);
                begin(input, Some("zstd"), memory, control)
            }
        }
    }
}

/// Begins the next part of an input, `after` a member or frame of that encoding. Skips skippable frames.
fn begin<'a>(
    mut input: Peeked<'a>,
    mut after: Option<&'static str>,
    memory: &Arc<dyn MemoryMeter>,
    control: &Control<'_>,
) -> Result<DecoderState<'a>, StructureError> {
    loop {
        check(control)?;
        input = peek(input).map_err(|error| failure(&error))?;
        let head = input.get_ref().0.get_ref();
        match (encoding(head), after) {
            (None, None) => return Ok(DecoderState::Plain(input)),
            (None, Some(_)) if head.is_empty() => return Ok(DecoderState::End),
            (Some("gzip"), None | Some("gzip")) => return Ok(DecoderState::Member(Box::new(GzDecoder::new(input)))),
            (Some("zstd"), None | Some("zstd")) if is_skippable(head) => {
                skip(&mut input, control)?;
                after = Some("zstd");
            }
            (Some("zstd"), None | Some("zstd")) => {
                let window = Reservation::new(memory);
                window.grow(zstd_window(head).min(MAX_ZSTD_WINDOW))?;
                let frame = StreamingDecoder::new_with_max_window_size(input, MAX_ZSTD_WINDOW)
                    .map_err(|error| broken("zstd", &error))?;
                return Ok(DecoderState::Frame(Box::new(frame), window));
            }
            (_, Some("gzip")) => {
                check_padding(&mut input, control)?;
                return Ok(DecoderState::End);
            }
            _ => return Err(broken("zstd", &"the bytes after the last frame are not zstd data")),
        }
    }
}

/// Reads the first bytes of a part, or all if it is shorter.
fn peek(input: Peeked<'_>) -> io::Result<Peeked<'_>> {
    let (mut first, mut rest) = input.into_inner();
    let mut head = Vec::with_capacity(MAX_HEADER);
    first.read_to_end(&mut head)?;
    rest.by_ref().take(MAX_HEADER.saturating_sub(head.len()) as u64).read_to_end(&mut head)?;
    Ok(Cursor::new(head).chain(rest))
}

/// Skips a skippable frame.
fn skip(input: &mut Peeked<'_>, control: &Control<'_>) -> Result<(), StructureError> {
    let size = input.get_ref().0.get_ref().get(4..8).and_then(|bytes| bytes.first_chunk());
    let mut left = SKIPPABLE_HEADER + size.map_or(0, |bytes| u64::from(u32::from_le_bytes(*bytes)));
    while left > 0 {
        check(control)?;
        let part = left.min(STEP as u64);
        if io::copy(&mut input.by_ref().take(part), &mut io::sink()).map_err(|error| failure(&error))? < part {
            return Err(broken("zstd", &"truncated frame"));
        }
        left -= part;
    }
    Ok(())
}

/// Rejects bytes after the last gzip member other than zeros. Tapes and block devices pad with zeros, which the gzip
/// tool ignores too.
fn check_padding(input: &mut Peeked<'_>, control: &Control<'_>) -> Result<(), StructureError> {
    loop {
        check(control)?;
        let bytes = input.fill_buf().map_err(|error| failure(&error))?;
        if bytes.iter().any(|byte| *byte != 0) {
            return Err(broken("gzip", &"the bytes after the last member are neither gzip data nor zeros"));
        }
        let n = bytes.len();
        if n == 0 {
            return Ok(());
        }
        input.consume(n);
    }
}

/// Returns the size of the window that a frame declares (RFC 8878, 3.1.1.1), bytes; 0 if its header is incomplete. A
/// frame of a single segment has a window of its content.
fn zstd_window(frame: &[u8]) -> u64 {
    let Some(&flags) = frame.get(ZSTD_MAGIC.len()) else { return 0 };
    let fields = &frame[ZSTD_MAGIC.len() + 1..];
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

fn failure(error: &io::Error) -> StructureError {
    let text = error.to_string();
    StructureError::Input { reason: text.split(" (os error").next().unwrap_or(&text).to_owned() }
}

fn broken(encoding: &'static str, reason: &impl ToString) -> StructureError {
    StructureError::Decompress { encoding, reason: reason.to_string() }
}

#[cfg(test)]
#[allow(clippy::pedantic, clippy::unwrap_used, reason = "tests fail by panicking")]
mod tests {
    use std::io::{BufReader, Write};
    use std::sync::atomic::{AtomicUsize, Ordering};

    use super::*;

    fn inflated(bytes: &[u8], limit: u64) -> Result<Cow<'_, [u8]>, StructureError> {
        let control = Control::default();
        inflate(bytes, limit, &Reservation::new(&control.memory), &control, &|_| Ok(()))
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
            assert_eq!(inflated(&packed, 3), Err(Exceeded::new(Limit::InflatedBytes, 3).error()));
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
            let memory = Reservation::new(&control.memory);
            assert!(inflate(&packed, u64::MAX, &memory, &control, &|_| Ok(())).unwrap() == plain);
            // 1, 2, 4 and 8 MiB.
            assert_eq!(count.0.load(Ordering::Relaxed), 4);
        }
    }

    #[test]
    fn a_bomb_stops_at_the_limit() {
        let zeros = vec![b' '; 64 << 20];
        for bomb in [gz(&zeros), zst(&zeros)] {
            assert_eq!(inflated(&bomb, 1 << 20), Err(Exceeded::new(Limit::InflatedBytes, 1 << 20).error()));
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
        let huge = [ZSTD_MAGIC, &[0x00, 0xA8, 0, 0, 0][..]].concat();
        assert!(matches!(inflated(&huge, u64::MAX), Err(StructureError::Decompress { .. })));
    }

    /// Reads a stream in parts of `step` bytes, from a buffer of 7 bytes.
    fn streamed(bytes: &[u8], limit: u64, step: u64) -> Result<Vec<u8>, StructureError> {
        let control = Control::default();
        let input = Box::new(BufReader::with_capacity(7, bytes));
        let (mut decoder, mut out) = (Decoder::new(input, limit, &control)?, Vec::new());
        while !decoder.at_end() {
            decoder.read(step, &mut out, &control)?;
        }
        Ok(out)
    }

    #[test]
    fn streams_are_decompressed_as_files_in_memory() {
        let skippable = b"\x53\x2a\x4d\x18\x03\0\0\0xyz".to_vec();
        let (long, zeros) = (vec![b'x'; 300_000], vec![0; 512]);
        let whole = [&long[..], b"cd"].concat();
        let [member, frame] = [gz(&long), zst(&long)];
        let cut = |packed: &[u8]| packed[..packed.len() - 1].to_vec();
        // A frame with a window of 64 MiB.
        let wide = [ZSTD_MAGIC, &[0x00, 0x80, 0x01, 0, 0]].concat();
        let readable = [
            whole.clone(),
            [member.clone(), gz(b"cd")].concat(),
            [gz(b""), member.clone(), gz(b""), gz(b"cd"), gz(b"")].concat(),
            [&member[..], &gz(b"cd"), &zeros].concat(),
            [frame.clone(), zst(b"cd")].concat(),
            [zst(b""), frame.clone(), zst(b""), zst(b"cd"), zst(b"")].concat(),
            [&skippable[..], &frame, &skippable, &skippable, &zst(b"cd"), &skippable].concat(),
        ];
        let broken = [
            ("gzip", cut(&member)),
            ("gzip", [&member[..], &zeros, &member].concat()),
            ("gzip", [&member[..], b"junk"].concat()),
            ("gzip", [&member[..], b"\x1f"].concat()),
            ("gzip", [&member[..], &frame].concat()),
            ("gzip", [&member[..], &cut(&gz(b"cd"))].concat()),
            ("zstd", cut(&frame)),
            ("zstd", [&frame[..], &zeros].concat()),
            ("zstd", [&frame[..], b"junk"].concat()),
            ("zstd", [&frame[..], &ZSTD_MAGIC[..3]].concat()),
            ("zstd", [&frame[..], &member].concat()),
            ("zstd", [&frame[..], &cut(&skippable)].concat()),
            ("zstd", [&frame[..], &skippable[..6]].concat()),
            ("zstd", [&frame[..], &wide].concat()),
            ("zstd", wide),
        ];
        let n = whole.len() as u64;
        for step in [1000, 65_536, 300_000, 1 << 30] {
            for (i, packed) in readable.iter().enumerate() {
                for (limit, expected) in
                    [(n, Ok(whole.clone())), (n - 1, Err(Exceeded::new(Limit::InflatedBytes, n - 1).error()))]
                {
                    assert!(inflated(packed, limit).map(Cow::into_owned) == expected, "{i} {limit}");
                    assert!(streamed(packed, limit, step) == expected, "{i} {limit} {step}");
                }
                assert_eq!(is_complete_gzip(packed, n, &CancelToken::default()), (1..4).contains(&i), "{i}");
            }
            for (i, (name, packed)) in broken.iter().enumerate() {
                let error = inflated(packed, 1 << 20).unwrap_err();
                assert!(
                    matches!(error, StructureError::Decompress { encoding, .. } if encoding == *name),
                    "{i}: {error}"
                );
                assert_eq!(streamed(packed, 1 << 20, step), Err(error), "{i} {step}");
                assert!(!is_complete_gzip(packed, 1 << 20, &CancelToken::default()), "{i}");
            }
        }
        assert_eq!(streamed(b"ab", 2, 1), Ok(b"ab".to_vec()));
    }

    /// Records the largest number of bytes that are charged at once.
    #[derive(Debug, Default)]
    struct Peak {
        held: AtomicUsize,
        most: AtomicUsize,
    }

    impl MemoryMeter for Peak {
        fn grow(&self, bytes: u64) -> Result<(), OutOfMemory> {
            let held = self.held.fetch_add(bytes as usize, Ordering::Relaxed) + bytes as usize;
            self.most.fetch_max(held, Ordering::Relaxed);
            Ok(())
        }

        fn shrink(&self, bytes: u64) {
            self.held.fetch_sub(bytes as usize, Ordering::Relaxed);
        }
    }

    #[test]
    fn windows_are_charged_while_their_frames_are_read() {
        // Frames of one raw block with a byte, and windows of 1 KiB and 1 MiB.
        let frame = |window: u8| [ZSTD_MAGIC, &[0, window, 9, 0, 0, b'a']].concat();
        let peak = Arc::<Peak>::default();
        let control = Control { memory: Arc::clone(&peak) as _, ..Control::default() };
        let packed = [frame(0), frame(0x50), frame(0x50), frame(0)].concat();
        let mut decoder = Decoder::new(Box::new(&packed[..]), 9, &control).unwrap();
        let held = || peak.held.load(Ordering::Relaxed);
        let mut out = Vec::new();
        for expected in [1 << 10, 1 << 20, 1 << 20, 1 << 10] {
            // A window does not keep other memory of the call that begins its frame.
            let call = control.metered();
            call.memory.grow(9).unwrap();
            decoder.read(1, &mut out, &call).unwrap();
            assert_eq!(held(), expected + 9);
            drop(call);
            assert_eq!(held(), expected);
        }
        decoder.read(1, &mut out, &control).unwrap();
        assert!(decoder.at_end() && out == b"aaaa");
        assert_eq!((held(), peak.most.load(Ordering::Relaxed)), (0, (1 << 20) + 9));
    }

    /// Cancels when its bytes have been read.
    struct CancelAtEnd<'a>(&'a [u8], CancelToken);

    impl Read for CancelAtEnd<'_> {
        fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
            let n = self.0.read(buffer)?;
            if self.0.is_empty() {
                self.1.cancel();
            }
            Ok(n)
        }
    }

    #[test]
    fn a_cancellation_stops_at_the_next_member_or_frame() {
        for part in [gz(b""), zst(b""), b"\x53\x2a\x4d\x18\0\0\0\0".to_vec()] {
            let (control, rest) = (Control::default(), part.repeat(9));
            let input = CancelAtEnd(&part, control.cancel.clone()).chain(&rest[..]);
            let input = Box::new(BufReader::with_capacity(7, input));
            let read = Decoder::new(input, 9, &control)
                .and_then(|mut decoder| decoder.read(9, &mut Vec::new(), &control).map(|()| decoder.at_end()));
            assert_eq!(read, Err(StructureError::Cancelled));
        }
    }

    #[test]
    fn truncated_and_changed_gzip_files_are_detected() {
        let is_complete = |bytes: &[u8], limit| is_complete_gzip(bytes, limit, &CancelToken::default());
        let good = gz(&[b'x'; 10_000]);
        assert!(is_complete(&good, 1 << 20));
        assert!(is_complete(&[good.clone(), good.clone()].concat(), 1 << 20));
        for cut in 0..good.len() {
            assert!(!is_complete(&good[..cut], 1 << 20), "{cut}");
        }
        let mut changed = good.clone();
        changed[good.len() - 6] ^= 1;
        assert!(!is_complete(&changed, 1 << 20));
        assert!(!is_complete(b"<html>", 1 << 20));
        // Inflating stops at the limit, before the changed end.
        assert!(is_complete(&changed, 5_000));
        let cancel = CancelToken::default();
        cancel.cancel();
        assert!(!is_complete_gzip(&good, 1 << 20, &cancel));
    }
}
