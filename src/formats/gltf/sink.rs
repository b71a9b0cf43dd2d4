//! GLB sink: writes the rows of a mesh to their final offset as they arrive, and the header last.
//!
//! The bytes are those of [`GlbPlan::write`]. A large buffer begins at a fixed offset, so its rows can be written
//! before the header is known. A small one is collected in memory.

use std::io::{self, Cursor, Write};
use std::sync::{Mutex, MutexGuard, OnceLock, PoisonError};

use thiserror::Error;

use super::buffer::Rows;
use super::glb::{GlbPlan, HEAD_BYTES, LARGE_BUFFER_BYTES};
use super::layout::{Drawn, Layout};
use crate::formats::check::Summary;
use crate::formats::{FormatError, Meta, Storage};
use crate::surface::{MeshPart, MeshSink, SinkFailed, Vertices};

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
    layout: OnceLock<Option<Layout>>,
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

    /// Writes the header, which completes the file, and returns the file's length in bytes. `centre` is that of the
    /// mesh, `bounds` are those of its positions.
    ///
    /// # Errors
    /// [`SinkFailed`]; see [`Self::failure`].
    pub fn finish(&self, meta: &Meta, centre: [f64; 3], bounds: [[f32; 3]; 2]) -> Result<u64, SinkFailed> {
        self.note(self.try_finish(meta, centre, bounds))
    }

    fn try_finish(&self, meta: &Meta, centre: [f64; 3], bounds: [[f32; 3]; 2]) -> Result<u64, GlbSinkError> {
        // Adding zero turns −0, which JSON would show, into 0.
        let bounds = bounds.map(|row| row.map(|v| v + 0.0));
        let summary = Summary { bounds, max_atom: None, translucent: false };
        let layout = self.layout.get().copied().flatten();
        let size = self.size.get().copied().unwrap_or_default();
        let drawn = [Drawn::whole(size, &summary)];
        let plan = GlbPlan::placed(layout, &drawn, self.storage(), centre, &summary, meta)?;
        let head = plan.head().len() as u64;
        let large = layout.is_some_and(|layout| layout.len >= LARGE_BUFFER_BYTES);
        if large && head != HEAD_BYTES {
            return Err(GlbSinkError::HeadTooLong { bytes: head });
        }
        self.out.write_all_at(plan.head(), 0)?;
        self.out.write_all_at(&lock(&self.small), head)?;
        if let Some(layout) = layout {
            let end = head + layout.len;
            let padding = usize::try_from(plan.len() - end).unwrap_or(0);
            self.out.write_all_at(&[0; 3][..padding], end)?;
        }
        Ok(plan.len())
    }

    fn storage(&self) -> Storage {
        *self.storage.get_or_init(Storage::default)
    }

    fn try_begin(&self, n_vertices: usize, n_triangles: usize) -> Result<(), GlbSinkError> {
        let size = *self.size.get_or_init(|| [n_vertices as u64, n_triangles as u64]);
        let layout = Layout::plain(size, self.storage())?;
        if let Some(layout) = layout {
            GlbPlan::check_len(HEAD_BYTES + layout.len.next_multiple_of(4))?;
        }
        if let Some(Layout { len, .. }) = self.layout.get_or_init(|| layout)
            && *len < LARGE_BUFFER_BYTES
        {
            lock(&self.small).resize(usize::try_from(*len).unwrap_or(0), 0);
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
        for (first, rows) in Rows::of_part(part) {
            if let Some(offset) = rows.offset(&layout, first) {
                self.write_at(&layout, offset, rows)?;
            }
        }
        Ok(())
    }

    /// Writes rows from byte `offset` of the buffer on.
    fn write_at(&self, layout: &Layout, offset: u64, rows: Rows<'_>) -> io::Result<()> {
        if layout.len >= LARGE_BUFFER_BYTES {
            return rows.write(layout, &mut WriterAt { out: self.out, offset: HEAD_BYTES + offset });
        }
        let mut small = lock(&self.small);
        let mut cursor = Cursor::new(&mut small[..]);
        cursor.set_position(offset);
        rows.write(layout, &mut cursor)
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
