//! Structures that are kept in memory after they were read, for further requests for the same file.
//!
//! A structure is found by the digest of its file and within its namespace only. It is charged to the memory budget,
//! which takes the memory back before it rejects anything.

use std::sync::{Arc, PoisonError};
use std::time::Duration;

use metrics::{counter, gauge};

use super::kept::{
    CacheKey, CacheState, Charged, Input, Kept, Shared, SharedColors, SharedStructure, SharedTileset, tileset_digests,
};
use super::rank::Client;
use super::{MemoryReservation, ScratchSpace};
use crate::memory_budget::{Budget, Reclaim};
use crate::pipeline::tileset::{self, StreamSource, StructureStream, Tileset};
use crate::pipeline::{JobError, Options, StageClock, WorkScope};
use crate::store::Digest;
use crate::structure::stream::{BLOCK_BYTES, ScratchFile};
use crate::structure::{self, ReadLimits, StructureError};
use crate::surface::{CancelToken, Control, Exceeded, Limit, MemoryMeter as _, OutOfMemory, Reservation, SurfaceError};
use crate::sync::{Condvar, Mutex, MutexGuard};
use crate::telemetry::{STRUCTURE_CACHE_BYTES, STRUCTURE_CACHE_REQUESTS};

/// Memory of a structure besides its atoms and texts, bytes: its columns are some 40 allocations. Without it, the cache
/// would take several times its limit for structures of one atom.
const OVERHEAD: u64 = 4 << 10;
/// Memory of the atoms of a tileset and of their index, bytes per atom.
const BYTES_PER_ATOM: u64 = 110;
/// Number of blocks that fit into the cache: a stream is read in blocks of this part of the cache. The index buffers
/// four blocks, which take up to twice their size while they grow.
const BLOCKS: u64 = 32;
/// Minimum size of a block, bytes.
const MIN_BLOCK: usize = 256 << 10;
/// Time between two checks of a request that waits for another one to read its structure.
const POLL: Duration = Duration::from_millis(20);

/// Cache of structures by namespace and digest, and of tilesets prepared from them, within a limit of memory.
#[derive(Debug)]
pub(crate) struct Structures {
    limit: u64,
    budget: Budget,
    /// Disk space for tilesets whose index would exceed the limit.
    scratch: Option<Arc<ScratchSpace>>,
    state: Mutex<CacheState>,
    /// Notified when a request stops making a value.
    ended: Condvar,
}

impl Structures {
    /// Keeps at most `limit` bytes, charged to `budget`, and indexes of tilesets that are larger in `scratch`.
    pub(crate) fn new(limit: u64, budget: &Budget, scratch: Option<Arc<ScratchSpace>>) -> Arc<Self> {
        let (state, ended) = (Mutex::default(), Condvar::default());
        let structures = Arc::new(Self { limit, budget: budget.clone(), scratch, state, ended });
        if let Some(scratch) = &structures.scratch {
            scratch.evict_from(Arc::downgrade(&structures));
        }
        let owner: Arc<dyn Reclaim> = Arc::<Self>::clone(&structures);
        budget.reclaim_from(Arc::downgrade(&owner));
        structures
    }

    /// Creates a temporary file of a client, whose size counts towards the disk space for tilesets.
    ///
    /// # Errors
    /// Returns [`StructureError::DiskSpace`] if there is no such space, and [`StructureError::Scratch`].
    pub(crate) fn scratch_file(&self, client: Client) -> Result<ScratchFile, StructureError> {
        let none = || StructureError::DiskSpace(OutOfMemory::Limit { needed: 1, limit: 0 });
        self.scratch.as_ref().ok_or_else(none)?.client_file(client)
    }

