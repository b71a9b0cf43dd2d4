//! Mean curvature at the vertices of the mesh of an isosurface, from the second derivatives of the density.

use std::ops::Range;

use rayon::prelude::*;

use super::checked_sort;
use super::control::Control;
use super::cpu::points::PointField;
use super::error::SurfaceError;
use super::lattice::{to_f32, to_i32, to_u32};
use super::mesh::Mesh;
use super::params::{SurfaceLimits, SurfaceParams};
use super::spheres::Spheres;

/// Edge length of the cubes whose vertices share a list of atoms, spacings.
const SIDE: i32 = 16;
/// Memory per vertex, bytes: its cube and row while they are sorted, and its curvature.
const VERTEX_BYTES: u64 = 40;

/// Returns the mean curvature at the vertices in `rows` of `mesh`, the mesh of the isosurface of `spheres` with
/// `params`, Å⁻¹: positive where the surface is convex, 0 where the gradient vanishes.
///
/// # Errors
/// Those of preparing the field, [`SurfaceError::Memory`] and [`SurfaceError::Cancelled`].
pub fn mean_curvatures(
    mesh: &Mesh,
    rows: Range<usize>,
    spheres: &Spheres,
    params: &SurfaceParams,
    limits: &SurfaceLimits,
    control: &Control<'_>,
) -> Result<Vec<f32>, SurfaceError> {
    // The memory of the field ends with this function.
    let metered = control.metered();
    metered.memory.grow(VERTEX_BYTES * rows.len() as u64)?;
    let field = PointField::new(spheres, params, limits, &metered)?;
    let spacings = |row: usize| -> [f64; 3] {
        std::array::from_fn(|k| (mesh.centre[k] + f64::from(mesh.position(row)[k])) / params.resolution)
    };
    let cube = |row: usize| spacings(row).map(|c| to_i32((c / f64::from(SIDE)).floor()));
    let mut sorted: Vec<([i32; 3], u32)> = rows.clone().map(|row| (cube(row), to_u32(row))).collect();
    checked_sort::sort(&mut sorted, Ord::cmp, control)?;
    let cube_curvatures = |entries: &&[([i32; 3], u32)]| {
        control.check()?;
        let low = entries[0].0.map(|c| c * SIDE);
        let mut near = field.near([low, low.map(|c| c + SIDE)]);
        let point = |row: u32| {
            let at = spacings(row as usize);
            std::array::from_fn(|k| to_f32(at[k] - f64::from(low[k])))
        };
        let points: Vec<[f32; 3]> = entries.iter().map(|(_, row)| point(*row)).collect();
        Ok(field.mean_curvatures(&mut near, &points))
    };
    let cubes: Vec<&[([i32; 3], u32)]> = sorted.chunk_by(|a, b| a.0 == b.0).collect();
    let found: Vec<Vec<f32>> = cubes.par_iter().map(cube_curvatures).collect::<Result<_, SurfaceError>>()?;
    let mut curvatures = vec![0.0; rows.len()];
    for ((_, row), curvature) in sorted.iter().zip(found.iter().flatten()) {
        if curvature.is_finite() {
            curvatures[*row as usize - rows.start] = curvature / to_f32(params.resolution);
        }
    }
    Ok(curvatures)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reference::Density;
    use crate::vector::length;
    use crate::{Backend, CpuBackend, SurfaceKind, SurfaceOptions};

    /// Returns the mean curvature of the level set of a density at `x`, by differences of its normals.
    fn by_differences(density: &Density, x: [f64; 3]) -> f64 {
        const STEP: f64 = 1e-4;
        let along = |k: usize, step: f64| {
            let mut at = x;
            at[k] += step;
            let gradient = density.gradient(at);
            -gradient[k] / length(gradient)
        };
        (0..3).map(|k| (along(k, STEP) - along(k, -STEP)) / (4.0 * STEP)).sum()
    }

    #[test]
    fn curvatures_are_those_of_the_density() {
        let mut state = 5_u64;
        let mut number = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            f64::from((state >> 40) as u32) / f64::from(1_u32 << 24)
        };
        let mut column = |low: f64, high: f64| (0..200).map(|_| low + (high - low) * number()).collect::<Vec<f64>>();
        let [x, y, z] = std::array::from_fn(|_| column(0.0, 16.0));
        let radii = column(1.2, 2.0).into_iter().map(to_f32).collect();
        let spheres = Spheres::new(x, y, z, radii).unwrap();
        for surface in [SurfaceKind::Gaussian, SurfaceKind::SoftObject, SurfaceKind::InverseSquare] {
            let options = SurfaceOptions { surface: Some(surface), resolution: Some(0.5), ..SurfaceOptions::default() };
            let (params, limits) = (SurfaceParams::new(&options).unwrap(), SurfaceLimits::default());
            let mesh = CpuBackend::default().run(&spheres, &params, &limits, &Control::default()).unwrap().mesh;
            let density = Density::new(&spheres, &params).unwrap();
            let n = mesh.n_vertices();
            let of = |rows| mean_curvatures(&mesh, rows, &spheres, &params, &limits, &Control::default()).unwrap();
            let found = of(0..n);
            assert_eq!(of(n / 3..n / 2), found[n / 3..n / 2]);
            let (mut squares, mut control, mut n_compared) = (0.0, 0.0, 0);
            for row in (0..n).step_by(7) {
                let at = std::array::from_fn(|k| mesh.centre[k] + f64::from(mesh.position(row)[k]));
                let expected = by_differences(&density, at);
                // Near saddles of the density, curvature has no bound.
                if expected.abs() < 5.0 {
                    squares += (f64::from(found[row]) - expected).powi(2);
                    control += (f64::from(found[(row + 70) % n]) - expected).powi(2);
                    n_compared += 1;
                }
            }
            let rms = [squares, control].map(|sum: f64| (sum / f64::from(n_compared)).sqrt());
            assert!(n_compared > 500 && rms[0] < 2e-3 && rms[1] > 0.1, "{surface}: {rms:?} at {n_compared} vertices");
        }
    }
}
