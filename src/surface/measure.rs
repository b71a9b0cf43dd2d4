//! What people compute surfaces for, and the proof that the mesh is one: area, volume, components, closedness.
//!
//! Sums run over fixed blocks of triangles, merged in order: the same mesh gives the same digits whatever the
//! thread count.

use rayon::prelude::*;
use rustc_hash::FxHashMap;

use super::control::Control;
use super::error::SurfaceError;
use super::labels::Labels;
use super::mesh::Mesh;
use super::simd::dispatched;
use super::topology;

/// Triangles per block of the sums.
const BLOCK: usize = 1 << 15;

/// How closedness and manifoldness are established.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Proof {
    /// A 64-bit checksum over the directed edges of the index buffer: opposite directions cancel, so anything but
    /// a closed, consistently wound mesh leaves a remainder (but for one chance in 2⁶⁴). That no edge is used more
    /// than twice then follows from the case table, which the tests prove: meant for meshes that a backend made.
    #[default]
    Checksum,
    /// Every edge and the fan of triangles around every vertex, for any mesh. Costs about as much as meshing.
    Exact,
}

impl Proof {
    /// `checksum` or `exact`.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Checksum => "checksum",
            Self::Exact => "exact",
        }
    }
}

/// One connected component of a mesh.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Component {
    /// Its triangles.
    pub triangles: u64,
    /// Its vertices.
    pub vertices: u64,
    /// Area, Å².
    pub area: f64,
    /// Signed volume, Å³: positive for an outer shell, negative for a cavity.
    pub volume: f64,
}

/// Measures of a mesh.
#[derive(Debug, Clone, PartialEq)]
pub struct Measures {
    /// Total area, Å².
    pub area: f64,
    /// Enclosed volume, Å³: the sum of the components' signed volumes.
    pub volume: f64,
    /// V − E + F.
    pub euler: i64,
    /// Every edge is used as often in one direction as in the other.
    pub closed: bool,
    /// Neighbouring triangles wind the same way: no directed edge is used twice.
    pub oriented: bool,
    /// Every edge has exactly two triangles and the triangles around every vertex form one closed fan.
    pub manifold: bool,
    /// How the last three were established.
    pub proof: Proof,
    /// Connected components, largest area first.
    pub components: Vec<Component>,
}

/// Sums over a block of triangles.
#[derive(Default)]
struct BlockSums {
    components: Vec<(u32, Component)>,
    checksum: u64,
    degenerate: bool,
}

