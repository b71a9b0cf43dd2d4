//! A GLB written out of order: rows go to their final place as they come, the header last.
//!
//! The bytes are those that [`GlbPlan`](super::glb::GlbPlan) writes in order. That works because a large buffer
//! begins at a fixed place; a small one waits in memory until the header is known.

use std::io::{self, Write};
use std::sync::{Mutex, MutexGuard, OnceLock, PoisonError};

use thiserror::Error;

use super::buffer::{extend_indices, write_indices, write_normals, write_positions};
use super::glb::{GlbPlan, HEAD_BYTES, LARGE_BUFFER_BYTES};
use super::layout::{IndexType, Layout};
use crate::formats::block::{write_bytes, write_shorts};
use crate::formats::check::Summary;
use crate::formats::{FormatError, Meta, Storage};
use crate::surface::{MeshPart, MeshSink, SinkFailed, Vertices};

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
    /// The header is longer than what is kept free for it.
    #[error("the header takes {bytes} bytes, {HEAD_BYTES} are kept free for it")]
    HeadTooLong {
        /// Its length.
        bytes: u64,
    },
}

/// Blocks that may wait for the file.
const MOST_WAITING: usize = 48;
/// Room in a block: what a part has of one column is mostly less.
const BLOCK_BYTES: usize = 96 << 10;

/// A GLB that is being written into `out`.
pub struct GlbSink<'a> {
    out: &'a dyn PlaceBytes,
    storage: OnceLock<Storage>,
    layout: OnceLock<Option<Layout>>,
    /// The buffer, if it is small.
    small: Mutex<Vec<u8>>,
    /// Held by whoever writes into the file. Systems let one thread at a time write to a file and put the others to
    /// sleep; threads that find it taken leave their bytes in `waiting` and compute on.
    lane: Mutex<()>,
    waiting: Mutex<Vec<(u64, Vec<u8>)>>,
    /// Blocks that were written: fresh memory costs more than the copy.
    spare: Mutex<Vec<Vec<u8>>>,
    failure: Mutex<Option<PlaceError>>,
}

impl<'a> GlbSink<'a> {
    /// A GLB that will be written into `out`, which is empty.
    #[must_use]
    pub fn new(out: &'a dyn PlaceBytes) -> Self {
        Self {
            out,
            storage: OnceLock::new(),
            layout: OnceLock::new(),
            small: Mutex::default(),
            lane: Mutex::default(),
            waiting: Mutex::default(),
            spare: Mutex::default(),
            failure: Mutex::default(),
        }
    }

    /// Says how the mesh is stored. To be called before it begins, as the places of vertices depend on it; a second call
    /// changes nothing.
    pub fn store(&self, storage: impl Into<Storage>) {
        let _first = self.storage.set(storage.into()).is_ok();
    }

    /// Why a part was refused.
    #[must_use]
    pub fn failure(&self) -> Option<PlaceError> {
        lock(&self.failure).take()
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
        let plan = GlbPlan::placed(layout, *self.storage.get_or_init(Storage::default), centre, &summary, meta)?;
        let head = plan.head().len() as u64;
        let small = lock(&self.small);
        self.drain()?;
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
        let storage = *self.storage.get_or_init(Storage::default);
        let layout = Layout::plain([n_vertices as u64, n_triangles as u64], storage)?;
        if let Some(layout) = layout {
            GlbPlan::check_len(HEAD_BYTES + layout.len.next_multiple_of(4))?;
            if layout.len < LARGE_BUFFER_BYTES {
                let mut small = lock(&self.small);
                small.resize(usize::try_from(layout.len).unwrap_or(0), 0);
            }
        }
        // A second call would have the same counts.
        let _set = self.layout.set(layout).is_ok();
        Ok(())
    }

