//! Exact check of the topology of a triangle mesh: every edge, and the fan of triangles around every vertex.

use rayon::prelude::*;

use super::control::Control;
use super::error::SurfaceError;

/// Result of [`check`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Topology {
    /// Distinct undirected edges.
    pub(super) edges: u64,
    /// True if every edge is used as often in one direction as in the other, and no triangle is degenerate.
    pub(super) closed: bool,
    /// True if no directed edge is used twice.
    pub(super) oriented: bool,
    /// True if every edge has exactly two triangles and the triangles around every vertex form one closed fan.
    pub(super) manifold: bool,
}

impl Topology {
    /// Returns the topology of a part of a closed manifold, in which `boundary` edges have one triangle.
    pub(super) const fn of_part(n_triangles: u64, boundary: u64) -> Self {
        let closed = boundary == 0;
        Self { edges: (n_triangles * 3).midpoint(boundary), closed, oriented: true, manifold: closed }
    }

    /// Returns the topology of a closed manifold, in which every edge has two triangles.
    pub(super) const fn of_closed(n_triangles: u64) -> Self {
        Self::of_part(n_triangles, 0)
    }

    /// Returns the topology of two meshes without a common edge.
    fn and(self, other: Self) -> Self {
        Self {
            edges: self.edges + other.edges,
            closed: self.closed && other.closed,
            oriented: self.oriented && other.oriented,
            manifold: self.manifold && other.manifold,
        }
    }
}

/// A corner of a triangle: its vertex, then the triangle's other vertices in order.
type TriangleCorner = [u32; 3];

/// Memory of `n` corners, bytes.
fn memory(n: usize) -> u64 {
    (n * size_of::<TriangleCorner>()) as u64
}

/// Triangles per part. Sorting their corners takes a few milliseconds.
const PART: usize = 1 << 15;

/// Checks `triangles`. Sorts the corners of each part of the triangles by vertex, then checks the vertices in as many
/// ranges as there are parts.
///
/// # Errors
/// [`SurfaceError::Cancelled`], [`SurfaceError::Memory`].
pub(super) fn check(triangles: &[[u32; 3]], control: &Control<'_>) -> Result<Topology, SurfaceError> {
    let _parts = control.reserve(memory(3 * triangles.len()))?;
    let corners = |part: &[[u32; 3]]| {
        control.check()?;
        let mut corners: Vec<TriangleCorner> =
            part.iter().flat_map(|&[a, b, c]| [[a, b, c], [b, c, a], [c, a, b]]).collect();
        corners.sort_unstable_by_key(|corner| corner[0]);
        Ok(corners)
    };
    let parts: Vec<Vec<TriangleCorner>> =
        triangles.par_chunks(PART).map(corners).collect::<Result<_, SurfaceError>>()?;
    let last = parts.iter().filter_map(|part| part.last()).map(|corner| corner[0] as usize).max();
    let width = last.map_or(0, |last| last / parts.len() + 1);
    let examined = (0..parts.len()).into_par_iter().map(|range| {
        control.check()?;
        let pieces = parts.iter().map(|part| {
            let start = |range| part.partition_point(|corner| (corner[0] as usize) < range * width);
            &part[start(range)..start(range + 1)]
        });
        let pieces: Vec<&[TriangleCorner]> = pieces.collect();
        // The sort needs as much again.
        let _corners = control.reserve(2 * memory(pieces.iter().map(|piece| piece.len()).sum()))?;
        let mut corners = pieces.concat();
        // The stable sort merges sorted pieces.
        corners.sort_by_key(|corner| corner[0]);
        let fans = corners.chunk_by_mut(|a, b| a[0] == b[0]).map(of_fan);
        Ok(fans.fold(Topology::of_closed(0), Topology::and))
    });
    examined.try_reduce(|| Topology::of_closed(0), |a, b| Ok(a.and(b)))
}

/// Returns the topology of the edges at one vertex. Each edge is counted at its lower end. `fan` contains all corners
/// at the vertex.
fn of_fan(fan: &mut [TriangleCorner]) -> Topology {
    fan.sort_unstable();
    let [vertex, ..] = fan[0];
    let mut ends: Vec<u32> = fan.iter().map(|corner| corner[2]).collect();
    ends.sort_unstable();
    let degenerate = fan.iter().any(|[a, b, c]| a == b || b == c || c == a);
    let closed = !degenerate && fan.iter().map(|corner| &corner[1]).eq(&ends);
    let oriented = fan.windows(2).all(|pair| pair[0][1] != pair[1][1]);
    if !closed {
        ends.extend(fan.iter().map(|corner| corner[1]));
        ends.sort_unstable();
    }
    ends.dedup();
    let edges = ends.iter().filter(|end| **end >= vertex).count() as u64;
    Topology { edges, closed, oriented, manifold: closed && oriented && is_cycle(fan) }
}

/// Returns true if the triangles around one vertex form one cycle. `fan` contains the corners at the vertex, in order.
fn is_cycle(fan: &[TriangleCorner]) -> bool {
    let [_, first, mut at] = fan[0];
    let mut n = 1;
    while at != first {
        // The triangle (vertex, _, at) is followed by the one that leaves along (vertex, at).
        let Ok(next) = fan.binary_search_by_key(&at, |corner| corner[1]) else { return false };
        at = fan[next][2];
        n += 1;
    }
    n == fan.len()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn defects_of_a_mesh_of_several_parts() {
        let n = 300;
        let id = |i: u32, j: u32| (i * 7 % n) * n + j % n;
        let cells = (0..n).flat_map(|i| (0..n).map(move |j| [i, j]));
        let torus: Vec<[u32; 3]> = cells
            .flat_map(|[i, j]| {
                let [a, b, c, d] = [id(i, j), id(i + 1, j), id(i + 1, j + 1), id(i, j + 1)];
                [[a, b, c], [a, c, d]]
            })
            .collect();
        assert!(torus.len() > 4 * PART);
        let whole = Topology::of_closed(torus.len() as u64);
        let defect = |change: fn(&mut Vec<[u32; 3]>)| {
            let mut triangles = torus.clone();
            change(&mut triangles);
            check(&triangles, &Control::default()).unwrap()
        };
        assert_eq!(defect(|_| {}), whole);
        let open = Topology { closed: false, manifold: false, ..whole };
        assert_eq!(defect(|triangles| triangles.truncate(triangles.len() - 1)), open);
        let twice = Topology { oriented: false, ..open };
        assert_eq!(defect(|triangles| triangles.push(triangles[0])), twice);
        assert_eq!(defect(|triangles| triangles.push([9, 9, 9])), Topology { edges: whole.edges + 1, ..twice });
        let pair = Topology { edges: whole.edges + 3, manifold: false, ..whole };
        // Two more triangles, back to back, with one vertex of the torus.
        assert_eq!(defect(|triangles| triangles.extend([[0, 90_000, 90_001], [0, 90_001, 90_000]])), pair);
    }
}
