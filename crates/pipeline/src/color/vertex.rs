//! Colours that do not follow from the nearest atom alone: values of vertices, and blended colours.
//!
//! Both kinds of colours are computed on the host from the finished mesh, so that every backend gives the same ones.

use molmesh_formats::linear_of_srgb;
use molmesh_structure::AtomPart;
use molmesh_structure::map::Map;
use molmesh_surface::curvature::mean_curvatures;
use molmesh_surface::vector::{add, area_vector, cross, dot, length, sub, unit};
use molmesh_surface::{Column, Control, Mesh, Spheres, SurfaceError, SurfaceLimits, SurfaceParams, Vertices};

use super::super::SPHERE_BYTES;
use super::{depth, of_map};

/// Memory of a value and its sums while values are computed, bytes per vertex.
const VALUE_BYTES: u64 = 20;
/// Memory of computing depths, bytes per vertex: lists of points outside the hull, and of indices with depths.
const DEPTH_BYTES: u64 = 40;
/// Memory of blending, bytes per vertex: a colour, the sum of its neighbours and their number.
const BLEND_BYTES: u64 = 22;
/// Rounds of blending at a grid spacing of 1 Å. Each round averages over neighbours, which are about 0.7 grid spacings
/// apart, and halves the difference to them, so that colours spread by about 1 Å (root mean square) at every spacing.
const ROUNDS_AT_1: f64 = 4.0;
/// Largest number of rounds, reached at 0.25 Å.
const MAX_ROUNDS: u32 = 64;

/// Property of a vertex that a scheme shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum VertexProperty {
    /// Mean curvature, Å⁻¹; positive where the surface is convex.
    Curvature,
    /// Distance from the centroid of the meshed atoms, Å.
    Radial,
    /// Distance from the convex hull of the mesh, Å.
    Depth,
    /// Pocket that the vertex lines.
    Pocket,
    /// Value of the map that is sent beside the structure, near the vertex.
    Map,
}

/// Surface of a mesh whose vertices are coloured.
pub(in super::super) struct MeshedSurface<'a> {
    /// Spheres of the mesh, or of all parts.
    pub(in super::super) spheres: &'a Spheres,
    pub(in super::super) params: &'a SurfaceParams,
    pub(in super::super) limits: &'a SurfaceLimits,
    /// Parts that have meshes of their own.
    pub(in super::super) parts: Option<&'a [AtomPart]>,
}

/// Source of the values of the vertices.
pub(super) enum ValueSource {
    Curvature,
    /// Distance from this centroid of the meshed atoms.
    Radial([f64; 3]),
    Depth,
    /// Map, sampled at this distance from the surface, Å.
    Map(Box<Map>, f64),
}

/// Returns the value of each vertex; NaN for those without one.
pub(super) fn values(
    mesh: &Mesh,
    source: &ValueSource,
    surface: &MeshedSurface<'_>,
    control: &Control<'_>,
) -> Result<Vec<f32>, SurfaceError> {
    control.check()?;
    let bytes = if matches!(source, ValueSource::Depth) { DEPTH_BYTES } else { VALUE_BYTES };
    let _memory = control.reserve(bytes * mesh.n_vertices() as u64)?;
    Ok(match source {
        ValueSource::Curvature if surface.params.surface.kernel().is_some() => {
            density_curvatures(mesh, surface, control)?
        }
        ValueSource::Curvature => normal_curvatures(mesh),
        ValueSource::Radial(centroid) => {
            let origin = sub(mesh.centre, *centroid);
            let distance = |i| length(add(origin, mesh.position(i).map(f64::from)));
            (0..mesh.n_vertices()).map(|i| single(distance(i))).collect()
        }
        ValueSource::Depth => depth::depths(mesh.n_vertices(), |i| mesh.position(i).map(f64::from), control)?,
        ValueSource::Map(map, offset) => of_map::values(mesh, map, *offset, control)?,
    })
}

