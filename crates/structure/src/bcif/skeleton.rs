//! BinaryCIF file without its large byte strings, which are moved to a temporary file while it is read.
//!
//! The values of a MessagePack file are read one after the other, without regard to their nesting: where a byte string
//! begins follows from the heads of the values before it.

use std::sync::Arc;

use molmesh_surface::{Control, MemoryMeter as _, Reservation};

use super::super::error::StructureError;
use super::super::stored::StoredBytes;

/// Byte string in the temporary file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Cut {
    /// Position in the skeleton of the byte that replaces it.
    at: usize,
    /// Offset in the temporary file.
    pub(super) offset: u64,
    /// Number of bytes, less than declared at the end of a truncated file.
    pub(super) len: u64,
    /// Offset in the file.
    start: u64,
}

/// File without its large byte strings.
#[derive(Debug)]
pub(in super::super) struct Skeleton {
    /// Each large byte string is replaced by one byte behind its head.
    pub(super) bytes: Vec<u8>,
    /// In ascending order.
    cuts: Vec<Cut>,
    pub(super) file: Arc<StoredBytes>,
    /// Minimum length of the byte strings that are moved.
    least: u64,
    /// Start of the current value.
    head: usize,
    /// Number of bytes of the current value that have not been read.
    left: u64,
    /// True if the current value is moved.
    moves: bool,
    memory: Reservation,
}

impl Skeleton {
    /// Begins to read a file. Byte strings of `least` bytes and more are moved to `file`.
    pub(in super::super) fn new(file: &Arc<StoredBytes>, least: u64, control: &Control<'_>) -> Self {
        Self {
            bytes: Vec::new(),
            cuts: Vec::new(),
            file: Arc::clone(file),
            least: least.max(1),
            head: 0,
            left: 0,
            moves: false,
            memory: Reservation::new(&control.memory),
        }
    }

    /// Adds the next bytes of the file.
    ///
    /// # Errors
    /// Returns [`StructureError::Memory`] and [`StructureError::Scratch`].
    pub(in super::super) fn add(&mut self, mut input: &[u8]) -> Result<(), StructureError> {
        while let Some((first, rest)) = input.split_first() {
            if self.left == 0 {
                self.append(&[*first])?;
                self.begin()?;
                input = rest;
                continue;
            }
            let n = usize::try_from(self.left).unwrap_or(usize::MAX).min(input.len());
            let (part, others) = input.split_at(n);
            match self.cuts.last_mut() {
                Some(cut) if self.moves => {
                    self.file.write(cut.offset + cut.len, part)?;
                    cut.len += n as u64;
                }
                _ => self.append(part)?,
            }
            self.left -= n as u64;
            if self.left == 0 {
                self.head = self.bytes.len();
            }
            input = others;
        }
        Ok(())
    }

    /// Begins the current value if its head is complete.
    fn begin(&mut self) -> Result<(), StructureError> {
        let Some((len, is_bytes)) = content(&self.bytes[self.head..]) else { return Ok(()) };
        self.left = len;
        self.moves = is_bytes && len >= self.least;
        if self.moves {
            let (at, offset) = (self.bytes.len(), self.file.reserve(len));
            let start = self.offset(at);
            self.memory.grow(size_of::<Cut>() as u64)?;
            self.append(&[0])?;
            self.cuts.push(Cut { at, offset, len: 0, start });
        }
        if len == 0 {
            self.head = self.bytes.len();
        }
        Ok(())
    }

    fn append(&mut self, bytes: &[u8]) -> Result<(), StructureError> {
        self.memory.reserve_rows(&mut self.bytes, bytes.len())?;
        self.bytes.extend_from_slice(bytes);
        Ok(())
    }

    /// Returns the byte string that a position replaces.
    pub(super) fn cut_at(&self, at: usize) -> Option<Cut> {
        let found = self.cuts.binary_search_by_key(&at, |cut| cut.at).ok()?;
        Some(self.cuts[found])
    }

    /// Returns the offset in the file of a position.
    pub(super) fn offset(&self, at: usize) -> u64 {
        let before = self.cuts.partition_point(|cut| cut.at < at);
        match before.checked_sub(1).and_then(|last| self.cuts.get(last)) {
            None => at as u64,
            Some(cut) => cut.start + cut.len + (at - cut.at - 1) as u64,
        }
    }
}

/// Returns the number of bytes behind the head of a value, and true for a byte string. Returns `None` if the head is
/// not complete. The content of a container is values of their own.
fn content(head: &[u8]) -> Option<(u64, bool)> {
    let first = *head.first()?;
    let length = |log: u8, more: usize| {
        let size = 1 << log;
        let digits = head.get(1..1 + size + more)?;
        Some(digits[..size].iter().fold(0, |n, digit| n << 8 | u64::from(*digit)))
    };
    let (len, is_bytes) = match first {
        0xA0..=0xBF => (u64::from(first & 31), false),
        0xC4..=0xC6 => (length(first - 0xC4, 0)?, true),
        // The type of an extension precedes its content.
        0xC7..=0xC9 => (length(first - 0xC7, 1)?, false),
        0xCA | 0xDD | 0xDF => (4, false),
        0xCB => (8, false),
        0xCC..=0xCF => (1 << (first - 0xCC), false),
        0xD0..=0xD3 => (1 << (first - 0xD0), false),
        0xD4..=0xD8 => (1 + (1 << (first - 0xD4)), false),
        0xD9..=0xDB => (length(first - 0xD9, 0)?, false),
        0xDC | 0xDE => (2, false),
        _ => (0, false),
    };
    Some((len, is_bytes))
}