impl Measures {
    /// Measures `mesh`.
    ///
    /// # Errors
    /// [`SurfaceError::Cancelled`].
    pub fn of(mesh: &Mesh, proof: Proof, control: &Control<'_>) -> Result<Self, SurfaceError> {
        control.check()?;
        let labels = Labels::of(mesh);
        control.check()?;
        let blocks: Vec<BlockSums> =
            mesh.triangles.par_chunks(BLOCK).map(|block| sum_block(&mesh.positions, block, &labels)).collect();
        control.check()?;
        let mut by_root: FxHashMap<u32, Component> = FxHashMap::default();
        let (mut checksum, mut degenerate) = (0_u64, false);
        for block in &blocks {
            checksum = checksum.wrapping_add(block.checksum);
            degenerate |= block.degenerate;
            for (root, part) in &block.components {
                let sum = by_root.entry(*root).or_default();
                sum.triangles += part.triangles;
                sum.area += part.area;
                sum.volume += part.volume;
            }
        }
        let used = labels.count_vertices(&mut by_root);
        let mut roots: Vec<(u32, Component)> = by_root.into_iter().collect();
        roots.sort_unstable_by(|(i, a), (j, b)| b.area.total_cmp(&a.area).then(i.cmp(j)));
        let components: Vec<Component> = roots.into_iter().map(|(_, component)| component).collect();
        let balanced = checksum == 0 && !degenerate;
        let exact = (proof == Proof::Exact).then(|| topology::check(&mesh.triangles));
        let faces = mesh.n_triangles() as u64;
        // Where every edge has two triangles there are 3F/2 of them; otherwise only counting tells.
        let edges = match &exact {
            Some(topology) => topology.edges,
            None if balanced => faces * 3 / 2,
            None => topology::check(&mesh.triangles).edges,
        };
        Ok(Self {
            area: components.iter().map(|c| c.area).sum(),
            volume: components.iter().map(|c| c.volume).sum(),
            euler: (used + faces).cast_signed() - edges.cast_signed(),
            closed: exact.as_ref().map_or(balanced, |t| t.closed),
            oriented: exact.as_ref().map_or(balanced, |t| t.oriented),
            manifold: exact.as_ref().map_or(balanced, |t| t.manifold),
            proof,
            components,
        })
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

/// Triangles whose geometry is computed together: enough that what was gathered lane by lane has left the store
/// buffer when it is read back as vectors.
const LANES: usize = 128;

/// Area and volume of up to [`LANES`] triangles, each. Missing ones are zero.
type Lanes = [[f32; LANES]; 2];

dispatched! {
/// Sums of one block. Everything that can fill vectors is done for [`LANES`] triangles at a time.
fn sum_block(positions: &[[f32; 3]], block: &[[u32; 3]], labels: &Labels) -> BlockSums {
    let mut sums = BlockSums::default();
    let mut run = (u32::MAX, Component::default());
    for batch in block.chunks(LANES) {
        let (shares, degenerate) = edge_shares(batch);
        sums.checksum = sums.checksum.wrapping_add(shares);
        sums.degenerate |= degenerate;
        let [area, volume] = geometry(positions, batch);
        let root = labels.component(batch[0][0]);
        if root == run.0 && batch.iter().all(|t| labels.component(t[0]) == root) {
            run.1.triangles += batch.len() as u64;
            run.1.area += area.iter().map(|&a| f64::from(a)).sum::<f64>();
            run.1.volume += volume.iter().map(|&v| f64::from(v)).sum::<f64>();
            continue;
        }
        for (t, (&area, &volume)) in batch.iter().zip(area.iter().zip(&volume)) {
            let root = labels.component(t[0]);
            if root != run.0 {
                if run.1.triangles > 0 {
                    sums.components.push(run);
                }
                run = (root, Component::default());
            }
            run.1.triangles += 1;
            run.1.area += f64::from(area);
            run.1.volume += f64::from(volume);
        }
    }
    if run.1.triangles > 0 {
        sums.components.push(run);
    }
    sums
}
}

/// The checksum of a batch, and whether a triangle of it has a corner twice.
#[inline(always)]
fn edge_shares(batch: &[[u32; 3]]) -> (u64, bool) {
    let mut corners = [[0_u32; LANES]; 3];
    for (lane, t) in batch.iter().enumerate() {
        (corners[0][lane], corners[1][lane], corners[2][lane]) = (t[0], t[1], t[2]);
    }
    let [a, b, c] = corners;
    let (mut sum, mut degenerate) = ([0_u64; LANES], false);
    for i in 0..LANES {
        let shares = edge_share(a[i], b[i]).wrapping_add(edge_share(b[i], c[i])).wrapping_add(edge_share(c[i], a[i]));
        sum[i] = if i < batch.len() { shares } else { 0 };
    }
    for i in 0..LANES {
        let twice = a[i] == b[i] || b[i] == c[i] || c[i] == a[i];
        degenerate |= i < batch.len() && twice;
    }
    (sum.iter().fold(0, |all, s| all.wrapping_add(*s)), degenerate)
}

/// Areas and signed volumes against the mesh's centre. Single precision inside a triangle: differences of close
/// positions are nearly exact, and the sums over triangles are double.
#[inline(always)]
fn geometry(positions: &[[f32; 3]], batch: &[[u32; 3]]) -> Lanes {
    let mut p = [[0.0_f32; LANES]; 9];
    for (lane, t) in batch.iter().enumerate() {
        let [a, b, c] = [positions[t[0] as usize], positions[t[1] as usize], positions[t[2] as usize]];
        for k in 0..3 {
            (p[k][lane], p[3 + k][lane], p[6 + k][lane]) = (a[k], b[k], c[k]);
        }
    }
    let [ax, ay, az, bx, by, bz, cx, cy, cz] = p;
    let (mut area, mut volume) = ([0.0; LANES], [0.0; LANES]);
    for i in 0..LANES {
        let (ux, uy, uz) = (bx[i] - ax[i], by[i] - ay[i], bz[i] - az[i]);
        let (vx, vy, vz) = (cx[i] - ax[i], cy[i] - ay[i], cz[i] - az[i]);
        let (nx, ny, nz) = (uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx);
        area[i] = 0.5 * (nx * nx + ny * ny + nz * nz).sqrt();
        volume[i] = (ax[i] * nx + ay[i] * ny + az[i] * nz) * (1.0 / 6.0);
    }
    [area, volume]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A tetrahedron with corner vertices from `first` on, wound outwards.
    fn tetrahedron(mesh: &mut Mesh, at: [f32; 3], flip: bool) {
        let first = u32::try_from(mesh.n_vertices()).unwrap();
        let corners = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        let placed = corners.map(|c: [f32; 3]| [c[0] + at[0], c[1] + at[1], c[2] + at[2]]);
        mesh.positions = mesh.positions.iter().copied().chain(placed).collect();
        mesh.normals = mesh.positions.iter().map(|_| [0.0, 0.0, 1.0]).collect();
        let faces = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]].map(|t: [u32; 3]| t.map(|v| v + first));
        let faces = faces.map(|[a, b, c]| if flip { [a, c, b] } else { [a, b, c] });
        mesh.triangles = mesh.triangles.iter().copied().chain(faces).collect();
    }

