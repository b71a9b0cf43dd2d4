//! GLB sink: writes the rows of a mesh to their final offset as they arrive, and the header last.
//!
//! The file has the same bytes as that of [`GlbPlan::write`]. A large buffer begins at a fixed offset, so its rows can
//! be written before the header is known. A small buffer is collected in memory.

use std::io::{self, Write};
use std::sync::{Mutex, MutexGuard, OnceLock, PoisonError};

use molmesh_surface::{MeshPart, MeshSink, SinkFailed, Vertices};
use thiserror::Error;

use super::buffer::ColumnRows;
use super::glb::{GlbPlan, HEAD_BYTES, check_len, is_large};
use super::layout::{BufferLayout, Drawn};
use crate::check::Summary;
use crate::{FormatError, Meta, Storage};

/// Output with random access, such as a file. Several threads write to it concurrently.
pub trait RandomAccess: Sync {
    /// Writes all `bytes` from byte `offset` on.
    ///
    /// # Errors
    /// Returns the error of the output.
    fn write_all_at(&self, bytes: &[u8], offset: u64) -> io::Result<()>;
}

/// Error of a [`GlbSink`].
#[derive(Debug, Error)]
pub enum GlbSinkError {
    /// The format cannot hold the mesh.
    #[error(transparent)]
    Format(#[from] FormatError),
    /// The output failed.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// The header exceeds the space reserved for it.
    #[error("the GLB header has {bytes} bytes, more than the {HEAD_BYTES} reserved for it")]
    HeadTooLong {
        /// Length of the header.
        bytes: u64,
    },
}

/// Sink that writes a GLB.
pub struct GlbSink<'a> {
    out: &'a dyn RandomAccess,
    storage: OnceLock<Storage>,
    layout: OnceLock<Option<BufferLayout>>,
    /// Numbers of vertices and triangles.
    size: OnceLock<[u64; 2]>,
    /// Contents of a small buffer.
    small: Mutex<Vec<u8>>,
    failure: Mutex<Option<GlbSinkError>>,
}

impl<'a> GlbSink<'a> {
    /// Creates a sink that writes to `out`, which must be empty.
    #[must_use]
    pub fn new(out: &'a dyn RandomAccess) -> Self {
        let (storage, layout, size) = (OnceLock::new(), OnceLock::new(), OnceLock::new());
        Self { out, storage, layout, size, small: Mutex::default(), failure: Mutex::default() }
    }

    /// Sets the storage of the mesh in the file. Only the first call before the mesh begins has an effect.
    pub fn set_storage(&self, storage: impl Into<Storage>) {
        let _first = self.storage.set(storage.into()).is_ok();
    }

    /// Takes the error behind a [`SinkFailed`].
    #[must_use]
    pub fn failure(&self) -> Option<GlbSinkError> {
        lock(&self.failure).take()
    }

    /// Completes the file with its header. Returns the length of the file, bytes. `centre` is the centre of the mesh,
    /// and `bounds` are the bounds of its positions.
    ///
    /// # Errors
    /// [`SinkFailed`]; see [`Self::failure`].
    pub fn finish(&self, meta: &Meta, centre: [f64; 3], bounds: [[f32; 3]; 2]) -> Result<u64, SinkFailed> {
        self.note(self.try_finish(meta, centre, bounds))
    }

    fn try_finish(&self, meta: &Meta, centre: [f64; 3], bounds: [[f32; 3]; 2]) -> Result<u64, GlbSinkError> {
        // Adding zero turns −0 into 0. JSON distinguishes them.
        let bounds = bounds.map(|row| row.map(|v| v + 0.0));
        let summary = Summary { bounds, max_atom: None, translucent: false, open: false };
        let layout = self.layout.get().copied().flatten();
        let size = self.size.get().copied().unwrap_or_default();
        let drawn = [Drawn::whole(size, &summary)];
        let plan = GlbPlan::placed(layout, &drawn, self.storage(), centre, &summary, meta)?;
        let bytes = plan.head.len() as u64;
        let large = layout.is_some_and(is_large);
        if large && bytes != HEAD_BYTES {
            return Err(GlbSinkError::HeadTooLong { bytes });
        }
        plan.write_with(&mut WriterAt { out: self.out, offset: 0 }, |out, layout| {
            // The rows of a large buffer are in the file already.
            out.offset += if large { layout.len } else { 0 };
            out.write_all(&lock(&self.small))
        })?;
        Ok(plan.len())
    }

    fn storage(&self) -> Storage {
        *self.storage.get_or_init(Storage::default)
    }

    fn try_begin(&self, n_vertices: usize, n_triangles: usize) -> Result<(), GlbSinkError> {
        let size = *self.size.get_or_init(|| [n_vertices as u64, n_triangles as u64]);
        let layout = BufferLayout::plain(size, self.storage())?;
        if let Some(layout) = layout {
            check_len(HEAD_BYTES + layout.len.next_multiple_of(4))?;
        }
        if let Some(layout) = self.layout.get_or_init(|| layout).filter(|&layout| !is_large(layout)) {
            lock(&self.small).resize(usize::try_from(layout.len).unwrap_or(0), 0);
        }
        Ok(())
    }

    fn try_part(&self, part: &MeshPart<'_>) -> Result<(), GlbSinkError> {
        let Some(layout) = self.layout.get().copied().flatten() else { return Ok(()) };
        if let Vertices::Quantized { step, .. } = part.vertices
            && layout.storage.packing.step() != Some(step)
        {
            return Err(FormatError::AlreadyQuantized { step: step.length() }.into());
        }
        let (out, start): (&dyn RandomAccess, u64) =
            if is_large(layout) { (self.out, HEAD_BYTES) } else { (&self.small, 0) };
        for (first, rows) in ColumnRows::of_part(part) {
            if let Some(offset) = rows.offset(&layout, first) {
                rows.write(&layout, &mut WriterAt { out, offset: start + offset })?;
            }
        }
        Ok(())
    }

    fn note<T>(&self, done: Result<T, GlbSinkError>) -> Result<T, SinkFailed> {
        done.map_err(|error| {
            lock(&self.failure).get_or_insert(error);
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

/// Buffer of fixed size in memory.
impl RandomAccess for Mutex<Vec<u8>> {
    fn write_all_at(&self, bytes: &[u8], offset: u64) -> io::Result<()> {
        let start = usize::try_from(offset).unwrap_or(usize::MAX);
        let mut memory = lock(self);
        (&mut memory.get_mut(start..).unwrap_or_default()[..]).write_all(bytes)
    }
}

/// Writer that begins at an offset of the output.
struct WriterAt<'a> {
    out: &'a dyn RandomAccess,
    offset: u64,
}

impl Write for WriterAt<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.out.write_all_at(bytes, self.offset)?;
        self.offset += bytes.len() as u64;
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Locks a mutex and ignores poisoning: a panic of another thread leaves the data valid.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
