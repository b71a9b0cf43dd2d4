//! `.gltf`: the document as JSON, with the buffer as a base64 data URI that is encoded while writing.

use std::io::{self, BufWriter, IntoInnerError, Write};

use base64::engine::general_purpose::STANDARD;
use base64::write::EncoderWriter;
use molmesh_surface::Mesh;
use serde_json::Value;

use super::buffer::write_buffer;
use super::document::{Content, document};
use super::layout::{BufferLayout, Drawn};
use crate::block::BLOCK_BYTES;
use crate::check::Summary;
use crate::{FormatError, Meta, Storage};

/// Layout of a `.gltf` file.
#[derive(Debug)]
pub(crate) struct GltfPlan {
    /// Text before the base64; the whole text if there is no buffer.
    before: Vec<u8>,
    /// Text after the base64.
    after: &'static [u8],
    layout: Option<BufferLayout>,
}

impl GltfPlan {
    pub(crate) fn new(mesh: &Mesh, storage: Storage, summary: &Summary, meta: &Meta) -> Result<Self, FormatError> {
        let layout = BufferLayout::of(mesh, storage, summary)?;
        let content = layout.as_ref().map(Content::Columns);
        let mut document = document(mesh.centre, summary, storage, content, &Drawn::of(mesh, summary), meta)?;
        // The entry of the buffer comes last and is formatted here, so that `write` can insert the base64 into it.
        document.shift_remove("buffers");
        let json = |error: serde_json::Error| FormatError::Json { reason: error.to_string() };
        let mut before = serde_json::to_vec(&Value::Object(document)).map_err(json)?;
        let Some(open) = &layout else { return Ok(Self { before, after: b"", layout: None }) };
        before.pop();
        let length = open.len;
        let entry = format!(r#","buffers":[{{"byteLength":{length},"uri":"data:application/octet-stream;base64,"#);
        before.extend_from_slice(entry.as_bytes());
        Ok(Self { before, after: br#""}]}"#, layout })
    }

    pub(crate) fn len(&self) -> u64 {
        let text = (self.before.len() + self.after.len()) as u64;
        text + self.layout.map_or(0, |layout| layout.len.div_ceil(3) * 4)
    }

    pub(crate) fn write(&self, mesh: &Mesh, out: &mut dyn Write) -> io::Result<()> {
        out.write_all(&self.before)?;
        if let Some(layout) = &self.layout {
            // The encoder writes pieces of 1 KiB.
            let buffered = BufWriter::with_capacity(BLOCK_BYTES, &mut *out);
            let mut base64 = EncoderWriter::new(buffered, &STANDARD);
            write_buffer(mesh, layout, &mut base64)?;
            base64.finish()?.into_inner().map_err(IntoInnerError::into_error)?;
        }
        out.write_all(self.after)
    }
}
