//! Estimate of a job's work from the size of its input, before the input is read.

use molmesh_structure::{GZIP_MAGIC, ZSTD_MAGIC};
use molmesh_surface::pockets::{SPACING, rows_in_reach};
use molmesh_surface::{SurfaceKind, TriangleQuality};

use super::Options;
use super::color::{Scheme, VertexProperty};

/// Approximate bytes of text per atom. A line of a PDB file has 81, a line of an mmCIF file 90 to 110.
pub const BYTES_PER_ATOM: f64 = 90.0;
/// Approximate compression ratio of structure files.
const COMPRESSION: f64 = 4.0;
/// Largest ratio of compression by gzip.
const MAX_GZIP_RATIO: u64 = 1032;
/// Approximate ratio of the sizes of atoms in text and in BinaryCIF. It does not apply to compressed input, whose
/// format is unknown and whose sizes differ less.
const BINARY: f64 = 5.0;
/// Approximate bytes of an archive's BinaryCIF that describe columns. The number does not depend on the size of the
/// entry.
const DESCRIPTION: f64 = 150e3;
/// Work of the smallest job, in atoms.
const MIN_WORK: f64 = 2_000.0;
/// Time of the search for a spacing, relative to the final mesh. A coarse mesh precedes it, and sometimes a third is
/// needed.
const TRIES: f64 = 1.5;
/// Work of a pixel of a picture, in atoms: 100 ns on one core. An atom takes 4 µs on two cores.
const PIXEL: f64 = 0.0125;

/// Atoms around a tile at 0.5 Å. Tiles of other levels have as many grid points.
const TILE_ATOMS: f64 = 3_000.0;

/// Estimates the work of meshing, without reading, in atoms at 0.5 Å.
fn mesh_work(atoms: f64, resolution: f64) -> f64 {
    // Grid points scale with the inverse cube of the spacing, the surface with the inverse square.
    (atoms + MIN_WORK) * (0.5 / resolution).powf(2.5)
}

/// Estimates the work of a search for a spacing, in atoms at 0.5 Å. `resolution` is the expected result.
fn search_work(atoms: f64, resolution: f64) -> f64 {
    TRIES * mesh_work(atoms, resolution)
}

/// Returns the time of a surface relative to that of an isosurface, measured on 1AON at 0.5 Å on two cores.
const fn relative_time(surface: SurfaceKind) -> f64 {
    match surface {
        SurfaceKind::Gaussian | SurfaceKind::SoftObject | SurfaceKind::InverseSquare => 1.0,
        SurfaceKind::Vdw => 3.0,
        SurfaceKind::Sas => 2.0,
        SurfaceKind::Ses => 7.0,
    }
}

/// Returns the size at the end of a gzip file: that of its last member, modulo 2³². `None` if the size cannot be that
/// of the whole file.
fn gzip_size(input: &[u8]) -> Option<u32> {
    let size = input.starts_with(GZIP_MAGIC).then(|| input.last_chunk().map(|size| u32::from_le_bytes(*size)))??;
    let (least, most) = (input.len() as u64, input.len() as u64 * MAX_GZIP_RATIO);
    (least..=most).contains(&u64::from(size)).then_some(size)
}

/// Estimates the number of atoms in a structure file from its size.
#[must_use]
pub fn estimate_atoms(input: &[u8]) -> f64 {
    let compressed = input.starts_with(GZIP_MAGIC) || input.starts_with(ZSTD_MAGIC);
    // First byte of a MessagePack map; no text begins with it.
    let binary = matches!(input.first(), Some(0x80..=0x8F | 0xDE | 0xDF));
    let len = input.len() as f64;
    let bytes = match (compressed, binary) {
        (true, _) => gzip_size(input).map_or(len * COMPRESSION, f64::from),
        (false, true) => len.max((len - DESCRIPTION) * BINARY),
        (false, false) => len,
    };
    bytes / BYTES_PER_ATOM
}

