//! Sequential reference: marching cubes over a dense box, every atom at every grid point, in double precision.
//!
//! The parallel backends are compared with it, as in Dias, Bora and Gomes (HPDC 2010). Its time grows with the number
//! of atoms times the number of grid points. It shares only the formulas and the case table with the other backends.

use super::backend::{Backend, BackendJob, GridStats, MeshOutput};
use super::cases::{CASES, cell_edge};
use super::control::Stage;
use super::cpu::MAX_SHARE;
use super::cpu::scan;
use super::error::SurfaceError;
use super::kernel::{MIN_DISTANCE2, Profile};
use super::lattice::{EDGE_MARGIN, to_f32, to_i32, to_u64};
use super::limit::{Exceeded, Limit, slightly_coarser};
use super::mesh::Mesh;
use super::params::{SurfaceLimits, SurfaceParams};
use super::spheres::Spheres;
use super::vector::{add, dot, length, squared_distance, sub};

/// The sequential reference backend.
#[derive(Debug, Clone, Copy, Default)]
pub struct ReferenceBackend;

/// Marks an edge without a vertex.
const NONE: u32 = u32::MAX;

/// The density as a sum over all spheres, in double precision.
#[derive(Debug, Clone)]
pub struct Density {
    profile: Profile,
    /// Centre and length scale ρ, Å.
    spheres: Vec<([f64; 3], f64)>,
}

impl Density {
    /// The density of `spheres` under `params`.
    ///
    /// # Errors
    /// [`SurfaceError::BadParameter`] if the surface has no density.
    pub fn new(spheres: &Spheres, params: &SurfaceParams) -> Result<Self, SurfaceError> {
        let profile = Profile::new(params.kernel_for("reference")?, params);
        let length = |i| profile.length(f64::from(spheres.radius(i)) * params.radius_scale + params.radius_offset);
        Ok(Self { profile, spheres: (0..spheres.len()).map(|i| (spheres.centre(i), length(i))).collect() })
    }

    /// Returns the density F at `x` (Å).
    #[must_use]
    pub fn value(&self, x: [f64; 3]) -> f64 {
        let term = |(c, length): &([f64; 3], f64)| {
            let length2 = length * length;
            self.profile.value(squared_distance(x, *c) / length2, MIN_DISTANCE2 / length2)
        };
        self.spheres.iter().map(term).sum()
    }

    /// Returns the gradient ∇F at `x` (Å), per Å.
    #[must_use]
    pub fn gradient(&self, x: [f64; 3]) -> [f64; 3] {
        let mut sum = [0.0; 3];
        for (c, length) in &self.spheres {
            let (d, length2) = (sub(x, *c), length * length);
            let u = dot(d, d) / length2;
            let slope = 2.0 / length2 * self.profile.slope(u, MIN_DISTANCE2 / length2);
            sum = add(sum, d.map(|d| slope * d));
        }
        sum
    }

    /// Returns the index of the sphere that is nearest to `x`: the distance to its centre minus its radius is smallest.
    fn nearest(&self, x: [f64; 3]) -> u32 {
        let radius_per_length = self.profile.radius_per_length();
        let distance = |(c, size): &([f64; 3], f64)| length(sub(x, *c)) - radius_per_length * size;
        let best = (0_u32..).zip(&self.spheres).min_by(|(_, a), (_, b)| distance(a).total_cmp(&distance(b)));
        best.map_or(0, |(i, _)| i)
    }

    /// Returns the largest reach of any sphere's density, Å.
    fn reach(&self) -> f64 {
        self.spheres.iter().map(|(_, length)| self.profile.reach(*length)).fold(0.0, f64::max)
    }
}

/// A dense box of grid points.
struct DenseGrid {
    origin: [i32; 3],
    n: [usize; 3],
}

