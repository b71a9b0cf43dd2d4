//! Index of spheres in a file: sorted by cube, so that tiles read the spheres near them.

use std::sync::Arc;

use bytemuck::{Pod, Zeroable};
use molmesh_structure::stream::StoredBytes;
use molmesh_surface::vector::joined_bounds;
use molmesh_surface::{Control, MemoryMeter as _, Reservation, SurfaceError};
use rustc_hash::FxHashMap;

use super::level::{cube, grid_cell};
use crate::JobError;

/// Memory of a cube, and of a part of it in the file, bytes.
const CUBE_BYTES: u64 = 128;
const RUN_BYTES: u64 = 16;

/// Sphere with the values of its atom that a tile needs.
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub(super) struct StoredSphere {
    pub(super) centre: [f64; 3],
    /// Order of the spheres of a level, before that of their atoms.
    pub(super) order: u64,
    pub(super) radius: f32,
    /// Atom of the structure, or the atom that represents a group.
    pub(super) atom: u32,
    pub(super) color: [u8; 4],
    /// Makes the size a multiple of the alignment.
    pub(super) padding: u32,
}

impl StoredSphere {
    /// Returns the key that sorts the spheres of a level.
    pub(super) const fn key(&self) -> (u64, u32) {
        (self.order, self.atom)
    }
}

/// Writes spheres at the end of a file. Returns their offset, bytes.
fn append(file: &StoredBytes, spheres: &[StoredSphere]) -> Result<u64, JobError> {
    let bytes: &[u8] = bytemuck::must_cast_slice(spheres);
    let offset = file.reserve(bytes.len() as u64);
    file.write(offset, bytes)?;
    Ok(offset)
}

/// Spheres in a file, in the order in which they were added.
#[derive(Debug)]
pub(super) struct SphereList {
    file: Arc<StoredBytes>,
    /// Offsets and lengths of the parts in the file.
    runs: Vec<(u64, u32)>,
    buffer: Vec<StoredSphere>,
    memory: Reservation,
}

/// Number of spheres in a part of a list.
const RUN: usize = 1 << 14;

impl SphereList {
    /// Creates an empty list.
    pub(super) fn new(file: &Arc<StoredBytes>, control: &Control<'_>) -> Result<Self, JobError> {
        let memory = control.reserve((RUN * size_of::<StoredSphere>()) as u64).map_err(SurfaceError::from)?;
        Ok(Self { file: Arc::clone(file), runs: Vec::new(), buffer: Vec::with_capacity(RUN), memory })
    }

    /// Adds a sphere.
    pub(super) fn push(&mut self, sphere: StoredSphere) -> Result<(), JobError> {
        self.buffer.push(sphere);
        if self.buffer.len() < RUN { Ok(()) } else { self.flush() }
    }

    fn flush(&mut self) -> Result<(), JobError> {
        self.memory.grow(RUN_BYTES).map_err(SurfaceError::from)?;
        let length = u32::try_from(self.buffer.len()).unwrap_or(u32::MAX);
        self.runs.push((append(&self.file, &self.buffer)?, length));
        self.buffer.clear();
        Ok(())
    }

    /// Calls `visit` with the spheres, in parts.
    pub(super) fn each_run(
        mut self,
        mut visit: impl FnMut(&[StoredSphere]) -> Result<(), JobError>,
    ) -> Result<(), JobError> {
        self.flush()?;
        for (offset, length) in self.runs {
            self.buffer.resize(length as usize, StoredSphere::default());
            self.file.read(offset, bytemuck::must_cast_slice_mut(&mut self.buffer))?;
            visit(&self.buffer)?;
        }
        Ok(())
    }
}

/// Spheres in a cube: runs in the file, as offset and length, and those that are not written yet.
#[derive(Debug, Default)]
struct StoredCube {
    runs: Vec<(u64, u32)>,
    buffer: Vec<StoredSphere>,
}

/// Spheres by the cube that contains their centres.
#[derive(Debug)]
pub(super) struct SphereIndex {
    file: Arc<StoredBytes>,
    /// Edge length of the cubes, Å.
    side: f64,
    numbers: FxHashMap<[i64; 3], usize>,
    /// Latest cube and its number. Successive atoms mostly lie in one cube.
    latest: ([i64; 3], usize),
    cubes: Vec<StoredCube>,
    n_buffered: usize,
    /// Number of spheres.
    pub(super) len: u64,
    /// Bytes of spheres in memory before they are written.
    buffer_bytes: usize,
    /// Smallest and largest radius, Å.
    pub(super) radii: [f32; 2],
    /// Lowest and highest coordinates of the centres, Å.
    pub(super) bounds: [[f64; 3]; 2],
    memory: Reservation,
}

