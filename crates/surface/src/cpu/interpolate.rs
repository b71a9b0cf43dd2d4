//! Stage `interpolate`: vertex positions on crossing edges, analytic normals, and nearest atoms on request.
//!
//! `classify` places a vertex by linear interpolation. A sum over the atoms there gives density and slope for a step
//! along the edge, and a second sum gives the normal at the final position: near saddles of the density, the step turns
//! it by up to 170°. A second sum only for vertices that moved far would spare half of them, but change normals, and
//! with them those of the backends relative to each other, by up to 2°. Edge parameters are replaced in place: the page
//! faults of a second column took as long as the step.

use std::ops::Range;

use super::brick_atoms::{BrickAtoms, nearest_atoms};
use super::edge::Edge;
use super::field::Constants;
use super::{Field, Scanned};
use crate::control::Control;
use crate::error::SurfaceError;
use crate::lattice::{EDGE_MARGIN, LatticeAtom, to_f32};
use crate::mesh::{normal_row, position_row};
use crate::params::Kernel;
use crate::quantize::Step;
use crate::simd::{LANES, dispatched, exp2, extent, fma};
use crate::sink::Vertices;
use crate::sphere_union::Feature;

/// Maximum step of a vertex, as a share of the rest of its edge up to the end on the other side of the surface.
pub(crate) const MAX_SHARE: f32 = 0.75;

/// Vertices of one brick, in spacings relative to its first grid point, and the atoms around them. The last vertex is
/// repeated up to whole vectors.
#[derive(Debug, Default)]
pub(super) struct VertexBatch {
    edges: Vec<Edge>,
    t: Vec<f32>,
    p: [Vec<f32>; 3],
    n: [Vec<f32>; 3],
    /// Densities without their common factor.
    density: Vec<f32>,
    atoms: BrickAtoms,
}

impl VertexBatch {
    /// Loads a brick's vertices and computes their positions.
    fn fill(&mut self, edges: &[Edge], t: &[f32]) {
        let padded = t.len().next_multiple_of(LANES);
        self.edges.clear();
        self.edges.extend_from_slice(edges);
        self.edges.resize(padded, edges[edges.len() - 1]);
        self.t.clear();
        self.t.extend_from_slice(t);
        self.t.resize(padded, t[t.len() - 1]);
        for column in self.p.iter_mut().chain(&mut self.n).chain([&mut self.density]) {
            column.resize(padded, 0.0);
        }
        positions(&self.edges, &self.t, &mut self.p);
    }

    /// Sums −∇F and F of the candidates at the positions, each up to a common factor. `is_loaded`: an earlier sum has
    /// loaded the last block of candidates.
    ///
    /// # Errors
    /// [`SurfaceError::Cancelled`].
    fn sum(
        &mut self,
        constants: &Constants,
        atoms: &[LatticeAtom],
        source: &BrickVertices<'_>,
        is_loaded: bool,
        control: &Control<'_>,
    ) -> Result<(), SurfaceError> {
        self.n.iter_mut().chain([&mut self.density]).for_each(|column| column.fill(0.0));
        for block in source.candidates.chunks(BLOCK) {
            control.check()?;
            if !is_loaded || source.candidates.len() > BLOCK {
                self.atoms.fill(atoms, block, source.origin);
            }
            sums(constants, &mut self.atoms, &self.p, &mut self.n, &mut self.density);
        }
        Ok(())
    }
}

dispatched! {
/// Computes the positions of vertices on their edges, in spacings from the brick's first grid point.
fn positions(edges: &[Edge], t: &[f32], p: &mut [Vec<f32>; 3]) {
    let [x, y, z] = p;
    for (((x, y), z), (edge, t)) in x.iter_mut().zip(y).zip(z).zip(edges.iter().zip(t)) {
        let along = |axis: u16| if edge.axis() == axis { *t } else { 0.0 };
        *x = f32::from(edge.x()) + along(0);
        *y = f32::from(edge.y()) + along(1);
        *z = f32::from(edge.z()) + along(2);
    }
}
}

/// Inputs of a brick's vertices.
pub(super) struct BrickVertices<'a> {
    /// The brick's first grid point.
    pub(super) origin: [i32; 3],
    /// The brick's candidate atoms.
    pub(super) candidates: &'a [u32],
    /// Part of the boundary that is nearest to each vertex, for surfaces of spheres.
    pub(super) features: &'a [Feature],
    /// Sphere that is nearest to each vertex, for surfaces of spheres, if requested.
    pub(super) spheres: &'a [u32],
    /// Edge of each vertex.
    pub(super) edges: &'a [Edge],
}

