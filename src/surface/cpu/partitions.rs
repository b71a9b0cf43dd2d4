//! First pass in partitions: results of some tiles as bytes, and the pass that joins them.
//!
//! The bytes are those of the records, so they are read by the same release on a machine with the same byte order only.
//! Numbers of vertices and triangles start at 0 in each tile; `scan` adds the totals of the tiles before.

use std::hash::Hasher as _;
use std::ops::Range;
use std::sync::Arc;

use bytemuck::{Pod, Zeroable};
use rustc_hash::FxHasher;

use super::bin::{SIDE, slot_brick};
use super::classify::ClassifiedBricks;
use super::first_pass::{Pass, TILE_BYTES};
use super::{CpuBackend, FirstPass, NO_BRICK, RunContext, Tile};
use crate::surface::control::Control;
use crate::surface::error::SurfaceError;
use crate::surface::lattice::{BRICK_POINTS, Lattice, to_u32};
use crate::surface::memory::Reservation;
use crate::surface::params::{SurfaceLimits, SurfaceParams};
use crate::surface::partitions::{MeshPartition, PartitionSource, PartitionStep};
use crate::surface::spheres::Spheres;
use crate::surface::threads;

/// Beginning of the bytes of a partition.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
struct PartitionHeader {
    magic: [u8; 8],
    /// Hash of the lattice.
    lattice: u64,
    /// Number of the partition, number of partitions, first tile and number of tiles.
    partition: [u32; 4],
    counts: PassCounts,
}

const MAGIC: [u8; 8] = *b"molmesh1";

/// Numbers that the first pass counts over the tiles of a partition.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub(super) struct PassCounts {
    pub(super) bricks: u64,
    pub(super) grid_points: u64,
    pub(super) candidates: u64,
    pub(super) candidate_pairs: u64,
}

/// Beginning of the records of a tile: its number, and the lengths of its lists.
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
#[repr(C)]
struct TileHeader {
    tile: u32,
    triangles: u32,
    bricks: u32,
    vertices: u32,
    cases: u32,
    candidates: u32,
    features: u32,
    spheres: u32,
    sheets: u32,
}

impl CpuBackend {
    /// Computes partitions of a mesh that another process joins, until none is left. That process has the same spheres,
    /// parameters, release and arithmetic.
    ///
    /// # Errors
    /// Those of [`Backend::write`](crate::surface::Backend::write); of the limits, those that the partitions exceed.
    pub fn help(
        &self,
        spheres: &Spheres,
        params: &SurfaceParams,
        limits: &SurfaceLimits,
        control: &Control<'_>,
    ) -> Result<(), SurfaceError> {
        self.install(|free_threads| {
            let context = RunContext { params, limits, control, free_threads };
            let Some((source, count)) = source(spheres.len(), context) else { return Ok(()) };
            let first = FirstPass::new(super::place(spheres, context)?, context)?;
            while let Some(step) = source.next(control)? {
                let (PartitionStep::Compute(index) | PartitionStep::Join(index, _)) = step;
                // Releases the memory of the partition.
                let memory = Arc::new(Reservation::new(&control.memory));
                let control = &Control { memory, ..control.clone() };
                let results = results(&first, RunContext { control, ..context }, MeshPartition { index, count })?;
                source.publish(index, results);
                source.finished(index, false);
            }
            Ok(())
        })
    }
}

/// Returns the source of partitions of a run, and their number. Called before the first pass is prepared, so that
/// helpers prepare it at the same time.
pub(super) fn source(spheres: usize, context: RunContext<'_>) -> Option<(&dyn PartitionSource, u32)> {
    let source = context.control.partitions.as_deref()?;
    Some((source, source.begin(spheres, context.params)?))
}

/// Returns the results of a partition.
fn results(first: &FirstPass, context: RunContext<'_>, partition: MeshPartition) -> Result<Vec<u8>, SurfaceError> {
    let pass = first.pass(context);
    let tiles = pass.tiles.of_partition(partition);
    let found = evaluate(&pass, &tiles)?;
    let header = PartitionHeader {
        magic: MAGIC,
        lattice: hash(pass.lattice),
        partition: [partition.index, partition.count, to_u32(tiles.start), to_u32(tiles.len())],
        counts: pass.counters.counts(),
    };
    let of_tiles = found.iter().map(|(_, tile)| size_of::<TileHeader>() as u64 + tile.found.bytes()).sum::<u64>();
    context.control.memory.grow(of_tiles)?;
    let mut bytes = Vec::with_capacity(size_of::<PartitionHeader>() + usize::try_from(of_tiles).unwrap_or_default());
    bytes.extend_from_slice(bytemuck::bytes_of(&header));
    for (t, tile) in &found {
        encode(to_u32(*t), &tile.found, &mut bytes);
    }
    Ok(bytes)
}

