//! Comparison of measures that were taken in different ways.

use molmesh::surface::{Component, Measures, Mesh};

/// Returns true if two measures belong to the same mesh, up to rounding. Components of equal size may be in any order.
/// Positions have single precision, whose rounding is visible far from the centre of the mesh; measures during meshing
/// are taken before this rounding.
pub(crate) fn agree(a: &Measures, b: &Measures, mesh: &Mesh) -> bool {
    let furthest = mesh.bounds().as_flattened().iter().fold(0.0_f64, |far, c| far.max(f64::from(c.abs())));
    let tolerance = 2e-5 + furthest * 1.2e-7;
    let close = |x: f64, y: f64| (x - y).abs() <= tolerance * x.abs().max(y.abs()).max(1.0);
    let counts = |m: &Measures| {
        let mut counts: Vec<_> = m.components.iter().map(|c| (c.triangles, c.vertices)).collect();
        counts.sort_unstable();
        counts
    };
    let volumes = |m: &Measures| {
        let mut volumes: Vec<f64> = m.components.iter().map(|c| c.volume).collect();
        volumes.sort_by(f64::total_cmp);
        volumes
    };
    // Single precision has no digits for the moment of a small component, or of one beyond 10⁴ Å from the centre.
    let near = |x: &Component, y: &Component| {
        let off = |k: usize| (x.centroid()[k] - y.centroid()[k]).abs();
        x.triangles == y.triangles && (0..3).all(|k| off(k) < 0.05)
    };
    let mut large = a.components.iter().filter(|c| c.volume.abs() > 1.0 && furthest < 1e4);
    let placed = large.all(|x| b.components.iter().any(|y| near(x, y)));
    (a.euler, a.closed, a.oriented, a.manifold) == (b.euler, b.closed, b.oriented, b.manifold)
        && close(a.area, b.area)
        && close(a.volume, b.volume)
        && counts(a) == counts(b)
        && placed
        && volumes(a).iter().zip(&volumes(b)).all(|(x, y)| close(*x, *y))
}
