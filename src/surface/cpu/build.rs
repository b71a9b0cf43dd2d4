//! The second pass: every tile writes its own part of the mesh, vertices by `interpolate`, triangles by `emit`.

use std::cell::RefCell;
use std::ops::Range;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

use super::bin::{Tiles, slot_origin};
use super::emit;
use super::interpolate::{self, Batch, Rows, SlopeConstants, Source, Target, take};
use super::join;
use super::near::{self, Numbered};
use super::sheets::Sheets;
use super::table::{BrickTable, Rounding};
use super::tally::Tally;
use super::{Scanned, Tile, threads};
use crate::surface::column::Column;
use crate::surface::control::{Control, Stage};
use crate::surface::error::SurfaceError;
use crate::surface::lattice::Lattice;
use crate::surface::measure::Measures;
use crate::surface::mesh::{Mesh, Quantized};
use crate::surface::quantize::Step;

thread_local! {
    // As the first pass's scratch: kept per thread, not per piece of work.
    static SHADING: RefCell<Shading> = RefCell::default();
}

/// What one thread keeps from tile to tile.
#[derive(Default)]
pub(super) struct Shading {
    batch: Batch,
    table: BrickTable,
    sheets: Sheets,
}

/// What a piece of the mesh adds up to.
#[derive(Default)]
pub(super) struct Written {
    /// Vertices that have no gradient to take a normal from.
    pub(super) flat: usize,
    /// Its sums.
    pub(super) tally: Tally,
}

/// `interpolate` and `emit`: every piece is written to its final place.
pub(super) fn build(
    scanned: &Scanned,
    atom_ids: bool,
    control: &Control<'_>,
) -> Result<(Mesh, Option<Measures>), SurfaceError> {
    let Scanned { lattice, done, totals, pieces, .. } = scanned;
    let n_single = if scanned.quantize.is_some() { 0 } else { totals.vertices };
    let mut mesh = Mesh {
        centre: lattice.centre(),
        positions: Column::zeroed(n_single),
        normals: Column::zeroed(n_single),
        quantized: scanned.quantize.map(|step| Quantized::zeroed(step, totals.vertices)),
        triangles: Column::zeroed(totals.triangles),
        atom_ids: atom_ids.then(|| Column::zeroed(totals.vertices)),
        colors: None,
        parts: done.iter().map(|tile| (tile.first_vertex, tile.first_triangle)).collect(),
    };
    let mut work = Vec::with_capacity(pieces.len());
    let mut rows = match &mut mesh.quantized {
        Some(quantized) => Rows::of(quantized),
        None => Rows::Single { positions: &mut mesh.positions, normals: &mut mesh.normals },
    };
    let (mut triangles, mut ids) = (&mut mesh.triangles[..], mesh.atom_ids.as_deref_mut());
    for piece in pieces {
        let (tile, [start, end]) = (&done[piece.tile], done[piece.tile].span(piece));
        let (n, m) = (end.vertices - start.vertices, end.triangles - start.triangles);
        work.push(Mutex::new(TilePart {
            tile,
            bricks: piece.bricks.clone(),
            rows: rows.take(n),
            triangles: take(&mut triangles, m),
            atom_ids: ids.as_mut().map(|ids| take(ids, n)),
        }));
    }
    let slope = SlopeConstants::new(&lattice.profile, lattice.spacing);
    let finished = AtomicUsize::new(0);
    let written = threads::each(work.len(), |i| {
        control.check()?;
        let mut written = Written::default();
        // Nobody else locks it: the lock only hands the slices over.
        let mut part = work[i].lock().unwrap_or_else(PoisonError::into_inner);
        SHADING.with_borrow_mut(|shading| part.write(scanned, &slope, shading, control, &mut written))?;
        let n = finished.fetch_add(1, Ordering::Relaxed) + 1;
        control.observer.progress(Stage::Emit, n, pieces.len());
        Ok(written)
    })?;
    drop(work);
    if written.iter().any(|part| part.flat > 0) {
        control.span(Stage::Interpolate, || mesh.fill_flat_normals());
    }
    let measures = control.span(Stage::Measure, || join::measures(scanned, &written));
    Ok((mesh, measures))
}