    /// Finds a file in the cache. If `options` have a tile, its tileset comes first: returns the tileset itself if its
    /// atoms are on disk, else its structure.
    pub(crate) fn find(&self, key: CacheKey, options: Option<&Options>) -> Option<Input> {
        let options = options.filter(|options| options.tile.is_some());
        let tilesets = options.map(|options| tileset_keys(key, options));
        let mut state = self.lock();
        let mut keys = tilesets.into_iter().flatten().chain([key]);
        let kept = keys.find_map(|key| state.find(&key))?;
        let Some(tileset): Option<SharedTileset> = kept.get() else { return kept.get().map(Input::Kept) };
        Some(if tileset.is_streamed() { Input::Tileset(tileset) } else { Input::Kept(tileset.structure().clone()) })
    }

    /// Returns the structure of the file with this digest, reading `input` if necessary. Concurrent calls read it once
    /// if it fits into the cache. Otherwise each call reads it, one at a time.
    ///
    /// Memory is charged to the budget until the last reference is dropped, not to the meter of `control`.
    ///
    /// # Errors
    /// Returns the errors of [`structure::read_with`].
    pub(crate) fn get(
        &self,
        key: CacheKey,
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
            // Has no atoms. Only jobs on tiles have such an input, and they do not read the structure.
            Input::Tileset(_) => return Err(StructureError::Scratch { reason: "the atoms are on disk".to_owned() }),
        };
        control.memory.also_held(file.len() as u64);
        let found = self.find_or_begin(&[key], &control.cancel).ok_or(StructureError::Cancelled)?;
        if let Some(kept) = found.as_ref().ok().and_then(Kept::get) {
            return hit(kept);
        }
        counter!(STRUCTURE_CACHE_REQUESTS, "result" => "miss").increment(1);
        let reservation = Arc::new(self.budget.reservation());
        // Such as the file, and the memory for drawing.
        reservation.also_held(control.memory.budget().map_or(0, |[_, held]| held));
        let charged = control.with_memory(&reservation);
        let structure = structure::read_with(file, limits, &charged)?;
        reservation.grow(OVERHEAD)?;
        let read = self.charged(structure, input, reservation);
        control.memory.also_held(read.bytes());
        if read.bytes() <= self.limit {
            self.keep(key, read.clone().into());
        }
        Ok(read)
    }

    /// Returns the tileset of a job on the file with this digest, and the colours of its atoms. Prepares them from
    /// `input` if necessary; concurrent calls prepare them once. `clock` measures the preparation. A tileset too
    /// large for the cache has its index on disk if its parameters allow it.
    ///
    /// # Errors
    /// Returns the errors of [`Tileset::new`], [`Tileset::of_stream`] and [`Tileset::colors`], and
    /// [`SurfaceError::Limit`] if one of them does not fit into the cache.
    pub(crate) fn tileset(
        &self,
        key: CacheKey,
        input: &Input,
        options: &Options,
        limits: &ReadLimits,
        control: &Control<'_>,
        clock: &StageClock<'_>,
    ) -> Result<(SharedTileset, Option<SharedColors>), JobError> {
        let keys = tileset_keys(key, options);
        let in_memory = |limits: &ReadLimits| {
            let read = |control: &Control<'_>| self.get(key, input, limits, control);
            let prepare = |control: &Control<'_>| Tileset::new(read, options, limits, &WorkScope::new(clock, control));
            self.made(keys[0], input, control, &self.budget.part(self.limit), prepare)
        };
        let on_disk = |scratch: &ScratchSpace| {
            let prepare = |control: &Control<'_>| self.streamed(scratch, input, options, limits, control, clock);
            // Only what remains must fit into the cache, not the memory of reading and sorting.
            self.made(keys[1], input, control, &self.budget, prepare)
        };
        let not_on_disk = tileset::needs_memory(options, 1).map(|(name, ..)| name);
        let make = || match &self.scratch {
            Some(scratch) if self.limit > 0 && not_on_disk.is_none() => {
                // Reading, or copying for an assembly, ends early if the atoms do not fit.
                let max_atoms = limits.max_atoms.min(self.limit / BYTES_PER_ATOM);
                match in_memory(&ReadLimits { max_atoms, ..*limits }) {
                    Err(JobError::Surface(SurfaceError::Limit(error)))
                        if error.limit == Limit::TilesetBytes
                            || error.limit == Limit::Atoms && max_atoms < limits.max_atoms =>
                    {
                        on_disk(scratch)
                    }
                    made => made,
                }
            }
            _ => in_memory(limits).map_err(|error| match error {
                JobError::Surface(SurfaceError::Limit(mut error)) if error.limit == Limit::TilesetBytes => {
                    let on_disk = |name| format!("another `{name}`, for which a larger index can be on disk").into();
                    error.hint = not_on_disk.map(on_disk);
                    SurfaceError::from(error).into()
                }
                error => error,
            }),
        };
        let tileset = match input {
            Input::Tileset(tileset) => tileset.clone(),
            _ => self.found_or_made(&keys, control, make)?,
        };
        let (namespace, prepared) = keys[usize::from(tileset.is_streamed())];
        let Some(coloring) = options.color else { return Ok((tileset, None)) };
        let key = (namespace, Digest::of(format!("colors\n{prepared}\n{}", coloring.canonical()).as_bytes()));
        let prepare = |control: &Control<'_>| tileset.colors(coloring, control);
        let budget = self.budget.part(self.limit);
        let make = || self.made(key, input, control, &budget, prepare);
        let colors = self.found_or_made(&[key], control, make)?;
        Ok((tileset, Some(colors)))
    }

    /// Prepares a tileset with its atoms in a temporary file.
    fn streamed(
        &self,
        scratch: &ScratchSpace,
        input: &Input,
        options: &Options,
        limits: &ReadLimits,
        control: &Control<'_>,
        clock: &StageClock<'_>,
    ) -> Result<Tileset<SharedStructure>, JobError> {
        // The copy of a structure in memory.
        let copy = Reservation::new(&control.memory);
        let source = match input {
            Input::File(file) => {
                control.memory.also_held(file.len() as u64);
                StreamSource::Files(vec![Box::new(&file[..])])
            }
            // The atoms fit into memory, but not all copies of an assembly.
            Input::Kept(structure) => {
                copy.grow(structure.bytes()).map_err(SurfaceError::from)?;
                StreamSource::Structure(structure)
            }
            // Has no atoms. The caller returns this tileset itself.
            Input::Tileset(_) => return Err(SurfaceError::NoSpheres.into()),
        };
        let block_bytes = usize::try_from(self.limit / BLOCKS).unwrap_or(usize::MAX).clamp(MIN_BLOCK, BLOCK_BYTES);
        let scratch = [scratch.file()?, scratch.file()?];
        let stream = StructureStream { source, scratch, block_bytes, began: &|_| {} };
        let tileset = Tileset::of_stream(stream, options, limits, &WorkScope::new(clock, control))?;
        drop(copy);
        let reservation = Arc::new(self.budget.reservation());
        Ok(tileset.with_structure(|structure| self.charged(*structure, input, reservation)))
    }

    /// Returns the value with one of the keys, and calls `make` if there is none.
    fn found_or_made<T: Send + Sync + 'static>(
        &self,
        keys: &[CacheKey],
        control: &Control<'_>,
        make: impl FnOnce() -> Result<Shared<T>, JobError>,
    ) -> Result<Shared<T>, JobError> {
        let found = self.find_or_begin(keys, &control.cancel).ok_or(SurfaceError::Cancelled)?;
        if let Ok(kept) = &found
            && let Some(kept) = kept.get::<T>()
        {
            control.memory.also_held(kept.bytes());
            return Ok(kept);
        }
        make()
    }

    /// Prepares a value with memory of `budget`, and keeps it. It must fit into the cache.
    fn made<T: Send + Sync + 'static>(
        &self,
        key: CacheKey,
        input: &Input,
        control: &Control<'_>,
        budget: &Budget,
        prepare: impl FnOnce(&Control<'_>) -> Result<T, JobError>,
    ) -> Result<Shared<T>, JobError> {
        let limit = self.limit;
        let too_large = || SurfaceError::from(Box::new(Exceeded::new(Limit::TilesetBytes, limit))).into();
        let reservation = Arc::new(budget.reservation());
        let charged = control.with_memory(&reservation);
        let value = prepare(&charged).map_err(|error| match error {
            JobError::Surface(SurfaceError::Memory(
                OutOfMemory::Limit { limit: of, .. } | OutOfMemory::Budget { limit: of, .. },
            )) if of == limit => too_large(),
            error => error,
        })?;
        if reservation.bytes() > limit {
            return Err(too_large());
        }
        let shared = self.charged(value, input, reservation);
        control.memory.also_held(shared.bytes());
        self.keep(key, shared.clone().into());
        Ok(shared)
    }

    /// Finds a value with one of the keys. If there is none, returns the mark of the first key as an error; the caller
    /// holds it while it makes the value. Waits while another request makes it; `None` if this one is cancelled. There
    /// is at least one key.
    fn find_or_begin(&self, keys: &[CacheKey], cancel: &CancelToken) -> Option<Result<Kept, MakingMark<'_>>> {
        let key = *keys.first()?;
        let mut state = self.lock();
        loop {
            if let Some(kept) = keys.iter().find_map(|key| state.find(key)) {
                return Some(Ok(kept));
            }
            if self.limit == 0 || state.making.insert(key) {
                return Some(Err(MakingMark { structures: self, key }));
            }
            state = self.ended.wait_timeout(state, POLL).unwrap_or_else(PoisonError::into_inner).0;
            if cancel.is_cancelled() {
                return None;
            }
        }
    }

    /// Charges a value to the budget.
    fn charged<T>(&self, value: T, input: &Input, reservation: Arc<MemoryReservation>) -> Shared<T> {
        let bytes = reservation.bytes();
        let charge = if bytes <= self.limit { Ok(reservation.to_buffers()) } else { Err(reservation) };
        let (file_bytes, atoms) = (input.file_bytes(), input.atoms());
        Shared(Arc::new(Charged { value, file_bytes, atoms, bytes, _charge: charge }))
    }

    /// Keeps a value, and evicts others.
    fn keep(&self, key: CacheKey, kept: Kept) {
        let mut state = self.lock();
        state.insert(key, kept);
        let mut evicted = Vec::new();
        while state.bytes > self.limit
            && let Some(kept) = state.evict(|_| true)
        {
            evicted.push(kept);
        }
        publish(&state);
        // Closing a large file takes time, which must not delay other requests.
        drop(state);
    }

    /// Evicts the least recently used tileset with its atoms on disk that no request uses. Returns true if there was
    /// one.
    pub(super) fn evict_streamed(&self) -> bool {
        let mut state = self.lock();
        let evicted = state.evict(|kept| kept.is_streamed() && !kept.is_used());
        publish(&state);
        drop(state);
        evicted.is_some()
    }

    fn lock(&self) -> MutexGuard<'_, CacheState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Reclaim for Structures {
    /// Frees values that no request uses until `bytes` are free, least recently used first.
    fn reclaim(&self, bytes: u64) -> bool {
        let mut state = self.lock();
        let (mut freed, mut evicted) = (0, Vec::new());
        while freed < bytes
            && let Some(kept) = state.evict(|kept| !kept.is_used())
        {
            freed += kept.bytes;
            evicted.push(kept);
        }
        publish(&state);
        drop(state);
        freed > 0
    }
}

