// Position of a vertex along its edge. Requires `params`.

// Same value as `EDGE_MARGIN` in `surface/lattice.rs`.
const EDGE_MARGIN: f32 = 1.0 / 1024.0;

// Parameter of the crossing along an edge, from the densities at its first and its second grid point.
fn crossing_at(inner: f32, beyond: f32) -> f32 {
    return clamp((inner - params.isovalue) / (inner - beyond), EDGE_MARGIN, 1.0 - EDGE_MARGIN);
}
