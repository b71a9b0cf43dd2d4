//! Threads of a process that meshes once: each on a processor of its own from the start.
//!
//! A new thread begins on the processor of the thread that made it, and some kernels (those of small virtual machines
//! above all) leave it there for milliseconds although another processor is idle: longer than a small protein takes.

/// Moves the calling thread, the pool's `index`th from 1, away from `home` and from its fellows. Does nothing where it
/// cannot: the scheduler then decides, as always.
#[cfg(target_os = "linux")]
pub(super) fn spread(home: usize, index: usize) {
    use rustix::thread::{CpuSet, sched_getaffinity, sched_setaffinity};

    let Ok(allowed) = sched_getaffinity(None) else { return };
    let others: Vec<usize> = (0..CpuSet::MAX_CPU).filter(|&cpu| cpu != home && allowed.is_set(cpu)).collect();
    let Some(&cpu) = index.checked_sub(1).and_then(|i| others.get(i)) else { return };
    let mut own = CpuSet::new();
    own.set(cpu);
    let _moved = sched_setaffinity(None, &own).is_ok();
}

/// The processor that the calling thread runs on.
#[cfg(target_os = "linux")]
pub(super) fn current() -> usize {
    rustix::thread::sched_getcpu()
}

/// Does nothing: there is no portable way.
#[cfg(not(target_os = "linux"))]
pub(super) fn spread(_home: usize, _index: usize) {}

/// Unknown.
#[cfg(not(target_os = "linux"))]
pub(super) fn current() -> usize {
    usize::MAX
}