/// Returns the normal of a vertex, of length 1 unless it is 0.
pub(super) fn unit_normal(mesh: &Mesh, i: usize) -> [f64; 3] {
    let normal = normal(mesh, i);
    if length(normal) > 0.0 { unit(normal) } else { normal }
}

/// Returns the normal of a vertex as it is stored.
fn normal(mesh: &Mesh, i: usize) -> [f64; 3] {
    match mesh.vertices() {
        Vertices::Single { normals, .. } => normals[i].map(f64::from),
        Vertices::Quantized { normals, .. } => {
            let [x, y, z, _] = normals[i];
            [x, y, z].map(|v| f64::from(v) / 127.0)
        }
    }
}

/// Returns the mean curvature of each vertex of an isosurface, from the density of its part.
fn density_curvatures(
    mesh: &Mesh,
    surface: &MeshedSurface<'_>,
    control: &Control<'_>,
) -> Result<Vec<f32>, SurfaceError> {
    let MeshedSurface { spheres, params, limits, parts } = *surface;
    let Some(parts) = parts else {
        return mean_curvatures(mesh, 0..mesh.n_vertices(), spheres, params, limits, control);
    };
    let mut curvatures = vec![0.0; mesh.n_vertices()];
    for (part, range) in parts.iter().zip(&mesh.parts).filter(|(_, range)| !range.vertices.is_empty()) {
        let _spheres = control.reserve(SPHERE_BYTES * part.rows.len() as u64)?;
        let spheres = spheres.subset(&part.rows);
        let values = mean_curvatures(mesh, range.vertices.clone(), &spheres, params, limits, control)?;
        curvatures[range.vertices.clone()].copy_from_slice(&values);
    }
    Ok(curvatures)
}

/// Returns the mean curvature of each vertex of a surface of spheres: half the divergence of the normals, averaged over
/// the area of its triangles. The normals are those of the exact surface and interpolated linearly in a triangle, so
/// that thin triangles have little weight.
fn normal_curvatures(mesh: &Mesh) -> Vec<f32> {
    // Sums of area and of divergence times area.
    let mut sums = vec![[0.0; 2]; mesh.n_vertices()];
    for triangle in &mesh.triangles[..] {
        let corners = triangle.map(|i| mesh.position(i as usize).map(f64::from));
        let edge = |from: usize, to: usize| sub(corners[to], corners[from]);
        let cross_product = area_vector(corners);
        let twice_area = length(cross_product);
        if twice_area <= 0.0 {
            continue;
        }
        let unit = cross_product.map(|v| v / twice_area);
        // The gradient of the weight of a corner is the cross product of the unit normal and the opposite edge, divided
        // by twice the area.
        let divergence: f64 =
            (0..3).map(|k| dot(normal(mesh, triangle[k] as usize), cross(unit, edge((k + 1) % 3, (k + 2) % 3)))).sum();
        for i in triangle {
            let [area, total] = &mut sums[*i as usize];
            *area += twice_area;
            *total += divergence;
        }
    }
    sums.into_iter().map(|[area, total]| if area > 0.0 { single(0.5 * total / area) } else { 0.0 }).collect()
}

