//! Disjoint sets of consecutive integers.

use super::lattice::to_u32;

/// Disjoint sets of the integers from 0 on. The lowest member of a set represents it, so the result does not depend on
/// the order of the unions.
#[derive(Debug, Default, Clone)]
pub struct UnionFind {
    /// For each integer, a member of the same set that is not higher; for a representative, itself.
    parent: Vec<u32>,
}

impl UnionFind {
    /// Creates `n` sets of one integer each.
    #[must_use]
    pub fn new(n: usize) -> Self {
        Self { parent: (0..to_u32(n)).collect() }
    }

    /// Removes all integers and keeps the memory.
    pub fn clear(&mut self) {
        self.parent.clear();
    }

    /// Adds an integer in a set of its own and returns it.
    #[inline(always)]
    pub fn push(&mut self) -> u32 {
        let next = to_u32(self.parent.len());
        self.parent.push(next);
        next
    }

    /// Merges the sets of `a` and `b`.
    #[inline]
    pub fn union(&mut self, a: u32, b: u32) {
        let (a, b) = (self.find(a), self.find(b));
        self.parent[a.max(b) as usize] = a.min(b);
    }

    /// Returns the representative of `x`. Halves the path to it.
    fn find(&mut self, mut x: u32) -> u32 {
        while self.parent[x as usize] != x {
            let above = self.parent[self.parent[x as usize] as usize];
            self.parent[x as usize] = above;
            x = above;
        }
        x
    }

    /// Writes the number of each integer's set to `numbers`, from 0 in the order of the representatives. Returns the
    /// number of sets.
    pub fn number_sets(&self, numbers: &mut Vec<u32>) -> u32 {
        let mut n = 0;
        numbers.clear();
        for (x, &parent) in (0..).zip(&self.parent) {
            let number = if parent == x { n } else { numbers[parent as usize] };
            n += u32::from(parent == x);
            numbers.push(number);
        }
        n
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_lowest_member_represents_a_set_for_any_order_of_unions() {
        let pairs = [[7, 3], [3, 9], [1, 2], [9, 8], [2, 0]];
        let joined = |order: &mut dyn Iterator<Item = &[u32; 2]>| {
            let mut sets = UnionFind::new(10);
            order.for_each(|[a, b]| sets.union(*a, *b));
            let mut numbers = vec![5];
            assert_eq!(sets.number_sets(&mut numbers), 5);
            assert_eq!(numbers, [0, 0, 0, 1, 2, 3, 4, 1, 1, 1]);
            (0..10).map(|x| sets.find(x)).collect::<Vec<_>>()
        };
        let expected = [0, 0, 0, 3, 4, 5, 6, 3, 3, 3];
        assert_eq!(joined(&mut pairs.iter()), expected);
        assert_eq!(joined(&mut pairs.iter().rev()), expected);
    }
}
