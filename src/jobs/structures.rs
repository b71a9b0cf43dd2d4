//! Structures that are kept in memory after they were read, for further requests for the same file.
//!
//! A structure is found by the digest of its file and within its namespace only. It is charged to the memory budget,
//! which takes the memory back before it rejects anything.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::ops::Deref;
use std::sync::{Arc, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use metrics::{counter, gauge};

use super::MemoryReservation;
use crate::memory_budget::{Budget, Buffers, Reclaim};
use crate::pipeline::estimate_atoms;
use crate::store::{Digest, Namespace};
use crate::structure::{self, ReadLimits, Structure, StructureError};
use crate::surface::{Control, MemoryMeter as _};
use crate::sync::{Condvar, Mutex, MutexGuard};
use crate::telemetry::{STRUCTURE_CACHE_BYTES, STRUCTURE_CACHE_REQUESTS};

/// Namespace and digest of a file. All other input of the reader is the same for the whole service, except limits.
type StructureKey = (Namespace, Digest);

/// Memory of a structure besides its atoms and texts, bytes: its columns are some 40 allocations. Without it, the cache
/// would take several times its limit for structures of one atom.
const OVERHEAD: u64 = 4 << 10;
/// Time between two checks of a request that waits for another one to read its structure.
const POLL: Duration = Duration::from_millis(20);

/// A structure, and the memory that it is charged to.
#[derive(Debug)]
struct Charged {
    structure: Structure,
    /// Size of its file, bytes.
    file_bytes: usize,
    /// Number of atoms as estimated from the file, so that estimates of work do not depend on its presence in memory.
    atoms: f64,
    /// Memory of the structure, bytes.
    bytes: u64,
    _charge: Charge,
}

/// Charge of a structure. The metric of the budget counts it only if the structure is not kept.
#[derive(Debug)]
enum Charge {
    Kept { _buffers: Buffers },
    Used { _reservation: Arc<MemoryReservation> },
}

/// A structure that other requests may use as well. Clones share it.
#[derive(Debug, Clone)]
pub(crate) struct SharedStructure(Arc<Charged>);

impl SharedStructure {
    fn bytes(&self) -> u64 {
        self.0.bytes
    }

    /// Returns true if a request uses the structure.
    fn is_used(&self) -> bool {
        Arc::strong_count(&self.0) > 1
    }
}

impl Deref for SharedStructure {
    type Target = Structure;

    fn deref(&self) -> &Structure {
        &self.0.structure
    }
}

/// Structure of a task or a request.
#[derive(Debug, Clone)]
pub(crate) enum Input {
    /// Structure file, compressed or not.
    File(Bytes),
    /// Structure in memory, whose file need not be loaded.
    Kept(SharedStructure),
}

impl Input {
    /// Returns the file; `None` if it was not loaded.
    pub(crate) fn file(&self) -> Option<&Bytes> {
        match self {
            Self::File(file) => Some(file),
            Self::Kept(_) => None,
        }
    }

    /// Returns the size of the file, bytes.
    pub(crate) fn file_bytes(&self) -> usize {
        match self {
            Self::File(file) => file.len(),
            Self::Kept(kept) => kept.0.file_bytes,
        }
    }

    /// Returns the number of atoms as estimated from the file.
    pub(crate) fn atoms(&self) -> f64 {
        match self {
            Self::File(file) => estimate_atoms(file),
            Self::Kept(kept) => kept.0.atoms,
        }
    }
}

#[derive(Debug, Default)]
struct CacheState {
    /// Structures, each with the number of its last use.
    kept: HashMap<StructureKey, (u64, SharedStructure)>,
    /// Least recently used first.
    by_use: BTreeMap<u64, StructureKey>,
    /// Number of uses.
    uses: u64,
    /// Memory of all structures, bytes.
    bytes: u64,
    /// Structures that a request is reading.
    reading: HashSet<StructureKey>,
}

impl CacheState {
    /// Adds a structure as the most recently used one.
    fn insert(&mut self, key: StructureKey, structure: SharedStructure) {
        self.remove(&key);
        self.uses += 1;
        self.bytes += structure.bytes();
        self.by_use.insert(self.uses, key);
        self.kept.insert(key, (self.uses, structure));
    }

    fn remove(&mut self, key: &StructureKey) -> Option<SharedStructure> {
        let (used, structure) = self.kept.remove(key)?;
        self.by_use.remove(&used);
        self.bytes -= structure.bytes();
        Some(structure)
    }

    /// Removes the least recently used structure that `is_candidate` accepts, and returns its memory in bytes.
    fn evict(&mut self, is_candidate: impl Fn(&SharedStructure) -> bool) -> Option<u64> {
        let accepted = |key: &&StructureKey| self.kept.get(*key).is_some_and(|(_, structure)| is_candidate(structure));
        let found = *self.by_use.values().find(accepted)?;
        self.remove(&found).map(|structure| structure.bytes())
    }

    /// Finds a structure, and makes it the most recently used one.
    fn find(&mut self, key: &StructureKey) -> Option<SharedStructure> {
        let found = self.remove(key)?;
        self.insert(*key, found.clone());
        Some(found)
    }
}

/// Structures by namespace and digest, within a limit of memory.
#[derive(Debug)]
pub(crate) struct Structures {
    limit: u64,
    budget: Budget,
    state: Mutex<CacheState>,
    /// Notified when a request has ended reading.
    ended: Condvar,
}

impl Structures {
    /// Keeps at most `limit` bytes, charged to `budget`.
    pub(crate) fn new(limit: u64, budget: &Budget) -> Arc<Self> {
        let (state, ended) = (Mutex::default(), Condvar::default());
        let structures = Arc::new(Self { limit, budget: budget.clone(), state, ended });
        let owner: Arc<dyn Reclaim> = Arc::<Self>::clone(&structures);
        budget.reclaim_from(Arc::downgrade(&owner));
        structures
    }

    /// Returns the structure of a file if it is kept.
    pub(crate) fn find(&self, namespace: Namespace, digest: Digest) -> Option<SharedStructure> {
        self.lock().find(&(namespace, digest))
    }

    /// Returns the structure of the file with this digest, reading `input` if necessary. Concurrent calls read it once
    /// if it is kept, else one after the other.
    ///
    /// Memory is charged to the budget until the last reference is dropped, not to the meter of `control`.
    ///
    /// # Errors
    /// Returns the errors of [`structure::read_with`].
    pub(crate) fn get(
        &self,
        namespace: Namespace,
        digest: Digest,
        input: &Input,
        limits: &ReadLimits,
        control: &Control<'_>,
    ) -> Result<SharedStructure, StructureError> {
        let hit = |kept: SharedStructure| {
            counter!(STRUCTURE_CACHE_REQUESTS, "result" => "hit").increment(1);
            control.memory.also_held(kept.bytes());
            limits.check_atoms(kept.len()).map(|()| kept)
        };
        let file = match input {
            Input::File(file) => file,
            Input::Kept(kept) => return hit(kept.clone()),
        };
        control.memory.also_held(file.len() as u64);
        let key = (namespace, digest);
        let mut state = self.lock();
        loop {
            if let Some(kept) = state.find(&key) {
                return hit(kept);
            }
            if self.limit == 0 || state.reading.insert(key) {
                break;
            }
            state = self.ended.wait_timeout(state, POLL).unwrap_or_else(PoisonError::into_inner).0;
            if control.cancel.is_cancelled() {
                return Err(StructureError::Cancelled);
            }
        }
        drop(state);
        let _reading = ReadingMark { structures: self, key };
        counter!(STRUCTURE_CACHE_REQUESTS, "result" => "miss").increment(1);
        let reservation = Arc::new(self.budget.reservation());
        reservation.also_held(file.len() as u64);
        let charged = Control { memory: Arc::<MemoryReservation>::clone(&reservation), ..control.clone() };
        let structure = structure::read_with(file, limits, &charged)?;
        reservation.grow(OVERHEAD)?;
        let bytes = reservation.bytes();
        control.memory.also_held(bytes);
        let is_kept = bytes <= self.limit;
        let charge = if is_kept {
            Charge::Kept { _buffers: reservation.to_buffers() }
        } else {
            Charge::Used { _reservation: reservation }
        };
        let (file_bytes, atoms) = (input.file_bytes(), input.atoms());
        let read = SharedStructure(Arc::new(Charged { structure, file_bytes, atoms, bytes, _charge: charge }));
        if is_kept {
            self.keep(key, &read);
        }
        Ok(read)
    }

    /// Keeps a structure, and evicts others.
    fn keep(&self, key: StructureKey, kept: &SharedStructure) {
        let mut state = self.lock();
        state.insert(key, kept.clone());
        while state.bytes > self.limit && state.evict(|_| true).is_some() {}
        publish(&state);
    }

    fn lock(&self) -> MutexGuard<'_, CacheState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Reclaim for Structures {
    /// Frees structures that no request uses until `bytes` are free, least recently used first.
    fn reclaim(&self, bytes: u64) -> bool {
        let mut state = self.lock();
        let mut freed = 0;
        while freed < bytes
            && let Some(more) = state.evict(|kept| !kept.is_used())
        {
            freed += more;
        }
        publish(&state);
        freed > 0
    }
}

/// Mark of a structure that a request is reading. Dropping it, even after an error or a panic, lets others read.
struct ReadingMark<'a> {
    structures: &'a Structures,
    key: StructureKey,
}

