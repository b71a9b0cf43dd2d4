//! The second pass: `interpolate` writes the vertices of every piece, then `emit` its triangles, in memory or into a
//! sink. `emit` sums over triangles, whose corners may belong to other pieces, so all vertices come first.
//!
//! In memory, a piece is written to its final position. For a sink, it is written to a scratch buffer of the thread,
//! which the sink reads.

use std::cell::RefCell;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

use super::bin::slot_origin;
use super::interpolate::{self, BrickVertices, VertexBatch, VertexRows, VertexTarget, take};
use super::neighbours::{NumberedBrick, TileNeighbours};
use super::sheets::Sheets;
use super::table::{BrickTable, Rounding};
use super::{Piece, RunContext, Scanned, emit, measure, scan_lattice, threads};
use crate::backend::{MeshOutput, StreamedMesh};
use crate::column::Column;
use crate::control::{Control, Stage};
use crate::error::SurfaceError;
use crate::join::{Sheet, SheetSums};
use crate::lattice::Lattice;
use crate::mesh::{Mesh, Quantized};
use crate::quantize::Step;
use crate::sink::{MeshPart, MeshSink, SinkFailed, Vertices};
use crate::vector::joined_bounds;

thread_local! {
    // Kept per thread, as in the first pass.
    static SCRATCH: RefCell<PieceScratch> = RefCell::default();
}

/// Buffers that a thread reuses from piece to piece.
#[derive(Default)]
struct PieceScratch {
    stages: Stages,
    rows: ScratchRows,
}

/// Working memory of the stages.
#[derive(Default)]
struct Stages {
    batch: VertexBatch,
    table: BrickTable,
    sheets: Sheets,
}

/// Rows of a piece for a sink.
#[derive(Default)]
struct ScratchRows {
    positions: Vec<[f32; 3]>,
    normals: Vec<[f32; 3]>,
    quantized: (Vec<[i16; 4]>, Vec<[i8; 4]>),
    triangles: Vec<[u32; 3]>,
}

/// Rows of the mesh that a piece fills.
pub(super) struct PieceRows<'a> {
    rows: VertexRows<'a>,
    atom_ids: Option<&'a mut [u32]>,
    triangles: &'a mut [[u32; 3]],
}