impl SphereIndex {
    /// Creates an empty index with cubes of the edge length `side`, Å. Writes spheres when `buffer_bytes` are in
    /// memory.
    pub(super) fn new(
        file: &Arc<StoredBytes>,
        side: f64,
        buffer_bytes: usize,
        control: &Control<'_>,
    ) -> Result<Self, JobError> {
        let memory = Reservation::new(&control.memory);
        // Buffers grow by doubling.
        memory.grow(2 * buffer_bytes as u64).map_err(SurfaceError::from)?;
        Ok(Self {
            file: Arc::clone(file),
            side,
            numbers: FxHashMap::default(),
            latest: ([i64::MIN; 3], 0),
            cubes: Vec::new(),
            n_buffered: 0,
            len: 0,
            buffer_bytes,
            radii: [f32::MAX, 0.0],
            bounds: [[f64::MAX; 3], [f64::MIN; 3]],
            memory,
        })
    }

    /// Adds a sphere.
    pub(super) fn push(&mut self, sphere: StoredSphere) -> Result<(), JobError> {
        let c = sphere.centre;
        self.radii = [self.radii[0].min(sphere.radius), self.radii[1].max(sphere.radius)];
        self.bounds = joined_bounds(self.bounds, [c; 2]);
        let at = cube(c, self.side);
        if at != self.latest.0 {
            let next = self.cubes.len();
            self.latest = (at, *self.numbers.entry(at).or_insert(next));
            if self.latest.1 == next {
                self.memory.grow(CUBE_BYTES).map_err(SurfaceError::from)?;
                self.cubes.push(StoredCube::default());
            }
        }
        self.cubes[self.latest.1].buffer.push(sphere);
        self.n_buffered += 1;
        self.len += 1;
        if self.n_buffered * size_of::<StoredSphere>() >= self.buffer_bytes { self.flush() } else { Ok(()) }
    }

    /// Writes all buffers.
    fn flush(&mut self) -> Result<(), JobError> {
        for cube in self.cubes.iter_mut().filter(|cube| !cube.buffer.is_empty()) {
            let buffer = std::mem::take(&mut cube.buffer);
            let offset = append(&self.file, &buffer)?;
            self.memory.grow(RUN_BYTES).map_err(SurfaceError::from)?;
            cube.runs.push((offset, u32::try_from(buffer.len()).unwrap_or(u32::MAX)));
        }
        self.n_buffered = 0;
        Ok(())
    }

    /// Writes all spheres, so that the index can be read.
    pub(super) fn finish(mut self) -> Result<Self, JobError> {
        self.flush()?;
        self.memory.shrink(2 * self.buffer_bytes as u64);
        Ok(self)
    }

    /// Keeps the memory of the index in the meter, whose owner subtracts it.
    pub(super) fn keep_memory(&self) {
        self.memory.keep();
    }

    /// Returns the number of spheres in cubes.
    fn count(&self, cubes: &[usize]) -> usize {
        cubes.iter().flat_map(|number| &self.cubes[*number].runs).map(|run| run.1 as usize).sum()
    }

    /// Returns the spheres in cubes with the memory that they are charged to.
    pub(super) fn read(
        &self,
        cubes: &[usize],
        control: &Control<'_>,
    ) -> Result<(Vec<StoredSphere>, Reservation), JobError> {
        control.check()?;
        let n = self.count(cubes);
        let memory = control.reserve((size_of::<StoredSphere>() * n) as u64).map_err(SurfaceError::from)?;
        let mut spheres = vec![StoredSphere::default(); n];
        let mut rest = &mut spheres[..];
        for (offset, length) in cubes.iter().flat_map(|number| &self.cubes[*number].runs) {
            let (run, others) = rest.split_at_mut(*length as usize);
            self.file.read(*offset, bytemuck::must_cast_slice_mut(run))?;
            rest = others;
        }
        Ok((spheres, memory))
    }

    /// Returns the spheres whose centres are at most `margin` away from a box along each axis, in their order. Lengths
    /// are in Å.
    pub(super) fn near(
        &self,
        [low, high]: [[f64; 3]; 2],
        margin: f64,
        control: &Control<'_>,
    ) -> Result<(Vec<StoredSphere>, Reservation), JobError> {
        let [low, high] = [low.map(|c| c - margin), high.map(|c| c + margin)];
        let [from, to] = [low, high].map(|corner| cube(corner, self.side));
        let columns = (from[2]..=to[2]).flat_map(|z| (from[1]..=to[1]).map(move |y| [y, z]));
        let cubes = columns.flat_map(|[y, z]| (from[0]..=to[0]).map(move |x| [x, y, z]));
        let cubes: Vec<usize> = cubes.filter_map(|cube| self.numbers.get(&cube).copied()).collect();
        let (mut found, memory) = self.read(&cubes, control)?;
        found.retain(|sphere| (0..3).all(|k| (low[k]..=high[k]).contains(&sphere.centre[k])));
        found.sort_unstable_by_key(StoredSphere::key);
        Ok((found, memory))
    }

    /// Returns the cubes in groups that contain all spheres of each cell of a grid, Å.
    pub(super) fn by_cell(&self, spacing: f64) -> Vec<Vec<usize>> {
        let cells = self.numbers.iter().map(|(at, number)| (grid_cell(*at, self.side, spacing), *at, *number));
        let mut cells: Vec<_> = cells.collect();
        cells.sort_unstable();
        cells.chunk_by(|a, b| a.0 == b.0).map(|run| run.iter().map(|(.., number)| *number).collect()).collect()
    }
}