/// Rows of a mesh's vertices. Normals are zero where the gradient vanishes, to be filled from the triangles.
pub(super) enum VertexRows<'a> {
    /// Positions relative to the mesh's centre, Å, and unit normals.
    Single { positions: &'a mut [[f32; 3]], normals: &'a mut [[f32; 3]] },
    /// Positions in steps, and normals in units of 1/127.
    Quantized { step: Step, positions: &'a mut [[i16; 4]], normals: &'a mut [[i8; 4]] },
}

impl VertexRows<'_> {
    /// Returns the rows for reading.
    pub(super) fn as_vertices(&self) -> Vertices<'_> {
        match self {
            Self::Single { positions, normals } => Vertices::Single { positions, normals },
            Self::Quantized { step, positions, normals } => Vertices::Quantized { step: *step, positions, normals },
        }
    }

    /// Returns some of the rows.
    pub(super) fn slice(&mut self, rows: Range<usize>) -> VertexRows<'_> {
        match self {
            Self::Single { positions, normals } => {
                VertexRows::Single { positions: &mut positions[rows.clone()], normals: &mut normals[rows] }
            }
            Self::Quantized { step, positions, normals } => VertexRows::Quantized {
                step: *step,
                positions: &mut positions[rows.clone()],
                normals: &mut normals[rows],
            },
        }
    }

    /// Splits the first `n` rows off.
    pub(super) fn take(&mut self, n: usize) -> Self {
        match self {
            Self::Single { positions, normals } => {
                Self::Single { positions: take(positions, n), normals: take(normals, n) }
            }
            Self::Quantized { step, positions, normals } => {
                Self::Quantized { step: *step, positions: take(positions, n), normals: take(normals, n) }
            }
        }
    }
}

/// Splits the first `n` rows off.
#[expect(clippy::mut_mut, reason = "it moves the caller's slice forward")]
pub(super) fn take<'a, T>(rest: &mut &'a mut [T], n: usize) -> &'a mut [T] {
    let (head, tail) = std::mem::take(rest).split_at_mut(n);
    *rest = tail;
    head
}

/// Destination of a brick's vertices.
pub(super) struct VertexTarget<'a> {
    pub(super) rows: VertexRows<'a>,
    /// Parameter of each vertex along its edge: that of `classify`, replaced by the final one.
    pub(super) t: &'a mut [f32],
    /// Nearest sphere of each vertex, in the caller's numbering.
    pub(super) atom_ids: Option<&'a mut [u32]>,
}

/// Candidates whose gradients are summed together: their coordinates take 200 KB and stay in the core's cache.
const BLOCK: usize = 4096;

/// Computes the vertices of one brick. Returns the number of vertices whose gradient has no direction.
///
/// # Errors
/// [`SurfaceError::Cancelled`].
pub(super) fn interpolate(
    scanned: &Scanned,
    source: &BrickVertices<'_>,
    batch: &mut VertexBatch,
    target: VertexTarget<'_>,
    control: &Control<'_>,
) -> Result<usize, SurfaceError> {
    let Scanned { lattice, field, .. } = scanned;
    let BrickVertices { origin, candidates, features, spheres, edges } = *source;
    batch.fill(edges, target.t);
    match field {
        Field::Density(constants) => {
            batch.sum(constants, &lattice.atoms, source, false, control)?;
            newton_step(constants, scanned.level, &batch.edges, &batch.n, &batch.density, &mut batch.t);
            positions(&batch.edges, &batch.t, &mut batch.p);
            batch.sum(constants, &lattice.atoms, source, true, control)?;
            target.t.copy_from_slice(&batch.t[..edges.len()]);
            if let Some(ids) = target.atom_ids {
                nearest_atoms(&lattice.atoms, constants.radius_per_length, candidates, origin, &batch.p, ids);
            }
        }
        Field::Distance(distance) => {
            control.check()?;
            distance.normals(&lattice.atoms, features, origin, &batch.p, &mut batch.n);
            if let Some(ids) = target.atom_ids {
                ids.iter_mut().zip(spheres).for_each(|(id, sphere)| *id = lattice.atoms[*sphere as usize].source);
            }
        }
    }
    let offset: [f64; 3] = std::array::from_fn(|k| f64::from(origin[k] - lattice.centre[k]));
    Ok(match target.rows {
        VertexRows::Single { positions, normals } => finish(lattice.spacing, offset, batch, positions, normals),
        VertexRows::Quantized { step, positions, normals } => {
            round(lattice.spacing, offset, batch, step, positions, normals)
        }
    })
}