impl Drop for ReadingMark<'_> {
    fn drop(&mut self) {
        self.structures.lock().reading.remove(&self.key);
        self.structures.ended.notify_all();
    }
}

#[expect(clippy::cast_precision_loss, reason = "gauges are floats; exact up to 8 PiB")]
fn publish(state: &CacheState) {
    gauge!(STRUCTURE_CACHE_BYTES).set(state.bytes as f64);
}

#[cfg(test)]
#[allow(clippy::pedantic, clippy::unwrap_used, reason = "tests fail by panicking")]
mod tests {
    use std::sync::Barrier;
    use std::sync::atomic::{AtomicUsize, Ordering};

    use super::*;
    use crate::surface::CancelToken;

    type File = (Input, Digest);

    /// Returns a file of `n` atoms and its digest.
    fn file(n: usize) -> File {
        let line = |i: usize| format!("ATOM      1  CA  ALA A{:>4}    {i:>8}   2.000   3.000\n", i % 10_000);
        let text: String = (0..n).map(line).collect();
        let digest = Digest::of(text.as_bytes());
        (Input::File(text.into()), digest)
    }

    type Got = Result<SharedStructure, StructureError>;

    fn get_with(structures: &Structures, (input, digest): &File, control: &Control<'_>) -> Got {
        structures.get(Namespace::default(), *digest, input, &ReadLimits::default(), control)
    }

