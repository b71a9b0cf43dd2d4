//! In-memory index of objects: sizes, times of last use, pins and reservations. Never blocks or accesses a disk.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Bound;
use std::time::{Duration, SystemTime};

use metrics::gauge;

use super::name::{Folder, Name};
use super::object::Usage;
use super::records::{AtCap, JobRecords};
use crate::config::JobsConfig;
use crate::telemetry::{STORE_BYTES, STORE_OBJECTS};

/// Order of last use. The counter orders uses within one clock tick.
pub(super) type Use = (SystemTime, u64);

#[derive(Debug, Clone, Copy)]
struct ObjectEntry {
    bytes: u64,
    used: Use,
    /// Time of last use that the disk has.
    saved: SystemTime,
    /// Number of writes to the name.
    version: u64,
}

/// State of a name at the start of a read, which shows whether the result of the read is outdated.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Seen {
    version: Option<u64>,
    removals: u64,
}

/// Group of objects that may be evicted together, and their state when they were chosen.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct EvictionCandidate {
    pub(super) names: Vec<Name>,
    pub(super) bytes: u64,
    used: Vec<Use>,
}

impl EvictionCandidate {
    /// Returns the objects with the times of their last uses.
    pub(super) fn uses(&self) -> impl Iterator<Item = (&Name, SystemTime)> {
        self.names.iter().zip(self.used.iter().map(|(used, _)| *used))
    }
}

/// Reason for a failed reservation.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum ReserveError {
    /// These objects must be evicted first.
    Remove(Vec<EvictionCandidate>),
    /// Evicting all candidates would not suffice. Bytes in use.
    Held(u64),
}

/// Index of all objects.
#[derive(Debug, Default)]
pub(super) struct Index {
    entries: BTreeMap<Name, ObjectEntry>,
    by_use: BTreeMap<Use, Name>,
    pub(super) records: JobRecords,
    /// Number of pins by group.
    pins: BTreeMap<Name, usize>,
    /// Objects being removed: no longer readable, but still on disk.
    removing: BTreeSet<Name>,
    /// Usage by folder, including objects that are being removed.
    totals: [Usage; Folder::ALL.len()],
    /// Bytes reserved by writers, in folders that count against the capacity.
    reserved: u64,
    count: u64,
    removals: u64,
    /// True if inputs are never evicted for space: another node may be about to read them.
    pub(super) keeps_inputs: bool,
}

impl Index {
    fn next(&mut self) -> u64 {
        self.count += 1;
        self.count
    }

    /// Adds an object that was written, or found at startup. Its group counts as used.
    pub(super) fn commit(&mut self, name: &Name, bytes: u64, used: SystemTime) {
        self.forget(name);
        let members = self.members(&name.group());
        let last = members.iter().filter_map(|name| Some(self.entries.get(name)?.used.0)).max();
        let (saved, at) = (used, last.map_or(used, |last| last.max(used)));
        let (version, used) = (self.next(), (at, self.next()));
        if name.folder() == Folder::Jobs && members.is_empty() {
            self.records.add(name);
        }
        self.reorder(name, None, Some(used));
        self.entries.insert(name.clone(), ObjectEntry { bytes, used, saved, version });
        self.touch(name, at);
        let total = &mut self.totals[name.folder() as usize];
        *total = Usage { bytes: total.bytes + bytes, objects: total.objects + 1 };
        self.update_metrics(name.folder());
    }

    /// Removes an object that no longer exists. Returns true if it was in the index.
    pub(super) fn forget(&mut self, name: &Name) -> bool {
        let Some(entry) = self.entries.remove(name) else { return false };
        self.reorder(name, Some(entry.used), None);
        if name.folder() == Folder::Jobs && self.members(&name.group()).is_empty() {
            self.records.remove(name);
        }
        self.removals += 1;
        let total = &mut self.totals[name.folder() as usize];
        *total = Usage { bytes: total.bytes - entry.bytes, objects: total.objects - 1 };
        self.update_metrics(name.folder());
        true
    }