/// Blends each colour with those of its neighbours in the mesh, in linear light, over about 1 Å. `resolution` is the
/// grid spacing, Å.
pub(in super::super) fn blend(
    colors: &mut Column<[u8; 4]>,
    triangles: &[[u32; 3]],
    resolution: f64,
    control: &Control<'_>,
) -> Result<(), SurfaceError> {
    let _memory = control.reserve(BLEND_BYTES * colors.len() as u64)?;
    let linear = linear_of_srgb();
    let mut levels: Vec<[u16; 3]> =
        colors.iter().map(|[r, g, b, _]| [r, g, b].map(|v| linear[usize::from(*v)])).collect();
    let mut sums = vec![([0_u32; 3], 0_u32); levels.len()];
    for _ in 0..rounds(resolution) {
        control.check()?;
        sums.fill(([0; 3], 0));
        for triangle in triangles {
            let [a, b, c] = triangle.map(|i| i as usize);
            for (at, next) in [(a, b), (b, c), (c, a)] {
                // Each edge of a closed mesh has both directions, so every neighbour counts once.
                let (sum, n) = &mut sums[at];
                sum.iter_mut().zip(levels[next]).for_each(|(sum, level)| *sum = sum.saturating_add(u32::from(level)));
                *n += 1;
            }
        }
        for (level, (sum, n)) in levels.iter_mut().zip(&sums).filter(|(_, (_, n))| *n > 0) {
            for (own, sum) in level.iter_mut().zip(sum) {
                *own = u16::try_from((u32::from(*own) + sum / n).div_ceil(2)).unwrap_or(u16::MAX);
            }
        }
    }
    for (color, level) in colors.iter_mut().zip(&levels) {
        for (byte, level) in color.iter_mut().zip(level) {
            *byte = nearest_srgb(&linear, *level);
        }
    }
    Ok(())
}

/// Returns the number of rounds of blending at a grid spacing, Å.
fn rounds(resolution: f64) -> u32 {
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "casts saturate, positive number")]
    let rounds = (ROUNDS_AT_1 / (resolution * resolution)).ceil() as u32;
    rounds.clamp(1, MAX_ROUNDS)
}

/// Returns the sRGB level nearest to a linear one.
fn nearest_srgb(linear: &[u16; 256], level: u16) -> u8 {
    let above = linear.partition_point(|known| *known < level).min(255);
    let below = above.saturating_sub(1);
    let nearest = if level.abs_diff(linear[below]) < level.abs_diff(linear[above]) { below } else { above };
    u8::try_from(nearest).unwrap_or(u8::MAX)
}

#[expect(clippy::cast_possible_truncation, reason = "values of vertices are single precision")]
pub(super) fn single(value: f64) -> f32 {
    value as f32
}

#[cfg(test)]
mod tests {
    use molmesh_surface::{SurfaceKind, SurfaceOptions};

    use super::*;

    #[test]
    fn every_srgb_level_survives_a_round_trip() {
        let linear = linear_of_srgb();
        assert!((0..=255).all(|level: u8| nearest_srgb(&linear, linear[usize::from(level)]) == level));
        assert_eq!((linear[0], linear[255], nearest_srgb(&linear, 1)), (0, 65_535, 0));
    }

    #[test]
    fn blending_spreads_equally_at_every_spacing() {
        assert_eq!([4.0, 1.0, 0.5, 0.25, 0.01].map(rounds), [1, 4, 16, 64, 64]);
    }

    /// Returns the values of the vertices of a mesh of a surface of spheres.
    fn values_of_ses(mesh: &Mesh, source: &ValueSource) -> Vec<f32> {
        let spheres = Spheres::new(vec![0.0], vec![0.0], vec![0.0], vec![1.0]).unwrap();
        let options = SurfaceOptions { surface: Some(SurfaceKind::Ses), ..SurfaceOptions::default() };
        let (params, limits) = (SurfaceParams::new(&options).unwrap(), SurfaceLimits::default());
        let surface = MeshedSurface { spheres: &spheres, params: &params, limits: &limits, parts: None };
        values(mesh, source, &surface, &Control::default()).unwrap()
    }