impl DenseGrid {
    fn new(spheres: &Spheres, density: &Density, h: f64, limits: &SurfaceLimits) -> Result<Self, SurfaceError> {
        let Some([lo, hi]) = spheres.bounds() else { return Err(SurfaceError::NoSpheres) };
        let reach = density.reach();
        let first: [f64; 3] = std::array::from_fn(|k| ((lo[k] - reach) / h).floor() - 1.0);
        let last: [f64; 3] = std::array::from_fn(|k| ((hi[k] + reach) / h).ceil() + 1.0);
        let n: [f64; 3] = std::array::from_fn(|k| last[k] - first[k] + 1.0);
        let grid_points = to_u64(n.iter().product());
        if grid_points > limits.max_grid_points {
            let excess = grid_points as f64 / limits.max_grid_points.max(1) as f64;
            let error = Exceeded::new(Limit::GridPoints, limits.max_grid_points);
            let error = Exceeded { actual: Some(grid_points), resolution: Some(h), ..error };
            return Err(error.suggest(slightly_coarser(h * excess.cbrt())).error());
        }
        Ok(Self { origin: first.map(to_i32), n: n.map(|n| usize::try_from(to_u64(n)).unwrap_or(usize::MAX)) })
    }

    fn len(&self) -> usize {
        self.n.iter().product()
    }

    fn at(&self, [x, y, z]: [usize; 3]) -> usize {
        (z * self.n[1] + y) * self.n[0] + x
    }

    fn cells(&self) -> impl Iterator<Item = [usize; 3]> {
        let [nx, ny, nz] = self.n;
        (0..nz - 1).flat_map(move |z| (0..ny - 1).flat_map(move |y| (0..nx - 1).map(move |x| [x, y, z])))
    }

    fn point(&self, at: [usize; 3]) -> [i32; 3] {
        std::array::from_fn(|k| self.origin[k] + i32::try_from(at[k]).unwrap_or(i32::MAX))
    }
}

/// Returns the number of cells along each axis of the box that the reference evaluates. Allocates nothing.
///
/// # Errors
/// [`SurfaceError::NoSpheres`], and [`SurfaceError::BadParameter`] if the surface has no density.
pub fn cells(spheres: &Spheres, params: &SurfaceParams) -> Result<[u64; 3], SurfaceError> {
    let unlimited = SurfaceLimits { max_grid_points: u64::MAX, max_mesh_bytes: u64::MAX, max_candidates: u64::MAX };
    let grid = DenseGrid::new(spheres, &Density::new(spheres, params)?, params.resolution, &unlimited)?;
    Ok(grid.n.map(|n| n as u64 - 1))
}

impl Backend for ReferenceBackend {
    fn name(&self) -> &'static str {
        "reference"
    }

    fn describe(&self) -> String {
        "sequential reference, 1 thread, double precision".to_owned()
    }

    fn write(&self, job: &BackendJob<'_>) -> Result<MeshOutput, SurfaceError> {
        let BackendJob { spheres, params, limits, control, sink } = *job;
        params.check_radius(spheres.radius_range().0)?;
        let density = Density::new(spheres, params)?;
        let grid = DenseGrid::new(spheres, &density, params.resolution, limits)?;
        let h = params.resolution;
        let mut field = vec![0.0_f64; grid.len()];
        let layer = grid.n[0] * grid.n[1];
        for (z, layer) in field.chunks_mut(layer).enumerate() {
            control.check()?;
            control.span(Stage::Field, || {
                for (i, value) in layer.iter_mut().enumerate() {
                    let at = [i % grid.n[0], i / grid.n[0], z];
                    *value = density.value(grid.point(at).map(|s| f64::from(s) * h));
                }
            });
            control.observer.progress(Stage::Field, z + 1, grid.n[2]);
        }
        let cases: Vec<u8> = control.span(Stage::Classify, || {
            let inside = |at| field[grid.at(at)] >= params.isovalue;
            let corner = |[x, y, z]: [usize; 3], c: usize| [x + (c & 1), y + (c >> 1 & 1), z + (c >> 2 & 1)];
            grid.cells().map(|cell| (0..8).fold(0, |case, c| case | u8::from(inside(corner(cell, c))) << c)).collect()
        });
        control.check()?;
        let (mut mesh, ids) = control.span(Stage::Interpolate, || vertices(&grid, &field, &density, params, spheres));
        control.check()?;
        control.span(Stage::Emit, || mesh.triangles = triangles(&grid, &cases, &ids).into());
        if mesh.n_triangles() == 0 {
            return Err(SurfaceError::NoSurface { isovalue: Some(params.isovalue) });
        }
        scan::check_size(params, limits, mesh.n_vertices() as u64, mesh.n_triangles() as u64)?;
        let n = grid.len() as u64;
        let stats = GridStats { grid_points: n, box_cells: cases.len() as u64, ..GridStats::default() };
        MeshOutput::new(mesh, stats).deliver(params, control, sink)
    }
}

