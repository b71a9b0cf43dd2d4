//! Values of a map near the vertices of a mesh.

use molmesh_structure::map::Map;
use molmesh_surface::{Control, Mesh, SurfaceError};
use rayon::prelude::*;

use super::ROWS;
use super::vertex::{single, unit_normal};

/// Returns the value of the map at each vertex, moved outward along its normal by `offset`, Å; NaN where the map has
/// none. Vertices and normals must be contiguous.
pub(super) fn values(mesh: &Mesh, map: &Map, offset: f64, control: &Control<'_>) -> Result<Vec<f32>, SurfaceError> {
    let n = mesh.n_vertices();
    let mut values = vec![f32::NAN; n];
    values.par_chunks_mut(ROWS).enumerate().try_for_each(|(part, values)| {
        control.check()?;
        for (i, value) in (ROWS * part..).zip(values) {
            let (position, normal) = (mesh.position(i), unit_normal(mesh, i));
            let at = std::array::from_fn(|k| mesh.centre[k] + f64::from(position[k]) + offset * normal[k]);
            *value = map.at(at).map_or(f32::NAN, single);
        }
        Ok::<(), SurfaceError>(())
    })?;
    Ok(values)
}

/// Returns the range around 0 that contains all finite values, to four significant digits; `None` if there are none.
pub(super) fn symmetric_range(values: &[f32]) -> Option<[f64; 2]> {
    let finite = values.iter().copied().filter(|value| value.is_finite());
    let most = finite.map(|value| f64::from(value.abs())).reduce(f64::max)?;
    let end = significant(most, 3);
    Some([-end + 0.0, end])
}

/// Rounds a number to `decimals` digits after the first significant one.
pub(super) fn significant(value: f64, decimals: usize) -> f64 {
    format!("{value:.decimals$e}").parse().unwrap_or(value)
}

#[cfg(test)]
mod tests {
    use std::fmt::Write as _;

    use molmesh_structure::map::{MapError, MapLimits};
    use molmesh_surface::CpuBackend;

    use super::*;
    use crate::color::tables::OTHER;
    use crate::color::{Palette, scaled};
    use crate::{Choice, JobError, JobLimits, MapFile, Product, params, run};

    const SAMPLE: &[u8] = include_bytes!("../../../../samples/4pti.pdb");

    /// Returns a map with the value `scale · (x − 2y + z)` at `n`³ points from the corner (−20, −20, −20) on.
    fn linear_map(scale: f64, n: u32, step: f64) -> String {
        let mut text = format!(
            "object 1 class gridpositions counts {n} {n} {n}\norigin -20 -20 -20\ndelta {step} 0 0\ndelta 0 {step} 0\n\
             delta 0 0 {step}\nobject 3 class array type double rank 0 items {} data follows\n",
            n * n * n
        );
        for i in 0..n * n * n {
            let p = [i / (n * n), i / n % n, i % n].map(|i| f64::from(i) * step - 20.0);
            writeln!(text, "{:e}", of_position(scale, p)).unwrap();
        }
        text
    }

    fn of_position(scale: f64, [x, y, z]: [f64; 3]) -> f64 {
        scale * (x - 2.0 * y + z)
    }

    fn product(map: &str, pairs: &[(&str, &str)]) -> Result<Product, JobError> {
        let backend = CpuBackend::new(None).unwrap();
        let own = [("resolution", "1.5"), ("color", "map")];
        let mut options = params::parse(own.iter().chain(pairs).copied()).unwrap().options;
        options.map = Some(MapFile::new(String::new(), map.as_bytes().to_vec()));
        let choice = Choice { backend: &backend, reason: "" };
        run(SAMPLE, &options, &JobLimits::default(), &choice, &Control::default(), &(), None)
    }

    /// Returns the largest difference between a colour of the mesh and that of the closed form at `offset`.
    fn worst(product: &Product, scale: f64, offset: f64, palette: Palette) -> u8 {
        let (mesh, range) = (&product.mesh, product.report.color.as_ref().unwrap().range.unwrap());
        let colors = mesh.colors.as_ref().unwrap();
        let of = |i: usize| {
            let (position, normal) = (mesh.position(i), unit_normal(mesh, i));
            let at = std::array::from_fn(|k| mesh.centre[k] + f64::from(position[k]) + offset * normal[k]);
            let [_, r, g, b] = scaled(palette, range, of_position(scale, at)).to_be_bytes();
            let off = [r, g, b].iter().zip(colors[i]).map(|(a, b)| a.abs_diff(b)).max().unwrap();
            assert_eq!(colors[i][3], 255);
            off
        };
        (0..mesh.n_vertices()).map(of).max().unwrap()
    }

