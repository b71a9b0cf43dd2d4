//! Sums over triangles: area, volume, and the checksum of directed edges.
//!
//! Work is vectorized over batches of triangles.

use super::measure::Component;
use super::mesh::Mesh;
use super::simd::dispatched;

/// No label: see [`add`].
pub(super) const NONE: u32 = u32::MAX;

/// Sums over the triangles of one part of a mesh.
#[derive(Default)]
pub(super) struct Sums {
    /// By label.
    pub(super) by_label: Vec<Component>,
    /// Triangles without a label, each with one of its vertices.
    pub(super) unlabelled: Vec<(u32, Component)>,
    /// Sum of the shares of all directed edges: zero for a closed, consistently wound mesh.
    pub(super) checksum: u64,
    /// True if a triangle has a corner twice.
    pub(super) degenerate: bool,
}

impl Sums {
    /// Returns empty sums of `n_labels` labels.
    pub(super) fn new(n_labels: usize) -> Self {
        Self { by_label: vec![Component::default(); n_labels], ..Self::default() }
    }
}

impl Component {
    fn add(&mut self, triangles: u64, [area, volume, x, y, z]: [f64; 5]) {
        self.triangles += triangles;
        self.area += area;
        self.volume += volume;
        self.moment.iter_mut().zip([x, y, z]).for_each(|(sum, part)| *sum += part);
    }
}

/// A directed edge's share of the checksum: the two directions of an edge have opposite shares.
#[inline(always)]
fn edge_share(from: u32, to: u32) -> u64 {
    let (low, high) = if from < to { (from, to) } else { (to, from) };
    // Two rounds of multiply and shift, as in splitmix64: neighbouring keys must not cancel by arithmetic.
    let mut key = (u64::from(low) << 32 | u64::from(high)).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    key = (key ^ key >> 32).wrapping_mul(0xd6e8_feb8_6659_fd93);
    key ^= key >> 32;
    if from < to { key } else { key.wrapping_neg() }
}

/// Vertex positions relative to the mesh's centre.
#[derive(Clone, Copy)]
pub(super) enum Positions<'a> {
    /// Å.
    Single(&'a [[f32; 3]]),
    /// In steps of so many Å.
    Quantized(&'a [[i16; 4]], f32),
}

impl<'a> From<&'a Mesh> for Positions<'a> {
    fn from(mesh: &'a Mesh) -> Self {
        // Normals stay where they lie, in pieces if need be.
        match &mesh.quantized {
            None => Self::Single(&mesh.positions),
            Some(quantized) => Self::Quantized(&quantized.positions, quantized.step.length()),
        }
    }
}

/// Triangles whose geometry is computed together: enough that values gathered lane by lane have left the store
/// buffer when it is read back as vectors.
const LANES: usize = 128;

/// Area, volume, and first moment of the volume along x, y and z of up to [`LANES`] triangles. Missing ones are zero.
type Lanes = [[f32; LANES]; 5];

dispatched! {
/// Adds `triangles` to `sums` by the label of their vertices. `labels` are those of the vertices from `first` on; the
/// label of a triangle is that of its first corner among them, if any is. The sums do not depend on how the triangles
/// are divided among calls, if all slices but the last have a multiple of [`LANES`] triangles.
pub(super) fn add(sums: &mut Sums, positions: Positions<'_>, triangles: &[[u32; 3]], first: u32, labels: &[u32]) {
    for batch in triangles.chunks(LANES) {
        let (shares, degenerate) = edge_shares(batch);
        sums.checksum = sums.checksum.wrapping_add(shares);
        sums.degenerate |= degenerate;
        let parts = geometry(positions, batch);
        let label = |t: &[u32; 3]| {
            t.iter().find_map(|v| labels.get(v.wrapping_sub(first) as usize)).copied().unwrap_or(NONE)
        };
        let common = label(&batch[0]);
        if common != NONE && batch.iter().all(|t| label(t) == common) {
            sums.by_label[common as usize].add(batch.len() as u64, parts.each_ref().map(sum_lanes));
            continue;
        }
        for (lane, t) in batch.iter().enumerate() {
            let part = parts.each_ref().map(|lanes| f64::from(lanes[lane]));
            if let Some(component) = sums.by_label.get_mut(label(t) as usize) {
                component.add(1, part);
            } else {
                let mut alone = Component::default();
                alone.add(1, part);
                sums.unlabelled.push((t[0], alone));
            }
        }
    }
}
}

