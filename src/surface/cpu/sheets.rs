//! The sheets of surface within a brick: which of its vertices hang together by its own triangles.

use super::edge::EDGES;

/// The mark of a vertex that no triangle has met yet.
pub(super) const NONE: u16 = u16::MAX;

/// Sheets of the brick at hand, numbered as they are met. Sheets that meet are made equal.
#[derive(Default)]
pub(super) struct Sheets {
    /// Per sheet one that it equals: itself or a lower one. After [`Sheets::resolve`] the final number.
    equal: Vec<u16>,
}

impl Sheets {
    /// Forgets all.
    pub(super) fn clear(&mut self) {
        self.equal.clear();
    }

    /// Starts with `n` sheets that do not meet.
    pub(super) fn known(&mut self, n: u16) {
        self.equal.extend(0..n);
    }

    /// Puts the vertices on `edges` onto one sheet: the lowest that any of them is on, or a new one.
    #[inline(always)]
    pub(super) fn join(&mut self, sheet: &mut [u16; EDGES], edges: &[u16]) {
        let (mut low, mut above) = (NONE, 0);
        for &edge in edges {
            let on = sheet[usize::from(edge) % EDGES];
            low = low.min(on);
            // One more than the highest; none is 0.
            above = above.max(on.wrapping_add(1));
        }
        if low == NONE {
            // A brick has at most 512 cells with four loops each.
            low = u16::try_from(self.equal.len()).unwrap_or_default();
            self.equal.push(low);
        } else if above > low + 1 {
            for &edge in edges {
                self.unite(sheet[usize::from(edge) % EDGES], low);
            }
        }
        for &edge in edges {
            sheet[usize::from(edge) % EDGES] = low;
        }
    }

    #[cold]
    fn unite(&mut self, a: u16, b: u16) {
        if a == NONE || a == b {
            return;
        }
        let find = |mut on: u16| {
            while self.equal[usize::from(on)] != on {
                on = self.equal[usize::from(on)];
            }
            on
        };
        let (a, b) = (find(a), find(b));
        self.equal[usize::from(a.max(b))] = a.min(b);
    }

    /// Numbers the sheets that are left, from 0, and returns how many there are.
    pub(super) fn resolve(&mut self) -> u16 {
        let mut n = 0;
        for on in 0..self.equal.len() {
            // Ascending: the lower sheet that this one equals has its final number already.
            let equals = usize::from(self.equal[on]);
            if equals == on {
                (self.equal[on], n) = (n, n + 1);
            } else {
                self.equal[on] = self.equal[equals];
            }
        }
        n
    }

    /// The final number of a sheet.
    #[inline(always)]
    pub(super) fn of(&self, on: u16) -> u16 {
        self.equal[usize::from(on)]
    }
}
