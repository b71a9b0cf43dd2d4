//! The exact check of a triangle mesh's topology: every edge, and the fan of triangles around every vertex.

use std::cmp::Ordering;

use rayon::prelude::*;

use super::control::Control;
use super::error::SurfaceError;

/// Result of [`check`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Topology {
    /// Distinct undirected edges.
    pub edges: u64,
    /// True if every edge is used as often in one direction as in the other, and no triangle is degenerate.
    pub closed: bool,
    /// True if no directed edge is used twice.
    pub oriented: bool,
    /// True if every edge has exactly two triangles and the triangles around every vertex form one closed fan.
    pub manifold: bool,
}

impl Topology {
    /// Returns the topology of a closed manifold, in which every edge has two triangles.
    pub(super) const fn of_closed(n_triangles: u64) -> Self {
        Self { edges: n_triangles * 3 / 2, closed: true, oriented: true, manifold: true }
    }
}

/// A directed edge with the third corner of its triangle, in an order that groups edges by their first vertex.
type Corner = (u64, u32);

fn key(from: u32, to: u32) -> u64 {
    u64::from(from) << 32 | u64::from(to)
}

/// The two vertices of a key.
fn ends(key: u64) -> [u32; 2] {
    let half = |v: u64| u32::try_from(v & u64::from(u32::MAX)).unwrap_or_default();
    [half(key >> 32), half(key)]
}

/// Memory of [`check`], bytes per triangle: 32 for each of its edges.
pub(super) const BYTES_PER_TRIANGLE: u64 = 3 * 32;

/// Checks `triangles`.
///
/// # Errors
/// [`SurfaceError::Cancelled`].
pub fn check(triangles: &[[u32; 3]], control: &Control<'_>) -> Result<Topology, SurfaceError> {
    let corners = |&[a, b, c]: &[u32; 3]| [(key(a, b), c), (key(b, c), a), (key(c, a), b)];
    let proceeds = |_: &_| !control.cancel.is_cancelled();
    let mut forward: Vec<Corner> = triangles.par_iter().take_any_while(proceeds).flat_map_iter(corners).collect();
    sort(&mut forward, control)?;
    let mut backward: Vec<u64> = forward.par_iter().map(|(edge, _)| edge.rotate_left(32)).collect();
    sort(&mut backward, control)?;
    let degenerate = triangles.par_iter().any(|[a, b, c]| a == b || b == c || c == a);
    let closed = !degenerate && forward.par_iter().map(|(edge, _)| edge).eq(backward.par_iter());
    let oriented = forward.par_windows(2).all(|pair| pair[0].0 != pair[1].0);
    let fans = || forward.par_chunk_by(|a, b| a.0 >> 32 == b.0 >> 32).all(one_fan);
    let edges = count_edges(&forward, control)?;
    control.check()?;
    Ok(Topology { edges, closed, oriented, manifold: closed && oriented && fans() })
}

/// Distinct undirected edges.
fn count_edges(forward: &[Corner], control: &Control<'_>) -> Result<u64, SurfaceError> {
    let undirected = |edge: u64| {
        let [from, to] = ends(edge);
        key(from.min(to), from.max(to))
    };
    let mut edges: Vec<u64> = forward.par_iter().map(|(edge, _)| undirected(*edge)).collect();
    sort(&mut edges, control)?;
    edges.dedup();
    Ok(edges.len() as u64)
}

/// Sorts `items`. Once the run is cancelled, all items compare as equal, so that the sort ends soon.
fn sort<T: Ord + Send>(items: &mut [T], control: &Control<'_>) -> Result<(), SurfaceError> {
    items.par_sort_unstable_by(|a, b| if control.cancel.is_cancelled() { Ordering::Equal } else { a.cmp(b) });
    control.check()
}

/// Returns true if the triangles around one vertex form one cycle. `fan`: its outgoing edges, each with the third
/// corner.
fn one_fan(fan: &[Corner]) -> bool {
    let Some(&(start, _)) = fan.first() else { return true };
    let [vertex, first] = ends(start);
    let mut at = first;
    for step in 1..=fan.len() {
        // The triangle (vertex, at, next) is followed by the one that leaves along (vertex, next).
        match fan.binary_search_by_key(&key(vertex, at), |(edge, _)| *edge) {
            Ok(i) => at = fan[i].1,
            Err(_) => return false,
        }
        if at == first {
            return step == fan.len();
        }
    }
    false
}
