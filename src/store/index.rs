//! Bookkeeping, in memory: how large everything is, when it was used, who holds it. Nothing here waits or touches a disk.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, SystemTime};

use metrics::gauge;

use super::name::{Folder, Name};
use crate::telemetry::{STORE_BYTES, STORE_OBJECTS};

/// Order of last use; the count tells uses within one tick of the clock apart.
type Use = (SystemTime, u64);

#[derive(Debug, Clone, Copy)]
struct Entry {
    bytes: u64,
    used: Use,
    /// Which writing of the name this is.
    version: u64,
}

/// What a read saw when it began, so that what it brings back is not taken for newer than it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Seen {
    version: Option<u64>,
    removals: u64,
}

/// An object that may go: its name, and the state in which it was looked at.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Victim {
    pub(super) name: Name,
    pub(super) bytes: u64,
    used: Use,
}

/// Why there is no room.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum NoRoom {
    /// These have to go first.
    Remove(Vec<Victim>),
    /// There would be none if everything went that may go.
    Held(u64),
}

/// Sizes, uses, pins, reservations.
#[derive(Debug, Default)]
pub(super) struct Index {
    entries: BTreeMap<Name, Entry>,
    by_use: BTreeMap<Use, Name>,
    pins: BTreeMap<Name, usize>,
    /// On their way out: no longer to be read, still on disk.
    leaving: BTreeSet<Name>,
    /// Bytes and objects by folder, those on their way out included.
    totals: [(u64, u64); Folder::ALL.len()],
    /// Capped bytes promised to writers.
    reserved: u64,
    count: u64,
    removals: u64,
}

impl Index {
    fn next(&mut self) -> u64 {
        self.count += 1;
        self.count
    }

    /// Enters an object that was written, or found at the start. Its bytes are on disk from now on.
    pub(super) fn commit(&mut self, name: &Name, bytes: u64, used: SystemTime) {
        self.forget(name);
        let (version, used) = (self.next(), (used, self.next()));
        self.by_use.insert(used, name.clone());
        self.entries.insert(name.clone(), Entry { bytes, used, version });
        let total = &mut self.totals[name.folder() as usize];
        *total = (total.0 + bytes, total.1 + 1);
        self.show(name.folder());
    }

    /// Strikes an object that is gone. Returns whether there was one.
    pub(super) fn forget(&mut self, name: &Name) -> bool {
        let Some(entry) = self.entries.remove(name) else { return false };
        self.by_use.remove(&entry.used);
        self.removals += 1;
        let total = &mut self.totals[name.folder() as usize];
        *total = (total.0 - entry.bytes, total.1 - 1);
        self.show(name.folder());
        true
    }

    /// Notes a use at `at`, unless a later one is known.
    pub(super) fn touch(&mut self, name: &Name, at: SystemTime) {
        let count = self.next();
        let Some(entry) = self.entries.get_mut(name) else { return };
        self.by_use.remove(&entry.used);
        entry.used = (entry.used.0.max(at), count);
        self.by_use.insert(entry.used, name.clone());
    }

    /// Begins a read. `None`: the object is on its way out.
    pub(super) fn begin_read(&self, name: &Name) -> Option<Seen> {
        let version = self.entries.get(name).map(|entry| entry.version);
        (!self.leaving.contains(name)).then_some(Seen { version, removals: self.removals })
    }

    /// Whether nothing was written to the name since the read began, and it is still there.
    pub(super) fn is_current(&self, name: &Name, seen: Seen) -> bool {
        let version = self.entries.get(name).map(|entry| entry.version);
        version.is_some() && version == seen.version && !self.leaving.contains(name)
    }

    /// Enters what a read found and the index did not know: another process wrote it.
    pub(super) fn adopt(&mut self, name: &Name, seen: Seen, bytes: u64, used: SystemTime) {
        let unknown = !self.entries.contains_key(name) && !self.leaving.contains(name);
        if unknown && seen.version.is_none() && seen.removals == self.removals {
            self.commit(name, bytes, used);
        }
    }

    pub(super) fn pin(&mut self, name: &Name) {
        *self.pins.entry(name.clone()).or_default() += 1;
    }

    pub(super) fn unpin(&mut self, name: &Name) {
        if let Some(count) = self.pins.get_mut(name) {
            *count -= 1;
            if *count == 0 {
                self.pins.remove(name);
            }
        }
    }

    fn may_go(&self, name: &Name) -> bool {
        !self.pins.contains_key(name) && !self.leaving.contains(name)
    }

    /// What was last used longer ago than its folder allows, the longest first.
    pub(super) fn expired(&self, now: SystemTime, ttl: impl Fn(Folder) -> Duration) -> Vec<Victim> {
        self.by_use
            .iter()
            .filter(|((used, _), name)| now.duration_since(*used).is_ok_and(|age| age >= ttl(name.folder())))
            .filter(|(_, name)| self.may_go(name))
            .filter_map(|(used, name)| self.victim(name, *used))
            .collect()
    }

    /// Promises `bytes` below `cap`, or says what has to go for that.
    pub(super) fn reserve(&mut self, bytes: u64, cap: u64) -> Result<(), NoRoom> {
        let (victims, missing) = self.excess(bytes, cap);
        if missing > 0 {
            let taken = self.taken() - victims.iter().map(|victim| victim.bytes).sum::<u64>();
            return Err(NoRoom::Held(taken));
        }
        if !victims.is_empty() {
            return Err(NoRoom::Remove(victims));
        }
        self.reserved += bytes;
        Ok(())
    }