    #[test]
    fn colours_are_those_of_a_linear_function_at_the_offset() {
        for (scale, offset, pairs) in [
            (1.0, 1.4, &[][..]),
            (-1e-6, 1.4, &[]),
            (1.0, 0.0, &[("color_offset", "0")]),
            (1.0, 3.0, &[("color_offset", "3"), ("compress", "quantize")]),
        ] {
            let made = product(&linear_map(scale, 11, 8.0), pairs).unwrap();
            let palette = Palette::RedWhiteBlue;
            assert!(worst(&made, scale, offset, palette) <= 1, "{scale} {offset}");
            let report = made.report.color.unwrap();
            let map = report.map.unwrap();
            assert_eq!((map.format, map.size, map.offset, map.vertices_outside), ("dx", [11; 3], offset, 0));
            let [low, high] = report.range.unwrap();
            assert!(
                (low + high).abs() < 1e-9 * high && high > 10.0 * scale.abs() && high < 200.0 * scale.abs(),
                "{high}"
            );
            assert_eq!((report.palette, report.legend.len()), (Some("red-white-blue"), 5));
            assert_eq!(report.legend[2].label, "0");
        }
        // Negative controls: another function, another distance from the surface.
        let made = product(&linear_map(1.0, 11, 8.0), &[]).unwrap();
        assert!(worst(&made, -1.0, 1.4, Palette::RedWhiteBlue) > 50);
        assert!(worst(&made, 1.0, 0.0, Palette::RedWhiteBlue) > 2);
        let plain = crate::params::parse([("resolution", "1.5")]).unwrap().options;
        let backend = CpuBackend::new(None).unwrap();
        let choice = Choice { backend: &backend, reason: "" };
        let plain = run(SAMPLE, &plain, &JobLimits::default(), &choice, &Control::default(), &(), None).unwrap();
        assert_eq!((&plain.mesh.positions, &plain.mesh.triangles), (&made.mesh.positions, &made.mesh.triangles));
    }

    #[test]
    fn ranges_and_palettes_are_those_of_the_request() {
        let pairs = [("color_range", "-3,5"), ("palette", "viridis")];
        let made = product(&linear_map(1.0, 11, 8.0), &pairs).unwrap();
        assert_eq!(made.report.color.as_ref().unwrap().range, Some([-3.0, 5.0]));
        assert!(worst(&made, 1.0, 1.4, Palette::Viridis) <= 1);
    }

    #[test]
    fn vertices_outside_the_map_are_grey_and_counted() {
        // The map ends at x, y, z = 20 Å, within the protein.
        let made = product(&linear_map(1.0, 11, 4.0), &[]).unwrap();
        let report = made.report.color.unwrap();
        let outside = report.map.unwrap().vertices_outside;
        let colors = made.mesh.colors.unwrap();
        let [_, r, g, b] = OTHER.to_be_bytes();
        assert_eq!(colors.iter().filter(|color| **color == [r, g, b, 255]).count() as u64, outside);
        assert!(outside > 0 && outside < colors.len() as u64, "{outside} of {}", colors.len());
        let far = linear_map(1.0, 4, 1.0).replace("origin -20", "origin 500");
        let error = product(&far, &[]).unwrap_err();
        assert!(
            error.to_string().contains("it extends from (500.0, -20.0, -20.0) to (503.0, -17.0, -17.0)"),
            "{error}"
        );
    }

    #[test]
    fn bad_maps_and_missing_ones_are_errors_before_meshing() {
        let error = product("nonsense", &[]).unwrap_err();
        assert!(matches!(error, JobError::Map(MapError::UnknownFormat { .. })), "{error}");
        let limits = JobLimits { map: MapLimits { max_points: 7, ..MapLimits::default() }, ..JobLimits::default() };
        let backend = CpuBackend::new(None).unwrap();
        let choice = Choice { backend: &backend, reason: "" };
        let mut options = params::parse([("color", "map")]).unwrap().options;
        let mut refused = |map: Option<MapFile>, color: bool| {
            options.map = map;
            options.color = options.color.filter(|_| color);
            run(SAMPLE, &options, &limits, &choice, &Control::default(), &(), None).unwrap_err().to_string()
        };
        let map = || Some(MapFile::new(String::new(), linear_map(1.0, 2, 90.0)));
        assert!(refused(None, true).contains("it needs a map"));
        assert_eq!(refused(map(), true), "the map has 8 points, the limit is 7");
        assert!(refused(map(), false).contains("does not use the map"));
    }

    #[test]
    fn keys_contain_the_map_and_the_offset() {
        let key = |pairs: &[(&str, &str)], digest: &str| {
            let mut options = params::parse(pairs.iter().copied()).unwrap().options;
            options.map = Some(MapFile::not_loaded(digest.to_owned()));
            params::canonical(&options)
        };
        let plain = [("color", "map")];
        assert_eq!(key(&plain, "1"), key(&[("color", "map"), ("color_offset", "1.4")], "1"));
        assert_ne!(key(&plain, "1"), key(&plain, "2"));
        assert_ne!(key(&plain, "1"), key(&[("color", "map"), ("color_offset", "1.5")], "1"));
    }
}
