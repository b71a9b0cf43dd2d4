//! Output file of a product: a mesh file or a picture.

use std::io::{self, Write};

use super::Product;
use crate::formats::{Encoder, Format, FormatError};

/// Output file that is planned but not yet written.
#[derive(Debug)]
pub enum File<'a> {
    /// Mesh file.
    Mesh(Encoder<'a>),
    /// PNG of a picture.
    Picture(&'a [u8]),
}

impl Product {
    /// Plans the file of this product in `format`.
    ///
    /// # Errors
    /// Returns a [`FormatError`]; [`FormatError::NotAMeshFormat`] for a picture that was not drawn.
    pub fn file(&self, format: Format) -> Result<File<'_>, FormatError> {
        match &self.picture {
            Some(picture) if format.is_picture() => Ok(File::Picture(picture)),
            _ => Ok(File::Mesh(Encoder::new(format, self.storage, &self.mesh, &self.meta())?)),
        }
    }
}

impl File<'_> {
    /// Returns the exact size of the file, bytes; `None` if it is known only after writing.
    #[must_use]
    pub fn bytes(&self) -> Option<u64> {
        match self {
            Self::Mesh(encoder) => encoder.encoded_len(),
            Self::Picture(bytes) => Some(bytes.len() as u64),
        }
    }

    /// Returns an upper bound of the size of the file, bytes. It is exact if [`Self::bytes`] is known.
    #[must_use]
    pub fn bytes_bound(&self) -> u64 {
        match self {
            Self::Mesh(encoder) => encoder.encoded_len_bound(),
            Self::Picture(bytes) => bytes.len() as u64,
        }
    }

    /// Writes the file and flushes `out`.
    ///
    /// # Errors
    /// Returns the errors of `out`.
    pub fn write(&self, out: &mut dyn Write) -> io::Result<()> {
        match self {
            Self::Mesh(encoder) => encoder.write(out),
            Self::Picture(bytes) => out.write_all(bytes).and_then(|()| out.flush()),
        }
    }
}
