//! Observation and cancellation of a meshing run. The core reads no clock; the observer does.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use super::error::SurfaceError;
use super::memory::{MemoryMeter, OutOfMemory, Reservation};
use crate::named;

/// Stages of a meshing run, in order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Stage {
    /// Occupied bricks and their candidate lists.
    Bin,
    /// Density at every grid point of every occupied brick.
    Field,
    /// Inside bits, crossing edges and cell cases.
    Classify,
    /// Exclusive scan over bricks: first vertex and triangle of each brick.
    Scan,
    /// Parameters of vertices on the surface. For isosurfaces, the CPU finds them in `interpolate`.
    Refine,
    /// Vertex positions and normals.
    Interpolate,
    /// Triangle indices.
    Emit,
    /// Area, volume, components and the check that the mesh is watertight.
    Measure,
    /// Writing finished parts of the mesh to a sink.
    Write,
    /// Improvement of triangles on request, on the CPU.
    Improve,
}

named!(Stage, Bin => "bin", Field => "field", Classify => "classify", Scan => "scan", Refine => "refine",
    Interpolate => "interpolate", Emit => "emit", Measure => "measure", Write => "write", Improve => "improve");

/// Watches a run. Called from several threads at once, a few thousand times a run at most.
pub trait Observer: Sync {
    /// Runs `work` as (a part of) `stage`; an observer with a clock times the call.
    fn span(&self, stage: Stage, work: &mut dyn FnMut()) {
        let _ = stage;
        work();
    }

    /// Reports that (a part of) `stage` took `ns` nanoseconds, measured by a device's clock.
    fn elapsed(&self, stage: Stage, ns: u64) {
        let _ = (stage, ns);
    }

    /// Reports that `done` of `total` parts of `stage` are finished.
    fn progress(&self, stage: Stage, done: usize, total: usize) {
        let _ = (stage, done, total);
    }
}

impl Observer for () {}

/// Cancellation flag, shared between a run and its caller.
#[derive(Debug, Clone, Default)]
pub struct CancelToken(Arc<AtomicBool>);

impl CancelToken {
    /// Requests the run to stop at its next check (between stages and every few bricks).
    pub fn cancel(&self) {
        self.0.store(true, Ordering::Relaxed);
    }

    /// Returns true if cancellation was requested.
    #[must_use]
    pub fn is_cancelled(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}

/// Cancels its token when it is dropped.
#[derive(Debug, Default)]
pub struct CancelOnDrop(pub CancelToken);

impl Drop for CancelOnDrop {
    fn drop(&mut self) {
        self.0.cancel();
    }
}

/// Cancellation, deadline, observer and memory of a run.
#[derive(Clone)]
pub struct Control<'a> {
    /// Checked between stages and every few bricks.
    pub cancel: CancelToken,
    /// Time after which the mesh is not needed. The core reads no clock and only passes it on; backends that queue jobs
    /// check it.
    pub deadline: Option<Instant>,
    /// Receives stages and progress.
    pub observer: &'a dyn Observer,
    /// Receives memory before it is allocated. The result of a run stays added; the owner of the meter subtracts it.
    pub memory: Arc<dyn MemoryMeter>,
}

impl Default for Control<'_> {
    fn default() -> Self {
        Self { cancel: CancelToken::default(), deadline: None, observer: &(), memory: Arc::new(()) }
    }
}

impl Control<'_> {
    /// Fails if the token is cancelled.
    ///
    /// # Errors
    /// Returns [`SurfaceError::Cancelled`] if the token is cancelled.
    pub fn check(&self) -> Result<(), SurfaceError> {
        if self.cancel.is_cancelled() { Err(SurfaceError::Cancelled) } else { Ok(()) }
    }

    /// Calls [`Self::check`] if `n` is a multiple of `step`.
    ///
    /// # Errors
    /// [`SurfaceError::Cancelled`].
    #[inline]
    pub fn check_every(&self, n: usize, step: usize) -> Result<(), SurfaceError> {
        if n.is_multiple_of(step) { self.check() } else { Ok(()) }
    }

    /// Reserves `bytes` of memory until the reservation is dropped.
    ///
    /// # Errors
    /// [`OutOfMemory`].
    pub fn reserve(&self, bytes: u64) -> Result<Reservation, OutOfMemory> {
        let reservation = Reservation::new(&self.memory);
        reservation.grow(bytes)?;
        Ok(reservation)
    }

    /// Returns a control with another meter.
    #[must_use]
    pub fn with_memory<M: MemoryMeter + 'static>(&self, memory: &Arc<M>) -> Self {
        Self { memory: Arc::<M>::clone(memory), ..self.clone() }
    }

    /// Returns a control that releases its memory when its last clone is dropped.
    #[must_use]
    pub fn metered(&self) -> Self {
        self.with_reservation().0
    }

    /// Returns the control of [`Self::metered`] and its reservation. After [`Reservation::keep`], the meter of `self`
    /// still counts the memory.
    #[must_use]
    pub fn with_reservation(&self) -> (Self, Arc<Reservation>) {
        let memory = Arc::new(Reservation::new(&self.memory));
        (self.with_memory(&memory), memory)
    }

    /// Times `work` as a part of `stage` and returns its value.
    pub fn span<T>(&self, stage: Stage, work: impl FnOnce() -> T) -> T {
        let mut work = Some(work);
        let mut value = None;
        self.observer.span(stage, &mut || {
            if let Some(work) = work.take() {
                value = Some(work());
            }
        });
        match value {
            Some(value) => value,
            None => unreachable!("an observer's span must call the work it is given"),
        }
    }
}