/// Returns a position relative to the mesh's centre, Å. `offset` is the brick's offset from the centre and `in_brick` a
/// position within the brick, both in spacings. Whole spacings are exact in f32, so the product is the only rounding
/// besides the sum.
#[inline(always)]
pub(super) fn position(offset: [f32; 3], in_brick: [f32; 3], spacing: f32) -> [f32; 3] {
    std::array::from_fn(|k| (offset[k] + in_brick[k]) * spacing)
}

/// Returns a gradient scaled to length 1, and true if it has a direction.
#[inline(always)]
fn normal([x, y, z]: [f32; 3]) -> ([f32; 3], bool) {
    let length2 = x * x + y * y + z * z;
    // Below this, single precision cannot represent the direction.
    let usable = length2 > 1e-14;
    let scale = if usable { length2.sqrt().recip() } else { 0.0 };
    ([x * scale, y * scale, z * scale], usable)
}

/// Writes the rows of a batch. Returns the number of gradients without a direction.
#[inline(always)]
fn write<P, N>(
    spacing: f64,
    offset: [f64; 3],
    batch: &VertexBatch,
    (positions, position_of): (&mut [P], impl Fn([f32; 3]) -> P),
    (normals, normal_of): (&mut [N], impl Fn([f32; 3]) -> N),
) -> usize {
    let (h, offset) = (to_f32(spacing), offset.map(to_f32));
    let ([px, py, pz], [nx, ny, nz]) = (&batch.p, &batch.n);
    for (row, ((x, y), z)) in positions.iter_mut().zip(px.iter().zip(py).zip(pz)) {
        *row = position_of(position(offset, [*x, *y, *z], h));
    }
    let mut flat = 0;
    for (row, ((x, y), z)) in normals.iter_mut().zip(nx.iter().zip(ny).zip(nz)) {
        let (unit, usable) = normal([*x, *y, *z]);
        flat += usize::from(!usable);
        *row = normal_of(unit);
    }
    flat
}

dispatched! {
/// Writes positions in Å and normals of length 1.
fn finish(
    spacing: f64,
    offset: [f64; 3],
    batch: &VertexBatch,
    positions: &mut [[f32; 3]],
    normals: &mut [[f32; 3]],
) -> usize {
    write(spacing, offset, batch, (positions, |p| p), (normals, |n| n))
}
}

dispatched! {
/// Writes quantized positions and normals.
fn round(
    spacing: f64,
    offset: [f64; 3],
    batch: &VertexBatch,
    step: Step,
    positions: &mut [[i16; 4]],
    normals: &mut [[i8; 4]],
) -> usize {
    write(spacing, offset, batch, (positions, |p| position_row(step, p)), (normals, normal_row))
}
}

