//! The second pass: every tile writes its own part of the mesh, vertices by `interpolate`, triangles by `emit`.

use std::cell::RefCell;
use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;

use super::bin::Tiles;
use super::emit::{self, IdTable, Numbered};
use super::interpolate::{self, Batch, SlopeConstants, Source, Target};
use super::{Tile, scan};
use crate::surface::column::Column;
use crate::surface::control::{Control, Stage};
use crate::surface::error::SurfaceError;
use crate::surface::lattice::Lattice;
use crate::surface::mesh::Mesh;

thread_local! {
    // As the first pass's scratch: kept per thread, not per piece of work.
    static SHADING: RefCell<(Batch, IdTable)> = RefCell::default();
}

/// `interpolate` and `emit`: every tile writes its own part of the mesh.
pub(super) fn build(
    lattice: &Lattice,
    tiles: &Tiles,
    done: &[Tile],
    totals: scan::Totals,
    atom_ids: bool,
    control: &Control<'_>,
) -> Result<Mesh, SurfaceError> {
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
    let flat: usize = work
        .into_par_iter()
        .with_max_len(1)
        .map(|mut part| {
            control.check()?;
            let flat = SHADING.with_borrow_mut(|(batch, table)| {
                let flat = control.span(Stage::Interpolate, || part.interpolate(lattice, &slope, batch));
                control.span(Stage::Emit, || part.emit(tiles, done, table));
                flat
            });
            let n = finished.fetch_add(1, Ordering::Relaxed) + 1;
            control.observer.progress(Stage::Emit, n, done.len());
            Ok(flat)
        })
        .sum::<Result<usize, SurfaceError>>()?;
    if flat > 0 {
        control.span(Stage::Interpolate, || mesh.fill_flat_normals());
    }
    Ok(mesh)
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

    /// Triangles of the tile's bricks.
    fn emit(&mut self, tiles: &Tiles, done: &[Tile], table: &mut IdTable) {
        // The tile itself and its neighbours towards +x, +y, +z.
        let near: [Option<&Tile>; 8] = std::array::from_fn(|n| {
            let coord = std::array::from_fn(|k| self.tile.coord[k] + i32::from(n >> k & 1 == 1));
            tiles.index.get(&coord).map(|&t| &done[t as usize])
        });
        let found = &self.tile.found;
        for (i, brick) in found.bricks.iter().enumerate() {
            let around: [Numbered<'_>; 8] = std::array::from_fn(|n| {
                let (slot, beyond) = emit::neighbour_slot(usize::from(brick.slot), n);
                near[beyond[0] | beyond[1] << 1 | beyond[2] << 2].and_then(|tile| tile.numbered(slot))
            });
            let end =
                found.bricks.get(i + 1).map_or((found.triangles, found.cases.len()), |n| (n.triangle, n.case as usize));
            let cases = &found.cases[brick.case as usize..end.1];
            emit::emit(table, &around, cases, &mut self.triangles[brick.triangle as usize..end.0 as usize]);
        }
    }
}
