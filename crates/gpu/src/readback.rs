//! Readback buffers: a submission copies results into them, and the host reads them there.
//!
//! The columns of a mesh stay in the buffer until the mesh is dropped; then the buffer returns to the pool. Copying
//! them to other memory would take many times as long as the transfer.

use std::sync::{Arc, Mutex, PoisonError};

use wgpu::{Buffer, BufferUsages, BufferView, Device};

use super::buffers::buffer;
use super::error::GpuError;

/// Pool of idle readback buffers.
#[derive(Debug, Clone)]
pub(super) struct ReadbackPool(Arc<Mutex<Idle>>);

#[derive(Debug)]
struct Idle {
    /// Maximum bytes of idle buffers: while jobs follow each other, and after [`ReadbackPool::release_idle`].
    limits: [u64; 2],
    /// Idle buffers, longest idle first.
    buffers: Vec<Buffer>,
    /// Bytes of all buffers, idle and in use.
    held: u64,
}

/// Buffer that a submission copies into. Returns to its pool when dropped.
pub(super) struct ReadbackBuffer {
    /// Target of copies.
    pub(super) buffer: Buffer,
    view: Option<BufferView>,
    pool: ReadbackPool,
}

impl Idle {
    fn create(&mut self, device: &Device, size: u64) -> Buffer {
        self.held += size;
        buffer(device, "molmesh.readback", size, BufferUsages::MAP_READ | BufferUsages::COPY_DST)
    }

    /// Frees the longest idle buffers until the others are at most `limit` bytes.
    fn shrink(&mut self, limit: u64) {
        let sizes: Vec<u64> = self.buffers.iter().map(Buffer::size).collect();
        let n = n_to_free(&sizes, limit);
        self.held -= sizes[..n].iter().sum::<u64>();
        self.buffers.drain(..n);
    }
}

impl ReadbackPool {
    /// Creates an empty pool that keeps at most `limits` bytes: between jobs, and after [`Self::release_idle`].
    pub(super) fn new(limits: [u64; 2]) -> Self {
        Self(Arc::new(Mutex::new(Idle { limits, buffers: Vec::new(), held: 0 })))
    }

    /// Returns a buffer of at least `bytes` bytes: the smallest idle one of at most twice the size, or a new one.
    pub(super) fn acquire(&self, device: &Device, bytes: u64) -> ReadbackBuffer {
        let size = size_class(bytes);
        let mut idle = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let fits = |b: &Buffer| (size..=2 * size).contains(&b.size());
        let best = (0..idle.buffers.len()).filter(|&i| fits(&idle.buffers[i])).min_by_key(|&i| idle.buffers[i].size());
        let buffer = match best {
            Some(i) => idle.buffers.remove(i),
            None => idle.create(device, size),
        };
        ReadbackBuffer { buffer, view: None, pool: self.clone() }
    }

    /// Adds an idle buffer. Discards it if `check`, called after the allocation, fails.
    ///
    /// # Errors
    /// Those of `check`.
    pub(super) fn reserve(
        &self,
        device: &Device,
        size: u64,
        check: impl FnOnce() -> Result<(), GpuError>,
    ) -> Result<(), GpuError> {
        let mut idle = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let buffer = idle.create(device, size);
        let checked = check();
        if checked.is_ok() {
            idle.buffers.push(buffer);
        } else {
            idle.held -= size;
        }
        checked
    }

    /// Bytes of all buffers, idle and in use.
    pub(super) fn held_bytes(&self) -> u64 {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).held
    }

    fn put_back(&self, buffer: Buffer) {
        let mut idle = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let [limit, _] = idle.limits;
        if buffer.size() > limit {
            idle.held -= buffer.size();
            return;
        }
        idle.buffers.push(buffer);
        idle.shrink(limit);
    }

    /// Frees idle buffers down to the second limit.
    pub(super) fn release_idle(&self) {
        let mut idle = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let [_, limit] = idle.limits;
        idle.shrink(limit);
    }
}

