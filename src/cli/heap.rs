//! What the C library's allocator does with memory that is free. The one place with unsafe code.

#[cfg(feature = "server")]
use std::time::Duration;

/// How often a service gives back what is free.
#[cfg(feature = "server")]
const PAUSE: Duration = Duration::from_secs(5);

/// For a process that meshes once and ends: memory is got in large steps and never given back. Each step is a system call
/// that the other threads' memory waits for, and what is given back is got again, page by page.
pub(super) fn keep() {
    glibc::keep();
}

/// For a service: what is free in the allocator goes back to the system now and then, so that the memory of a burst is
/// not held for ever, and what the process is seen to hold is what it uses.
///
/// # Errors
/// The system's, where it starts no thread.
#[cfg(feature = "server")]
pub(super) fn tend() -> std::io::Result<()> {
    let tend = || loop {
        std::thread::sleep(PAUSE);
        glibc::give_back();
    };
    std::thread::Builder::new().name("heap".to_owned()).spawn(tend).map(drop)
}

#[cfg(all(target_os = "linux", target_env = "gnu"))]
mod glibc {
    /// Bytes that the heap grows by at least.
    const STEP: i32 = 2 << 20;
    /// Up to this size memory comes from the heap, not from a mapping of its own: the most that glibc takes.
    const LARGEST: i32 = 32 << 20;

    #[expect(unsafe_code, reason = "there is no safe wrapper of these two functions")]
    pub(super) fn keep() {
        for (option, value) in
            [(libc::M_TOP_PAD, STEP), (libc::M_MMAP_THRESHOLD, LARGEST), (libc::M_TRIM_THRESHOLD, i32::MAX)]
        {
            // SAFETY: it sets a number under the allocator's own lock; a value that it refuses changes nothing.
            unsafe { libc::mallopt(option, value) };
        }
    }

    #[cfg(feature = "server")]
    #[expect(unsafe_code, reason = "there is no safe wrapper of these two functions")]
    pub(super) fn give_back() {
        // SAFETY: it touches nothing but memory that is free, under the allocator's own locks; any thread may call it.
        unsafe { libc::malloc_trim(0) };
    }
}

/// Other allocators look after themselves.
#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
mod glibc {
    pub(super) fn keep() {}

    #[cfg(feature = "server")]
    pub(super) fn give_back() {}
}

#[cfg(all(test, target_os = "linux", target_env = "gnu"))]
mod tests {
    use super::*;

    /// Resident memory of this process, MiB.
    fn resident() -> Option<u64> {
        let status = std::fs::read_to_string("/proc/self/status").ok()?;
        let line = status.lines().find(|line| line.starts_with("VmRSS:"))?;
        line.split_whitespace().nth(1)?.parse::<u64>().ok().map(|kib| kib >> 10)
    }

    /// `bytes` that were written to.
    fn used(bytes: usize) -> Vec<u8> {
        std::hint::black_box(vec![1; bytes])
    }

    // One test, as the allocator is one for the process.
    #[test]
    fn free_memory_is_given_back_when_asked_and_kept_when_told() {
        let resident = || resident().unwrap();
        let before = resident();
        // Small enough to come from the heap; what stays in use lies above all that is freed.
        let pieces: Vec<_> = (0..2000).map(|_| used(64 << 10)).collect();
        let last = used(64 << 10);
        let held = resident();
        assert!(held > before + 100, "{before} to {held} MiB");
        drop(pieces);
        let freed = resident();
        assert!(freed > before + 100, "the allocator holds what is free: {freed} MiB");
        glibc::give_back();
        let after = resident();
        assert!(after < before + 30, "{freed} to {after} MiB");
        drop(last);

        // In a thread with a heap of its own: this one's has room. Large enough for a mapping, which would end with the vector.
        let kept = std::thread::spawn(move || {
            let before = resident();
            keep();
            drop(used(8 << 20));
            (before, resident())
        });
        let (before, after) = kept.join().unwrap();
        assert!(after > before + 6, "{before} to {after} MiB");
    }
}