/// Evaluates all tiles that the surface reaches, in order: in partitions if there is a source of them.
pub(super) fn evaluate_all(
    pass: &Pass<'_>,
    source: Option<(&dyn PartitionSource, u32)>,
) -> Result<Vec<Tile>, SurfaceError> {
    let mut found = match source {
        None => evaluate(pass, &(0..pass.tiles.len()))?,
        Some((source, count)) => join(pass, source, count)?,
    };
    found.sort_unstable_by_key(|(t, _)| *t);
    Ok(found.into_iter().map(|(_, tile)| tile).collect())
}

/// Evaluates tiles, in parallel. Returns those with their numbers, in any order.
fn evaluate(pass: &Pass<'_>, tiles: &Range<usize>) -> Result<Vec<(usize, Tile)>, SurfaceError> {
    let own: Vec<usize> = (0..pass.slabs.len()).filter(|i| tiles.contains(&pass.slabs[*i].tile)).collect();
    let evaluated = threads::each(own.len(), |i| pass.evaluate(own[i]))?;
    Ok(own.iter().zip(evaluated).filter_map(|(i, tile)| Some((pass.slabs[*i].tile, tile?))).collect())
}

/// Computes the partitions that no other process computes, and joins the results of the others.
fn join(pass: &Pass<'_>, source: &dyn PartitionSource, count: u32) -> Result<Vec<(usize, Tile)>, SurfaceError> {
    let (control, lattice) = (pass.context.control, hash(pass.lattice));
    let mut found = Vec::new();
    while let Some(step) = source.next(control)? {
        control.check()?;
        let (index, bytes) = match step {
            PartitionStep::Compute(index) => (index, Vec::new()),
            PartitionStep::Join(index, bytes) => (index, bytes),
        };
        let partition = MeshPartition { index, count };
        let tiles = pass.tiles.of_partition(partition);
        // The bytes, and the lists with the same records.
        let _bytes = control.reserve(bytes.len() as u64)?;
        let memory = bytes.len() as u64 + TILE_BYTES * tiles.len() as u64;
        control.memory.grow(memory)?;
        let decoded = decode(&bytes, pass, lattice, partition, &tiles);
        let is_joined = decoded.is_some();
        if let Some((counts, joined)) = decoded {
            let vertices = joined.iter().map(|(_, tile)| u64::from(tile.found.vertices)).sum();
            let triangles = joined.iter().map(|(_, tile)| u64::from(tile.found.triangles)).sum();
            let slabs = pass.slabs.iter().filter(|slab| tiles.contains(&slab.tile)).count();
            pass.add(&counts, [vertices, triangles], slabs)?;
            found.extend(joined);
        } else {
            control.memory.shrink(memory);
            found.extend(evaluate(pass, &tiles)?);
        }
        source.finished(index, is_joined);
    }
    Ok(found)
}

/// Returns a hash of the spheres of a lattice and its spacing.
fn hash(lattice: &Lattice) -> u64 {
    let mut hasher = FxHasher::default();
    hasher.write(bytemuck::cast_slice(&lattice.atoms));
    hasher.write_u64(lattice.spacing.to_bits());
    hasher.finish()
}

/// Appends the records of a tile.
fn encode(tile: u32, found: &ClassifiedBricks, bytes: &mut Vec<u8>) {
    let ClassifiedBricks { bricks, t, edges, cases, vertices: _, triangles, candidates, features, spheres, sheets } =
        found;
    let header = TileHeader {
        tile,
        triangles: *triangles,
        bricks: to_u32(bricks.len()),
        vertices: to_u32(t.len()),
        cases: to_u32(cases.len()),
        candidates: to_u32(candidates.len()),
        features: to_u32(features.len()),
        spheres: to_u32(spheres.len()),
        sheets: to_u32(sheets.len()),
    };
    bytes.extend_from_slice(bytemuck::bytes_of(&header));
    let lists: [&[u8]; 8] = [
        bytemuck::cast_slice(bricks),
        bytemuck::cast_slice(t),
        bytemuck::cast_slice(edges),
        cases,
        bytemuck::cast_slice(candidates),
        bytemuck::cast_slice(features),
        bytemuck::cast_slice(spheres),
        bytemuck::cast_slice(sheets),
    ];
    for list in lists {
        bytes.extend_from_slice(list);
    }
}

