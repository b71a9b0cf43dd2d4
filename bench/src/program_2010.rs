//! GPU program of Dias, Bora and Gomes (HPDC 2010), implemented from its paper as a baseline for the stages.
//!
//! The grid is dense. One thread per atom adds its density to the grid points within its support: 20³ in the paper,
//! about as many at the spacings here. One thread per cube finds its case. A prefix sum gives the list of active cubes.
//! One thread per active cube writes triangles that share no vertices, and normals from central differences.
//!
//! Kernels and cut-off are those of molmesh, so the surface is the same. Grid points beyond the support of an atom are
//! visited but not written, so the baseline is faster than the paper's program.

#[cfg(test)]
mod tests;

use std::collections::BTreeMap;

use bytemuck::{Pod, Zeroable};
use molmesh::gpu::Prepared;
use molmesh::gpu::plan::layout::case_table;
use molmesh::surface::Kernel;
use molmesh::surface::lattice::Lattice;
use wgpu::{Buffer, BufferUsages, CommandEncoder, ComputePipeline};

use crate::device::{Gpu, Timer};
use crate::error::{Error, Result};

macro_rules! shader {
    ($name:literal) => {
        ($name, concat!(include_str!("../shaders/grid.wgsl"), include_str!(concat!("../shaders/", $name, ".wgsl"))))
    };
}

/// Shaders in execution order. `add` is the second half of the scan.
pub(crate) const SHADERS: [(&str, &str); 7] = [
    shader!("field"),
    shader!("classify"),
    shader!("scan"),
    shader!("add"),
    shader!("map"),
    shader!("vertices"),
    shader!("normals"),
];
/// Timed steps.
const STEPS: [&str; 6] = ["field", "classify", "scan", "map", "vertices", "normals"];
/// Isovalue in fixed-point units, as in `grid.wgsl`. Rounding of a term changes a density by less than 3·10⁻⁷ of the
/// isovalue. The program detects densities above 1024 isovalues, before they overflow.
const ISO: f64 = (1 << 21) as f64;
/// Values per workgroup of the prefix sum.
const BLOCK: u64 = 512;

/// Uniform buffer of the grid, in the layout of the shaders.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
struct GridUniform {
    origin: [i32; 3],
    n_atoms: u32,
    n: [u32; 3],
    n_points: u32,
    centre: [i32; 3],
    spacing: f32,
    scale: f32,
    n_active: u32,
    support: f32,
    share: f32,
    rate: f32,
    tail_share: f32,
    tail_rate: f32,
    amplitude: f32,
    u_min: f32,
    pad: [u32; 3],
}

/// Returns the lowest and the highest grid point along axis `k`.
fn bounds(lattice: &Lattice, k: usize) -> (f64, f64) {
    let reach = lattice.atoms.iter().map(|atom| lattice.reach(atom)).fold(0.0, f64::max);
    let cells = || lattice.atoms.iter().map(move |atom| atom.position(k));
    let (lo, hi) = (cells().fold(f64::MAX, f64::min), cells().fold(f64::MIN, f64::max));
    // Central differences need two more points.
    ((lo - reach).floor() - 2.0, (hi + reach).ceil() + 2.0)
}

/// Returns the number of cubes along each axis of the program's grid.
pub(crate) fn cubes(lattice: &Lattice) -> [u64; 3] {
    [0, 1, 2].map(|k| {
        let (lo, hi) = bounds(lattice, k);
        whole(hi - lo)
    })
}

#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "float-to-int casts saturate")]
const fn whole(v: f64) -> u64 {
    v as u64
}

#[expect(clippy::cast_possible_truncation, reason = "the shaders use single precision")]
const fn single(v: f64) -> f32 {
    v as f32
}