/// Destination of the rows.
pub(super) enum Destination<'a> {
    /// Rows of each piece. A lock gives one thread mutable access to them.
    Memory(Vec<Mutex<PieceRows<'a>>>),
    Sink(&'a dyn MeshSink),
}

/// Summary of all pieces.
pub(super) struct Written {
    /// Vertices whose gradient vanishes.
    flat: usize,
    /// Bounds of the positions, Å.
    bounds: Option<[[f32; 3]; 2]>,
    /// Sums over the triangles of each piece.
    pub(super) sums: Vec<SheetSums>,
}

/// Runs `interpolate` and `emit` for every piece. The output has measures unless the mesh is in memory and not closed.
///
/// # Errors
/// [`SurfaceError::Cancelled`], [`SurfaceError::Sink`].
pub(super) fn write(
    mut scanned: Scanned,
    context: RunContext<'_>,
    control: &Control<'_>,
    sink: Option<&dyn MeshSink>,
) -> Result<MeshOutput, SurfaceError> {
    let Some(sink) = sink else { return in_memory(&mut scanned, context.params.atom_ids, control) };
    let failed = |SinkFailed| SurfaceError::Sink;
    let [n_vertices, n_triangles] = [scanned.totals.vertices, scanned.totals.triangles];
    sink.begin(n_vertices, n_triangles).map_err(failed)?;
    let sums = control.reserve(SHEET_BYTES * scanned.grid.surface_bricks)?;
    let written = write_pieces(&mut scanned, control, &Destination::Sink(sink))?;
    let measures = control.span(Stage::Measure, || measure::of_pieces(&scanned, &written.sums));
    let (grid, centre) = (scanned.grid, scanned.lattice.centre());
    let measures = match measures {
        Some(measures) if written.flat == 0 => measures,
        // Normals of vertices without a gradient depend on triangles, and measuring an open mesh requires all of it.
        // In both cases, which are rare, the mesh is computed again from the first pass, as vertices have moved.
        _ => {
            drop((written.sums, sums));
            let mut output = in_memory(&mut scan_lattice(scanned.into_lattice(), context)?, false, control)?;
            sink.part(&MeshPart::whole(&output.mesh)).map_err(failed)?;
            output.measure(control)?.clone()
        }
    };
    let mesh = Mesh { centre, ..Mesh::default() };
    let streamed = Some(StreamedMesh { n_vertices, n_triangles, bounds: written.bounds.unwrap_or_default() });
    Ok(MeshOutput { streamed, measures: Some(measures), ..MeshOutput::new(mesh, grid) })
}

fn in_memory(scanned: &mut Scanned, atom_ids: bool, control: &Control<'_>) -> Result<MeshOutput, SurfaceError> {
    let (Scanned { lattice, totals, pieces, .. }, grid) = (&*scanned, scanned.grid);
    let of_ids = if atom_ids { size_of::<u32>() * totals.vertices } else { 0 };
    let [n, m] = [totals.vertices, totals.triangles].map(|n| n as u64);
    control.memory.grow(Mesh::bytes_for(n, m, scanned.quantize.is_some()) + of_ids as u64)?;
    let n_single = if scanned.quantize.is_some() { 0 } else { totals.vertices };
    let mut mesh = Mesh {
        centre: lattice.centre(),
        positions: Column::zeroed(n_single),
        normals: Column::zeroed(n_single),
        quantized: scanned.quantize.map(|step| Quantized::zeroed(step, totals.vertices)),
        triangles: Column::zeroed(totals.triangles),
        atom_ids: atom_ids.then(|| Column::zeroed(totals.vertices)),
        ..Mesh::default()
    };
    let mut rows = match &mut mesh.quantized {
        Some(Quantized { step, positions, normals }) => VertexRows::Quantized { step: *step, positions, normals },
        None => VertexRows::Single { positions: &mut mesh.positions, normals: &mut mesh.normals },
    };
    let (mut triangles, mut ids) = (&mut mesh.triangles[..], mesh.atom_ids.as_deref_mut());
    let of_piece = pieces.iter().map(|piece| {
        let [n, m] = scanned.size_of(piece);
        let atom_ids = ids.as_mut().map(|ids| take(ids, n));
        Mutex::new(PieceRows { rows: rows.take(n), atom_ids, triangles: take(&mut triangles, m) })
    });
    let _sums = control.reserve(SHEET_BYTES * grid.surface_bricks)?;
    let written = write_pieces(scanned, control, &Destination::Memory(of_piece.collect()))?;
    if written.flat > 0 {
        control.span(Stage::Interpolate, || mesh.fill_flat_normals());
    }
    let measures = control.span(Stage::Measure, || measure::of_pieces(scanned, &written.sums));
    Ok(MeshOutput { measures, bounds: written.bounds, ..MeshOutput::new(mesh, grid) })
}

/// Memory of the sums of a brick, bytes: its sheet, the copy in a group of bricks, and the component if it is separate.
/// Few bricks have several sheets.
const SHEET_BYTES: u64 = 3 * size_of::<Sheet>() as u64;

/// Writes all pieces, in parallel. Replaces the parameters of vertices by the final ones, so it runs once.
pub(super) fn write_pieces(
    scanned: &mut Scanned,
    control: &Control<'_>,
    destination: &Destination<'_>,
) -> Result<Written, SurfaceError> {
    let mut t: Vec<Vec<f32>> = scanned.done.iter_mut().map(|tile| std::mem::take(&mut tile.found.t)).collect();
    let vertices = write_vertices(scanned, control, destination, &mut t)?;
    for (tile, t) in scanned.done.iter_mut().zip(t) {
        tile.found.t = t;
    }
    let writer = Writer { scanned, control };
    let sums = writer.each(Stage::Emit, |i, piece, PieceScratch { stages, rows }| match destination {
        Destination::Memory(of_piece) => Ok(writer.emit(piece, lock(&of_piece[i]).triangles, stages)),
        Destination::Sink(sink) => writer.triangles_to_sink(piece, rows, stages, *sink),
    })?;
    let flat = vertices.iter().map(|piece| piece.flat).sum();
    let bounds = vertices.iter().filter_map(|piece| piece.bounds).reduce(joined_bounds);
    Ok(Written { flat, bounds, sums })
}

/// Writes the vertices of all pieces, in parallel. `t` are the parameters of the vertices of each tile.
fn write_vertices(
    scanned: &Scanned,
    control: &Control<'_>,
    destination: &Destination<'_>,
    t: &mut [Vec<f32>],
) -> Result<Vec<PieceVertices>, SurfaceError> {
    let mut rest: Vec<&mut [f32]> = t.iter_mut().map(Vec::as_mut_slice).collect();
    let own = |piece: &Piece| Mutex::new(take(&mut rest[piece.tile], scanned.size_of(piece)[0]));
    let t: Vec<Mutex<&mut [f32]>> = scanned.pieces.iter().map(own).collect();
    let writer = Writer { scanned, control };
    writer.each(Stage::Interpolate, |i, piece, PieceScratch { stages, rows }| {
        let (t, batch) = (&mut **lock(&t[i]), &mut stages.batch);
        match destination {
            Destination::Memory(of_piece) => {
                let PieceRows { rows, atom_ids, .. } = &mut *lock(&of_piece[i]);
                writer.interpolate(piece, rows, atom_ids.as_deref_mut(), t, batch)
            }
            Destination::Sink(sink) => writer.vertices_to_sink(piece, rows, t, batch, *sink),
        }
    })
}

/// Locks rows that one thread alone uses.
fn lock<T>(rows: &Mutex<T>) -> MutexGuard<'_, T> {
    rows.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Summary of a piece's vertices.
struct PieceVertices {
    /// Vertices whose gradient vanishes.
    flat: usize,
    /// Bounds of the positions, Å.
    bounds: Option<[[f32; 3]; 2]>,
}

/// Shared inputs of the second pass.
struct Writer<'a> {
    scanned: &'a Scanned,
    control: &'a Control<'a>,
}