/// Number of leading buffers to free so that the others take at most `limit` bytes.
fn n_to_free(sizes: &[u64], limit: u64) -> usize {
    let mut kept: u64 = sizes.iter().sum();
    let frees = |size: &&u64| {
        let exceeds = kept > limit;
        kept -= if exceeds { **size } else { 0 };
        exceeds
    };
    sizes.iter().take_while(frees).count()
}

/// Rounds a size up to a quarter of a power of two, so that later jobs can reuse the buffer.
pub(super) fn size_class(bytes: u64) -> u64 {
    let step = (bytes.max(4096).next_power_of_two() / 8).max(1024);
    bytes.max(4096).next_multiple_of(step)
}

/// Returns the sizes of the buffers to reserve within `bytes`, largest first: two of each power of two.
/// [`ReadbackPool::acquire`] then finds one buffer for the vertices and one for the triangles of any mesh whose columns
/// fit the largest size.
pub(super) fn reserved_sizes(bytes: u64) -> impl Iterator<Item = u64> {
    // The sum of all sizes is less than four times the largest.
    let sizes = (12..64).rev().map(|k| 1 << k).filter(move |size| *size <= bytes / 4);
    sizes.flat_map(|size| [size; 2])
}

impl ReadbackBuffer {
    /// Requests to map the first `bytes` bytes. They are readable once the submission is finished and the device was
    /// polled; see [`Self::mapped`].
    pub(super) fn map(&self, bytes: u64) {
        // `mapped` reports a failure.
        self.buffer.slice(..bytes).map_async(wgpu::MapMode::Read, |_| {});
    }

    /// Returns the buffer with its first `bytes` bytes, as requested by [`Self::map`], readable.
    pub(super) fn mapped(mut self, bytes: u64) -> Result<Arc<Self>, GpuError> {
        let view = self.buffer.slice(..bytes).get_mapped_range();
        self.view = Some(view.map_err(|e| GpuError::Failed(e.to_string()))?);
        Ok(Arc::new(self))
    }
}

impl AsRef<[u8]> for ReadbackBuffer {
    fn as_ref(&self) -> &[u8] {
        self.view.as_deref().unwrap_or_default()
    }
}

impl Drop for ReadbackBuffer {
    fn drop(&mut self) {
        // The view must be dropped before the buffer is unmapped.
        self.view = None;
        self.buffer.unmap();
        self.pool.put_back(self.buffer.clone());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_longest_idle_buffers_are_freed_until_the_others_fit() {
        assert_eq!(n_to_free(&[], 10), 0);
        assert_eq!(n_to_free(&[4, 3, 3], 10), 0);
        assert_eq!(n_to_free(&[4, 3, 3], 9), 1);
        assert_eq!(n_to_free(&[1, 1, 5, 4, 6], 10), 3);
        assert_eq!(n_to_free(&[1, 11], 10), 2);
    }

    #[test]
    fn size_classes_are_large_enough_and_waste_at_most_a_third() {
        for bytes in (0..200_000).step_by(77).chain([1 << 30, (1 << 30) + 1, 5 << 30]) {
            let class = size_class(bytes);
            assert!(class >= bytes && class.is_multiple_of(1024), "{bytes}: {class}");
            assert!(bytes < 8192 || class * 3 <= bytes * 4, "{bytes}: {class}");
            assert_eq!(size_class(class), class);
        }
    }

    #[test]
    fn reserved_buffers_fit_every_size_twice_and_keep_to_the_limit() {
        for bytes in [16_384, 20_000, 1 << 20, 3 << 20, (1 << 31) - 1, 2 << 30, 2 << 40] {
            let sizes: Vec<u64> = reserved_sizes(bytes).collect();
            assert!(sizes.iter().sum::<u64>() <= bytes && sizes[0] * 8 > bytes, "{bytes}: {sizes:?}");
            for wanted in (12..40).flat_map(|k| [1 << k, (1 << k) + 1]).map(size_class).filter(|n| *n <= sizes[0]) {
                let n_fit = sizes.iter().filter(|size| (wanted..=2 * wanted).contains(size)).count();
                assert!(n_fit >= 2, "{bytes}: {wanted}");
            }
        }
        assert_eq!((reserved_sizes(0).count(), reserved_sizes(16_383).count()), (0, 0));
    }
}