    fn both(mesh: &Mesh) -> [Measures; 2] {
        [Proof::Checksum, Proof::Exact].map(|proof| Measures::of(mesh, proof, &Control::default()).unwrap())
    }

    #[test]
    fn a_tetrahedron_and_a_cavity() {
        let mut mesh = Mesh::default();
        tetrahedron(&mut mesh, [10.0, -3.0, 7.0], false);
        tetrahedron(&mut mesh, [0.0; 3], true);
        for m in both(&mesh) {
            assert!(m.closed && m.oriented && m.manifold, "{m:?}");
            assert_eq!((m.euler, m.components.len()), (4, 2));
            let area = 1.5 + 3.0_f64.sqrt() / 2.0;
            assert!((m.area - 2.0 * area).abs() < 1e-6 && m.volume.abs() < 1e-6, "{m:?}");
            let volumes: Vec<f64> = m.components.iter().map(|c| (c.volume * 6.0).round()).collect();
            assert!(volumes.contains(&1.0) && volumes.contains(&-1.0), "{m:?}");
            assert!(m.components.iter().all(|c| c.vertices == 4 && c.triangles == 4));
        }
    }

    #[test]
    fn defects_are_seen_by_both_proofs() {
        let mut whole = Mesh::default();
        tetrahedron(&mut whole, [0.0; 3], false);
        let mut hole = whole.clone();
        hole.triangles = whole.triangles[..3].to_vec().into();
        let mut flipped = whole.clone();
        flipped.triangles[0].swap(0, 1);
        let mut collapsed = whole.clone();
        collapsed.triangles[3] = [1, 1, 3];
        for (what, mesh) in [("hole", hole), ("flipped", flipped), ("collapsed", collapsed)] {
            for m in both(&mesh) {
                assert!(!(m.manifold || m.closed && m.oriented), "{what}: {m:?}");
            }
        }
    }

    #[test]
    fn a_shared_edge_and_a_shared_vertex_are_not_manifold() {
        let mut mesh = Mesh::default();
        tetrahedron(&mut mesh, [0.0; 3], false);
        tetrahedron(&mut mesh, [-1.0; 3], true);
        let [_, apart] = both(&mesh);
        assert!(apart.manifold);
        for shared in [&[(4, 0)][..], &[(4, 0), (5, 1)]] {
            let mut joined = mesh.clone();
            for t in joined.triangles.iter_mut() {
                for v in t {
                    *v = shared.iter().find(|(from, _)| from == v).map_or(*v, |(_, to)| *to);
                }
            }
            let m = Measures::of(&joined, Proof::Exact, &Control::default()).unwrap();
            assert!(m.closed && !m.manifold && m.components.len() == 1, "{shared:?} {m:?}");
        }
    }

    #[test]
    fn an_empty_mesh_has_no_measures() {
        for m in both(&Mesh::default()) {
            assert_eq!((m.euler, m.components.len(), m.area), (0, 0, 0.0));
        }
    }
}
