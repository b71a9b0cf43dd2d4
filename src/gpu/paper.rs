//! The program of Dias, Bora and Gomes (HPDC 2010) as its paper describes it, on today's devices: the baseline that the
//! stages are compared with. Nothing here is meant to be fast.
//!
//! A dense box of samples; one thread an atom scatters its density into the cube of samples within its support (20³ in
//! the paper; about as many at its spacings here); one thread a cube finds its case; a prefix sum; the list of active
//! cubes; one thread an active cube writes triangles that share no vertices; normals from central differences. Kernels
//! and their cut-off are the crate's own, so that the surface is the same. Samples beyond an atom's support are looked
//! at but not added to, which is kinder to the baseline than the paper.
//!
//! Memory grows with the box, so the box is limited. The mesh is a soup: each triangle has three vertices of its own,
//! and measures rightly do not call it closed.

use std::sync::Arc;

use bytemuck::{Pod, Zeroable};
use wgpu::{Buffer, BufferUsages};

use super::engine::{Engine, check, scaled};
use super::error::GpuError;
use super::executor::{Executor, Finished, GpuJob};
use super::flight::values;
use super::landing::Landing;
use super::paper_pipelines::{Bound, PaperPipelines};
use super::prepare::Prepared;
use super::record::Recording;
use crate::surface::lattice::Lattice;
use crate::surface::layout::Params;
use crate::surface::plan::check_totals;
use crate::surface::{Column, GridStats, Kernel, Mesh, MeshOutput, Stage, SurfaceError, SurfaceParams};

/// Fixed-point units of the isovalue, as the shaders have it. Rounding a term moves a density by less than 3·10⁻⁷ of the
/// isovalue, and densities up to 1024 isovalues are told from those that may have overflowed.
const ISO: f64 = (1 << 21) as f64;
/// Values that a workgroup of the prefix sum takes.
const BLOCK: u64 = 512;
/// The paper's stages.
pub const STAGES: [&str; 6] = ["field", "classify", "scan", "map", "vertices", "normals"];
/// Bytes of the timestamps.
const CLOCK: u64 = 16 * STAGES.len() as u64;
/// Where the columns begin in a landing, behind timestamps and counters.
const BODY_AT: u64 = 256;

/// The box as the shaders see it.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Box {
    pub(super) origin: [i32; 3],
    pub(super) n_atoms: u32,
    pub(super) n: [u32; 3],
    pub(super) n_samples: u32,
    pub(super) scale: f32,
    pub(super) n_active: u32,
    pub(super) n_triangles: u32,
    pub(super) pad: u32,
}

/// Runs jobs by the paper's program, one after another.
#[derive(Debug)]
pub struct Paper {
    engine: Engine,
    pipelines: PaperPipelines,
    /// Kept from job to job, by name.
    buffers: Vec<(&'static str, Buffer)>,
    /// Device time of the last job's stages, ns.
    times: [u64; STAGES.len()],
}

/// Lowest and highest sample of the program's box along an axis.
fn bounds(lattice: &Lattice, k: usize, reach: f64) -> (f64, f64) {
    let cells = || lattice.atoms.iter().map(move |atom| atom.position(k));
    let (lo, hi) = (cells().fold(f64::MAX, f64::min), cells().fold(f64::MIN, f64::max));
    // Two beyond what is reached, for the differences.
    ((lo - reach).floor() - 2.0, (hi + reach).ceil() + 2.0)
}

/// The furthest that an atom reaches, in spacings.
fn furthest(lattice: &Lattice) -> f64 {
    lattice.atoms.iter().map(|atom| lattice.reach(atom)).fold(0.0, f64::max)
}

/// Cubes along each axis of the box that the program would visit.
#[must_use]
pub fn cubes(lattice: &Lattice) -> [u64; 3] {
    let reach = furthest(lattice);
    [0, 1, 2].map(|k| {
        let (lo, hi) = bounds(lattice, k, reach);
        whole(hi - lo)
    })
}

/// The samples of a job's box.
fn box_of(job: &Prepared, most: u64) -> Result<Box, SurfaceError> {
    let lattice = &job.lattice;
    let reach = furthest(lattice);
    let bounds = [0, 1, 2].map(|k| bounds(lattice, k, reach));
    let sides = bounds.map(|(lo, hi)| hi - lo + 1.0);
    let samples = sides.iter().product::<f64>();
    let limit = most.min(job.limits.max_samples);
    if samples > limit as f64 {
        let fitting = lattice.spacing * (samples / limit.max(1) as f64).cbrt();
        let suggested_resolution = (fitting * 105.0).ceil() / 100.0;
        let samples = whole(samples);
        return Err(SurfaceError::GridTooLarge { samples, limit, resolution: lattice.spacing, suggested_resolution });
    }
    let n = sides.map(|n| u32::try_from(whole(n)).unwrap_or(u32::MAX));
    let first = |k: usize| lattice.atoms.iter().map(|a| a.cell[k]).min().unwrap_or_default();
    let origin = std::array::from_fn(|k| {
        // Relative to the lowest cell, as that is whole already.
        let down = whole((f64::from(first(k)) - bounds[k].0).max(0.0));
        first(k) - i32::try_from(down).unwrap_or(i32::MAX)
    });
    Ok(Box {
        origin,
        n_atoms: u32::try_from(lattice.atoms.len()).unwrap_or(u32::MAX),
        n,
        n_samples: n.iter().product(),
        scale: single(ISO / job.params.isovalue),
        ..Box::zeroed()
    })
}

#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "float-to-int casts saturate, as wanted")]
fn whole(v: f64) -> u64 {
    v as u64
}

#[expect(clippy::cast_possible_truncation, reason = "rounding to single precision is the point")]
fn single(v: f64) -> f32 {
    v as f32
}

fn failed(why: impl Into<String>) -> GpuError {
    GpuError::Failed(why.into())
}

impl Paper {
    /// Compiles the program on `engine`'s device.
    ///
    /// # Errors
    /// [`GpuError`] as the device reports it.
    pub fn new(engine: Engine) -> Result<Self, GpuError> {
        let pipelines = PaperPipelines::new(&engine.device);
        let paper = Self { engine, pipelines, buffers: Vec::new(), times: [0; STAGES.len()] };
        paper.engine.healthy()?;
        Ok(paper)
    }

