//! Temporary file with random access.

use std::fs::File;
use std::io::{ErrorKind, Read as _, Seek as _, SeekFrom, Write as _};
use std::sync::{Arc, Mutex, PoisonError};

use molmesh_surface::{Exceeded, Limit, MemoryMeter, OutOfMemory, Reservation};

use super::error::StructureError;

/// Empty temporary file, and the meter of its size.
#[derive(Debug)]
pub struct ScratchFile {
    /// Empty file that can be read and written.
    pub file: File,
    /// Counter of the bytes in the file.
    pub meter: Arc<dyn MemoryMeter>,
}

/// Temporary file that only grows. Each range is reserved, written once and read by its offset.
#[derive(Debug)]
pub struct StoredBytes {
    file: Mutex<(File, u64)>,
    bytes: Reservation,
}

impl StoredBytes {
    /// Takes an empty file.
    #[must_use]
    pub fn new(ScratchFile { file, meter }: ScratchFile) -> Self {
        Self { file: Mutex::new((file, 0)), bytes: Reservation::new(&meter) }
    }

    /// Reserves `length` bytes at the end. Returns their offset.
    #[must_use]
    pub fn reserve(&self, length: u64) -> u64 {
        let mut guard = self.file.lock().unwrap_or_else(PoisonError::into_inner);
        let offset = guard.1;
        guard.1 += length;
        offset
    }

    /// Writes bytes at a reserved offset, once, and adds them to the meter.
    ///
    /// # Errors
    /// Returns [`StructureError::Scratch`], [`StructureError::DiskFull`], [`StructureError::DiskSpace`] and
    /// [`StructureError::Limit`].
    pub fn write(&self, offset: u64, bytes: &[u8]) -> Result<(), StructureError> {
        self.bytes.grow(bytes.len() as u64).map_err(|error| match error {
            OutOfMemory::Limit { needed, limit } => {
                Exceeded { actual: Some(needed), ..Exceeded::new(Limit::ScratchBytes, limit) }.error()
            }
            error => StructureError::DiskSpace(error),
        })?;
        self.at(offset, |file| file.write_all(bytes))
    }

    /// Reads bytes from an offset on.
    ///
    /// # Errors
    /// Returns [`StructureError::Scratch`].
    pub fn read(&self, offset: u64, bytes: &mut [u8]) -> Result<(), StructureError> {
        self.at(offset, |file| file.read_exact(bytes))
    }

    fn at(&self, offset: u64, act: impl FnOnce(&mut File) -> std::io::Result<()>) -> Result<(), StructureError> {
        let mut guard = self.file.lock().unwrap_or_else(PoisonError::into_inner);
        let file = &mut guard.0;
        let done = file.seek(SeekFrom::Start(offset)).and_then(|_| act(file));
        done.map_err(|error| match error.kind() {
            ErrorKind::StorageFull | ErrorKind::QuotaExceeded => StructureError::DiskFull,
            _ => StructureError::Scratch { reason: error.to_string() },
        })
    }
}