    /// What has to go, the least recently used first, so that `bytes` more are at most `cap`; and how many bytes are
    /// missing even then.
    pub(super) fn excess(&self, bytes: u64, cap: u64) -> (Vec<Victim>, u64) {
        let mut missing = self.taken().saturating_add(bytes).saturating_sub(cap);
        let mut victims = Vec::new();
        for (used, name) in &self.by_use {
            if missing == 0 {
                break;
            }
            if name.folder().is_capped() && self.may_go(name) {
                let Some(victim) = self.victim(name, *used) else { continue };
                missing = missing.saturating_sub(victim.bytes);
                victims.push(victim);
            }
        }
        (victims, missing)
    }

    /// Capped bytes, on disk and promised.
    fn taken(&self) -> u64 {
        let capped = Folder::ALL.into_iter().filter(|folder| folder.is_capped());
        capped.map(|folder| self.total(folder).0).sum::<u64>() + self.reserved
    }

    /// Gives promised bytes back.
    pub(super) fn release(&mut self, bytes: u64) {
        self.reserved -= bytes;
    }

    fn victim(&self, name: &Name, used: Use) -> Option<Victim> {
        self.entries.get(name).map(|entry| Victim { name: name.clone(), bytes: entry.bytes, used })
    }

    /// Takes any object out of sight, on the word of whoever owns it.
    pub(super) fn order_removal(&mut self, name: &Name) {
        self.leaving.insert(name.clone());
    }

    /// Takes a victim out of sight, unless it was used, written or pinned since it was chosen.
    pub(super) fn begin_removal(&mut self, victim: &Victim) -> bool {
        let unchanged = self.entries.get(&victim.name).is_some_and(|entry| entry.used == victim.used);
        unchanged && self.may_go(&victim.name) && self.leaving.insert(victim.name.clone())
    }

    /// Ends a removal: the object is gone, or is back in sight.
    pub(super) fn end_removal(&mut self, name: &Name, gone: bool) {
        self.leaving.remove(name);
        if gone {
            self.forget(name);
        }
    }

    /// Bytes and objects of a folder.
    pub(super) fn total(&self, folder: Folder) -> (u64, u64) {
        self.totals[folder as usize]
    }

    /// Tells the metrics about a folder.
    pub(super) fn show(&self, folder: Folder) {
        let (bytes, objects) = self.total(folder);
        gauge!(STORE_BYTES, "folder" => folder.as_str()).set(bytes as f64);
        gauge!(STORE_OBJECTS, "folder" => folder.as_str()).set(objects as f64);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn name(id: &str) -> Name {
        Name::read(Folder::Inputs, &id.repeat(64)).unwrap()
    }

    fn at(seconds: u64) -> SystemTime {
        SystemTime::UNIX_EPOCH + Duration::from_secs(seconds)
    }

    #[test]
    fn a_read_is_current_until_somebody_writes_or_removes() {
        let mut index = Index::default();
        index.commit(&name("a"), 5, at(1));
        let seen = index.begin_read(&name("a")).unwrap();
        assert!(index.is_current(&name("a"), seen));
        index.touch(&name("a"), at(2));
        assert!(index.is_current(&name("a"), seen), "a use changes nothing");
        index.commit(&name("a"), 5, at(3));
        assert!(!index.is_current(&name("a"), seen));
        let seen = index.begin_read(&name("a")).unwrap();
        index.order_removal(&name("a"));
        assert!(!index.is_current(&name("a"), seen) && index.begin_read(&name("a")).is_none());
        index.end_removal(&name("a"), false);
        assert!(index.is_current(&name("a"), seen), "it could not be removed");
    }

    #[test]
    fn what_was_removed_during_a_read_is_not_adopted() {
        let mut index = Index::default();
        let seen = index.begin_read(&name("a")).unwrap();
        index.adopt(&name("a"), seen, 7, at(1));
        assert_eq!(index.total(Folder::Inputs), (7, 1));
        let seen = index.begin_read(&name("b")).unwrap();
        index.forget(&name("a"));
        index.adopt(&name("b"), seen, 7, at(1));
        assert_eq!(index.total(Folder::Inputs), (0, 0));
    }

    #[test]
    fn a_victim_that_is_used_or_pinned_stays() {
        let mut index = Index::default();
        for (id, used) in [("a", 1), ("b", 2), ("c", 3)] {
            index.commit(&name(id), 10, at(used));
        }
        let Err(NoRoom::Remove(victims)) = index.reserve(20, 30) else { panic!("room where there is none") };
        assert_eq!(victims.iter().map(|v| v.name.clone()).collect::<Vec<_>>(), [name("a"), name("b")]);
        index.touch(&name("a"), at(1));
        index.pin(&name("b"));
        assert!(!index.begin_removal(&victims[0]) && !index.begin_removal(&victims[1]));
        index.unpin(&name("b"));
        assert!(index.begin_removal(&victims[1]) && !index.begin_removal(&victims[1]));
        index.end_removal(&name("b"), true);
        assert_eq!((index.reserve(10, 30), index.total(Folder::Inputs)), (Ok(()), (20, 2)));
        index.pin(&name("a"));
        index.pin(&name("c"));
        assert_eq!(index.reserve(1, 30), Err(NoRoom::Held(30)));
        index.release(10);
        assert_eq!(index.reserve(10, 30), Ok(()));
    }
}