/// Estimates the work of a job on a file of about `atoms` atoms, in atoms at 0.5 Å.
#[must_use]
pub fn estimate_work(atoms: f64, options: &Options) -> f64 {
    if options.tile.is_some() {
        // The root of an assembly is not kept in memory.
        let reading = if options.selection.instances { 0.3 * (atoms + MIN_WORK) } else { 0.0 };
        return reading + relative_time(options.params.surface) * mesh_work(atoms.min(TILE_ATOMS), 0.5);
    }
    let resolution = options.spacing.expected(&options.params, atoms);
    let mesh = if options.spacing.max_triangles().is_some() { search_work } else { mesh_work };
    // Reading does not depend on the spacing.
    0.3 * (atoms + MIN_WORK)
        + 0.7 * relative_time(options.params.surface) * mesh(atoms, resolution)
        + exact(options, atoms)
        + cavities(options, atoms)
        + pockets(options, atoms)
        + depth(options, VERTICES * atoms * (0.5 / resolution).powi(2))
        + simplification(options, VERTICES * atoms * (0.5 / resolution).powi(2))
        + improvement(options, VERTICES * atoms * (0.5 / resolution).powi(2))
        + drawing(options)
}

/// Minimum work of a surface that a GPU should compute, in atoms at 0.5 Å: about 10 ms on two cores. A GPU needs a
/// millisecond or two for any job, but shares submissions among small ones: it makes five times as many meshes of 602
/// atoms as 16 cores.
const MIN_GPU_WORK: f64 = 2_500.0;

/// Returns true if a GPU would make a job on a file of about `atoms` atoms faster: its surface takes most of the time,
/// and at least `MIN_GPU_WORK`. Tiles are too small.
#[must_use]
pub fn suits_gpu(atoms: f64, options: &Options) -> bool {
    let resolution = options.spacing.expected(&options.params, atoms);
    let surface = relative_time(options.params.surface) * mesh_work(atoms, resolution);
    options.tile.is_none() && surface >= MIN_GPU_WORK && 2.0 * surface >= estimate_work(atoms, options)
}

/// Work of a job besides its atoms and its grid, in atoms: about 1 ms.
const OVERHEAD: f64 = 250.0;
/// Work per pair of an atom and a brick, in atoms.
const PAIR: f64 = 0.019;
/// Work per grid point, in atoms.
const GRID_POINT: f64 = 0.00023;
/// Work per vertex, in atoms.
const VERTEX: f64 = 0.0032;

/// Counts that tell the work of a job.
pub(super) struct WorkCounts {
    /// Atoms of the file.
    pub(super) atoms: u64,
    /// Pairs of an atom and a brick.
    pub(super) pairs: u64,
    pub(super) grid_points: u64,
    pub(super) vertices: u64,
    /// Rows of grid points that the search for pockets passes over.
    pub(super) pocket_rows: u64,
}

/// Estimates the work of a job with known counts, in atoms at 0.5 Å.
pub(super) fn counted_work(options: &Options, counts: &WorkCounts) -> f64 {
    let [atoms, pairs, grid_points, vertices, pocket_rows] =
        [counts.atoms, counts.pairs, counts.grid_points, counts.vertices, counts.pocket_rows].map(|n| n as f64);
    let mesh = PAIR * pairs + GRID_POINT * grid_points + VERTEX * vertices;
    let tries = if options.spacing.max_triangles().is_some() { TRIES } else { 1.0 };
    OVERHEAD
        + 0.3 * atoms
        + tries * relative_time(options.params.surface) * mesh
        + exact(options, atoms)
        + cavities(options, atoms)
        + POCKET_ROW * pocket_rows
        + depth(options, vertices)
        + simplification(options, vertices)
        + improvement(options, vertices)
        + drawing(options)
}

/// Work of the exact areas of an atom, in atoms: they take about a third of the time of a solvent-excluded surface.
const EXACT: f64 = 1.5;

/// Estimates the work of exact areas, in atoms at 0.5 Å.
fn exact(options: &Options, atoms: f64) -> f64 {
    // An interface needs three measurements: the sides are measured alone and together, and the whole selection.
    let times = if options.interface.is_some() { 3.0 } else { 1.0 };
    if options.exact { EXACT * times * atoms } else { 0.0 }
}

/// Work of the search for cavities at an atom, in atoms: 55 to 80 µs on two cores.
const CAVITIES: f64 = 18.0;

/// Estimates the work of the search for cavities, in atoms at 0.5 Å.
fn cavities(options: &Options, atoms: f64) -> f64 {
    if options.cavities.is_some() { CAVITIES * atoms } else { 0.0 }
}

/// Work of the search for pockets at a row of grid points in reach of a probe, in atoms: 20 ns on two cores.
const POCKET_ROW: f64 = 0.005;
/// Typical radius of an atom, Å.
const RADIUS: f64 = 1.8;