impl GridUniform {
    /// Creates the grid of a job, with at most `limit` points.
    fn new(job: &Prepared, limit: u64) -> Result<Self> {
        let (lattice, params) = (&job.lattice, job.plan.params(&job.lattice, &job.params));
        let bounds = [0, 1, 2].map(|k| bounds(lattice, k));
        let sides = bounds.map(|(lo, hi)| hi - lo + 1.0);
        let n_points = sides.iter().product::<f64>();
        if n_points > limit as f64 {
            let spacing = lattice.spacing * 1.05 * (n_points / limit as f64).cbrt();
            let why = format!(
                "the grid has {n_points:.0} grid points, the device supports {limit}; a spacing of {spacing:.2} Å fits"
            );
            return Err(Error::Failed(why));
        }
        let n = sides.map(|n| u32::try_from(whole(n)).unwrap_or(u32::MAX));
        let origin = std::array::from_fn(|k| {
            // Relative to the lowest cell, which is an integer.
            let first = lattice.atoms.iter().map(|atom| atom.cell[k]).min().unwrap_or_default();
            let below = whole((f64::from(first) - bounds[k].0).max(0.0));
            first - i32::try_from(below).unwrap_or(i32::MAX)
        });
        Ok(Self {
            origin,
            n_atoms: u32::try_from(lattice.atoms.len()).unwrap_or(u32::MAX),
            n,
            n_points: n.iter().product(),
            centre: params.centre,
            spacing: params.spacing,
            scale: single(ISO / job.params.isovalue),
            support: params.support,
            share: params.share,
            rate: params.rate,
            tail_share: params.tail_share,
            tail_rate: params.tail_rate,
            amplitude: params.amplitude,
            u_min: params.u_min,
            ..Self::zeroed()
        })
    }
}

/// Compiled program on a device.
#[derive(Debug)]
pub(crate) struct Program2010 {
    gpu: Gpu,
    timer: Option<Timer>,
    /// Pipelines by shader. `field` has one for each kernel.
    pipelines: BTreeMap<&'static str, Vec<ComputePipeline>>,
    /// Buffers, reused by later runs.
    buffers: BTreeMap<&'static str, Buffer>,
}

/// Buffer and the number of its first bytes that are bound.
type Bound = (Buffer, u64);

impl Program2010 {
    /// Compiles the program.
    ///
    /// # Errors
    /// Returns the errors of the device as [`Error::Failed`].
    pub(crate) fn new(gpu: Gpu) -> Result<Self> {
        let compile = |(name, source)| {
            let kernels: &[f64] = if name == "field" { &[0.0, 1.0, 2.0] } else { &[] };
            let all = kernels.iter().map(|kernel| gpu.pipeline(name, source, &[("KERNEL", *kernel)]));
            (name, if kernels.is_empty() { vec![gpu.pipeline(name, source, &[])] } else { all.collect() })
        };
        let pipelines = SHADERS.map(compile).into();
        gpu.check()?;
        Ok(Self { timer: Timer::new(&gpu), pipelines, buffers: BTreeMap::new(), gpu })
    }

    /// Returns the device memory that the program holds, bytes.
    pub(crate) fn held_bytes(&self) -> u64 {
        self.buffers.values().map(Buffer::size).sum()
    }

    /// Returns the device time of the steps of the last run, s; `None` if the device does not support timestamps.
    ///
    /// # Errors
    /// Returns the errors of the device as [`Error::Failed`].
    pub(crate) fn steps(&self) -> Result<Option<[(&'static str, f64); STEPS.len()]>> {
        let Some(timer) = &self.timer else { return Ok(None) };
        let seconds: [f64; STEPS.len()] = timer.seconds(&self.gpu)?;
        Ok(Some(std::array::from_fn(|i| (STEPS[i], seconds[i]))))
    }

    /// Meshes a job.
    ///
    /// # Errors
    /// Returns [`Error::Failed`] if the grid or the mesh does not fit, or if the device fails.
    pub(crate) fn run(&mut self, job: &Prepared) -> Result<Soup<'_>> {
        // A binding holds two words per grid point.
        let mut grid = GridUniform::new(job, self.gpu.max_binding() / 8)?;
        let [n_active, n_triangles] = self.count(job, &grid)?;
        if n_triangles == 0 {
            return Err(Error::Failed("the surface is empty".to_owned()));
        }
        let column = 36 * u64::from(n_triangles);
        if column > self.gpu.max_binding() {
            return Err(Error::Failed(format!("{n_triangles} triangles do not fit into the device's buffers")));
        }
        grid.n_active = n_active;
        self.output(&grid, column)?;
        let readback = &self.buffers["soup"];
        Ok(Soup { n_triangles: n_triangles as usize, readback })
    }