/// Bricks of a tile with their part of the mesh.
pub(super) struct TilePart<'a> {
    pub(super) tile: &'a Tile,
    /// Which of its surface bricks.
    pub(super) bricks: Range<usize>,
    pub(super) rows: Rows<'a>,
    pub(super) triangles: &'a mut [[u32; 3]],
    pub(super) atom_ids: Option<&'a mut [u32]>,
}

impl TilePart<'_> {
    /// Writes the vertices and triangles of the part's bricks, and adds what they add up to.
    ///
    /// # Errors
    /// [`SurfaceError::Cancelled`].
    pub(super) fn write(
        &mut self,
        scanned: &Scanned,
        slope: &SlopeConstants,
        shading: &mut Shading,
        control: &Control<'_>,
        written: &mut Written,
    ) -> Result<(), SurfaceError> {
        let Shading { batch, table, sheets } = shading;
        written.tally.make_room(self.bricks.len());
        written.flat +=
            control.span(Stage::Interpolate, || self.interpolate(&scanned.lattice, slope, batch, control))?;
        control.span(Stage::Emit, || self.emit(scanned, table, sheets, &mut written.tally));
        Ok(())
    }

    /// Vertices of the bricks. Returns how many have no gradient.
    fn interpolate(
        &mut self,
        lattice: &Lattice,
        slope: &SlopeConstants,
        batch: &mut Batch,
        control: &Control<'_>,
    ) -> Result<usize, SurfaceError> {
        let found = &self.tile.found;
        let base = found.before(self.bricks.start).vertices;
        let mut flat = 0;
        for i in self.bricks.clone() {
            let (brick, all) = (&found.bricks[i], found.before(i).vertices..found.before(i + 1).vertices);
            if all.is_empty() {
                continue;
            }
            let candidates = &found.candidates[brick.candidates[0] as usize..brick.candidates[1] as usize];
            let rows = all.start - base..all.end - base;
            let target = Target {
                rows: self.rows.slice(rows.clone()),
                atom_ids: self.atom_ids.as_deref_mut().map(|ids| &mut ids[rows]),
            };
            let (t, edges) = (&found.t[all.clone()], &found.edges[all]);
            let source = Source { tile: self.tile.coord, candidates, t, edges };
            flat += interpolate::interpolate(lattice, slope, brick, &source, batch, target, control)?;
        }
        Ok(flat)
    }

    /// Triangles of the bricks, and what they add up to.
    fn emit(&mut self, scanned: &Scanned, table: &mut BrickTable, sheets: &mut Sheets, tally: &mut Tally) {
        let Scanned { tiles, done, .. } = scanned;
        let near = Near::new(tiles, done, self.tile.coord);
        let found = &self.tile.found;
        let base = found.before(self.bricks.start).triangles;
        for i in self.bricks.clone() {
            let (brick, before, end) = (&found.bricks[i], found.before(i), found.before(i + 1));
            let around: [Option<Numbered<'_>>; 8] =
                std::array::from_fn(|n| near.of(usize::from(brick.slot), n).map(|(_, _, numbered)| numbered));
            let cases = &found.cases[before.cases..end.cases];
            let out = &mut self.triangles[before.triangles - base..end.triangles - base];
            let own_sheets = match brick.n_sheets.map_or(0, |n| usize::from(n.get())) {
                0 | 1 => &[][..],
                n => &found.sheets[brick.sheets as usize..][..n],
            };
            let origin = slot_origin(self.tile.coord, usize::from(brick.slot));
            let rounding = scanned.quantize.map(|step| scanned.rounding(step, origin));
            emit::emit(table, sheets, &around, cases, own_sheets, rounding, out);
            tally.add(table, sheets, &around, origin, out);
        }
    }
}

impl Scanned {
    /// How vertices of the brick at `origin` are rounded.
    fn rounding(&self, step: Step, origin: [i32; 3]) -> Rounding {
        let Lattice { spacing, centre, .. } = &self.lattice;
        let offset = std::array::from_fn(|k| f64::from(origin[k] - centre[k]));
        Rounding { step, spacing: *spacing, offset }
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
    #[inline(always)]
    pub(super) fn of(&self, slot: usize, n: usize) -> Option<(usize, usize, Numbered<'a>)> {
        let (slot, beyond) = near::neighbour_slot(slot, n);
        let (t, tile) = self.tiles[beyond[0] | beyond[1] << 1 | beyond[2] << 2]?;
        let (ix, numbered) = tile.numbered(slot)?;
        Some((t, ix, numbered))
    }
}