/// Sums in double precision with eight accumulators, as a single one would wait for every addition.
#[inline(always)]
pub(super) fn sum_lanes<const N: usize>(lanes: &[f32; N]) -> f64 {
    let mut strands = [0.0_f64; 8];
    for row in lanes.as_chunks::<8>().0 {
        for (strand, value) in strands.iter_mut().zip(row) {
            *strand += f64::from(*value);
        }
    }
    strands.iter().sum()
}

/// Triangles whose checksum is computed together.
const SHARES: usize = 16;

/// The checksum of triangles, and whether one of them has a corner twice.
#[inline(always)]
pub(super) fn edge_shares(triangles: &[[u32; 3]]) -> (u64, bool) {
    let (mut sum, mut twice) = ([0_u64; SHARES], [false; SHARES]);
    let (whole, rest) = triangles.as_chunks::<SHARES>();
    for batch in whole {
        let [a, b, c]: [[u32; SHARES]; 3] = std::array::from_fn(|k| std::array::from_fn(|i| batch[i][k]));
        for i in 0..SHARES {
            let shares =
                edge_share(a[i], b[i]).wrapping_add(edge_share(b[i], c[i])).wrapping_add(edge_share(c[i], a[i]));
            sum[i] = sum[i].wrapping_add(shares);
            twice[i] |= a[i] == b[i] || b[i] == c[i] || c[i] == a[i];
        }
    }
    for &[a, b, c] in rest {
        sum[0] = sum[0].wrapping_add(edge_share(a, b)).wrapping_add(edge_share(b, c)).wrapping_add(edge_share(c, a));
        twice[0] |= a == b || b == c || c == a;
    }
    (sum.iter().fold(0, |all, s| all.wrapping_add(*s)), twice.contains(&true))
}

/// The corners of triangles, lane by lane.
#[inline(always)]
fn gather(batch: &[[u32; 3]], at: impl Fn(usize) -> [f32; 3]) -> [[f32; LANES]; 9] {
    let mut p = [[0.0_f32; LANES]; 9];
    for (lane, t) in batch.iter().enumerate() {
        let [a, b, c] = t.map(|v| at(v as usize));
        for k in 0..3 {
            (p[k][lane], p[3 + k][lane], p[6 + k][lane]) = (a[k], b[k], c[k]);
        }
    }
    p
}

/// Areas, signed volumes and their moments about the mesh's centre. By the divergence theorem, a triangle's part of the
/// volume's moment along an axis is the integral of half the squared coordinate times the normal. Single precision
/// inside a triangle: differences of close positions are nearly exact, and the sums over triangles are double.
#[inline(always)]
fn geometry(positions: Positions<'_>, batch: &[[u32; 3]]) -> Lanes {
    let corners = match positions {
        Positions::Single(rows) => gather(batch, |v| rows[v]),
        Positions::Quantized(rows, step) => gather(batch, |v| {
            let [x, y, z, _] = rows[v];
            // A power of two: exact.
            [x, y, z].map(|c| f32::from(c) * step)
        }),
    };
    let [ax, ay, az, bx, by, bz, cx, cy, cz] = corners;
    // Sum over all pairs of corners, each with itself and with the others: 6 times the mean square over a triangle.
    let squares = |a: f32, b: f32, c: f32| a * (a + b + c) + b * (b + c) + c * c;
    let [mut area, mut volume, mut mx, mut my, mut mz] = [[0.0; LANES]; 5];
    for i in 0..LANES {
        let (ux, uy, uz) = (bx[i] - ax[i], by[i] - ay[i], bz[i] - az[i]);
        let (vx, vy, vz) = (cx[i] - ax[i], cy[i] - ay[i], cz[i] - az[i]);
        let (nx, ny, nz) = (uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx);
        area[i] = 0.5 * (nx * nx + ny * ny + nz * nz).sqrt();
        volume[i] = (ax[i] * nx + ay[i] * ny + az[i] * nz) * (1.0 / 6.0);
        mx[i] = nx * squares(ax[i], bx[i], cx[i]) * (1.0 / 24.0);
        my[i] = ny * squares(ay[i], by[i], cy[i]) * (1.0 / 24.0);
        mz[i] = nz * squares(az[i], bz[i], cz[i]) * (1.0 / 24.0);
    }
    [area, volume, mx, my, mz]
}
