//! The second pass: every tile writes its own part of the mesh, vertices by `interpolate`, triangles by `emit`.

use std::cell::RefCell;
use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;

use super::bin::{Tiles, slot_origin};
use super::emit::{self, BrickTable, Numbered};
use super::interpolate::{self, Batch, SlopeConstants, Source, Target};
use super::join;
use super::sheets::Sheets;
use super::tally::{Place, Tally};
use super::{Tile, scan};
use crate::surface::column::Column;
use crate::surface::control::{Control, Stage};
use crate::surface::error::SurfaceError;
use crate::surface::lattice::Lattice;
use crate::surface::measure::Measures;
use crate::surface::mesh::Mesh;

thread_local! {
    // As the first pass's scratch: kept per thread, not per piece of work.
    static SHADING: RefCell<Shading> = RefCell::default();
}

/// What one thread keeps from tile to tile.
#[derive(Default)]
struct Shading {
    batch: Batch,
    table: BrickTable,
    sheets: Sheets,
}

/// `interpolate` and `emit`: every tile writes its own part of the mesh.
pub(super) fn build(
    lattice: &Lattice,
    tiles: &Tiles,
    done: &[Tile],
    totals: scan::Totals,
    atom_ids: bool,
    control: &Control<'_>,
) -> Result<(Mesh, Option<Measures>), SurfaceError> {
    let mut mesh = Mesh {
        centre: lattice.centre(),
        positions: Column::zeroed(totals.vertices),
        normals: Column::zeroed(totals.vertices),
        triangles: Column::zeroed(totals.triangles),
        atom_ids: atom_ids.then(|| Column::zeroed(totals.vertices)),
        colors: None,
        parts: done.iter().map(|tile| (tile.first_vertex, tile.first_triangle)).collect(),
    };
    let mut work = Vec::with_capacity(done.len());
    let (mut positions, mut normals) = (&mut mesh.positions[..], &mut mesh.normals[..]);
    let (mut triangles, mut ids) = (&mut mesh.triangles[..], mesh.atom_ids.as_deref_mut());
    for tile in done {
        let (n, m) = (tile.found.vertices as usize, tile.found.triangles as usize);
        let part = TilePart {
            tile,
            positions: take(&mut positions, n),
            normals: take(&mut normals, n),
            triangles: take(&mut triangles, m),
            atom_ids: ids.as_mut().map(|ids| take(ids, n)),
        };
        work.push(part);
    }
    let slope = SlopeConstants::new(&lattice.profile, lattice.spacing);
    let finished = AtomicUsize::new(0);
    let parts = work
        .into_par_iter()
        .with_max_len(1)
        .map(|mut part| {
            control.check()?;
            let done_part = SHADING.with_borrow_mut(|Shading { batch, table, sheets }| {
                let flat = control.span(Stage::Interpolate, || part.interpolate(lattice, &slope, batch));
                let tally = control.span(Stage::Emit, || part.emit(lattice, tiles, done, table, sheets));
                (flat, tally)
            });
            let n = finished.fetch_add(1, Ordering::Relaxed) + 1;
            control.observer.progress(Stage::Emit, n, done.len());
            Ok(done_part)
        })
        .collect::<Result<Vec<(usize, Tally)>, SurfaceError>>()?;
    let (flat, tallies): (Vec<usize>, Vec<Tally>) = parts.into_iter().unzip();
    if flat.iter().any(|&n| n > 0) {
        control.span(Stage::Interpolate, || mesh.fill_flat_normals());
    }
    let measures = control.span(Stage::Measure, || join::measures(tiles, done, &tallies, totals));
    Ok((mesh, measures))
}

/// Splits the first `n` rows off.
#[expect(clippy::mut_mut, reason = "it moves the caller's slice forward")]
fn take<'a, T>(rest: &mut &'a mut [T], n: usize) -> &'a mut [T] {
    let (head, tail) = std::mem::take(rest).split_at_mut(n);
    *rest = tail;
    head
}