    fn get(structures: &Structures, file: &File) -> SharedStructure {
        get_with(structures, file, &Control::default()).unwrap()
    }

    fn is_kept(structures: &Structures, file: &File) -> bool {
        structures.lock().kept.keys().any(|(_, digest)| *digest == file.1)
    }

    fn size(file: &File) -> u64 {
        get(&Structures::new(0, &Budget::unlimited()), file).bytes()
    }

    fn held(budget: &Budget) -> u64 {
        budget.used()
    }

    #[test]
    fn a_structure_is_read_once_within_its_namespace() {
        let structures = Structures::new(1 << 20, &Budget::unlimited());
        let file = file(10);
        let first = get(&structures, &file);
        assert!(Arc::ptr_eq(&first.0, &get(&structures, &file).0));
        let other = Namespace::from_group(&[1; 32], "other");
        let elsewhere = structures.get(other, file.1, &file.0, &ReadLimits::default(), &Control::default()).unwrap();
        assert!(!Arc::ptr_eq(&first.0, &elsewhere.0));
        assert_eq!(*first, *elsewhere);
        let tight = ReadLimits { max_atoms: 9, ..ReadLimits::default() };
        let refused = structures.get(Namespace::default(), file.1, &file.0, &tight, &Control::default());
        assert_eq!(refused.unwrap_err(), StructureError::TooManyAtoms { limit: 9 });
    }