    /// Torus around z with the radii `large` and `small`, and the exact mean curvature of its vertices.
    fn torus(large: f64, small: f64) -> (Mesh, Vec<f64>) {
        const N: u32 = 96;
        let (mut positions, mut normals, mut expected, mut triangles) = (vec![], vec![], vec![], vec![]);
        for u in 0..N {
            for v in 0..N {
                let [a, b] = [u, v].map(|i| f64::from(i) / f64::from(N) * std::f64::consts::TAU);
                let ring = large + small * b.cos();
                positions.push([ring * a.cos(), ring * a.sin(), small * b.sin()].map(single));
                normals.push([b.cos() * a.cos(), b.cos() * a.sin(), b.sin()].map(single));
                expected.push((large + 2.0 * small * b.cos()) / (2.0 * small * ring));
                let at = |u: u32, v: u32| u % N * N + v % N;
                let [p, q, r, s] = [at(u, v), at(u + 1, v), at(u + 1, v + 1), at(u, v + 1)];
                triangles.extend([[p, q, r], [p, r, s]]);
            }
        }
        let (positions, normals, triangles) = (positions.into(), normals.into(), triangles.into());
        (Mesh { centre: [5.0, 0.0, 0.0], positions, normals, triangles, ..Mesh::default() }, expected)
    }

    #[test]
    fn curvatures_are_those_of_a_torus_and_change_sign_with_its_normals() {
        let (mut mesh, expected) = torus(3.0, 1.5);
        let curvatures = |mesh: &Mesh| values_of_ses(mesh, &ValueSource::Curvature);
        let worst = |found: &[f32], sign: f64| {
            let off = found.iter().zip(&expected).map(|(found, expected)| (f64::from(*found) - sign * expected).abs());
            off.fold(0.0, f64::max)
        };
        assert!(worst(&curvatures(&mesh), 1.0) < 2e-3, "{}", worst(&curvatures(&mesh), 1.0));
        // The inner ring of this torus has the curvature 0, the outer one 4/9 Å⁻¹.
        assert!(expected.iter().any(|h| h.abs() < 1e-9) && expected.iter().any(|h| (h - 4.0 / 9.0).abs() < 1e-9));
        mesh.normals.iter_mut().for_each(|normal| *normal = normal.map(|v| -v));
        assert!(worst(&curvatures(&mesh), -1.0) < 2e-3 && worst(&curvatures(&mesh), 1.0) > 0.5);
    }

    #[test]
    fn distances_are_from_the_centroid() {
        let (mesh, _) = torus(3.0, 1.0);
        let found = values_of_ses(&mesh, &ValueSource::Radial([5.0, 0.0, 4.0]));
        // The vertex on the outer ring lies 4 Å from the axis and 4 Å below the centroid.
        assert!((f64::from(found[0]) - 32.0_f64.sqrt()).abs() < 1e-5, "{}", found[0]);
    }

    #[test]
    fn quantized_meshes_have_nearly_the_same_values() {
        use molmesh_surface::quantize::Step;
        let (mesh, expected) = torus(3.0, 1.5);
        let mut rounded = mesh.clone();
        assert!(rounded.quantize(Step::covering(5.0)));
        let found = values_of_ses(&rounded, &ValueSource::Curvature);
        let mean = |values: &mut dyn Iterator<Item = f64>| values.sum::<f64>() / expected.len() as f64;
        let off = mean(&mut found.iter().zip(&expected).map(|(found, expected)| f64::from(*found) - expected));
        assert!(off.abs() < 5e-3, "{off}");
    }

    #[test]
    fn blended_colours_lie_between_those_of_the_neighbours() {
        // A tetrahedron with one white corner: all edges join all corners.
        let triangles = [[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]];
        let mut colors: Column<[u8; 4]> = vec![[255, 0, 0, 9], [0; 4], [0; 4], [0; 4]].into();
        blend(&mut colors, &triangles, 4.0, &Control::default()).unwrap();
        // One round: the white level becomes a half, that of each other corner a sixth.
        assert_eq!(colors[..], [[188, 0, 0, 9], [113, 0, 0, 0], [113, 0, 0, 0], [113, 0, 0, 0]]);
        let mut uniform: Column<[u8; 4]> = vec![[7, 80, 200, 255]; 4].into();
        blend(&mut uniform, &triangles, 0.25, &Control::default()).unwrap();
        assert_eq!(uniform[..], [[7, 80, 200, 255]; 4]);
    }
}