    /// Device time of the last job's stages, by the paper's names, ns; zeros where the device has no timestamps.
    #[must_use]
    pub fn times(&self) -> [(&'static str, u64); STAGES.len()] {
        std::array::from_fn(|i| (STAGES[i], self.times[i]))
    }

    /// A buffer of at least `bytes` bytes, of which so many are bound.
    fn room(&mut self, name: &'static str, bytes: u64) -> Bound {
        let bytes = bytes.max(16).next_multiple_of(16);
        let kept = self.buffers.iter().position(|(n, buffer)| *n == name && buffer.size() >= bytes);
        if kept.is_none() {
            self.buffers.retain(|(n, _)| *n != name);
            let usage = match name {
                "params" | "box" => BufferUsages::UNIFORM | BufferUsages::COPY_DST,
                _ => BufferUsages::STORAGE | BufferUsages::COPY_DST | BufferUsages::COPY_SRC,
            };
            let descriptor =
                wgpu::BufferDescriptor { label: Some(name), size: bytes, usage, mapped_at_creation: false };
            self.buffers.push((name, self.engine.device.create_buffer(&descriptor)));
        }
        let at = kept.unwrap_or(self.buffers.len() - 1);
        Bound { name, buffer: self.buffers[at].1.clone(), bytes }
    }

    fn one(&mut self, job: &GpuJob) -> Result<Finished, GpuError> {
        check(job)?;
        let prepared = &*job.prepared;
        if prepared.params.atom_ids {
            let expected = "no nearest atoms with the 2010 program".to_owned();
            return Err(SurfaceError::BadParameter { name: "atom_ids", value: "true".to_owned(), expected }.into());
        }
        // Two words a sample are bound at once.
        let mut dense = box_of(prepared, self.engine.binding_bytes() / 8)?;
        let params = prepared.plan.params(&prepared.lattice, &prepared.params);
        self.times = [0; STAGES.len()];
        let n = u64::from(dense.n_samples);
        let counts = self.count(job, &params, &dense)?;
        let [n_active, n_triangles] = counts;
        let (lattice, limits) = (&prepared.lattice, &prepared.limits);
        let n_vertices = 3 * u64::from(n_triangles);
        // Its vertices are single-precision numbers, whatever was asked for.
        let single = SurfaceParams { quantize: None, ..prepared.params.clone() };
        check_totals(lattice, &single, limits, n_vertices, n_triangles.into())?;
        let most = self.engine.binding_bytes();
        if 12 * n_vertices > most {
            let excess = (12 * n_vertices) as f64 / most as f64;
            let suggested_resolution = (lattice.spacing * excess.sqrt() * 105.0).ceil() / 100.0;
            let bytes = Mesh::bytes_for(n_vertices, n_triangles.into());
            let limit = Mesh::bytes_for(most / 12, most / 36);
            return Err(SurfaceError::MeshTooLarge { bytes, limit, suggested_resolution }.into());
        }
        check(job)?;
        dense = Box { n_active, n_triangles, ..dense };
        let landing = self.output(&dense)?;
        let column = |at: u64| {
            let from = usize::try_from(at).unwrap_or(usize::MAX);
            let bytes = usize::try_from(12 * n_vertices).unwrap_or(usize::MAX);
            Column::shared(landing.clone(), from..from.saturating_add(bytes)).ok_or_else(|| failed("a short landing"))
        };
        let mut mesh = Mesh {
            centre: lattice.centre(),
            positions: column(BODY_AT)?,
            normals: column(BODY_AT + 12 * n_vertices)?,
            triangles: (0..n_triangles).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect(),
            ..Mesh::default()
        };
        if mesh.normals.iter().any(|n| n.iter().all(|c| c.abs() < 0.5)) {
            mesh.fill_flat_normals();
        }
        let grid = GridStats { samples: n, box_cells: lattice.box_cells, ..GridStats::default() };
        let [field, classify, scan, map, vertices, normals] = self.times;
        // By the names of the stages that do the same.
        let all = [
            (Stage::Field, field),
            (Stage::Classify, classify),
            (Stage::Scan, scan + map),
            (Stage::Interpolate, vertices + normals),
        ];
        let stages = if self.engine.has_clock() { all.to_vec() } else { Vec::new() };
        Ok(Finished { meshed: MeshOutput::new(mesh, grid), stages })
    }

    /// The first three stages. Returns the numbers of active cubes and triangles.
    fn count(&mut self, job: &GpuJob, params: &Params, dense: &Box) -> Result<[u32; 2], GpuError> {
        let atoms = &job.prepared.lattice.atoms;
        let n = u64::from(dense.n_samples);
        let table = crate::surface::layout::case_table();
        let bound = [
            self.room("params", size_of::<Params>() as u64),
            self.room("box", size_of::<Box>() as u64),
            self.room("atoms", size_of_val(&atoms[..]) as u64),
            self.room("cases", 4 * table.len() as u64),
            self.room("field", 4 * n),
            self.room("flags", 4 * n),
            self.room("counts", 8 * n),
            self.room("dense", 16),
        ];
        let write = |i: usize, bytes: &[u8]| self.engine.queue.write_buffer(&bound[i].buffer, 0, bytes);
        write(0, bytemuck::bytes_of(params));
        write(1, bytemuck::bytes_of(dense));
        write(2, bytemuck::cast_slice(atoms));
        write(3, bytemuck::cast_slice(&table));
        // What the levels of the prefix sum add up to: the next level's values.
        let mut levels = vec![Bound { bytes: 8 * n, ..bound[6].clone() }];
        for name in ["sums 0", "sums 1", "sums 2", "sums 3"] {
            let values = levels.last().map_or(1, |level| level.bytes / 8);
            levels.push(Bound { bytes: 8 * values.div_ceil(BLOCK), ..self.room(name, 8 * values.div_ceil(BLOCK)) });
        }
        let mut recording = self.engine.recording();
        recording.encoder.clear_buffer(&bound[4].buffer, 0, None);
        recording.encoder.clear_buffer(&bound[7].buffer, 0, None);
        let kernel = match job.prepared.params.kernel {
            Kernel::Gaussian => 0,
            Kernel::SoftObject => 1,
            Kernel::InverseSquare => 2,
        };
        let (device, pipelines) = (&self.engine.device, &self.pipelines);
        let threads = |n: u64, each: u64| u32::try_from(n.div_ceil(each)).unwrap_or(u32::MAX);
        let atoms = threads(dense.n_atoms.into(), 64);
        pipelines.pass(device, &mut recording, "field", kernel, &bound, atoms, Some([0, 1]));
        pipelines.pass(device, &mut recording, "classify", 0, &bound, threads(n, 256), Some([2, 3]));
        let last = levels.len() - 2;
        for (i, pair) in levels.windows(2).enumerate() {
            let both = [pair[0].renamed("values"), pair[1].renamed("sums")];
            let blocks = threads(pair[0].bytes / 8, BLOCK);
            pipelines.pass(device, &mut recording, "scan", 0, &both, blocks, (i == 0).then_some([4, u32::MAX]));
        }
        // The last level is one block, with nothing before it.
        for (i, pair) in levels.windows(2).enumerate().take(last).rev() {
            let both = [pair[0].renamed("values"), pair[1].renamed("sums")];
            let blocks = threads(pair[0].bytes / 8, 256);
            pipelines.pass(device, &mut recording, "add", 0, &both, blocks, (i == 0).then_some([u32::MAX, 5]));
        }
        let landing = self.engine.landings.get(&self.engine.device, BODY_AT);
        let target = landing.buffer().map_err(failed)?;
        self.pipelines.read_clock(&mut recording, 0..6, target);
        if let Some(total) = levels.last() {
            recording.encoder.copy_buffer_to_buffer(&total.buffer, 0, target, CLOCK, 8);
        }
        recording.encoder.copy_buffer_to_buffer(&bound[7].buffer, 0, target, CLOCK + 8, 8);
        let landing = self.fly(recording, (landing, BODY_AT))?;
        self.note_times(&landing, 0..3)?;
        let counts: &[u32] = values((*landing).as_ref(), CLOCK, 3).map_err(failed)?;
        match *counts {
            [_, _, dense] if dense != 0 => Err(failed("atoms lie too densely for the 2010 program's numbers")),
            [n_active, n_triangles, _] => Ok([n_active, n_triangles]),
            _ => Err(failed("no counters came back")),
        }
    }

    /// The last three stages.
    fn output(&mut self, dense: &Box) -> Result<Arc<Landing>, GpuError> {
        let n = u64::from(dense.n_samples);
        let column = 36 * u64::from(dense.n_triangles);
        let bound = [
            self.room("params", size_of::<Params>() as u64),
            self.room("box", size_of::<Box>() as u64),
            self.room("cases", 4 * crate::surface::layout::CASE_WORDS as u64),
            self.room("field", 4 * n),
            self.room("flags", 4 * n),
            self.room("counts", 8 * n),
            self.room("active_cubes", 4 * u64::from(dense.n_active)),
            self.room("positions", column),
            self.room("normals", column),
        ];
        self.engine.queue.write_buffer(&bound[1].buffer, 0, bytemuck::bytes_of(dense));
        let mut recording = self.engine.recording();
        let (device, pipelines) = (&self.engine.device, &self.pipelines);
        let cubes = u32::try_from(n.div_ceil(256)).unwrap_or(u32::MAX);
        pipelines.pass(device, &mut recording, "map", 0, &bound, cubes, Some([6, 7]));
        let active = dense.n_active.div_ceil(64);
        pipelines.pass(device, &mut recording, "vertices", 0, &bound, active, Some([8, 9]));
        pipelines.pass(device, &mut recording, "normals", 0, &bound, active, Some([10, 11]));
        let bytes = (BODY_AT + 2 * column).next_multiple_of(8);
        let landing = self.engine.landings.get(&self.engine.device, bytes);
        let target = landing.buffer().map_err(failed)?;
        self.pipelines.read_clock(&mut recording, 6..12, target);
        recording.encoder.copy_buffer_to_buffer(&bound[7].buffer, 0, target, BODY_AT, column);
        recording.encoder.copy_buffer_to_buffer(&bound[8].buffer, 0, target, BODY_AT + column, column);
        let landing = self.fly(recording, (landing, bytes))?;
        self.note_times(&landing, 3..6)?;
        Ok(landing)
    }

    /// Submits and waits.
    fn fly(&self, recording: Recording<'_>, landing: (Landing, u64)) -> Result<Arc<Landing>, GpuError> {
        let mut landed = self.engine.fly(recording, vec![landing])?;
        landed.pop().ok_or_else(|| failed("a submission without its landing"))
    }

    /// Takes the times of some stages from a landing.
    fn note_times(&mut self, landing: &Landing, stages: std::ops::Range<usize>) -> Result<(), GpuError> {
        if self.engine.has_clock() {
            let ticks: &[u64] = values(landing.as_ref(), 0, 2 * STAGES.len() as u64).map_err(failed)?;
            let period = f64::from(self.engine.queue.get_timestamp_period());
            for s in stages {
                self.times[s] = scaled(ticks[2 * s + 1].saturating_sub(ticks[2 * s]), period);
            }
        }
        Ok(())
    }
}

impl Executor for Paper {
    fn run(&mut self, jobs: &[GpuJob]) -> Vec<Result<Finished, GpuError>> {
        jobs.iter().map(|job| self.one(job)).collect()
    }

    fn held_bytes(&self) -> u64 {
        self.engine.held_bytes() + self.buffers.iter().map(|(_, buffer)| buffer.size()).sum::<u64>()
    }
}