    #[test]
    fn the_limit_is_respected_and_the_least_recently_used_structure_is_evicted() {
        let files = [file(100), file(101), file(102), file(100_000)];
        let budget = Budget::unlimited();
        let limit = size(&files[0]) + size(&files[2]);
        let structures = Structures::new(limit, &budget);
        for i in [0, 1, 0, 2, 3] {
            get(&structures, &files[i]);
            assert!(structures.lock().bytes <= limit);
        }
        assert_eq!([0, 1, 2, 3].map(|i| is_kept(&structures, &files[i])), [true, false, true, false]);
    }

    #[test]
    fn small_structures_are_charged_for_their_allocations() {
        // 400 structures of one atom and some texts.
        let structures = Structures::new(400 * (OVERHEAD + 1000), &Budget::unlimited());
        for i in 0..1000_u32 {
            get(&structures, &(file(1).0, Digest::of(&i.to_le_bytes())));
        }
        let state = structures.lock();
        assert!((400..=400 * 5 / 4).contains(&state.kept.len()), "{} structures", state.kept.len());
        assert_eq!(state.bytes, state.kept.values().map(|(_, kept)| kept.bytes()).sum::<u64>());
        assert_eq!(state.by_use.len(), state.kept.len());
    }

    #[test]
    fn memory_is_given_back_before_anything_is_rejected() {
        let files = [file(1000), file(1001), file(1002)];
        let budget = Budget::new(1 << 20);
        let structures = Structures::new(1 << 20, &budget);
        let in_use = get(&structures, &files[0]);
        for i in [1, 2] {
            get(&structures, &files[i]);
        }
        let (held, reservation) = (structures.lock().bytes, budget.reservation());
        // Only the least recently used structure that no request uses is freed.
        reservation.grow((1 << 20) - held + 1).unwrap();
        assert_eq!([0, 1, 2].map(|i| is_kept(&structures, &files[i])), [true, false, true]);
        // A structure in use cannot be freed.
        let most = (1 << 20) - in_use.bytes();
        assert!(reservation.grow(most + 1 - reservation.bytes()).is_err());
        reservation.grow(most - reservation.bytes()).unwrap();
        drop(in_use);
        reservation.grow((1 << 20) - reservation.bytes()).unwrap();
        assert_eq!(structures.lock().bytes, 0);
        // Memory that is taken regardless of the limit does not make the check fail either.
        drop(reservation);
        get(&structures, &files[0]);
        let buffers = budget.buffers(1 << 20);
        budget.check().unwrap();
        assert!(!is_kept(&structures, &files[0]));
        drop(buffers);
    }

    #[test]
    fn concurrent_requests_read_once_and_a_cancelled_one_does_not_fail_the_others() {
        let budget = Budget::unlimited();
        let structures = Structures::new(1 << 30, &budget);
        let file = file(50_000);
        let (start, cancelled) = (Barrier::new(8), AtomicUsize::new(0));
        let got: Vec<SharedStructure> = std::thread::scope(|scope| {
            let spawn = |i: usize| {
                let (structures, file, start, cancelled) = (&structures, &file, &start, &cancelled);
                scope.spawn(move || {
                    let cancel = CancelToken::default();
                    start.wait();
                    if i < 2 {
                        cancel.cancel();
                    }
                    let got = get_with(structures, file, &Control { cancel, ..Control::default() });
                    cancelled.fetch_add(usize::from(matches!(got, Err(StructureError::Cancelled))), Ordering::Relaxed);
                    got.ok()
                })
            };
            let threads: Vec<_> = (0..8).map(spawn).collect();
            threads.into_iter().filter_map(|thread| thread.join().unwrap()).collect()
        });
        assert!(got.len() >= 6 && got.len() + cancelled.into_inner() == 8);
        assert!(got.iter().all(|kept| Arc::ptr_eq(&kept.0, &got[0].0)));
        assert!(structures.lock().reading.is_empty());
        assert_eq!(held(&budget), structures.lock().bytes);
    }
}