/// Takes `n` records from the beginning of `bytes`. `None` if there are fewer.
fn take<T: Pod>(bytes: &mut &[u8], n: u32) -> Option<Vec<T>> {
    let (list, rest) = bytes.split_at_checked(size_of::<T>() * n as usize)?;
    *bytes = rest;
    let mut records = vec![T::zeroed(); n as usize];
    bytemuck::cast_slice_mut::<T, u8>(&mut records).copy_from_slice(list);
    Some(records)
}

/// Reads the results of a partition. `None` if they belong to another partition or lattice.
fn decode(
    mut bytes: &[u8],
    pass: &Pass<'_>,
    lattice: u64,
    partition: MeshPartition,
    tiles: &Range<usize>,
) -> Option<(PassCounts, Vec<(usize, Tile)>)> {
    let header: PartitionHeader = *take(&mut bytes, 1)?.first()?;
    let expected = [partition.index, partition.count, to_u32(tiles.start), to_u32(tiles.len())];
    if header != (PartitionHeader { magic: MAGIC, lattice, partition: expected, counts: header.counts }) {
        return None;
    }
    let mut found = Vec::new();
    while !bytes.is_empty() {
        let header: TileHeader = *take(&mut bytes, 1)?.first()?;
        let bricks = ClassifiedBricks {
            bricks: take(&mut bytes, header.bricks)?,
            t: take(&mut bytes, header.vertices)?,
            edges: take(&mut bytes, header.vertices)?,
            cases: take(&mut bytes, header.cases)?,
            vertices: header.vertices,
            triangles: header.triangles,
            candidates: take(&mut bytes, header.candidates)?,
            features: take(&mut bytes, header.features)?,
            spheres: take(&mut bytes, header.spheres)?,
            sheets: take(&mut bytes, header.sheets)?,
        };
        let tile = header.tile as usize;
        let coord = *pass.tiles.coords.get(tile).filter(|_| tiles.contains(&tile))?;
        found.push((tile, Tile { coord, bricks: table_of(&bricks)?, found: bricks, ..Tile::default() }));
    }
    Some((header.counts, found))
}