/// Adds −∇F and F of the candidates to the sums of each vertex, each up to a common factor.
#[inline(always)]
fn sum_candidates<const FMA: bool>(
    c: &Constants,
    around: &mut BrickAtoms,
    p: &[Vec<f32>; 3],
    n: &mut [Vec<f32>; 3],
    density: &mut [f32],
) {
    let [px, py, pz] = p;
    let [nx, ny, nz] = n;
    let lanes = px.as_chunks::<LANES>().0.iter().zip(py.as_chunks::<LANES>().0).zip(pz.as_chunks::<LANES>().0);
    let outs = nx.chunks_exact_mut(LANES).zip(ny.chunks_exact_mut(LANES)).zip(nz.chunks_exact_mut(LANES));
    for ((((px, py), pz), ((nx, ny), nz)), density) in lanes.zip(outs).zip(density.chunks_exact_mut(LANES)) {
        let mut sum = [[0.0_f32; LANES]; 4];
        for (sum, column) in sum.iter_mut().zip([&*nx, &*ny, &*nz, &*density]) {
            sum.copy_from_slice(column);
        }
        for &[x, y, z, inv] in around.reach(c.support, [extent(px), extent(py), extent(pz)]) {
            let u_min = c.u_min * inv;
            for i in 0..LANES {
                let (dx, dy, dz) = (px[i] - x, py[i] - y, pz[i] - z);
                let u = fma::<FMA>(dx, dx, fma::<FMA>(dy, dy, dz * dz)) * inv;
                let (slope, value) = match c.kernel {
                    Kernel::Gaussian => {
                        let exponent = fma::<FMA>(-c.rate, u, c.slope_offset);
                        let slope = exp2::<FMA>(if exponent > -100.0 { exponent } else { -100.0 }) - c.slope_tail;
                        (slope, fma::<FMA>(c.slope_decay, u - c.support, slope))
                    }
                    Kernel::SoftObject => {
                        let rest = 1.0 - u;
                        (rest * fma::<FMA>(u, -6.0, 11.0), rest * rest * fma::<FMA>(u, -4.0 / 9.0, 1.0))
                    }
                    Kernel::InverseSquare => {
                        let u = if u > u_min { u } else { u_min };
                        let ratio = (1.0 - u) / (u * u);
                        (ratio * (1.0 + u), ratio * (u - u * u))
                    }
                };
                let (slope, value) = if u < c.support { (slope * inv, value) } else { (0.0, 0.0) };
                sum[0][i] = fma::<FMA>(slope, dx, sum[0][i]);
                sum[1][i] = fma::<FMA>(slope, dy, sum[1][i]);
                sum[2][i] = fma::<FMA>(slope, dz, sum[2][i]);
                sum[3][i] += value;
            }
        }
        nx.copy_from_slice(&sum[0]);
        ny.copy_from_slice(&sum[1]);
        nz.copy_from_slice(&sum[2]);
        density.copy_from_slice(&sum[3]);
    }
}

dispatched! {
/// Adds −∇F and F of the candidates to the sums of each vertex, each up to a common factor.
pub(super) fn sums(
    c: &Constants,
    around: &mut BrickAtoms,
    p: &[Vec<f32>; 3],
    n: &mut [Vec<f32>; 3],
    density: &mut [f32],
) {
    if multiversion::target::target_cfg_f!(any(target_feature = "fma", target_arch = "aarch64")) {
        // One copy of the loop per kernel.
        let of = |kernel| Constants { kernel, ..*c };
        match c.kernel {
            Kernel::Gaussian => sum_candidates::<true>(&of(Kernel::Gaussian), around, p, n, density),
            Kernel::SoftObject => sum_candidates::<true>(&of(Kernel::SoftObject), around, p, n, density),
            Kernel::InverseSquare => sum_candidates::<true>(&of(Kernel::InverseSquare), around, p, n, density),
        }
    } else {
        sum_candidates::<false>(c, around, p, n, density);
    }
}
}

dispatched! {
/// Moves vertices along their edges by one step of Newton's method on ln F, which is closer to linear than F. `n` and
/// `density` are the sums of [`sum_candidates`] at the parameters `t`.
fn newton_step(c: &Constants, isovalue: f32, edges: &[Edge], n: &[Vec<f32>; 3], density: &[f32], t: &mut [f32]) {
    let [x, y, z] = n;
    let sums = x.iter().zip(y).zip(z).zip(density);
    for ((t, edge), (((x, y), z), density)) in t.iter_mut().zip(edges).zip(sums) {
        let along = if edge.axis() == 0 { x } else if edge.axis() == 1 { y } else { z };
        let value = c.amplitude * density;
        // Rational approximation of ln(F/isovalue): a library's logarithm differs between platforms.
        let log = 2.0 * (value - isovalue) / (value + isovalue);
        // The end of the edge that is on the other side of the surface.
        let end = if (value >= isovalue) == edge.starts_inside() { 1.0 } else { 0.0 };
        let rest = end - *t;
        // −dF/dt is twice the amplitude times the sum. The limit keeps the vertex on its edge, and its position
        // continuous where the density is monotonic. Comparisons with NaN are false.
        let share = log * value / (2.0 * c.slope_amplitude * along * rest);
        let share = if (0.0..MAX_SHARE).contains(&share) { share } else { MAX_SHARE };
        *t = (*t + share * rest).clamp(EDGE_MARGIN, 1.0 - EDGE_MARGIN);
    }
}
}