/// Estimates the work of the search for pockets, in atoms at 0.5 Å.
fn pockets(options: &Options, atoms: f64) -> f64 {
    let rows = |large: f64| {
        let [radius, small, large] = [RADIUS, options.params.probe, large].map(|length| length / SPACING);
        rows_in_reach(radius, small, large)
    };
    POCKET_ROW * atoms * options.pocket_probe().map_or(0.0, rows)
}

/// Work of the depth of a vertex, in atoms: 0.4 µs on two cores.
const DEPTH: f64 = 0.1;
/// Approximate number of vertices per atom at 0.5 Å.
const VERTICES: f64 = 36.0;

/// Estimates the work of the depths of vertices, in atoms at 0.5 Å.
fn depth(options: &Options, vertices: f64) -> f64 {
    let is_depth = options.color.is_some_and(|color| matches!(color.scheme, Scheme::Vertex(VertexProperty::Depth)));
    if is_depth { DEPTH * vertices } else { 0.0 }
}

/// Work of the simplification at a vertex, in atoms: 2.6 µs on two cores.
const SIMPLIFICATION: f64 = 0.65;

/// Estimates the work of a simplification of a mesh with this number of vertices, in atoms at 0.5 Å.
fn simplification(options: &Options, vertices: f64) -> f64 {
    if options.simplify.is_some() { SIMPLIFICATION * vertices } else { 0.0 }
}

/// Work of the improvement of triangles at a vertex, in atoms: 10 to 12 µs on two cores.
const IMPROVEMENT: f64 = 3.0;

/// Estimates the work of the improvement of a mesh with this number of vertices, in atoms at 0.5 Å. A search for a
/// spacing improves each mesh.
fn improvement(options: &Options, vertices: f64) -> f64 {
    let tries = if options.spacing.max_triangles().is_some() { TRIES } else { 1.0 };
    if options.quality == TriangleQuality::High { IMPROVEMENT * tries * vertices } else { 0.0 }
}

