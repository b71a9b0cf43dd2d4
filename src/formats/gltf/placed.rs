//! A GLB written out of order: rows go to their final place as they come, the header last.
//!
//! The bytes are those that [`GlbPlan`](super::glb::GlbPlan) writes in order. That works because a large buffer
//! begins at a fixed place; a small one waits in memory until the header is known.

use std::io::{self, Write};
use std::sync::{Mutex, OnceLock, PoisonError};

use thiserror::Error;

use super::buffer::write_indices;
use super::glb::{GlbPlan, HEAD_BYTES, LARGE_BUFFER_BYTES};
use super::layout::Layout;
use crate::formats::block::write_floats;
use crate::formats::check::Summary;
use crate::formats::{FormatError, Meta};
use crate::surface::{MeshPart, MeshSink, SinkFailed};

/// Something that takes bytes at any place, from several threads at once: a file.
pub trait PlaceBytes: Sync {
    /// Writes `bytes` from byte `offset` on.
    ///
    /// # Errors
    /// That of the system.
    fn place(&self, offset: u64, bytes: &[u8]) -> io::Result<()>;
}

/// Why a GLB could not be written.
#[derive(Debug, Error)]
pub enum PlaceError {
    /// The format cannot hold the mesh.
    #[error(transparent)]
    Format(#[from] FormatError),
    /// Whatever takes the bytes failed.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// The header is longer than what is kept free for it: write the mesh in order instead.
    #[error("the header takes {bytes} bytes, {HEAD_BYTES} are kept free for it")]
    HeadTooLong {
        /// Its length.
        bytes: u64,
    },
}

/// A GLB that is being written into `out`.
pub struct GlbSink<'a> {
    out: &'a dyn PlaceBytes,
    layout: OnceLock<Option<Layout>>,
    /// The buffer, if it is small.
    small: Mutex<Vec<u8>>,
    failure: Mutex<Option<PlaceError>>,
}

impl<'a> GlbSink<'a> {
    /// A GLB that will be written into `out`, which is empty.
    #[must_use]
    pub fn new(out: &'a dyn PlaceBytes) -> Self {
        Self { out, layout: OnceLock::new(), small: Mutex::default(), failure: Mutex::default() }
    }

    /// Why a part was refused.
    #[must_use]
    pub fn failure(&self) -> Option<PlaceError> {
        self.failure.lock().unwrap_or_else(PoisonError::into_inner).take()
    }

    /// Writes the header; the file is then complete. `centre` is the mesh's, `bounds` are those of its positions.
    /// Returns the length of the file.
    ///
    /// # Errors
    /// Any [`PlaceError`].
    pub fn finish(&self, meta: &Meta, centre: [f64; 3], bounds: [[f32; 3]; 2]) -> Result<u64, PlaceError> {
        // Adding zero turns −0 into 0, which JSON would tell apart.
        let bounds = bounds.map(|row| row.map(|v| v + 0.0));
        let summary = Summary { bounds, max_atom: None, translucent: false };
        let layout = self.layout.get().copied().flatten();
        let plan = GlbPlan::placed(layout, centre, &summary, meta)?;
        let head = plan.head().len() as u64;
        let small = self.small.lock().unwrap_or_else(PoisonError::into_inner);
        if layout.is_some() && small.is_empty() && head != HEAD_BYTES {
            return Err(PlaceError::HeadTooLong { bytes: head });
        }
        self.out.place(0, plan.head())?;
        let Some(layout) = layout else { return Ok(plan.len()) };
        if !small.is_empty() {
            self.out.place(head, &small)?;
        }
        let end = head + layout.len;
        let padding = usize::try_from(plan.len() - end).unwrap_or(0);
        self.out.place(end, &[0; 3][..padding])?;
        Ok(plan.len())
    }

    fn try_begin(&self, n_vertices: usize, n_triangles: usize) -> Result<(), PlaceError> {
        let layout = Layout::plain(n_vertices as u64, n_triangles as u64)?;
        if let Some(layout) = layout {
            GlbPlan::check_len(HEAD_BYTES + layout.len.next_multiple_of(4))?;
            if layout.len < LARGE_BUFFER_BYTES {
                let mut small = self.small.lock().unwrap_or_else(PoisonError::into_inner);
                small.resize(usize::try_from(layout.len).unwrap_or(0), 0);
            }
        }
        // A second call would have the same counts.
        let _set = self.layout.set(layout).is_ok();
        Ok(())
    }

    fn try_part(&self, part: &MeshPart<'_>) -> Result<(), PlaceError> {
        let Some(layout) = self.layout.get().copied().flatten() else { return Ok(()) };
        let row = 12 * part.first_vertex as u64;
        let (index_type, indices) = layout.indices;
        let first = 3 * part.first_triangle as u64 * index_type.bytes();
        write_floats(&mut self.at(layout.positions.offset + row), part.positions)?;
        write_floats(&mut self.at(layout.normals.offset + row), part.normals)?;
        write_indices(&mut self.at(indices.offset + first), index_type, part.triangles.as_flattened())?;
        Ok(())
    }

    fn at(&self, offset: u64) -> At<'_> {
        At { sink: self, offset }
    }

    fn note<T>(&self, done: Result<T, PlaceError>) -> Result<T, SinkFailed> {
        done.map_err(|error| {
            self.failure.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(error);
            SinkFailed
        })
    }
}

impl MeshSink for GlbSink<'_> {
    fn begin(&self, n_vertices: usize, n_triangles: usize) -> Result<(), SinkFailed> {
        self.note(self.try_begin(n_vertices, n_triangles))
    }

    fn part(&self, part: &MeshPart<'_>) -> Result<(), SinkFailed> {
        self.note(self.try_part(part))
    }
}

/// Writes from a place in the buffer on.
struct At<'a> {
    sink: &'a GlbSink<'a>,
    /// In the buffer, not in the file.
    offset: u64,
}

impl Write for At<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let mut small = self.sink.small.lock().unwrap_or_else(PoisonError::into_inner);
        if small.is_empty() {
            drop(small);
            self.sink.out.place(HEAD_BYTES + self.offset, bytes)?;
        } else {
            let start = usize::try_from(self.offset).unwrap_or(usize::MAX);
            let place = small.get_mut(start..).and_then(|rest| rest.get_mut(..bytes.len()));
            place.ok_or(io::ErrorKind::InvalidInput)?.copy_from_slice(bytes);
        }
        self.offset += bytes.len() as u64;
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}
