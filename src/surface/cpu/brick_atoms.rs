//! Atoms around a brick's vertices, and the subset that reaches a few of these.

use super::bin::NORMAL_ONLY;
use crate::surface::lattice::LatticeAtom;
use crate::surface::simd::LANES;

/// Factor that exceeds the rounding errors of u, for a vertex and for the box around it.
const MARGIN: f32 = 1.0 + 1e-4;

/// A brick's candidates in its own coordinates.
#[derive(Debug, Default)]
pub(super) struct BrickAtoms {
    /// Centres, and 1/ρ², column by column, padded to whole vectors: the padding is out of reach of every vertex.
    columns: [Vec<f32>; 4],
    /// The same, row by row.
    rows: Vec<[f32; 4]>,
    /// Rows of the candidates that may reach the current vertices, with spare capacity.
    near: Vec<[f32; 4]>,
}

impl BrickAtoms {
    /// Loads the candidates of the brick at `origin`.
    pub(super) fn fill(&mut self, atoms: &[LatticeAtom], candidates: &[u32], origin: [i32; 3]) {
        self.rows.clear();
        self.rows.extend(candidates.iter().map(|&candidate| {
            let atom = &atoms[(candidate & !NORMAL_ONLY) as usize];
            let [x, y, z] = std::array::from_fn(|k| (atom.cell[k] - origin[k]) as f32 + atom.frac[k]);
            [x, y, z, atom.inv_length2]
        }));
        self.rows.resize(candidates.len().next_multiple_of(LANES), [0.0, 0.0, 0.0, f32::INFINITY]);
        for (k, column) in self.columns.iter_mut().enumerate() {
            column.clear();
            column.extend(self.rows.iter().map(|row| row[k]));
        }
        self.near.resize(self.rows.len(), [0.0; 4]);
    }

    /// Returns the candidates that may reach a box, in order: rows of centre and 1/ρ². An omitted candidate is farther
    /// than `support` (in u) from every point in the box, so it would add exact zeros.
    #[inline(always)]
    pub(super) fn reach<'a>(&'a mut self, support: f32, bounds: [[f32; 2]; 3]) -> &'a [[f32; 4]] {
        let limit = support * MARGIN;
        let Self { columns: [x, y, z, inv], rows, near } = self;
        let batches = |column: &'a [f32]| column.as_chunks::<LANES>().0;
        let columns = batches(x).iter().zip(batches(y)).zip(batches(z)).zip(batches(inv));
        let mut n = 0;
        for ((((x, y), z), inv), rows) in columns.zip(rows.as_chunks::<LANES>().0) {
            let mut u = [0.0_f32; LANES];
            for i in 0..LANES {
                let beyond = |c: f32, [lo, hi]: [f32; 2]| {
                    let (below, above) = (lo - c, c - hi);
                    let out = if below > above { below } else { above };
                    if out > 0.0 { out } else { 0.0 }
                };
                let (dx, dy, dz) = (beyond(x[i], bounds[0]), beyond(y[i], bounds[1]), beyond(z[i], bounds[2]));
                u[i] = (dx * dx + dy * dy + dz * dz) * inv[i];
            }
            for (row, u) in rows.iter().zip(u) {
                if let Some(slot) = near.get_mut(n) {
                    *slot = *row;
                }
                n += usize::from(u < limit);
            }
        }
        &near[..n.min(near.len())]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::simd::extent;
    use proptest::prelude::*;

    fn atom(centre: [f32; 3], length: f32) -> LatticeAtom {
        let frac = centre.map(|c| c - c.round());
        #[expect(clippy::cast_possible_truncation, reason = "small whole numbers")]
        let cell = centre.map(|c| c.round() as i32);
        LatticeAtom { cell, inv_length2: (length * length).recip(), frac, source: 0 }
    }

    proptest! {
        #[test]
        fn atoms_that_reach_a_vertex_reach_its_box(
            atoms in prop::collection::vec((prop::array::uniform3(-12.0_f32..20.0), 2.0_f32..5.0), 0..70),
            vertices in prop::array::uniform3(prop::array::uniform16(0.0_f32..8.0)),
            support in 0.5_f32..5.0,
        ) {
            let atoms: Vec<LatticeAtom> = atoms.into_iter().map(|(centre, length)| atom(centre, length)).collect();
            // Every second one is a candidate, some for normals alone.
            let candidates: Vec<u32> =
                (0..).zip(&atoms).step_by(2).map(|(i, _)| if i % 3 == 0 { i | NORMAL_ONLY } else { i }).collect();
            let mut around = BrickAtoms::default();
            around.fill(&atoms, &candidates, [0; 3]);
            let all: Vec<[f32; 4]> = around.rows[..candidates.len()].to_vec();
            let near = around.reach(support, std::array::from_fn(|k| extent(&vertices[k]))).to_vec();
            let reaches = |row: &[f32; 4]| (0..LANES).any(|i| {
                let u: f32 = (0..3).map(|k| (vertices[k][i] - row[k]).powi(2)).sum::<f32>() * row[3];
                u < support
            });
            let mut left = near.iter().peekable();
            for row in &all {
                // Rows keep their order; none is lost or added.
                let kept = left.next_if(|kept| kept.map(f32::to_bits) == row.map(f32::to_bits)).is_some();
                prop_assert!(kept || !reaches(row), "{row:?}");
            }
            prop_assert!(left.next().is_none());
        }
    }

    #[test]
    fn distant_atoms_are_omitted() {
        let atoms = [atom([0.0; 3], 2.0), atom([30.0, 0.0, 0.0], 2.0), atom([7.0; 3], 2.0)];
        let mut around = BrickAtoms::default();
        around.fill(&atoms, &[0, 1, 2], [0; 3]);
        assert_eq!(around.reach(1.0, [[0.0, 1.0]; 3]), [[0.0, 0.0, 0.0, 0.25]]);
        assert_eq!(around.reach(1.0, [[0.0, 8.0]; 3]).len(), 2);
        assert_eq!(around.reach(1000.0, [[0.0, 8.0]; 3]).len(), 3, "and none of those that fill the vectors");
    }
}
