//! GLB sink: writes the rows of a mesh to their final offset as they arrive, and the header last.
//!
//! The bytes are those of [`GlbPlan::write`]. A large buffer begins at a fixed place, so its rows can be written before
//! the header is known; a small one waits in memory.

use std::io::{self, Seek, SeekFrom, Write};
use std::sync::{Mutex, MutexGuard, OnceLock, PoisonError};

use thiserror::Error;

use super::buffer::{write_indices, write_normals, write_positions};
use super::glb::{GlbPlan, HEAD_BYTES, LARGE_BUFFER_BYTES};
use super::layout::Layout;
use crate::formats::block::{write_bytes, write_shorts};
use crate::formats::check::Summary;
use crate::formats::{FormatError, Meta, Storage};
use crate::surface::{MeshPart, MeshSink, SinkFailed, Vertices};

/// Output with random access, such as a file.
pub trait RandomAccess: Write + Seek + Send {}

impl<T: Write + Seek + Send> RandomAccess for T {}

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

/// Blocks that may wait for the output before a thread waits, too.
const MAX_WAITING: usize = 48;

/// Locked output of a sink.
type Output<'l, 'a> = MutexGuard<'l, &'a mut dyn RandomAccess>;

/// Sink that writes a GLB.
pub struct GlbSink<'a> {
    /// Writes to a file are serialized by the system; a thread that finds the output in use leaves its blocks in
    /// `waiting` and continues to compute.
    out: Mutex<&'a mut dyn RandomAccess>,
    /// Blocks with their offsets in the buffer, oldest first.
    waiting: Mutex<Vec<(u64, Vec<u8>)>>,
    storage: OnceLock<Storage>,
    layout: OnceLock<Option<Layout>>,
    failure: Mutex<Option<GlbSinkError>>,
}

impl<'a> GlbSink<'a> {
    /// Sink that writes to `out`, which is empty.
    #[must_use]
    pub fn new(out: &'a mut dyn RandomAccess) -> Self {
        Self {
            out: Mutex::new(out),
            waiting: Mutex::default(),
            storage: OnceLock::new(),
            layout: OnceLock::new(),
            failure: Mutex::default(),
        }
    }

    /// Sets how the mesh is stored. The first call before the mesh begins counts.
    pub fn store(&self, storage: impl Into<Storage>) {
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
        let plan = GlbPlan::placed(layout, self.storage(), centre, &summary, meta)?;
        let head = plan.head().len() as u64;
        if layout.is_some_and(|layout| layout.len >= LARGE_BUFFER_BYTES) && head != HEAD_BYTES {
            return Err(GlbSinkError::HeadTooLong { bytes: head });
        }
        let mut out = lock(&self.out);
        self.drain(&mut **out, head)?;
        write_at(&mut **out, 0, plan.head())?;
        if let Some(layout) = layout {
            let end = head + layout.len;
            let padding = usize::try_from(plan.len() - end).unwrap_or(0);
            write_at(&mut **out, end, &[0; 3][..padding])?;
        }
        Ok(plan.len())
    }

    fn storage(&self) -> Storage {
        *self.storage.get_or_init(Storage::default)
    }

    fn try_begin(&self, n_vertices: usize, n_triangles: usize) -> Result<(), GlbSinkError> {
        let layout = Layout::plain([n_vertices as u64, n_triangles as u64], self.storage())?;
        if let Some(layout) = layout {
            GlbPlan::check_len(HEAD_BYTES + layout.len.next_multiple_of(4))?;
        }
        let _first = self.layout.set(layout).is_ok();
        Ok(())
    }

    fn try_part(&self, part: &MeshPart<'_>) -> Result<(), GlbSinkError> {
        let Some(layout) = self.layout.get().copied().flatten() else { return Ok(()) };
        let packing = layout.storage.packing;
        let mut out = if layout.len >= LARGE_BUFFER_BYTES { self.output() } else { None };
        if let Some(out) = &mut out {
            // Waiting rows are older than these, which may replace them.
            self.drain(&mut ***out, HEAD_BYTES)?;
        }
        let row = part.first_vertex as u64;
        let positions = layout.positions.offset + packing.position_bytes() * row;
        let normals = layout.normals.map(|normals| normals.offset + packing.normal_bytes() * row);
        match part.vertices {
            Vertices::Single { positions: rows, normals: units } => {
                self.place(&mut out, positions, |out| write_positions(out, packing, rows))?;
                if let Some(normals) = normals {
                    self.place(&mut out, normals, |out| write_normals(out, packing, units))?;
                }
            }
            Vertices::Quantized { step, positions: rows, normals: units } if packing.step() == Some(step) => {
                self.place(&mut out, positions, |out| write_shorts(out, rows))?;
                if let Some(normals) = normals {
                    self.place(&mut out, normals, |out| write_bytes(out, units))?;
                }
            }
            Vertices::Quantized { step, .. } => return Err(FormatError::OtherPacking { step: step.length() }.into()),
        }
        let (index_type, indices) = layout.indices;
        let indices = indices.offset + 3 * index_type.bytes() * part.first_triangle as u64;
        self.place(&mut out, indices, |out| write_indices(out, index_type, part.triangles.as_flattened()))?;
        if let Some(out) = &mut out {
            self.drain(&mut ***out, HEAD_BYTES)?;
        }
        Ok(())
    }

    /// The output, or `None` if another thread is writing and not too many blocks are waiting.
    fn output(&self) -> Option<Output<'_, 'a>> {
        if lock(&self.waiting).len() > MAX_WAITING { Some(lock(&self.out)) } else { self.out.try_lock().ok() }
    }

    /// Writes rows from byte `offset` of a large buffer to the output, if there is one, or into a block that waits for
    /// it.
    fn place(
        &self,
        out: &mut Option<Output<'_, 'a>>,
        offset: u64,
        write: impl Fn(&mut dyn Write) -> io::Result<()>,
    ) -> io::Result<()> {
        if let Some(out) = out {
            out.seek(SeekFrom::Start(HEAD_BYTES + offset))?;
            return write(&mut **out);
        }
        let mut block = Vec::new();
        write(&mut block)?;
        lock(&self.waiting).push((offset, block));
        Ok(())
    }

    /// Writes the waiting blocks into the buffer, which begins at byte `base`.
    fn drain(&self, out: &mut dyn RandomAccess, base: u64) -> io::Result<()> {
        loop {
            let blocks = std::mem::take(&mut *lock(&self.waiting));
            if blocks.is_empty() {
                return Ok(());
            }
            for (offset, block) in blocks {
                write_at(out, base + offset, &block)?;
            }
        }
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

/// Writes `bytes` at `offset`.
fn write_at(out: &mut dyn RandomAccess, offset: u64, bytes: &[u8]) -> io::Result<()> {
    out.seek(SeekFrom::Start(offset))?;
    out.write_all(bytes)
}

/// Locks a mutex and ignores poisoning: a panic of another thread leaves the data valid.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
