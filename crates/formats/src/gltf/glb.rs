//! GLB: a header of 12 bytes, a chunk with the JSON, a chunk with the buffer; lengths are 32 bits wide.

use std::io::{self, Write};

use molmesh_surface::{Exceeded, Limit, Mesh};

use super::buffer::write_buffer;
use super::document::{Content, document};
use super::layout::{BufferLayout, Drawn};
use crate::check::Summary;
use crate::{FormatError, Meta, Storage};

const MAGIC: u32 = u32::from_le_bytes(*b"glTF");
const VERSION: u32 = 2;
const JSON: u32 = u32::from_le_bytes(*b"JSON");
const BIN: u32 = u32::from_le_bytes(*b"BIN\0");
/// Length of the file header and of a chunk header, bytes.
const HEADER_BYTES: u64 = 12;
const CHUNK_HEADER_BYTES: u64 = 8;

/// Size from which on a buffer begins at a multiple of [`HEAD_BYTES`], bytes. Such a buffer can be written, mapped or
/// requested by range before the JSON is known.
const LARGE_BUFFER_BYTES: u64 = 1 << 20;
/// Unit of the size of everything before a large buffer, bytes. The longest report takes 15,500 bytes: a hundred
/// components of 105 bytes, a title of a thousand characters of four bytes, and a thousand more bytes.
pub(super) const HEAD_BYTES: u64 = 16 << 10;

/// Returns true if the buffer begins at a multiple of [`HEAD_BYTES`].
pub(super) const fn is_large(layout: BufferLayout) -> bool {
    layout.len >= LARGE_BUFFER_BYTES
}

/// Layout of a GLB file.
#[derive(Debug)]
pub(crate) struct GlbPlan {
    /// Everything before the buffer.
    pub(super) head: Vec<u8>,
    layout: Option<BufferLayout>,
    len: u32,
}

impl GlbPlan {
    pub(crate) fn new(mesh: &Mesh, storage: Storage, summary: &Summary, meta: &Meta) -> Result<Self, FormatError> {
        let layout = BufferLayout::of(mesh, storage, summary)?;
        Self::placed(layout, &Drawn::of(mesh, summary), storage, mesh.centre, summary, meta)
    }