/// Estimates the work of drawing, in atoms at 0.5 Å.
fn drawing(options: &Options) -> f64 {
    PIXEL * options.picture.map_or(0.0, |picture| f64::from(picture.width) * f64::from(picture.height))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::params;

    const fn counts(atoms: u64, pairs: u64, grid_points: u64, vertices: u64) -> WorkCounts {
        WorkCounts { atoms, pairs, grid_points, vertices, pocket_rows: 0 }
    }

    /// Counts of 1AON at 0.5 Å.
    const LARGE_PROTEIN: WorkCounts = counts(58_870, 1_300_000, 20_000_000, 2_100_000);

    fn estimate_work(input: &[u8], options: &Options) -> f64 {
        super::estimate_work(estimate_atoms(input), options)
    }

    #[test]
    fn large_surfaces_suit_a_gpu() {
        let suits = |atoms: f64, pairs: &[(&str, &str)]| {
            suits_gpu(atoms, &params::parse(pairs.iter().copied()).unwrap().options)
        };
        assert!(suits(60_000.0, &[]) && suits(602.0, &[]) && !suits(300.0, &[]) && suits(300.0, &[("surface", "ses")]));
        // Most of the time is spent on the CPU.
        assert!(
            !suits(60_000.0, &[("resolution", "2")]) && !suits(60_000.0, &[("cavities", "keep"), ("surface", "sas")])
        );
        assert!(!suits(60_000.0, &[("tile", "0/0/0/0")]));
    }

    #[test]
    fn finer_larger_and_compressed_inputs_cost_more() {
        let at = |resolution: &str| params::parse([("resolution", resolution)]).unwrap().options;
        let text = vec![b'A'; 90_000];
        let gzip = [&[0x1f, 0x8b][..], &text].concat();
        let coarse = estimate_work(&text, &at("1"));
        assert!(estimate_work(&text, &at("0.5")) > 2.0 * coarse);
        assert!(estimate_work(&gzip, &at("1")) > 2.0 * coarse);
        let sized = [&gzip[..], &9_000_000_u32.to_le_bytes()].concat();
        assert!((estimate_work(&sized, &at("0.5")) - 102_000.0).abs() < 1.0, "the size at the end");
        let binary = |first: u8| estimate_work(&[&[first][..], &vec![0; 450_000]].concat(), &at("1"));
        assert!(binary(0x83) > 2.0 * binary(b'A'));
        assert!((estimate_work(&text, &at("0.5")) - 3000.0).abs() < 1.0);
    }

    #[test]
    fn surfaces_of_spheres_cost_more() {
        let (text, of) = (vec![b'A'; 90_000], |surface: &str| params::parse([("surface", surface)]).unwrap().options);
        let [gaussian, sas, ses] = ["gaussian", "sas", "ses"].map(|surface| estimate_work(&text, &of(surface)));
        assert!(gaussian < sas && sas < ses, "{gaussian} {sas} {ses}");
    }

    #[test]
    fn cavities_cost_more() {
        let at =
            |pairs: &[(&str, &str)]| super::estimate_work(1e4, &params::parse(pairs.iter().copied()).unwrap().options);
        let [with, without] = [&[("cavities", "keep")][..], &[]].map(at);
        assert!((with - without - 18e4).abs() < 1.0, "{with} {without}");
    }

    #[test]
    fn wide_searches_for_pockets_cost_more() {
        let at =
            |pairs: &[(&str, &str)]| super::estimate_work(1e4, &params::parse(pairs.iter().copied()).unwrap().options);
        let [without, narrow, wide] =
            [&[][..], &[("pockets", "true")], &[("pockets", "true"), ("pocket_probe", "20")]].map(at);
        assert!(narrow > without + 1e4 && wide > without + 5.0 * (narrow - without), "{without} {narrow} {wide}");
    }

    #[test]
    fn depths_cost_more() {
        let at = |color: &str| params::parse([("color", color), ("resolution", "0.5")]).unwrap().options;
        let counted = |color: &str| counted_work(&at(color), &LARGE_PROTEIN);
        let guessed = |color: &str| super::estimate_work(58_870.0, &at(color));
        let [counted, guessed] = [counted("depth") - counted("radial"), guessed("depth") - guessed("radial")];
        assert!(counted > 1e5 && (0.9..1.1).contains(&(counted / guessed)), "{counted} {guessed}");
    }

    #[test]
    fn simplifications_and_improvements_cost_more() {
        let at = |pairs: &[(&str, &str)]| params::parse(pairs.iter().copied()).unwrap().options;
        let counted = |pairs: &[(&str, &str)]| counted_work(&at(pairs), &LARGE_PROTEIN);
        let guessed = |pairs: &[(&str, &str)]| super::estimate_work(58_870.0, &at(pairs));
        let without = &[("resolution", "0.5")];
        for (parameter, least) in [(("simplify", "0.1"), 1e6), (("quality", "high"), 5e6)] {
            let with = &[parameter, ("resolution", "0.5")];
            let [counted, guessed] = [counted(with) - counted(without), guessed(with) - guessed(without)];
            assert!(counted > least && (0.9..1.1).contains(&(counted / guessed)), "{counted} {guessed}");
        }
    }

    #[test]
    fn counted_work_agrees_for_proteins_and_not_for_a_sphere_on_a_fine_grid() {
        let at = |resolution: &str| params::parse([("resolution", resolution)]).unwrap().options;
        let protein = counted_work(&at("0.5"), &LARGE_PROTEIN);
        assert!((0.5..2.0).contains(&(protein / super::estimate_work(58_870.0, &at("0.5")))), "{protein}");
        // An atom at 0.02 Å takes tens of milliseconds, 4 µs for each unit.
        let sphere = counted_work(&at("0.02"), &counts(1, 70_000, 36_000_000, 140_000));
        assert!((2e3..2e4).contains(&sphere), "{sphere}");
        assert!(super::estimate_work(1.0, &at("0.02")) > 100.0 * sphere, "the control");
    }

    #[test]
    fn large_pictures_cost_more() {
        let (text, of) =
            (vec![b'A'; 90_000], |side: &str| params::parse([("format", "png"), ("width", side)]).unwrap().options);
        assert!(estimate_work(&text, &of("4096")) > 1.2 * estimate_work(&text, &of("512")));
    }

    #[test]
    fn automatic_spacing_is_estimated_from_the_input_size() {
        let of = |name: &str, value: &str| params::parse([(name, value)]).unwrap().options;
        let [small, large] = [90_000, 90_000_000].map(|n| vec![b'A'; n]);
        assert!(
            (estimate_work(&small, &of("detail", "4")) / estimate_work(&small, &of("resolution", "0.5")) - 1.0).abs()
                < 1e-9
        );
        // A million atoms at the same level of detail get a coarser grid.
        assert!(estimate_work(&large, &of("detail", "4")) < 0.5 * estimate_work(&large, &of("resolution", "0.5")));
        let bounded = |most: &str| estimate_work(&large, &of("max_triangles", most));
        assert!(bounded("1000000") < bounded("10000000"));
        assert!(bounded("4000000000") > estimate_work(&large, &of("resolution", "0.5")));
    }
}
