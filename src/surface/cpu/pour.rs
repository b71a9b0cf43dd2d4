//! The second pass into a sink: every tile's part of the mesh lives only until the sink has taken it.

use std::cell::RefCell;
use std::sync::atomic::{AtomicUsize, Ordering};

use super::build::{Shading, TilePart, Written};
use super::interpolate::{Rows, SlopeConstants};
use super::{Piece, Scanned, build, join, threads};
use crate::surface::control::{Control, Stage};
use crate::surface::error::SurfaceError;
use crate::surface::measure::{Measures, Proof};
use crate::surface::simd::dispatched;
use crate::surface::sink::{MeshPart, MeshSink, Poured, SinkFailed, Vertices};

/// What one thread keeps from tile to tile.
#[derive(Default)]
struct Scratch {
    shading: Shading,
    positions: Vec<[f32; 3]>,
    normals: Vec<[f32; 3]>,
    quantized: (Vec<[i16; 4]>, Vec<[i8; 4]>),
    triangles: Vec<[u32; 3]>,
}

thread_local! {
    static SCRATCH: RefCell<Scratch> = RefCell::default();
}

/// Makes the calling thread's scratch.
pub(super) fn warm() {
    SCRATCH.with_borrow_mut(|scratch| {
        first(&mut scratch.positions, USUAL);
        first(&mut scratch.normals, USUAL);
        first(&mut scratch.triangles, 2 * USUAL);
    });
}

type Bounds = [[f32; 3]; 2];

/// What no bounds are: less than any.
const NOWHERE: Bounds = [[f32::INFINITY; 3], [f32::NEG_INFINITY; 3]];

/// `interpolate` and `emit` into `sink`.
pub(super) fn pour(scanned: &Scanned, control: &Control<'_>, sink: &dyn MeshSink) -> Result<Poured, SurfaceError> {
    let Scanned { lattice, totals, pieces, .. } = scanned;
    let failed = |SinkFailed| SurfaceError::Sink;
    sink.begin(totals.vertices, totals.triangles).map_err(failed)?;
    let slope = SlopeConstants::new(&lattice.profile, lattice.spacing);
    let finished = AtomicUsize::new(0);
    let parts = threads::each(pieces.len(), |i| {
        control.check()?;
        let part = SCRATCH.with_borrow_mut(|scratch| scratch.pour(&pieces[i], scanned, &slope, control, sink))?;
        let n = finished.fetch_add(1, Ordering::Relaxed) + 1;
        control.observer.progress(Stage::Emit, n, pieces.len());
        Ok(part)
    })?;
    let (written, bounds): (Vec<Written>, Vec<Bounds>) = parts.into_iter().unzip();
    let measures = control.span(Stage::Measure, || join::measures(scanned, &written));
    let measures = match measures {
        Some(measures) if written.iter().all(|part| part.flat == 0) => measures,
        // A normal without a gradient needs the triangles around it, and a mesh that is not closed a closer look: the
        // whole mesh, then, and the same rows once more.
        found => {
            let (mesh, _) = build::build(scanned, false, control)?;
            let (vertices, triangles) = (mesh.vertices(), &mesh.triangles[..]);
            let whole = MeshPart { first_vertex: 0, vertices, first_triangle: 0, triangles };
            sink.part(&whole).map_err(failed)?;
            found.map_or_else(|| Measures::of(&mesh, Proof::Checksum, control), Ok)?
        }
    };
    Ok(Poured {
        centre: lattice.centre(),
        n_vertices: totals.vertices,
        n_triangles: totals.triangles,
        bounds: bounds.into_iter().fold(NOWHERE, join_bounds),
        grid: scanned.grid,
        measures,
        served: None,
    })
}

impl Scratch {
    /// One piece.
    fn pour(
        &mut self,
        piece: &Piece,
        scanned: &Scanned,
        slope: &SlopeConstants,
        control: &Control<'_>,
        sink: &dyn MeshSink,
    ) -> Result<(Written, Bounds), SurfaceError> {
        let tile = &scanned.done[piece.tile];
        let [start, end] = tile.span(piece);
        let (n, m) = (end.vertices - start.vertices, end.triangles - start.triangles);
        let Self { shading, positions, normals, quantized, triangles } = self;
        let rows = match scanned.quantize {
            None => Rows::Single { positions: first(positions, n), normals: first(normals, n) },
            Some(step) => {
                let (positions, normals) = quantized;
                Rows::Quantized { step, positions: first(positions, n), normals: first(normals, n) }
            }
        };
        let mut written = Written::default();
        let triangles = first(triangles, m);
        let mut part = TilePart { tile, bricks: piece.bricks.clone(), rows, triangles, atom_ids: None };
        part.write(scanned, slope, shading, control, &mut written)?;
        let TilePart { rows, triangles, .. } = part;
        let vertices = match rows {
            Rows::Single { positions, normals } => Vertices::Single { positions, normals },
            Rows::Quantized { step, positions, normals } => Vertices::Quantized { step, positions, normals },
        };
        let bounds = bounds_of(&vertices);
        let part = MeshPart {
            first_vertex: tile.first_vertex + start.vertices,
            vertices,
            first_triangle: tile.first_triangle + start.triangles,
            triangles,
        };
        control.span(Stage::Write, || sink.part(&part)).map_err(|SinkFailed| SurfaceError::Sink)?;
        Ok((written, bounds))
    }
}

/// Vertices of a piece, which few exceed; it has twice as many triangles.
const USUAL: usize = 3072;

/// The first `n` rows of a scratch, which grows for them.
fn first<T: Clone + Default>(rows: &mut Vec<T>, n: usize) -> &mut [T] {
    if rows.len() < n {
        // Room for most pieces, once: growing would copy, and what is not touched costs nothing.
        rows.reserve(n.max(3 * USUAL) - rows.len());
        rows.resize(n, T::default());
    }
    &mut rows[..n]
}

/// Lowest and highest position, Å.
fn bounds_of(vertices: &Vertices<'_>) -> Bounds {
    match vertices {
        Vertices::Single { positions, .. } => bounds(positions),
        Vertices::Quantized { step, positions, .. } => positions.iter().fold(NOWHERE, |bounds, [x, y, z, _]| {
            let p = step.decoded([*x, *y, *z]);
            join_bounds(bounds, [p, p])
        }),
    }
}

dispatched! {
/// The same, sixteen positions at a time.
fn bounds(positions: &[[f32; 3]]) -> Bounds {
    const LANES: usize = 16;
    let (batches, rest) = positions.as_chunks::<LANES>();
    let (mut low, mut high) = ([[f32::INFINITY; 3]; LANES], [[f32::NEG_INFINITY; 3]; LANES]);
    for batch in batches {
        let rows = low.as_flattened_mut().iter_mut().zip(high.as_flattened_mut()).zip(batch.as_flattened());
        for ((low, high), v) in rows {
            *low = if *v < *low { *v } else { *low };
            *high = if *v > *high { *v } else { *high };
        }
    }
    let lanes = low.into_iter().zip(high).map(|(low, high)| [low, high]);
    lanes.chain(rest.iter().map(|p| [*p, *p])).fold(NOWHERE, join_bounds)
}
}

/// The bounds of both.
#[inline(always)]
fn join_bounds([low, high]: Bounds, [other_low, other_high]: Bounds) -> Bounds {
    // Comparisons that compile to minimum and maximum of vectors.
    [
        std::array::from_fn(|k| if other_low[k] < low[k] { other_low[k] } else { low[k] }),
        std::array::from_fn(|k| if other_high[k] > high[k] { other_high[k] } else { high[k] }),
    ]
}
