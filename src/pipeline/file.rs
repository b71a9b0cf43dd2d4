//! What becomes of a product in a format: a mesh file that is laid out, or the picture that was drawn.

use std::io::{self, Write};

use super::Product;
use crate::formats::{Encoder, Format, FormatError};

/// A file that is known and not yet written.
#[derive(Debug)]
pub enum File<'a> {
    /// A mesh.
    Mesh(Encoder<'a>),
    /// A picture.
    Picture(&'a [u8]),
}

impl Product {
    /// The file of this product in `format`.
    ///
    /// # Errors
    /// Any [`FormatError`]; [`FormatError::NotAMesh`] for a picture that nobody has drawn.
    pub fn file(&self, format: Format) -> Result<File<'_>, FormatError> {
        match &self.picture {
            Some(picture) if format.is_picture() => Ok(File::Picture(picture)),
            _ => Ok(File::Mesh(Encoder::stored(format, self.storage, &self.mesh, &self.meta())?)),
        }
    }
}

impl File<'_> {
    /// Bytes of the file, exactly; `None` where they are known only afterwards.
    #[must_use]
    pub fn bytes(&self) -> Option<u64> {
        match self {
            Self::Mesh(encoder) => encoder.encoded_len(),
            Self::Picture(bytes) => Some(bytes.len() as u64),
        }
    }

    /// Bytes of the file at most; exact where [`Self::bytes`] is.
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
    /// Those of `out`.
    pub fn write(&self, out: &mut dyn Write) -> io::Result<()> {
        match self {
            Self::Mesh(encoder) => encoder.write(out),
            Self::Picture(bytes) => out.write_all(bytes).and_then(|()| out.flush()),
        }
    }
}
