//! Atoms around a brick's vertices, the subset that reaches a few of these, and the nearest one.

use super::bin::NORMAL_ONLY;
use crate::lattice::LatticeAtom;
use crate::simd::{LANES, dispatched};

/// Factor that exceeds the rounding errors of u, for a vertex and for the box around it.
const MARGIN: f32 = 1.0 + 1e-4;

/// Margin for the rounding of distances between atoms and vertices, grid spacings.
const ROUNDING: f32 = 0.01;

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

dispatched! {
/// Finds the candidate whose sphere is nearest to each vertex: the distance to its centre minus its radius is smallest.
/// Among equals, takes the first in canonical order.
pub(super) fn nearest_atoms(
    atoms: &[LatticeAtom],
    radius_per_length: f32,
    candidates: &[u32],
    origin: [i32; 3],
    p: &[Vec<f32>; 3],
    ids: &mut [u32],
) {
    let mut spheres: [Vec<f32>; 4] = std::array::from_fn(|_| Vec::with_capacity(candidates.len()));
    for &candidate in candidates {
        let atom = &atoms[(candidate & !NORMAL_ONLY) as usize];
        for k in 0..3 {
            spheres[k].push((atom.cell[k] - origin[k]) as f32 + atom.frac[k]);
        }
        spheres[3].push(radius_per_length / atom.inv_length2.sqrt());
    }
    let [x, y, z, radius] = &spheres;
    let mut from_middle = vec![0.0_f32; candidates.len()];
    let [px, py, pz] = p;
    let lanes = px.chunks_exact(LANES).zip(py.chunks_exact(LANES)).zip(pz.chunks_exact(LANES));
    for (ids, ((px, py), pz)) in ids.chunks_mut(LANES).zip(lanes) {
        // No vertex is farther from the middle of their box than its half-diagonal. So a sphere that is farther from
        // the middle than the nearest one, by more than the diagonal, is the nearest to no vertex.
        let bounds = [px, py, pz].map(|column| {
            column.iter().fold([f32::MAX, f32::MIN], |[low, high], &v| [low.min(v), high.max(v)])
        });
        let [cx, cy, cz] = bounds.map(|[low, high]| 0.5 * (low + high));
        let [sx, sy, sz] = bounds.map(|[low, high]| high - low);
        let mut least = f32::MAX;
        for (i, distance) in from_middle.iter_mut().enumerate() {
            let (dx, dy, dz) = (cx - x[i], cy - y[i], cz - z[i]);
            *distance = (dx * dx + dy * dy + dz * dz).sqrt() - radius[i];
            least = least.min(*distance);
        }
        let most = least + (sx * sx + sy * sy + sz * sz).sqrt() + ROUNDING;
        let (mut best, mut source) = ([f32::MAX; LANES], [0_u32; LANES]);
        for (at, _) in from_middle.iter().enumerate().filter(|(_, distance)| **distance <= most) {
            let (x, y, z, radius) = (x[at], y[at], z[at], radius[at]);
            let id = atoms[(candidates[at] & !NORMAL_ONLY) as usize].source;
            for i in 0..LANES {
                let (dx, dy, dz) = (px[i] - x, py[i] - y, pz[i] - z);
                let distance = (dx * dx + dy * dy + dz * dz).sqrt() - radius;
                let closer = distance < best[i];
                best[i] = if closer { distance } else { best[i] };
                source[i] = if closer { id } else { source[i] };
            }
        }
        ids.copy_from_slice(&source[..ids.len()]);
    }
}
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::extent;
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