/// Returns the index of each brick of a tile among the bricks with surface.
fn table_of(found: &ClassifiedBricks) -> Option<Vec<u16>> {
    let mut table = vec![NO_BRICK; BRICK_POINTS];
    for (brick, number) in found.bricks.iter().zip(0_u16..) {
        let [x, y, z] = slot_brick(usize::from(brick.slot));
        if x.max(y) >= SIDE - 1 {
            return None;
        }
        *table.get_mut((z * 8 + y) * 8 + x)? = number;
    }
    Some(table)
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};
    use std::sync::{Arc, Mutex};

    use super::*;
    use crate::surface::backend::Backend as _;
    use crate::surface::{MeshOutput, SurfaceKind, SurfaceOptions};

    /// Source whose steps are given.
    #[derive(Debug)]
    struct Steps {
        left: Mutex<Vec<PartitionStep>>,
        count: u32,
        published: Mutex<Vec<Vec<u8>>>,
        begun: AtomicUsize,
        joined: AtomicUsize,
    }

    impl Steps {
        fn new(count: u32, steps: Vec<PartitionStep>) -> Arc<Self> {
            let [begun, joined] = [0, 0].map(AtomicUsize::new);
            Arc::new(Self { left: Mutex::new(steps), count, published: Mutex::default(), begun, joined })
        }

        fn control(self: &Arc<Self>) -> Control<'static> {
            Control { partitions: Some(Arc::<Self>::clone(self)), ..Control::default() }
        }
    }

    impl PartitionSource for Steps {
        fn is_divided(&self) -> bool {
            self.begun.load(Ordering::SeqCst) > 0
        }

        fn begin(&self, _: usize, _: &SurfaceParams) -> Option<u32> {
            (self.begun.fetch_add(1, Ordering::SeqCst) == 0).then_some(self.count)
        }

        fn next(&self, _: &Control<'_>) -> Result<Option<PartitionStep>, SurfaceError> {
            Ok(self.left.lock().unwrap().pop())
        }

        fn publish(&self, _: u32, results: Vec<u8>) {
            self.published.lock().unwrap().push(results);
        }

        fn finished(&self, _: u32, is_joined: bool) {
            self.joined.fetch_add(usize::from(is_joined), Ordering::SeqCst);
        }
    }

    /// Returns spheres that reach many tiles with different numbers of atoms.
    fn spheres(n: usize) -> Spheres {
        let at = |i: usize, k: f64| 90.0 * (i as f64 * k).sin().powi(3);
        let column = |k: f64| (0..n).map(|i| at(i, k)).collect::<Vec<_>>();
        Spheres::new(column(0.37), column(1.13), column(2.71), vec![1.6; n]).unwrap()
    }

    /// Meshes `spheres` with the partitions that `steps` yields, last one first. Also returns the number of joined
    /// ones.
    fn mesh(spheres: &Spheres, params: &SurfaceParams, count: u32, steps: Vec<PartitionStep>) -> (MeshOutput, usize) {
        let source = Steps::new(count, steps);
        let limits = SurfaceLimits::default();
        let output = CpuBackend::default().run(spheres, params, &limits, &source.control()).unwrap();
        (output, source.joined.load(Ordering::SeqCst))
    }

    fn partition(spheres: &Spheres, params: &SurfaceParams, index: u32, count: u32) -> Vec<u8> {
        let (backend, limits) = (CpuBackend::new(Some(1)).unwrap(), SurfaceLimits::default());
        let source = Steps::new(count, vec![PartitionStep::Compute(index)]);
        backend.help(spheres, params, &limits, &source.control()).unwrap();
        source.published.lock().unwrap().pop().unwrap()
    }

    fn described(output: &MeshOutput) -> String {
        let mesh = &output.mesh;
        format!(
            "{:?} {:?} {:?} {:?} {:?} {:?}",
            &mesh.positions[..],
            &mesh.normals[..],
            &mesh.triangles[..],
            mesh.atom_ids,
            output.grid,
            output.measures
        )
    }

    #[test]
    fn joined_partitions_give_the_bytes_of_one_run() {
        let spheres = spheres(700);
        for (surface, atom_ids) in [
            (SurfaceKind::Gaussian, false),
            (SurfaceKind::Gaussian, true),
            (SurfaceKind::Ses, true),
            (SurfaceKind::Vdw, false),
        ] {
            let options = SurfaceOptions { surface: Some(surface), resolution: Some(0.7), ..SurfaceOptions::default() };
            let params = SurfaceParams { atom_ids, ..SurfaceParams::new(&options).unwrap() };
            let whole = CpuBackend::default().run(&spheres, &params, &SurfaceLimits::default(), &Control::default());
            let expected = described(&whole.unwrap());
            for count in [1, 3, 8, 200] {
                let step = |index| match index % 3 {
                    1 => PartitionStep::Compute(index),
                    _ => PartitionStep::Join(index, partition(&spheres, &params, index, count)),
                };
                let (found, joined) = mesh(&spheres, &params, count, (0..count).map(step).collect());
                assert!(described(&found) == expected, "{surface} in {count} partitions");
                assert_eq!(joined, (0..count).filter(|index| index % 3 != 1).count());
            }
        }
    }

    #[test]
    fn results_of_other_partitions_are_not_joined() {
        let (spheres, other) = (spheres(300), spheres(301));
        let params = SurfaceParams::default();
        let whole = CpuBackend::default().run(&spheres, &params, &SurfaceLimits::default(), &Control::default());
        let expected = described(&whole.unwrap());
        let good = partition(&spheres, &params, 0, 2);
        let cut = good[..good.len() - 1].to_vec();
        let bad = [
            partition(&other, &params, 0, 2),
            partition(&spheres, &params, 1, 2),
            cut,
            Vec::new(),
            b"molmesh1".to_vec(),
        ];
        for bytes in bad {
            let steps = vec![PartitionStep::Compute(1), PartitionStep::Join(0, bytes)];
            let (found, joined) = mesh(&spheres, &params, 2, steps);
            assert_eq!((described(&found) == expected, joined), (true, 0));
        }
        // Control: good results are used.
        assert_eq!(mesh(&spheres, &params, 2, vec![PartitionStep::Compute(1), PartitionStep::Join(0, good)]).1, 1);
    }

    #[test]
    fn limits_apply_to_all_partitions_together() {
        let (spheres, params, most) = (spheres(300), SurfaceParams::default(), SurfaceLimits::default());
        let points = CpuBackend::default().run(&spheres, &params, &most, &Control::default()).unwrap().grid.grid_points;
        for (max_grid_points, fits) in [(points, true), (points - 1, false)] {
            let limits = SurfaceLimits { max_grid_points, ..most };
            let steps =
                (0..4).map(|index| PartitionStep::Join(index, partition(&spheres, &params, index, 4))).collect();
            let found = CpuBackend::default().run(&spheres, &params, &limits, &Steps::new(4, steps).control());
            assert_eq!(found.is_ok(), fits, "{found:?}");
        }
    }
}