    /// Records a use of the group of an object at time `at`, unless a later one is known.
    pub(super) fn touch(&mut self, name: &Name, at: SystemTime) {
        for name in self.members(&name.group()) {
            let count = self.next();
            let Some(entry) = self.entries.get_mut(&name) else { continue };
            let (old, new) = (entry.used, (entry.used.0.max(at), count));
            entry.used = new;
            self.reorder(&name, Some(old), Some(new));
        }
    }

    /// Changes the position of an object in the orders of use.
    fn reorder(&mut self, name: &Name, old: Option<Use>, new: Option<Use>) {
        old.and_then(|old| self.by_use.remove(&old));
        new.and_then(|new| self.by_use.insert(new, name.clone()));
        if name.is_ended_job() || name.is_batch() {
            self.records.reorder(name, old, new);
        }
    }

    /// Returns the names of the objects of a folder.
    pub(super) fn names(&self, folder: Folder) -> Vec<Name> {
        self.names_after(&Name::before(folder), usize::MAX)
    }

    /// Returns the names of at most `n` objects of the folder of `name` that follow it.
    pub(super) fn names_after(&self, name: &Name, n: usize) -> Vec<Name> {
        let later = self.entries.range((Bound::Excluded(name), Bound::Unbounded)).map(|(name, _)| name);
        later.take_while(|other| other.folder() == name.folder()).take(n).cloned().collect()
    }

    /// Counts the record of a new job, unless a cap is reached.
    pub(super) fn admit_record(&mut self, name: &Name, caps: &JobsConfig) -> Result<(), AtCap> {
        if let Some((scope, limit, mut ended)) = self.records.at_cap(name, caps) {
            return Err(AtCap { scope, limit, oldest: ended.find_map(|name| self.candidate(&name.group())) });
        }
        self.records.add(name);
        Ok(())
    }

    /// Returns the objects of a group, whose names are adjacent.
    fn members(&self, group: &Name) -> Vec<Name> {
        let from_group = self.entries.range(group..).map(|(name, _)| name);
        from_group.take_while(|name| name.group() == *group).cloned().collect()
    }

    /// Starts a read. Returns `None` if the object is being removed.
    pub(super) fn begin_read(&self, name: &Name) -> Option<Seen> {
        let version = self.entries.get(name).map(|entry| entry.version);
        (!self.removing.contains(name)).then_some(Seen { version, removals: self.removals })
    }

    /// Returns true if the object exists and was not written since the read started.
    pub(super) fn is_current(&self, name: &Name, seen: Seen) -> bool {
        let version = self.entries.get(name).map(|entry| entry.version);
        version.is_some() && version == seen.version && !self.removing.contains(name)
    }

    /// Adds an object that a read found, because another process wrote it.
    pub(super) fn adopt(&mut self, name: &Name, seen: Seen, bytes: u64, used: SystemTime) {
        let unknown = !self.entries.contains_key(name) && !self.removing.contains(name);
        if unknown && seen.version.is_none() && seen.removals == self.removals {
            self.commit(name, bytes, used);
        }
    }

    pub(super) fn pin(&mut self, name: &Name) {
        *self.pins.entry(name.group()).or_default() += 1;
    }

    pub(super) fn unpin(&mut self, name: &Name) {
        let group = name.group();
        if let Some(count) = self.pins.get_mut(&group) {
            *count -= 1;
            if *count == 0 {
                self.pins.remove(&group);
            }
        }
    }

    /// Returns the objects whose last use is `interval` later than the disk says, and marks them as saved.
    pub(super) fn unsaved_uses(&mut self, interval: Duration) -> Vec<(Name, SystemTime)> {
        let late = |entry: &ObjectEntry| entry.used.0.duration_since(entry.saved).is_ok_and(|since| since >= interval);
        let late = self.entries.iter_mut().filter(|(_, entry)| late(entry));
        late.map(|(name, entry)| {
            entry.saved = entry.used.0;
            (name.clone(), entry.saved)
        })
        .collect()
    }