/// A tile with its part of the mesh.
struct TilePart<'a> {
    tile: &'a Tile,
    positions: &'a mut [[f32; 3]],
    normals: &'a mut [[f32; 3]],
    triangles: &'a mut [[u32; 3]],
    atom_ids: Option<&'a mut [u32]>,
}

impl TilePart<'_> {
    /// Vertices of the tile's bricks. Returns how many have no gradient.
    fn interpolate(&mut self, lattice: &Lattice, slope: &SlopeConstants, batch: &mut Batch) -> usize {
        let found = &self.tile.found;
        let mut flat = 0;
        for (i, brick) in found.bricks.iter().enumerate() {
            let end = found.bricks.get(i + 1).map_or(found.vertices, |next| next.vertex);
            let rows = brick.vertex as usize..end as usize;
            if rows.is_empty() {
                continue;
            }
            let candidates = &found.candidates[brick.candidates[0] as usize..brick.candidates[1] as usize];
            let target = Target {
                positions: &mut self.positions[rows.clone()],
                normals: &mut self.normals[rows.clone()],
                atom_ids: self.atom_ids.as_deref_mut().map(|ids| &mut ids[rows.clone()]),
            };
            let source = Source { tile: self.tile.coord, candidates, t: &found.t[rows] };
            flat += interpolate::interpolate(lattice, slope, brick, &source, batch, target);
        }
        flat
    }

    /// Triangles of the tile's bricks, and what they add up to.
    fn emit(
        &mut self,
        lattice: &Lattice,
        tiles: &Tiles,
        done: &[Tile],
        table: &mut BrickTable,
        sheets: &mut Sheets,
    ) -> Tally {
        let near = Near::new(tiles, done, self.tile.coord);
        let found = &self.tile.found;
        let mut tally = Tally::default();
        for (i, brick) in found.bricks.iter().enumerate() {
            let around: [Option<Numbered<'_>>; 8] =
                std::array::from_fn(|n| near.of(usize::from(brick.slot), n).map(|(_, _, numbered)| numbered));
            let end =
                found.bricks.get(i + 1).map_or((found.triangles, found.cases.len()), |n| (n.triangle, n.case as usize));
            let cases = &found.cases[brick.case as usize..end.1];
            let out = &mut self.triangles[brick.triangle as usize..end.0 as usize];
            let own_sheets = match brick.n_sheets.map_or(0, |n| usize::from(n.get())) {
                0 | 1 => &[][..],
                n => &found.sheets[brick.sheets as usize..][..n],
            };
            emit::emit(table, sheets, &around, cases, own_sheets, out);
            let origin = slot_origin(self.tile.coord, usize::from(brick.slot));
            let offset = std::array::from_fn(|k| f64::from(origin[k] - lattice.centre[k]));
            tally.add(table, sheets, &around, &Place { offset, spacing: lattice.spacing }, out);
        }
        tally
    }
}

/// A tile and its neighbours towards +x, +y, +z.
pub(super) struct Near<'a> {
    tiles: [Option<(usize, &'a Tile)>; 8],
}

impl<'a> Near<'a> {
    pub(super) fn new(tiles: &Tiles, done: &'a [Tile], coord: [i32; 3]) -> Self {
        Self {
            tiles: std::array::from_fn(|n| {
                let coord = std::array::from_fn(|k| coord[k] + i32::from(n >> k & 1 == 1));
                tiles.index.get(&coord).map(|&t| (t as usize, &done[t as usize]))
            }),
        }
    }

    /// The neighbour `n` (bits: 0 x, 1 y, 2 z; 0 is the brick itself) of the brick in `slot`, if it has surface: its
    /// tile, its place among the tile's bricks, and the brick.
    pub(super) fn of(&self, slot: usize, n: usize) -> Option<(usize, usize, Numbered<'a>)> {
        let (slot, beyond) = emit::neighbour_slot(slot, n);
        let (t, tile) = self.tiles[beyond[0] | beyond[1] << 1 | beyond[2] << 2]?;
        let (ix, numbered) = tile.numbered(slot)?;
        Some((t, ix, numbered))
    }
}
