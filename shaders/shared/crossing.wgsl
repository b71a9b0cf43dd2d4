// First position of a vertex along its edge, by linear interpolation. Requires `params`.

// Same value as `EDGE_MARGIN` in `surface/lattice.rs`.
const EDGE_MARGIN: f32 = 1.0 / 1024.0;

// Parameter of the linearly interpolated crossing, from the values at the first and the second grid point.
fn crossing_at(inner: f32, beyond: f32) -> f32 {
    return clamp((inner - params.isovalue) / (inner - beyond), EDGE_MARGIN, 1.0 - EDGE_MARGIN);
}
