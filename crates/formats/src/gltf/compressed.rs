//! GLB whose vertices and indices are compressed. The pieces are compressed before, so the length of the file is known.

use std::io::{self, Write};

use molmesh_surface::Mesh;

use super::buffer::ColumnRows;
use super::document::{Content, document};
use super::glb::head;
use super::layout::Drawn;
use super::pieces::Pieces;
use crate::{FormatError, Meta};

/// Planned GLB of a compressed mesh.
#[derive(Debug)]
pub struct CompressedGlb<'a> {
    mesh: &'a Mesh,
    pieces: &'a Pieces,
    /// Everything before the buffer.
    head: Vec<u8>,
    len: u32,
}

impl<'a> CompressedGlb<'a> {
    /// Plans the file of `mesh`, whose `pieces` are compressed.
    ///
    /// # Errors
    /// Returns [`FormatError::Limit`], or [`FormatError::OutOfQuantizationRange`] for positions beyond the range of the
    /// step.
    pub fn new(mesh: &'a Mesh, pieces: &'a Pieces, meta: &Meta) -> Result<Self, FormatError> {
        let Pieces { storage, summary, .. } = pieces;
        let content = (!pieces.is_empty()).then_some(Content::Pieces(pieces));
        let document = document(mesh.centre, summary, *storage, content, &Drawn::of(mesh, summary), meta)?;
        let json = serde_json::to_vec(&document).map_err(|e| FormatError::Json { reason: e.to_string() })?;
        let (head, len) = head(json, content.map(|_| pieces.buffer_bytes()), false)?;
        Ok(Self { mesh, pieces, head, len })
    }

    /// Returns the exact length of the file, bytes.
    #[must_use]
    pub fn encoded_len(&self) -> u64 {
        u64::from(self.len)
    }

    /// Writes the file and flushes `out`.
    ///
    /// # Errors
    /// Returns the errors of `out`.
    pub fn write(&self, out: &mut dyn Write) -> io::Result<()> {
        out.write_all(&self.head)?;
        // The lengths of pieces and placements are multiples of 4.
        self.pieces.data().try_for_each(|data| out.write_all(data))?;
        if let (Some(placements), Some(layout)) = (&self.mesh.placements, self.pieces.layout()) {
            ColumnRows::Translations(&placements.translations).write(layout, out)?;
            ColumnRows::Rotations(&placements.rotations).write(layout, out)?;
        }
        out.flush()
    }
}