    fn try_part(&self, part: &MeshPart<'_>) -> Result<(), PlaceError> {
        let Some(layout) = self.layout.get().copied().flatten() else { return Ok(()) };
        let (packing, row) = (layout.storage.packing, part.first_vertex as u64);
        let (position, normal) = (packing.position_bytes() * row, packing.normal_bytes() * row);
        let (index_type, indices) = layout.indices;
        let first = 3 * part.first_triangle as u64 * index_type.bytes();
        let lane = self.lane();
        if lane.is_some() {
            // Rows that wait are older than these, which may be the same rows once more.
            self.drain()?;
        }
        let at = |offset: u64| At { sink: self, offset, now: lane.is_some() };
        let mut positions = at(layout.positions.offset + position);
        let mut normals = layout.normals.map(|normals| at(normals.offset + normal));
        match part.vertices {
            Vertices::Single { positions: rows, normals: units } => {
                write_positions(&mut positions, packing, rows)?;
                if let Some(normals) = &mut normals {
                    write_normals(normals, packing, units)?;
                }
            }
            Vertices::Quantized { step, positions: rows, normals: units } if packing.step() == Some(step) => {
                write_shorts(&mut positions, rows)?;
                if let Some(normals) = &mut normals {
                    write_bytes(normals, units)?;
                }
            }
            Vertices::Quantized { step, .. } => return Err(FormatError::OtherPacking { step: step.length() }.into()),
        }
        let (mut to, triangles) = (at(indices.offset + first), part.triangles.as_flattened());
        if index_type == IndexType::U32 {
            write_indices(&mut to, index_type, triangles)?;
        } else {
            let mut block = self.block();
            extend_indices(&mut block, index_type, triangles);
            to.hand(block)?;
        }
        if lane.is_some() {
            self.drain()?;
        }
        Ok(())
    }

    /// Leave to write into the file; `None` if others are writing and it is better to leave the bytes to them.
    fn lane(&self) -> Option<MutexGuard<'_, ()>> {
        match self.lane.try_lock() {
            Ok(lane) => Some(lane),
            // Too much is waiting: now it is right to sleep.
            Err(_) if lock(&self.waiting).len() > MOST_WAITING => Some(lock(&self.lane)),
            Err(_) => None,
        }
    }

    /// An empty block.
    fn block(&self) -> Vec<u8> {
        let mut block = lock(&self.spare).pop().unwrap_or_else(|| Vec::with_capacity(BLOCK_BYTES));
        block.clear();
        block
    }

    /// Writes what is waiting. The caller holds the lane, or is the last.
    fn drain(&self) -> io::Result<()> {
        loop {
            let Some((offset, bytes)) = lock(&self.waiting).pop() else { return Ok(()) };
            self.out.place(offset, &bytes)?;
            lock(&self.spare).push(bytes);
        }
    }

    fn note<T>(&self, done: Result<T, PlaceError>) -> Result<T, SinkFailed> {
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

/// Writes from a place in the buffer on.
struct At<'a> {
    sink: &'a GlbSink<'a>,
    /// In the buffer, not in the file.
    offset: u64,
    /// Whether the lane is ours.
    now: bool,
}

impl At<'_> {
    /// Puts `bytes` where they belong if that is possible now; says whether it was.
    fn put(&self, bytes: &[u8]) -> io::Result<bool> {
        let mut small = lock(&self.sink.small);
        if !small.is_empty() {
            let start = usize::try_from(self.offset).unwrap_or(usize::MAX);
            let place = small.get_mut(start..).and_then(|rest| rest.get_mut(..bytes.len()));
            place.ok_or(io::ErrorKind::InvalidInput)?.copy_from_slice(bytes);
            return Ok(true);
        }
        drop(small);
        if self.now {
            self.sink.out.place(HEAD_BYTES + self.offset, bytes)?;
        }
        Ok(self.now)
    }

    /// Puts a block there, or leaves it to who is writing.
    fn hand(&self, block: Vec<u8>) -> io::Result<()> {
        if self.put(&block)? {
            lock(&self.sink.spare).push(block);
        } else {
            lock(&self.sink.waiting).push((HEAD_BYTES + self.offset, block));
        }
        Ok(())
    }
}

impl Write for At<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if !self.put(bytes)? {
            let mut block = self.sink.block();
            block.extend_from_slice(bytes);
            lock(&self.sink.waiting).push((HEAD_BYTES + self.offset, block));
        }
        self.offset += bytes.len() as u64;
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// A panic elsewhere leaves bytes unwritten, which ends the run there; the lock is still good.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