    /// Returns the layout of a mesh of which only the summary is known.
    pub(super) fn placed(
        layout: Option<BufferLayout>,
        drawn: &[Drawn<'_>],
        storage: Storage,
        centre: [f64; 3],
        summary: &Summary,
        meta: &Meta,
    ) -> Result<Self, FormatError> {
        let content = layout.as_ref().map(Content::Columns);
        let document = document(centre, summary, storage, content, drawn, meta)?;
        let json = serde_json::to_vec(&document).map_err(|e| FormatError::Json { reason: e.to_string() })?;
        Self::wrap(json, layout)
    }

    fn wrap(json: Vec<u8>, layout: Option<BufferLayout>) -> Result<Self, FormatError> {
        let (head, len) = head(json, layout.map(|layout| layout.len), layout.is_some_and(is_large))?;
        Ok(Self { head, layout, len })
    }

    pub(crate) fn len(&self) -> u64 {
        u64::from(self.len)
    }

    pub(crate) fn write(&self, mesh: &Mesh, out: &mut dyn Write) -> io::Result<()> {
        self.write_with(&mut { out }, |out, layout| write_buffer(mesh, layout, out))
    }

    /// Writes the file; `buffer` writes the `layout.len` bytes of the buffer.
    pub(super) fn write_with<W: Write>(
        &self,
        out: &mut W,
        buffer: impl FnOnce(&mut W, &BufferLayout) -> io::Result<()>,
    ) -> io::Result<()> {
        out.write_all(&self.head)?;
        let Some(layout) = &self.layout else { return Ok(()) };
        buffer(out, layout)?;
        let padding = layout.len.next_multiple_of(4) - layout.len;
        out.write_all(&[0; 3][..usize::try_from(padding).unwrap_or(0)])
    }
}

/// Returns everything before a buffer of `buffer_bytes`, and the length of the file. With `aligned`, the buffer begins
/// at a multiple of [`HEAD_BYTES`].
pub(super) fn head(mut json: Vec<u8>, buffer_bytes: Option<u64>, aligned: bool) -> Result<(Vec<u8>, u32), FormatError> {
    json.resize(json.len().next_multiple_of(4), b' ');
    if aligned {
        let around = HEADER_BYTES + 2 * CHUNK_HEADER_BYTES;
        let head = (json.len() as u64 + around).next_multiple_of(HEAD_BYTES);
        json.resize(usize::try_from(head - around).unwrap_or(json.len()), b' ');
    }
    let json_len = json.len() as u64;
    let bin_len = buffer_bytes.map(|bytes| bytes.next_multiple_of(4));
    let bytes = HEADER_BYTES + CHUNK_HEADER_BYTES + json_len + bin_len.map_or(0, |len| CHUNK_HEADER_BYTES + len);
    let len = check_len(bytes)?;
    // No chunk is longer than the file.
    let fits = |n: u64| u32::try_from(n).unwrap_or(u32::MAX);
    let mut head = Vec::with_capacity(json.len() + 28);
    for word in [MAGIC, VERSION, len, fits(json_len), JSON] {
        head.extend_from_slice(&word.to_le_bytes());
    }
    head.append(&mut json);
    if let Some(bin_len) = bin_len {
        for word in [fits(bin_len), BIN] {
            head.extend_from_slice(&word.to_le_bytes());
        }
    }
    Ok((head, len))
}

/// Returns the file length as the header stores it.
pub(super) fn check_len(bytes: u64) -> Result<u32, FormatError> {
    let error = |_overflow| {
        let hint = Some("the format ply or a tileset".into());
        let error = Exceeded { actual: Some(bytes), hint, ..Exceeded::new(Limit::FileBytes, u64::from(u32::MAX)) };
        error.error()
    };
    u32::try_from(bytes).map_err(error)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Packing;

    #[test]
    fn rejects_a_glb_of_four_gibibytes() {
        // 24 bytes per vertex and 12 per triangle, two triangles per vertex: 48 bytes a vertex.
        let fits = BufferLayout::plain([89_000_000, 178_000_000], Packing::Full).unwrap();
        assert_eq!(GlbPlan::wrap(vec![b' '; 1000], fits).unwrap().len(), 48 * 89_000_000 + HEAD_BYTES);
        let large = BufferLayout::plain([90_000_000, 180_000_000], Packing::Full).unwrap();
        let error = GlbPlan::wrap(vec![b' '; 1000], large).unwrap_err();
        assert!(error.to_string().starts_with("the file would have 4320016384 bytes, the limit is 4294967295; "));
    }

    #[test]
    fn glb_limit_is_exact() {
        // A GLB's length is a multiple of 4: the largest is 4,294,967,292 bytes.
        assert_eq!(check_len(4_294_967_295).unwrap(), u32::MAX);
        assert!(check_len(4_294_967_296).is_err());
    }

    #[test]
    fn a_large_buffer_begins_at_a_fixed_offset() {
        let head = |json: usize, vertices: u64| {
            let layout = BufferLayout::plain([vertices, 1], Packing::Full).unwrap();
            GlbPlan::wrap(vec![b' '; json], layout).unwrap().head.len() as u64
        };
        // 24 bytes a vertex and 3 indices of four bytes.
        let large = LARGE_BUFFER_BYTES.div_ceil(24);
        assert_eq!((head(10, large), head(16_000, large), head(16_356, large)), (HEAD_BYTES, HEAD_BYTES, HEAD_BYTES));
        assert_eq!(head(16_357, large), 2 * HEAD_BYTES);
        assert_eq!(head(10, large - 1), 40);
    }
}