    /// Returns the groups whose time to live has expired, oldest first.
    pub(super) fn expired(&self, now: SystemTime, ttl: impl Fn(Folder) -> Duration) -> Vec<EvictionCandidate> {
        let expired = self
            .by_use
            .iter()
            .filter(|((used, _), name)| now.duration_since(*used).is_ok_and(|age| age >= ttl(name.folder())));
        self.candidates(expired.map(|(_, name)| name)).collect()
    }

    /// Returns the removable groups of `names`, each once, in their order.
    fn candidates<'a>(&self, names: impl Iterator<Item = &'a Name>) -> impl Iterator<Item = EvictionCandidate> {
        let mut seen = BTreeSet::new();
        let groups = names.map(Name::group).filter(move |group| seen.insert(group.clone()));
        groups.filter_map(|group| self.candidate(&group))
    }

    /// Returns a group as a candidate, unless it is pinned or being removed.
    fn candidate(&self, group: &Name) -> Option<EvictionCandidate> {
        let names = self.members(group);
        let entries: Vec<_> = names.iter().filter_map(|name| self.entries.get(name)).collect();
        let is_removable = !self.pins.contains_key(group) && names.iter().all(|name| !self.removing.contains(name));
        let bytes = entries.iter().map(|entry| entry.bytes).sum();
        let used = entries.iter().map(|entry| entry.used).collect();
        (is_removable && !names.is_empty()).then_some(EvictionCandidate { names, bytes, used })
    }

    /// Reserves `bytes` for an object within the capacity `cap`, or returns the objects to evict.
    pub(super) fn reserve(&mut self, bytes: u64, cap: Usage) -> Result<(), ReserveError> {
        let (candidates, missing) = self.excess(bytes, cap);
        if missing > 0 {
            let taken = self.used().bytes - candidates.iter().map(|candidate| candidate.bytes).sum::<u64>();
            return Err(ReserveError::Held(taken));
        }
        if !candidates.is_empty() {
            return Err(ReserveError::Remove(candidates));
        }
        self.reserved += bytes;
        Ok(())
    }

    /// Returns the least recently used objects to evict so that another object of `bytes` fits into `cap`, and the
    /// bytes that are missing even then. Pinned objects, which are few, may exceed the number of objects.
    pub(super) fn excess(&self, bytes: u64, cap: Usage) -> (Vec<EvictionCandidate>, u64) {
        let used = self.used();
        let missing = Usage {
            bytes: used.bytes.saturating_add(bytes).saturating_sub(cap.bytes),
            objects: (used.objects + u64::from(bytes > 0)).saturating_sub(cap.objects),
        };
        let chosen = self.oldest(missing);
        let found = chosen.iter().map(|candidate| candidate.bytes).sum();
        (chosen, missing.bytes.saturating_sub(found))
    }

    /// Returns the least recently used objects, of at least `missing` bytes and objects if there are so many.
    pub(super) fn oldest(&self, mut missing: Usage) -> Vec<EvictionCandidate> {
        let mut chosen = Vec::new();
        let mut candidates = self.candidates(self.by_use.values().filter(|name| self.is_evictable(name)));
        while missing.bytes > 0 || missing.objects > 0 {
            let Some(candidate) = candidates.next() else { break };
            missing.bytes = missing.bytes.saturating_sub(candidate.bytes);
            missing.objects = missing.objects.saturating_sub(candidate.names.len() as u64);
            chosen.push(candidate);
        }
        drop(candidates);
        chosen
    }

    fn is_evictable(&self, name: &Name) -> bool {
        name.folder().is_capped() && !(self.keeps_inputs && name.folder() == Folder::Inputs)
    }

    /// Returns what counts against the capacity: objects on disk, and reserved bytes.
    fn used(&self) -> Usage {
        let capped = Folder::ALL.into_iter().filter(|folder| folder.is_capped()).map(|folder| self.usage(folder));
        capped.fold(Usage { bytes: self.reserved, objects: 0 }, |sum, usage| Usage {
            bytes: sum.bytes + usage.bytes,
            objects: sum.objects + usage.objects,
        })
    }

    /// Releases reserved bytes.
    pub(super) fn release(&mut self, bytes: u64) {
        self.reserved -= bytes;
    }

    /// Marks an object as being removed, unconditionally.
    pub(super) fn mark_removed(&mut self, name: &Name) {
        self.removing.insert(name.clone());
    }

    /// Marks a candidate as being removed, unless an object of its group was used, written or pinned since it was
    /// chosen.
    pub(super) fn begin_removal(&mut self, candidate: &EvictionCandidate) -> bool {
        let unchanged =
            candidate.names.first().and_then(|name| self.candidate(&name.group())).as_ref() == Some(candidate);
        if unchanged {
            self.removing.extend(candidate.names.iter().cloned());
        }
        unchanged
    }

    /// Ends a removal. If it failed, the object becomes readable again.
    pub(super) fn end_removal(&mut self, name: &Name, gone: bool) {
        self.removing.remove(name);
        if gone {
            self.forget(name);
        }
    }

    pub(super) fn usage(&self, folder: Folder) -> Usage {
        self.totals[folder as usize]
    }

    /// Updates the metrics of a folder.
    pub(super) fn update_metrics(&self, folder: Folder) {
        let Usage { bytes, objects } = self.usage(folder);
        gauge!(STORE_BYTES, "folder" => folder.as_str()).set(bytes as f64);
        gauge!(STORE_OBJECTS, "folder" => folder.as_str()).set(objects as f64);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn name(id: &str) -> Name {
        Name::from_file_name(Folder::Inputs, &id.repeat(64)).unwrap()
    }

    const CAP: Usage = Usage { bytes: 30, objects: 100 };

    fn at(seconds: u64) -> SystemTime {
        SystemTime::UNIX_EPOCH + Duration::from_secs(seconds)
    }

    #[test]
    fn a_read_is_current_until_a_write_or_removal() {
        let mut index = Index::default();
        index.commit(&name("a"), 5, at(1));
        let seen = index.begin_read(&name("a")).unwrap();
        assert!(index.is_current(&name("a"), seen));
        index.touch(&name("a"), at(2));
        assert!(index.is_current(&name("a"), seen), "a use does not outdate a read");
        index.commit(&name("a"), 5, at(3));
        assert!(!index.is_current(&name("a"), seen));
        let seen = index.begin_read(&name("a")).unwrap();
        index.mark_removed(&name("a"));
        assert!(!index.is_current(&name("a"), seen) && index.begin_read(&name("a")).is_none());
        index.end_removal(&name("a"), false);
        assert!(index.is_current(&name("a"), seen), "the removal failed");
    }

    #[test]
    fn a_removal_during_a_read_prevents_adoption() {
        let mut index = Index::default();
        let seen = index.begin_read(&name("a")).unwrap();
        index.adopt(&name("a"), seen, 7, at(1));
        assert_eq!(index.usage(Folder::Inputs), Usage { bytes: 7, objects: 1 });
        let seen = index.begin_read(&name("b")).unwrap();
        index.forget(&name("a"));
        index.adopt(&name("b"), seen, 7, at(1));
        assert_eq!(index.usage(Folder::Inputs), Usage { bytes: 0, objects: 0 });
    }

    #[test]
    fn used_or_pinned_candidates_are_not_evicted() {
        let mut index = Index::default();
        for (id, used) in [("a", 1), ("b", 2), ("c", 3)] {
            index.commit(&name(id), 10, at(used));
        }
        let Err(ReserveError::Remove(candidates)) = index.reserve(20, CAP) else {
            panic!("reserved more than the capacity")
        };
        assert_eq!(candidates.iter().map(|c| c.names.clone()).collect::<Vec<_>>(), [[name("a")], [name("b")]]);
        index.touch(&name("a"), at(1));
        index.pin(&name("b"));
        assert!(!index.begin_removal(&candidates[0]) && !index.begin_removal(&candidates[1]));
        index.unpin(&name("b"));
        assert!(index.begin_removal(&candidates[1]) && !index.begin_removal(&candidates[1]));
        index.end_removal(&name("b"), true);
        assert_eq!((index.reserve(10, CAP), index.usage(Folder::Inputs)), (Ok(()), Usage { bytes: 20, objects: 2 }));
        index.pin(&name("a"));
        index.pin(&name("c"));
        assert_eq!(index.reserve(1, CAP), Err(ReserveError::Held(30)));
        index.release(10);
        assert_eq!(index.reserve(10, CAP), Ok(()));
    }

    #[test]
    fn the_number_of_objects_is_limited() {
        let mut index = Index::default();
        let cap = Usage { bytes: 1000, objects: 3 };
        for (id, used) in [("a", 1), ("b", 2), ("c", 3)] {
            assert_eq!(index.reserve(10, cap), Ok(()));
            index.commit(&name(id), 10, at(used));
            index.release(10);
        }
        // Job records have caps of their own.
        index.commit(&Name::ended_job("1").unwrap(), 10, at(0));
        let Err(ReserveError::Remove(candidates)) = index.reserve(10, cap) else { panic!("reserved a fourth object") };
        assert_eq!(candidates.iter().map(|c| c.names.clone()).collect::<Vec<_>>(), [[name("a")]]);
        assert_eq!(index.excess(0, cap), (Vec::new(), 0), "three objects are within the capacity");
        assert_eq!(index.excess(0, Usage { objects: 1, ..cap }).0.len(), 2, "the capacity was lowered");
        for id in ["a", "b", "c"] {
            index.pin(&name(id));
        }
        assert_eq!(index.reserve(10, cap), Ok(()), "objects in use do not reject others");
    }

    #[test]
    fn a_mesh_and_its_report_are_used_pinned_and_removed_together() {
        let result = |key: &str, extension| Name::result(&key.repeat(64), extension).unwrap();
        let mut index = Index::default();
        for (key, used) in [("a", 1), ("b", 3)] {
            index.commit(&result(key, "json"), 10, at(used));
            index.commit(&result(key, "glb"), 90, at(used + 1));
        }
        let ttl = |_: Folder| Duration::from_secs(8);
        let cap = Usage { bytes: 200, objects: 100 };
        let chosen = |found: &[EvictionCandidate]| found.iter().flat_map(|v| v.names.clone()).collect::<Vec<_>>();
        // The later use of either counts for both.
        assert_eq!(index.expired(at(9), ttl), []);
        let oldest = [result("a", "glb"), result("a", "json")];
        assert_eq!(chosen(&index.expired(at(10), ttl)), oldest);
        assert_eq!(chosen(&index.excess(1, cap).0), oldest, "a part of the group would suffice");
        let chosen_before = index.excess(1, cap).0;
        index.touch(&result("a", "glb"), at(20));
        assert!(!index.begin_removal(&chosen_before[0]), "the group was used");
        assert_eq!(chosen(&index.excess(1, cap).0), [result("b", "glb"), result("b", "json")]);
        index.pin(&result("b", "glb"));
        assert_eq!(chosen(&index.excess(1, cap).0), oldest, "the report is pinned with its mesh");
        let candidates = index.excess(1, cap).0;
        assert!(index.begin_removal(&candidates[0]) && oldest.iter().all(|name| index.begin_read(name).is_none()));
    }
}