impl Writer<'_> {
    /// Runs `work` for every piece, in parallel, with the scratch of the thread.
    fn each<T: Send + Sync>(
        &self,
        stage: Stage,
        work: impl Fn(usize, &Piece, &mut PieceScratch) -> Result<T, SurfaceError> + Sync,
    ) -> Result<Vec<T>, SurfaceError> {
        let pieces = &self.scanned.pieces;
        let finished = AtomicUsize::new(0);
        threads::each(pieces.len(), |i| {
            self.control.check()?;
            let done = SCRATCH.with_borrow_mut(|scratch| work(i, &pieces[i], scratch))?;
            let n = finished.fetch_add(1, Ordering::Relaxed) + 1;
            self.control.observer.progress(stage, n, pieces.len());
            Ok(done)
        })
    }

    /// Writes the vertices of a piece into the scratch, then into `sink`.
    fn vertices_to_sink(
        &self,
        piece: &Piece,
        scratch: &mut ScratchRows,
        t: &mut [f32],
        batch: &mut VertexBatch,
        sink: &dyn MeshSink,
    ) -> Result<PieceVertices, SurfaceError> {
        let [n, _] = self.scanned.size_of(piece);
        let mut rows = match self.scanned.quantize {
            None => VertexRows::Single {
                positions: first(&mut scratch.positions, n),
                normals: first(&mut scratch.normals, n),
            },
            Some(step) => {
                let (positions, normals) = &mut scratch.quantized;
                VertexRows::Quantized { step, positions: first(positions, n), normals: first(normals, n) }
            }
        };
        let written = self.interpolate(piece, &mut rows, None, t, batch)?;
        self.part_to_sink(piece, rows.as_vertices(), &[], sink)?;
        Ok(written)
    }

    /// Writes the triangles of a piece into the scratch, then into `sink`.
    fn triangles_to_sink(
        &self,
        piece: &Piece,
        scratch: &mut ScratchRows,
        stages: &mut Stages,
        sink: &dyn MeshSink,
    ) -> Result<SheetSums, SurfaceError> {
        let [_, n] = self.scanned.size_of(piece);
        let triangles = first(&mut scratch.triangles, n);
        let sums = self.emit(piece, triangles, stages);
        let none = match self.scanned.quantize {
            None => Vertices::Single { positions: &[], normals: &[] },
            Some(step) => Vertices::Quantized { step, positions: &[], normals: &[] },
        };
        self.part_to_sink(piece, none, triangles, sink)?;
        Ok(sums)
    }

    /// Hands rows of a piece to `sink`.
    fn part_to_sink(
        &self,
        piece: &Piece,
        vertices: Vertices<'_>,
        triangles: &[[u32; 3]],
        sink: &dyn MeshSink,
    ) -> Result<(), SurfaceError> {
        let tile = &self.scanned.done[piece.tile];
        let [start, _] = tile.span(piece);
        let part = MeshPart {
            first_vertex: tile.first_vertex + start.vertices,
            vertices,
            first_triangle: tile.first_triangle + start.triangles,
            triangles,
        };
        self.control.span(Stage::Write, || sink.part(&part)).map_err(|SinkFailed| SurfaceError::Sink)
    }

    /// Writes the vertices and replaces their parameters `t` by the final ones.
    fn interpolate(
        &self,
        piece: &Piece,
        rows: &mut VertexRows<'_>,
        atom_ids: Option<&mut [u32]>,
        t: &mut [f32],
        batch: &mut VertexBatch,
    ) -> Result<PieceVertices, SurfaceError> {
        let flat = self.control.span(Stage::Interpolate, || self.vertices(piece, rows, atom_ids, t, batch))?;
        Ok(PieceVertices { flat, bounds: rows.as_vertices().bounds() })
    }

    /// Writes the vertices brick by brick. Returns the number of vertices without a gradient.
    fn vertices(
        &self,
        piece: &Piece,
        rows: &mut VertexRows<'_>,
        mut atom_ids: Option<&mut [u32]>,
        t: &mut [f32],
        batch: &mut VertexBatch,
    ) -> Result<usize, SurfaceError> {
        let tile = &self.scanned.done[piece.tile];
        let found = &tile.found;
        let base = found.before(piece.bricks.start).vertices;
        let mut flat = 0;
        for i in piece.bricks.clone() {
            let (brick, all) = (&found.bricks[i], found.before(i).vertices..found.before(i + 1).vertices);
            if all.is_empty() {
                continue;
            }
            let of_brick = all.start - base..all.end - base;
            let target = VertexTarget {
                rows: rows.slice(of_brick.clone()),
                t: &mut t[of_brick.clone()],
                atom_ids: atom_ids.as_deref_mut().map(|ids| &mut ids[of_brick]),
            };
            let source = BrickVertices {
                origin: slot_origin(tile.coord, usize::from(brick.slot)),
                candidates: &found.candidates[brick.candidates[0] as usize..brick.candidates[1] as usize],
                features: found.features.get(all.clone()).unwrap_or_default(),
                spheres: found.spheres.get(all.clone()).unwrap_or_default(),
                edges: &found.edges[all],
            };
            flat += interpolate::interpolate(self.scanned, &source, batch, target, self.control)?;
        }
        Ok(flat)
    }

    /// Writes the triangles. Returns the sums over them.
    fn emit(&self, piece: &Piece, triangles: &mut [[u32; 3]], stages: &mut Stages) -> SheetSums {
        self.control.span(Stage::Emit, || self.triangles(piece, triangles, stages))
    }

    /// Writes the triangles brick by brick.
    fn triangles(&self, piece: &Piece, triangles: &mut [[u32; 3]], stages: &mut Stages) -> SheetSums {
        let (scanned, Stages { table, sheets, .. }) = (self.scanned, stages);
        let tile = &scanned.done[piece.tile];
        let near = TileNeighbours::new(&scanned.tiles, &scanned.done, tile.coord);
        let found = &tile.found;
        let base = found.before(piece.bricks.start).triangles;
        let mut sums = SheetSums::with_capacity(piece.bricks.len());
        for i in piece.bricks.clone() {
            let (brick, before, end) = (&found.bricks[i], found.before(i), found.before(i + 1));
            let around: [Option<NumberedBrick<'_>>; 8] =
                std::array::from_fn(|n| near.of(usize::from(brick.slot), n).map(|(_, _, numbered)| numbered));
            let cases = &found.cases[before.cases..end.cases];
            let out = &mut triangles[before.triangles - base..end.triangles - base];
            let own_sheets = match brick.n_sheets.map_or(0, |n| usize::from(n.get())) {
                0 | 1 => &[][..],
                n => &found.sheets[brick.sheets as usize..][..n],
            };
            let origin = slot_origin(tile.coord, usize::from(brick.slot));
            let rounding = scanned.quantize.map(|step| scanned.rounding(step, origin));
            emit::emit(table, sheets, &around, cases, own_sheets, rounding, out);
            let from_centre = std::array::from_fn(|k| origin[k] - scanned.lattice.centre[k]);
            sums.add(table, sheets, &around, from_centre, out);
        }
        sums
    }
}

impl Scanned {
    /// Vertices and triangles of a piece.
    fn size_of(&self, piece: &Piece) -> [usize; 2] {
        let [start, end] = self.done[piece.tile].span(piece);
        [end.vertices - start.vertices, end.triangles - start.triangles]
    }

    /// Rounding of the vertices of the brick at `origin`.
    fn rounding(&self, step: Step, origin: [i32; 3]) -> Rounding {
        let Lattice { spacing, centre, .. } = &self.lattice;
        let offset = std::array::from_fn(|k| f64::from(origin[k] - centre[k]));
        Rounding { step, spacing: *spacing, offset }
    }
}

/// Returns the first `n` rows of a scratch, which grows if necessary.
fn first<T: Clone + Default>(rows: &mut Vec<T>, n: usize) -> &mut [T] {
    if rows.len() < n {
        rows.resize(n, T::default());
    }
    &mut rows[..n]
}