/// Returns the vertices of all crossing edges, and their ids by grid point and axis.
fn vertices(
    grid: &DenseGrid,
    field: &[f64],
    density: &Density,
    params: &SurfaceParams,
    spheres: &Spheres,
) -> (Mesh, Vec<[u32; 3]>) {
    let (h, iso, margin) = (params.resolution, params.isovalue, f64::from(EDGE_MARGIN));
    let centre =
        spheres.bounds().map_or([0.0; 3], |[lo, hi]| std::array::from_fn(|k| (0.5 * (lo[k] + hi[k]) / h).round() * h));
    let (mut positions, mut normals, mut nearest) = (Vec::new(), Vec::new(), Vec::new());
    let mut ids = vec![[NONE; 3]; grid.len()];
    for cell in grid.cells() {
        let (i, value) = (grid.at(cell), field[grid.at(cell)]);
        for axis in 0..3 {
            let mut next = cell;
            next[axis] += 1;
            let other = field[grid.at(next)];
            if (value >= iso) == (other >= iso) {
                continue;
            }
            let linear = ((value - iso) / (value - other)).clamp(margin, 1.0 - margin);
            let at = |t: f64| {
                let mut x = grid.point(cell).map(f64::from);
                x[axis] += t;
                x.map(|c| c * h)
            };
            let x = at(linear);
            let f = density.value(x);
            let t = refined(linear, value >= iso, f / iso, f / (density.gradient(x)[axis] * h));
            let moved = at(t.clamp(margin, 1.0 - margin));
            ids[i][axis] = u32::try_from(positions.len()).unwrap_or(NONE);
            positions.push(sub(moved, centre).map(to_f32));
            let g = density.gradient(moved);
            let length = length(g);
            normals.push(if length > 1e-9 { g.map(|c| to_f32(-c / length)) } else { [0.0; 3] });
            if params.atom_ids {
                nearest.push(density.nearest(moved));
            }
        }
    }
    let atom_ids = params.atom_ids.then(|| nearest.into());
    let mesh = Mesh { centre, positions: positions.into(), normals: normals.into(), atom_ids, ..Mesh::default() };
    (mesh, ids)
}

/// Returns the parameter of a vertex after one step of Newton's method on ln F from `t`. `ratio` is F over the
/// isovalue, `per_slope` F over dF/dt. Approximates the logarithm and limits the step as the other backends do.
fn refined(t: f64, starts_inside: bool, ratio: f64, per_slope: f64) -> f64 {
    let end = if (ratio >= 1.0) == starts_inside { 1.0 } else { 0.0 };
    let (step, rest) = (-2.0 * (ratio - 1.0) / (ratio + 1.0) * per_slope, end - t);
    let (share, limit) = (step / rest, f64::from(MAX_SHARE));
    t + rest * if (0.0..limit).contains(&share) { share } else { limit }
}

/// Returns the triangles of every cell.
fn triangles(grid: &DenseGrid, cases: &[u8], ids: &[[u32; 3]]) -> Vec<[u32; 3]> {
    let mut triangles = Vec::new();
    for (cell, &case) in grid.cells().zip(cases) {
        triangles.extend(CASES.of(case).iter().map(|t| {
            t.map(|e| {
                let edge = cell_edge(e);
                let owner = std::array::from_fn(|k| cell[k] + usize::from(edge.offset[k]));
                ids[grid.at(owner)][usize::from(edge.axis)]
            })
        }));
    }
    triangles
}
