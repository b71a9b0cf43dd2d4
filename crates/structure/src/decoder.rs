//! Decompression of a stream: gzip (all members) and zstd (all frames), detected by their magic numbers.

use std::io::{self, BufReader, Chain, Cursor, Read};

use flate2::bufread::MultiGzDecoder;
use ruzstd::decoding::{FrameDecoder, StreamingDecoder};

use super::error::StructureError;
use super::inflate::{MAX_ZSTD_WINDOW, encoding, skippable_frame};

/// Length of the magic numbers of zstd, bytes.
const MAGIC: usize = 4;
/// Size of the buffer of the input, bytes.
const BUFFER: usize = 1 << 18;

type Input<'a> = BufReader<Box<dyn Read + Send + 'a>>;
/// Input whose first bytes have been read.
type Peeked<'a> = Chain<Cursor<Vec<u8>>, Input<'a>>;
type Frame<'a> = StreamingDecoder<Peeked<'a>, FrameDecoder>;

/// Decompressed bytes of an input.
pub(super) enum Decoder<'a> {
    Plain(Peeked<'a>),
    Gzip(Box<MultiGzDecoder<Peeked<'a>>>),
    /// Data frame, or `None` at the end.
    Zstd(Option<Box<Frame<'a>>>),
}

impl<'a> Decoder<'a> {
    /// Begins to decompress an input.
    ///
    /// # Errors
    /// Returns [`StructureError::Input`] and [`StructureError::Decompress`].
    pub(super) fn new(input: Box<dyn Read + Send + 'a>) -> Result<Self, StructureError> {
        let mut input = BufReader::with_capacity(BUFFER, input);
        let mut head = Vec::new();
        input.by_ref().take(MAGIC as u64).read_to_end(&mut head).map_err(|error| failure(&error))?;
        Ok(match encoding(&head) {
            None => Self::Plain(Cursor::new(head).chain(input)),
            Some("gzip") => Self::Gzip(Box::new(MultiGzDecoder::new(Cursor::new(head).chain(input)))),
            Some(_) => Self::Zstd(frame(head, input).map_err(broken_frame)?),
        })
    }

    /// Returns the largest window of decompressed bytes that the decoder keeps.
    pub(super) const fn window(&self) -> u64 {
        if matches!(self, Self::Zstd(_)) { MAX_ZSTD_WINDOW } else { 0 }
    }

    /// Reads at most `limit` bytes to the end of `out`. Reads less only at the end of the input.
    ///
    /// # Errors
    /// Returns [`StructureError::Input`] and [`StructureError::Decompress`].
    pub(super) fn read(&mut self, limit: u64, out: &mut Vec<u8>) -> Result<u64, StructureError> {
        match self {
            Self::Plain(input) => input.take(limit).read_to_end(out).map_err(|error| failure(&error)),
            Self::Gzip(input) => input.take(limit).read_to_end(out).map_err(|error| broken("gzip", error.to_string())),
            Self::Zstd(current) => {
                let start = out.len();
                while let Some(decoder) = current
                    && ((out.len() - start) as u64) < limit
                {
                    let part = limit - (out.len() - start) as u64;
                    let n = decoder.take(part).read_to_end(out).map_err(|error| broken_frame(error.to_string()))?;
                    if (n as u64) < part {
                        *current = current.take().map_or(Ok(None), |ended| next_frame(*ended)).map_err(broken_frame)?;
                    }
                }
                Ok(out.len() - start)
            }
        }
        .map(|n| n as u64)
    }
}

fn failure(error: &io::Error) -> StructureError {
    let text = error.to_string();
    StructureError::Input { reason: text.split(" (os error").next().unwrap_or(&text).to_owned() }
}

fn broken(encoding: &'static str, reason: String) -> StructureError {
    StructureError::Decompress { encoding, reason }
}

fn broken_frame(reason: String) -> StructureError {
    broken("zstd", reason)
}

/// Ends a frame, checks its checksum, and begins the next one.
fn next_frame(ended: Frame<'_>) -> Result<Option<Box<Frame<'_>>>, String> {
    let (declared, computed) = (ended.decoder.get_checksum_from_data(), ended.decoder.get_calculated_checksum());
    if let (Some(declared), Some(computed)) = (declared, computed)
        && declared != computed
    {
        return Err(format!("checksum {computed:08x}, but the frame declares {declared:08x}"));
    }
    let (_, mut input) = ended.into_inner().into_inner();
    let mut head = Vec::new();
    input.by_ref().take(MAGIC as u64).read_to_end(&mut head).map_err(|error| error.to_string())?;
    frame(head, input)
}

/// Begins the frame whose first bytes are `head`, after skippable frames. Returns `None` at the end of the input.
fn frame(mut head: Vec<u8>, mut input: Input<'_>) -> Result<Option<Box<Frame<'_>>>, String> {
    while skippable_frame(&head) {
        let mut size = [0; 4];
        let mut skip = || -> io::Result<bool> {
            input.read_exact(&mut size)?;
            let size = u64::from(u32::from_le_bytes(size));
            let skipped = io::copy(&mut input.by_ref().take(size), &mut io::sink())?;
            head.clear();
            input.by_ref().take(MAGIC as u64).read_to_end(&mut head)?;
            Ok(skipped == size)
        };
        if !skip().map_err(|error| error.to_string())? {
            return Err("truncated frame".to_owned());
        }
    }
    if head.is_empty() {
        return Ok(None);
    }
    let peeked = Cursor::new(head).chain(input);
    let decoder = StreamingDecoder::new_with_max_window_size(peeked, MAX_ZSTD_WINDOW);
    decoder.map(|decoder| Some(Box::new(decoder))).map_err(|error| error.to_string())
}

#[cfg(test)]
#[allow(clippy::pedantic, clippy::unwrap_used, reason = "tests fail by panicking")]
mod tests {
    use std::io::Write;

    use super::*;

    fn gz(data: &[u8]) -> Vec<u8> {
        let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
        encoder.write_all(data).unwrap();
        encoder.finish().unwrap()
    }

    fn zst(data: &[u8]) -> Vec<u8> {
        ruzstd::encoding::compress_to_vec(data, ruzstd::encoding::CompressionLevel::Fastest)
    }

    /// Reads a stream in parts of `step` bytes.
    fn read(bytes: &[u8], step: u64) -> Result<Vec<u8>, StructureError> {
        let (mut decoder, mut out) = (Decoder::new(Box::new(bytes))?, Vec::new());
        while decoder.read(step, &mut out)? == step {}
        Ok(out)
    }

    #[test]
    fn all_members_and_frames_are_read_in_parts() {
        let skippable = b"\x53\x2a\x4d\x18\x03\0\0\0xyz".to_vec();
        let long = vec![b'x'; 300_000];
        let zstd = [skippable.clone(), zst(&long), skippable, zst(b""), zst(b"cd")].concat();
        for packed in [[&long[..], b"cd"].concat(), [gz(&long), gz(b""), gz(b"cd")].concat(), zstd] {
            for step in [1000, 65_536, 1 << 30] {
                assert!(read(&packed, step).unwrap() == [&long[..], b"cd"].concat());
            }
        }
        assert_eq!(read(b"ab", 1), Ok(b"ab".to_vec()));
        for packed in [gz(&long), zst(&long)] {
            let cut = read(&packed[..packed.len() - 1], 1000);
            assert!(matches!(cut, Err(StructureError::Decompress { .. })), "{cut:?}");
        }
    }
}
