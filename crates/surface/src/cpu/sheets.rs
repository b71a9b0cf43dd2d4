//! Sheets of a brick: sets of vertices that its triangles connect.

use super::edge::EDGES;
use crate::union_find::UnionFind;

/// Mark of a vertex that no triangle has used yet.
pub(super) const NONE: u16 = u16::MAX;

/// Sheets of the current brick. New sheets get provisional numbers; sheets that meet are united.
#[derive(Default)]
pub(super) struct Sheets {
    united: UnionFind,
    /// Final number by provisional number, after [`Sheets::resolve`].
    numbers: Vec<u32>,
}

impl Sheets {
    /// Removes all sheets.
    pub(super) fn clear(&mut self) {
        self.united.clear();
    }

    /// Starts with `n` separate sheets.
    pub(super) fn known(&mut self, n: u16) {
        for _ in 0..n {
            self.united.push();
        }
    }

    /// Puts the vertices on `edges` onto one sheet: the lowest of their sheets, or a new one.
    #[inline(always)]
    pub(super) fn join(&mut self, sheet: &mut [u16; EDGES], edges: &[u16]) {
        let (mut low, mut above) = (NONE, 0);
        for &edge in edges {
            let on = sheet[usize::from(edge) % EDGES];
            low = low.min(on);
            // One more than the highest; `NONE` wraps to 0.
            above = above.max(on.wrapping_add(1));
        }
        if low == NONE {
            // A brick has at most 512 cells with four loops each.
            low = u16::try_from(self.united.push()).unwrap_or_default();
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
        if a != NONE && a != b {
            self.united.union(u32::from(a), u32::from(b));
        }
    }

    /// Numbers the remaining sheets from 0. Returns how many there are.
    pub(super) fn resolve(&mut self) -> u16 {
        u16::try_from(self.united.number_sets(&mut self.numbers)).unwrap_or(u16::MAX)
    }

    /// Final number of a sheet.
    #[inline(always)]
    pub(super) fn of(&self, on: u16) -> u16 {
        u16::try_from(self.numbers[usize::from(on)]).unwrap_or(u16::MAX)
    }
}
