//! Base64 (RFC 4648, padded) as a stream: blocks in, blocks out, one block of memory.

use std::io::{self, Write};

use base64::Engine;
use base64::engine::general_purpose::STANDARD;

use crate::formats::block::BLOCK_BYTES;

/// Bytes encoded at once: the text of three fills a block to four.
const INPUT_BYTES: usize = BLOCK_BYTES / 4 * 3;

/// Characters that so many bytes become.
pub(super) const fn encoded_len(bytes: u64) -> u64 {
    bytes.div_ceil(3) * 4
}

/// Encodes what is written to it. [`Base64Writer::finish`] writes the last group and its padding.
pub(super) struct Base64Writer<'a> {
    out: &'a mut dyn Write,
    /// Bytes that do not make a group of three yet.
    carry: [u8; 3],
    carried: usize,
    text: Vec<u8>,
}

impl<'a> Base64Writer<'a> {
    pub(super) fn new(out: &'a mut dyn Write) -> Self {
        Self { out, carry: [0; 3], carried: 0, text: Vec::new() }
    }

    /// Writes what is left, with padding.
    pub(super) fn finish(mut self) -> io::Result<()> {
        let (carry, carried) = (self.carry, self.carried);
        self.encode(&carry[..carried])
    }

    /// Encodes at most [`INPUT_BYTES`].
    fn encode(&mut self, bytes: &[u8]) -> io::Result<()> {
        let needed = bytes.len().div_ceil(3) * 4;
        if self.text.len() < needed {
            self.text.resize(needed, 0);
        }
        let len = STANDARD.encode_slice(bytes, &mut self.text).map_err(io::Error::other)?;
        self.out.write_all(&self.text[..len])
    }
}

impl Write for Base64Writer<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let mut rest = bytes;
        if self.carried > 0 {
            let (head, tail) = rest.split_at(rest.len().min(3 - self.carried));
            self.carry[self.carried..self.carried + head.len()].copy_from_slice(head);
            self.carried += head.len();
            rest = tail;
            if self.carried == 3 {
                self.carried = 0;
                self.encode(&self.carry.clone())?;
            }
        }
        let (groups, tail) = rest.split_at(rest.len() / 3 * 3);
        for block in groups.chunks(INPUT_BYTES) {
            self.encode(block)?;
        }
        if !tail.is_empty() {
            self.carry[..tail.len()].copy_from_slice(tail);
            self.carried = tail.len();
        }
        Ok(bytes.len())
    }

    /// Nothing is held back that could be written: an open group is not.
    fn flush(&mut self) -> io::Result<()> {
        self.out.flush()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pieces_of_any_size_make_the_same_text() {
        let bytes: Vec<u8> = (0..1_000_000_u32).map(|i| i.wrapping_mul(2_654_435_761).to_be_bytes()[0]).collect();
        for total in [0, 1, 2, 3, 4, 5, 997, bytes.len()] {
            for piece in [1, 2, 3, 4, 7, 1000, INPUT_BYTES + 1, bytes.len()] {
                if total / piece > 100_000 {
                    continue;
                }
                let mut text = Vec::new();
                let mut writer = Base64Writer::new(&mut text);
                for part in bytes[..total].chunks(piece) {
                    writer.write_all(part).unwrap();
                }
                writer.finish().unwrap();
                assert_eq!(text.len() as u64, encoded_len(total as u64));
                assert_eq!(STANDARD.decode(&text).unwrap(), bytes[..total], "{total} bytes by {piece}");
            }
        }
    }

    #[test]
    fn the_padding_is_that_of_the_standard() {
        for (plain, expected) in [("f", "Zg=="), ("fo", "Zm8="), ("foo", "Zm9v"), ("foob", "Zm9vYg==")] {
            let mut text = Vec::new();
            let mut writer = Base64Writer::new(&mut text);
            writer.write_all(plain.as_bytes()).unwrap();
            writer.finish().unwrap();
            assert_eq!(text, expected.as_bytes());
        }
    }
}
