//! Items by group, sorted by counting: in linear time, without memory besides the result.
//!
//! The first pass counts the items of each group. The second pass adds them, and keeps their order within a group.
//! Callers make both passes themselves where they check for cancellation. The number of items has 32 bits.

/// Number of items in each group.
#[derive(Debug)]
pub struct GroupCounts {
    /// Count of each group, after a zero.
    counts: Vec<u32>,
}

impl GroupCounts {
    /// Creates counts of `n_groups` empty groups.
    #[must_use]
    pub fn new(n_groups: usize) -> Self {
        Self { counts: vec![0; n_groups + 1] }
    }

    /// Adds an empty group.
    pub fn push_group(&mut self) {
        self.counts.push(0);
    }

    /// Counts an item.
    #[inline]
    pub fn add(&mut self, group: usize) {
        self.counts[group + 1] += 1;
    }

    /// Returns groups with space for the items.
    #[must_use]
    pub fn groups<T: Copy + Default>(self) -> Groups<T> {
        let (mut ends, mut n_items) = (self.counts, 0);
        for end in &mut ends {
            n_items += std::mem::replace(end, n_items);
        }
        Groups { ends, items: vec![T::default(); n_items as usize] }
    }
}

/// Items by group.
#[derive(Debug, Default)]
pub struct Groups<T = u32> {
    /// End of the items of each group so far, after a zero.
    ends: Vec<u32>,
    items: Vec<T>,
}

impl<T: Copy + Default> Groups<T> {
    /// Sorts pairs of a group and an item by group.
    #[must_use]
    pub fn new(n_groups: usize, pairs: impl Iterator<Item = (usize, T)> + Clone) -> Self {
        let mut counts = GroupCounts::new(n_groups);
        pairs.clone().for_each(|(group, _)| counts.add(group));
        let mut groups = counts.groups();
        pairs.for_each(|(group, item)| groups.push(group, item));
        groups
    }

    /// Adds an item. The groups are complete after as many items as were counted.
    #[inline]
    pub fn push(&mut self, group: usize, item: T) {
        let end = &mut self.ends[group + 1];
        self.items[*end as usize] = item;
        *end += 1;
    }

    /// Returns the items of a group.
    #[must_use]
    #[inline]
    pub fn get(&self, group: usize) -> &[T] {
        &self.items[self.ends[group] as usize..self.ends[group + 1] as usize]
    }

    /// Returns the items of all groups, one after another.
    #[must_use]
    pub fn into_items(self) -> Vec<T> {
        self.items
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn items_keep_their_order_within_a_group() {
        let pairs = [(2, 'a'), (0, 'b'), (2, 'c'), (4, 'd'), (0, 'e'), (2, 'f')];
        let groups = Groups::new(6, pairs.into_iter());
        let expected: [&[char]; 6] = [&['b', 'e'], &[], &['a', 'c', 'f'], &[], &['d'], &[]];
        assert!(expected.into_iter().enumerate().all(|(group, items)| groups.get(group) == items), "{groups:?}");
        assert_eq!(groups.into_items(), ['b', 'e', 'a', 'c', 'f', 'd']);
    }

    #[test]
    fn groups_can_be_added_while_items_are_counted() {
        let mut counts = GroupCounts::new(0);
        for group in [0, 0, 1] {
            if group + 1 == counts.counts.len() {
                counts.push_group();
            }
            counts.add(group);
        }
        let mut groups = counts.groups();
        for (group, item) in [(1, 7), (0, 8), (0, 9)] {
            groups.push(group, item);
        }
        assert_eq!([groups.get(0), groups.get(1)], [&[8, 9][..], &[7]]);
    }
}
