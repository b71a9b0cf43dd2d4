//! Byte strings of a file, in memory or in the temporary file, and their bytes in order.

use std::borrow::Cow;
use std::sync::Arc;

use super::super::stored::StoredBytes;
use super::fault::Fault;

/// Bytes of the temporary file that are read at a time, a multiple of the size of every number.
const BUFFER: u64 = 1 << 16;

/// A byte string.
#[derive(Debug, Clone, Copy)]
pub(super) enum Payload<'a> {
    Bytes(&'a [u8]),
    /// A range of the temporary file.
    Stored {
        file: &'a Arc<StoredBytes>,
        offset: u64,
        len: u64,
    },
}

impl<'a> Payload<'a> {
    /// Begins to read the bytes.
    pub(super) fn bytes(self) -> ByteStream<'a> {
        match self {
            Self::Bytes(bytes) => {
                ByteStream { buffer: Cow::Borrowed(bytes), at: 0, len: bytes.len() as u64, rest: None }
            }
            Self::Stored { file, offset, len } => {
                let rest = (Arc::clone(file), offset..offset + len);
                ByteStream { buffer: Cow::Owned(Vec::new()), at: 0, len, rest: Some(rest) }
            }
        }
    }
}

/// Bytes of a byte string, in order.
#[derive(Debug)]
pub(super) struct ByteStream<'a> {
    buffer: Cow<'a, [u8]>,
    at: usize,
    /// Length of the byte string.
    pub(super) len: u64,
    /// Temporary file, and the range of the bytes after the buffer.
    rest: Option<(Arc<StoredBytes>, std::ops::Range<u64>)>,
}

impl ByteStream<'_> {
    /// Copies the bytes that are in memory.
    pub(super) fn into_owned(self) -> ByteStream<'static> {
        let Self { buffer, at, len, rest } = self;
        ByteStream { buffer: Cow::Owned(buffer.into_owned()), at, len, rest }
    }

    /// Returns at most `most` of the next bytes, and none only at the end.
    pub(super) fn next(&mut self, most: usize) -> Result<&[u8], Box<Fault>> {
        if self.at == self.buffer.len()
            && let Some((file, range)) = &mut self.rest
        {
            let n = BUFFER.min(range.end - range.start);
            let buffer = self.buffer.to_mut();
            buffer.resize(usize::try_from(n).unwrap_or(0), 0);
            file.read(range.start, buffer).map_err(Fault::of_scratch)?;
            range.start += n;
            self.at = 0;
        }
        let start = self.at;
        self.at = start.saturating_add(most).min(self.buffer.len());
        Ok(&self.buffer[start..self.at])
    }
}