    /// Returns a buffer of at least `bytes` bytes, with its first `bytes` bytes bound.
    fn bound(&mut self, name: &'static str, bytes: u64) -> Bound {
        let fits = self.buffers.get(name).is_some_and(|buffer| buffer.size() >= bytes);
        if !fits {
            let usage = match name {
                "grid" => BufferUsages::UNIFORM | BufferUsages::COPY_DST,
                "soup" | "counters" => BufferUsages::MAP_READ | BufferUsages::COPY_DST,
                _ => BufferUsages::STORAGE | BufferUsages::COPY_DST | BufferUsages::COPY_SRC,
            };
            // Free the old buffer first, as both may not fit.
            self.buffers.remove(name);
            self.buffers.insert(name, self.gpu.buffer(name, bytes.next_multiple_of(16), usage));
        }
        (self.buffers[name].clone(), bytes)
    }

    /// Adds a pass with one dispatch, which begins and ends the given timed steps.
    fn pass(
        &self,
        encoder: &mut CommandEncoder,
        (name, variant): (&str, usize),
        buffers: &[&Bound],
        workgroups: u64,
        [begins, ends]: [Option<u32>; 2],
    ) {
        let timed = self.timer.as_ref().filter(|_| begins.is_some() || ends.is_some());
        let timestamp_writes = timed.map(|timer| timer.writes(begins, ends));
        let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor { label: Some(name), timestamp_writes });
        let buffers: Vec<_> = buffers.iter().map(|(buffer, bytes)| (buffer, *bytes)).collect();
        let workgroups = u32::try_from(workgroups).unwrap_or(u32::MAX);
        self.gpu.dispatch(&mut pass, &self.pipelines[name][variant], &buffers, workgroups);
    }

    /// Runs the first three steps. Returns the numbers of active cubes and triangles.
    fn count(&mut self, job: &Prepared, grid: &GridUniform) -> Result<[u32; 2]> {
        let (n, table) = (u64::from(grid.n_points), case_table());
        let atoms_bytes: &[u8] = bytemuck::cast_slice(&job.lattice.atoms);
        let grid_buffer = self.bound("grid", size_of::<GridUniform>() as u64);
        let atoms = self.bound("atoms", atoms_bytes.len() as u64);
        let cases = self.bound("cases", 4 * table.len() as u64);
        let [field, flags] = ["field", "flags"].map(|name| self.bound(name, 4 * n));
        let dense = self.bound("dense", 4);
        // Each level of the prefix sum holds the sums of the blocks of the previous level.
        let mut levels = vec![self.bound("counts", 8 * n)];
        for name in ["sums 0", "sums 1", "sums 2", "sums 3"] {
            let blocks = levels.last().map_or(1, |(_, bytes)| (bytes / 8).div_ceil(BLOCK));
            levels.push(self.bound(name, 8 * blocks));
        }
        let write = |(buffer, _): &Bound, bytes: &[u8]| self.gpu.queue.write_buffer(buffer, 0, bytes);
        write(&grid_buffer, bytemuck::bytes_of(grid));
        write(&atoms, atoms_bytes);
        write(&cases, bytemuck::cast_slice(&table));
        let mut encoder = self.gpu.encoder();
        encoder.clear_buffer(&field.0, 0, None);
        encoder.clear_buffer(&dense.0, 0, None);
        let kernel = match job.params.surface.kernel() {
            Some(Kernel::Gaussian) => 0,
            Some(Kernel::SoftObject) => 1,
            Some(Kernel::InverseSquare) => 2,
            None => return Err(Error::failed("the program of 2010 makes isosurfaces only")),
        };
        let step = |n: u32| [Some(n); 2];
        let threads = u64::from(grid.n_atoms).div_ceil(64);
        self.pass(&mut encoder, ("field", kernel), &[&grid_buffer, &atoms, &field], threads, step(0));
        let bound = [&grid_buffer, &field, &cases, &flags, &levels[0], &dense];
        self.pass(&mut encoder, ("classify", 0), &bound, n.div_ceil(256), step(1));
        for (i, pair) in levels.windows(2).enumerate() {
            let begins = (i == 0).then_some(2);
            let blocks = (pair[0].1 / 8).div_ceil(BLOCK);
            self.pass(&mut encoder, ("scan", 0), &[&pair[0], &pair[1]], blocks, [begins, None]);
        }
        // The last level is a single block.
        for (i, pair) in levels.windows(2).enumerate().take(levels.len() - 2).rev() {
            let ends = (i == 0).then_some(2);
            let blocks = (pair[0].1 / 8).div_ceil(256);
            self.pass(&mut encoder, ("add", 0), &[&pair[0], &pair[1]], blocks, [None, ends]);
        }
        let (counters, total) = (self.bound("counters", 16).0, &levels[levels.len() - 1].0);
        encoder.copy_buffer_to_buffer(total, 0, &counters, 0, 8);
        encoder.copy_buffer_to_buffer(&dense.0, 0, &counters, 8, 4);
        let view = self.gpu.submit(encoder, &counters, 16)?;
        let read: Vec<u32> = bytemuck::pod_collect_to_vec(&view);
        drop(view);
        counters.unmap();
        if read[2] != 0 {
            return Err(Error::Failed(
                "atoms are too dense for the fixed-point numbers of the 2010 program".to_owned(),
            ));
        }
        Ok([read[0], read[1]])
    }

    /// Runs the last three steps. Maps positions and normals, `column` bytes each, in `soup`.
    fn output(&mut self, grid: &GridUniform, column: u64) -> Result<()> {
        let (n, active) = (u64::from(grid.n_points), u64::from(grid.n_active));
        let grid_buffer = self.bound("grid", size_of::<GridUniform>() as u64);
        self.gpu.queue.write_buffer(&grid_buffer.0, 0, bytemuck::bytes_of(grid));
        let cases = self.bound("cases", 4 * case_table().len() as u64);
        let [field, flags] = ["field", "flags"].map(|name| self.bound(name, 4 * n));
        let counts = self.bound("counts", 8 * n);
        let cubes = self.bound("active cubes", 4 * active);
        let [positions, normals] = ["positions", "normals"].map(|name| self.bound(name, column));
        let (soup, bytes) = self.bound("soup", (2 * column).next_multiple_of(8));
        let mut encoder = self.gpu.encoder();
        let step = |n: u32| [Some(n); 2];
        let bound = [&grid_buffer, &cases, &flags, &counts, &cubes];
        self.pass(&mut encoder, ("map", 0), &bound, n.div_ceil(256), step(3));
        let bound = [&grid_buffer, &field, &cases, &flags, &counts, &cubes, &positions, &normals];
        self.pass(&mut encoder, ("vertices", 0), &bound[..7], active.div_ceil(64), step(4));
        self.pass(&mut encoder, ("normals", 0), &bound, active.div_ceil(64), step(5));
        encoder.copy_buffer_to_buffer(&positions.0, 0, &soup, 0, column);
        encoder.copy_buffer_to_buffer(&normals.0, 0, &soup, column, column);
        self.gpu.submit(encoder, &soup, bytes).map(drop)
    }
}

/// Triangles that share no vertices, in a mapped readback buffer.
#[derive(Debug)]
pub(crate) struct Soup<'a> {
    pub(crate) n_triangles: usize,
    readback: &'a Buffer,
}

impl Drop for Soup<'_> {
    fn drop(&mut self) {
        self.readback.unmap();
    }
}
