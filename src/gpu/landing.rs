//! Where results arrive: buffers that the host reads in place.
//!
//! A mesh's columns lie in such a buffer for as long as the mesh lives; then the buffer goes back to the pool. Copying
//! them into fresh memory would take many times as long as the transfer.

use std::fmt;
use std::sync::{Arc, Mutex, PoisonError};

use wgpu::{Buffer, BufferUsages, BufferView, Device};

/// Idle buffers.
#[derive(Debug, Clone)]
pub(super) struct Landings(Arc<Mutex<Idle>>);

#[derive(Debug)]
struct Idle {
    /// Bytes of idle buffers at most: between jobs that follow each other, and after a rest.
    most: [u64; 2],
    /// The one that has been idle longest first.
    buffers: Vec<Buffer>,
    /// Bytes of all buffers, idle and in use.
    held: u64,
}

/// A buffer that a submission copies into.
pub(super) struct Landing {
    /// Taken when the landing is dropped.
    buffer: Option<Buffer>,
    view: Option<BufferView>,
    pool: Landings,
}

impl Idle {
    /// Lets the oldest buffers go until the others are `most` bytes at most.
    fn shrink(&mut self, most: u64) {
        let sizes: Vec<u64> = self.buffers.iter().map(Buffer::size).collect();
        let n = surplus(&sizes, most);
        self.held -= sizes[..n].iter().sum::<u64>();
        self.buffers.drain(..n);
    }
}

impl Landings {
    /// None yet; so many bytes of them are kept between jobs, and after a rest.
    pub(super) fn keeping(most: [u64; 2]) -> Self {
        Self(Arc::new(Mutex::new(Idle { most, buffers: Vec::new(), held: 0 })))
    }

    /// A buffer of at least `bytes` bytes: the smallest idle one that is not much too large, or a new one.
    pub(super) fn get(&self, device: &Device, bytes: u64) -> Landing {
        let wanted = size_class(bytes);
        let mut idle = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let fits = |b: &Buffer| (wanted..=2 * wanted).contains(&b.size());
        let best = (0..idle.buffers.len()).filter(|&i| fits(&idle.buffers[i])).min_by_key(|&i| idle.buffers[i].size());
        let buffer = if let Some(i) = best {
            idle.buffers.remove(i)
        } else {
            idle.held += wanted;
            device.create_buffer(&wgpu::BufferDescriptor {
                label: Some("molmesh.landing"),
                size: wanted,
                usage: BufferUsages::MAP_READ | BufferUsages::COPY_DST,
                mapped_at_creation: false,
            })
        };
        Landing { buffer: Some(buffer), view: None, pool: self.clone() }
    }

    /// Bytes of all buffers, idle and in use.
    pub(super) fn held(&self) -> u64 {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).held
    }

    fn put(&self, buffer: Buffer) {
        let mut idle = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let [most, _] = idle.most;
        if buffer.size() > most {
            idle.held -= buffer.size();
            return;
        }
        idle.buffers.push(buffer);
        idle.shrink(most);
    }

    /// Lets go what is not worth its memory while nothing is done.
    pub(super) fn rest(&self) {
        let mut idle = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let [_, most] = idle.most;
        idle.shrink(most);
    }
}

/// How many of the first must go, that the others are `most` bytes together: what was used last is wanted again, and what
/// nobody asks for must not keep its place for ever.
fn surplus(sizes: &[u64], most: u64) -> usize {
    let mut kept: u64 = sizes.iter().sum();
    let goes = |size: &&u64| {
        let too_much = kept > most;
        kept -= if too_much { **size } else { 0 };
        too_much
    };
    sizes.iter().take_while(goes).count()
}

/// Sizes come in steps of a quarter of a power of two, so that buffers are used again.
pub(super) fn size_class(bytes: u64) -> u64 {
    let step = (bytes.max(4096).next_power_of_two() / 8).max(1024);
    bytes.max(4096).next_multiple_of(step)
}

impl Landing {
    /// What to copy into.
    pub(super) fn buffer(&self) -> Result<&Buffer, String> {
        self.buffer.as_ref().ok_or_else(|| "a landing without a buffer".to_owned())
    }

    /// Asks for the bytes. They are there when the submission is done and the device was polled; see [`Self::look`].
    pub(super) fn request(&self, bytes: u64) -> Result<(), String> {
        // A failure shows when the bytes are looked at.
        self.buffer()?.slice(..bytes).map_async(wgpu::MapMode::Read, |_| {});
        Ok(())
    }

    /// The first `bytes` bytes, which were requested.
    pub(super) fn look(mut self, bytes: u64) -> Result<Arc<Self>, String> {
        let view = self.buffer()?.slice(..bytes).get_mapped_range().map_err(|e| e.to_string())?;
        self.view = Some(view);
        Ok(Arc::new(self))
    }
}

impl AsRef<[u8]> for Landing {
    fn as_ref(&self) -> &[u8] {
        self.view.as_deref().unwrap_or_default()
    }
}

impl Drop for Landing {
    fn drop(&mut self) {
        // The view before the mapping.
        self.view = None;
        if let Some(buffer) = self.buffer.take() {
            buffer.unmap();
            self.pool.put(buffer);
        }
    }
}

impl fmt::Debug for Landing {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Landing({} bytes)", self.as_ref().len())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_oldest_idle_buffers_go_until_the_others_fit() {
        assert_eq!(surplus(&[], 10), 0);
        assert_eq!(surplus(&[4, 3, 3], 10), 0);
        assert_eq!(surplus(&[4, 3, 3], 9), 1);
        assert_eq!(surplus(&[1, 1, 5, 4, 6], 10), 3);
        assert_eq!(surplus(&[1, 11], 10), 2);
    }

    #[test]
    fn classes_are_never_too_small_and_waste_a_third_at_most() {
        for bytes in (0..200_000).step_by(77).chain([1 << 30, (1 << 30) + 1, 5 << 30]) {
            let class = size_class(bytes);
            assert!(class >= bytes && class.is_multiple_of(1024), "{bytes}: {class}");
            assert!(bytes < 8192 || class * 3 <= bytes * 4, "{bytes}: {class}");
            assert_eq!(size_class(class), class);
        }
    }
}