/// Mark of a value that a request is making. Dropping it, even after an error or a panic, lets others make it.
struct MakingMark<'a> {
    structures: &'a Structures,
    key: CacheKey,
}

impl Drop for MakingMark<'_> {
    fn drop(&mut self) {
        self.structures.lock().making.remove(&self.key);
        self.structures.ended.notify_all();
    }
}

/// Returns the keys of a tileset: in memory, and with its atoms on disk.
fn tileset_keys((namespace, digest): CacheKey, options: &Options) -> [CacheKey; 2] {
    tileset_digests(&digest, options).map(|digest| (namespace, digest))
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
    use crate::pipeline::params;
    use crate::store::Namespace;
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
        structures.get((Namespace::default(), *digest), input, &ReadLimits::default(), control)
    }

    fn get(structures: &Structures, file: &File) -> SharedStructure {
        get_with(structures, file, &Control::default()).unwrap()
    }

    fn is_kept(structures: &Structures, file: &File) -> bool {
        structures.lock().kept.keys().any(|(_, digest)| *digest == file.1)
    }

    fn size(file: &File) -> u64 {
        get(&Structures::new(0, &Budget::unlimited(), None), file).bytes()
    }

    fn held(budget: &Budget) -> u64 {
        budget.used()
    }

    #[test]
    fn a_structure_is_read_once_within_its_namespace() {
        let structures = Structures::new(1 << 20, &Budget::unlimited(), None);
        let file = file(10);
        let first = get(&structures, &file);
        assert!(Arc::ptr_eq(&first.0, &get(&structures, &file).0));
        let other = Namespace::from_group(&[1; 32], "other");
        let elsewhere = structures.get((other, file.1), &file.0, &ReadLimits::default(), &Control::default()).unwrap();
        assert!(!Arc::ptr_eq(&first.0, &elsewhere.0));
        assert_eq!(*first, *elsewhere);
        let tight = ReadLimits { max_atoms: 9, ..ReadLimits::default() };
        let refused = structures.get((Namespace::default(), file.1), &file.0, &tight, &Control::default());
        assert_eq!(refused.unwrap_err(), Exceeded::new(Limit::Atoms, 9).error());
    }

    #[test]
    fn the_limit_is_respected_and_the_least_recently_used_structure_is_evicted() {
        let files = [file(100), file(101), file(102), file(100_000)];
        let budget = Budget::unlimited();
        let limit = size(&files[0]) + size(&files[2]);
        let structures = Structures::new(limit, &budget, None);
        for i in [0, 1, 0, 2, 3] {
            get(&structures, &files[i]);
            assert!(structures.lock().bytes <= limit);
        }
        assert_eq!([0, 1, 2, 3].map(|i| is_kept(&structures, &files[i])), [true, false, true, false]);
    }

    #[test]
    fn small_structures_are_charged_for_their_allocations() {
        // 400 structures of one atom and some texts.
        let structures = Structures::new(400 * (OVERHEAD + 1000), &Budget::unlimited(), None);
        for i in 0..1000_u32 {
            get(&structures, &(file(1).0, Digest::of(&i.to_le_bytes())));
        }
        let state = structures.lock();
        assert!((400..=400 * 5 / 4).contains(&state.kept.len()), "{} structures", state.kept.len());
        assert_eq!(state.bytes, state.kept.values().map(|(_, kept)| kept.bytes).sum::<u64>());
        assert_eq!(state.by_use.len(), state.kept.len());
    }

    #[test]
    fn memory_is_given_back_before_anything_is_rejected() {
        let files = [file(1000), file(1001), file(1002)];
        let budget = Budget::new(1 << 20);
        let structures = Structures::new(1 << 20, &budget, None);
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
    fn a_tileset_is_prepared_once_and_keeps_its_structure() {
        let budget = Budget::unlimited();
        let structures = Structures::new(1 << 24, &budget, None);
        let (input, digest) = file(20_000);
        let options = |pairs: &[(&str, &str)]| params::parse(pairs.iter().copied()).unwrap().options;
        let [root, child] = ["0/0/0/0", "1/0/0/0"].map(|tile| options(&[("tile", tile), ("select", "all")]));
        let other = options(&[("tile", "0/0/0/0"), ("select", "all"), ("resolution", "1")]);
        let get = |options: &Options| {
            let (limits, clock) = (ReadLimits::default(), StageClock::new(&()));
            let key = (Namespace::default(), digest);
            structures.tileset(key, &input, options, &limits, &Control::default(), &clock).unwrap().0
        };
        let start = Barrier::new(4);
        let got: Vec<SharedTileset> = std::thread::scope(|scope| {
            let spawn = |i: usize| {
                let (start, get, root, child) = (&start, &get, &root, &child);
                scope.spawn(move || {
                    start.wait();
                    get(if i.is_multiple_of(2) { root } else { child })
                })
            };
            let threads: Vec<_> = (0..4).map(spawn).collect();
            threads.into_iter().map(|thread| thread.join().unwrap()).collect()
        });
        assert!(got.iter().all(|tileset| Arc::ptr_eq(&tileset.0, &got[0].0)));
        assert!(!Arc::ptr_eq(&got[0].0, &get(&other).0), "the control");
        // A structure that was evicted is found in its tileset, for jobs on its tiles only.
        let found = |options| match structures.find((Namespace::default(), digest), options) {
            Some(Input::Kept(found)) => Some(Arc::as_ptr(&found.0)),
            _ => None,
        };
        let structure = found(None);
        assert!(structure.is_some());
        structures.lock().remove(&(Namespace::default(), digest));
        assert_eq!((found(None), found(Some(&Options::default())), found(Some(&child))), (None, None, structure));
        // Both values are in the budget, and are freed if nothing uses them.
        drop(got);
        let bytes = structures.lock().bytes;
        assert!(bytes > 20_000 * 60, "{bytes}");
        assert!(structures.reclaim(u64::MAX) && structures.lock().kept.is_empty() && held(&budget) == 0);
    }

    #[test]
    fn concurrent_requests_for_a_tileset_on_disk_index_it_once() {
        let folder = tempfile::tempdir().unwrap();
        let (budget, scratch) = (Budget::unlimited(), ScratchSpace::new(folder.path(), 1 << 30, 1.0));
        let space = scratch.budget().clone();
        let structures = Structures::new(1 << 20, &budget, Some(scratch));
        let (input, digest) = file(20_000);
        let options = params::parse([("tile", "0/0/0/0"), ("select", "all")]).unwrap().options;
        let start = Barrier::new(4);
        let get = || {
            let (limits, clock, key) = (ReadLimits::default(), StageClock::new(&()), (Namespace::default(), digest));
            start.wait();
            let got = structures.tileset(key, &input, &options, &limits, &Control::default(), &clock).unwrap().0;
            let has_read = clock.finish().iter().any(|(stage, _)| *stage == "read");
            (got, has_read)
        };
        let got: Vec<(SharedTileset, bool)> = std::thread::scope(|scope| {
            let threads: Vec<_> = (0..4).map(|_| scope.spawn(get)).collect();
            threads.into_iter().map(|thread| thread.join().unwrap()).collect()
        });
        assert!(got.iter().all(|(tileset, _)| Arc::ptr_eq(&tileset.0, &got[0].0.0) && tileset.is_streamed()));
        // The others do not attempt to read it into memory either.
        assert_eq!(got.iter().filter(|(_, has_read)| *has_read).count(), 1);
        assert!(structures.lock().making.is_empty());
        // The memory and the disk space of an index are freed with it.
        drop(got);
        let [memory, disk] = [held(&budget), held(&space)];
        assert!(memory > 0 && memory < 1 << 20 && disk >= 48 * 20_000, "{memory} {disk}");
        assert!(structures.reclaim(u64::MAX) && held(&budget) == 0 && held(&space) == 0);
    }

    #[test]
    fn concurrent_requests_read_once_and_a_cancelled_one_does_not_fail_the_others() {
        let budget = Budget::unlimited();
        let structures = Structures::new(1 << 30, &budget, None);
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
        assert!(structures.lock().making.is_empty());
        assert_eq!(held(&budget), structures.lock().bytes);
    }
}
