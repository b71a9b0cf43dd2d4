//! What is measured: structures at spacings.

use std::fs;
use std::path::{Path, PathBuf};

use molmesh::structure::{self, ReadLimits, Selection};
use molmesh::surface::lattice::Lattice;
use molmesh::surface::{Spheres, SurfaceOptions, SurfaceParams};

/// Cubes of the 2010 paper's largest structure, 1BIJ; 2HHB stands in for it.
const PAPER_CUBES: f64 = 7_267_456.0;

/// Where spheres come from.
#[derive(Debug, Clone, Copy)]
enum Source {
    /// A file of this name, with these kinds of atoms, repeated along x and y.
    File { stem: &'static str, kinds: &'static str, copies: [u32; 2] },
    /// So many atoms, made up.
    MadeUp(usize),
}

/// How the spacing is chosen.
#[derive(Debug, Clone, Copy)]
enum Spacing {
    /// Å.
    Is(f64),
    /// So that the box has so many cells, within 1 %.
    Cells(f64),
}

/// A structure at a spacing.
#[derive(Debug)]
pub(super) struct Case {
    /// What `--only` looks at.
    pub(super) name: &'static str,
    /// Whether the 2010 program runs too: its box must be one that it could have had.
    pub(super) with_paper: bool,
    /// Gigabytes of mesh: measured only where it is asked for by its whole name.
    huge: bool,
    source: Source,
    spacing: Spacing,
}

/// The cases whose names contain `only`; the made-up one has `atoms` atoms.
pub(super) fn chosen(atoms: usize, only: &str) -> Vec<Case> {
    let asked = |case: &Case| if case.huge { case.name == only } else { case.name.contains(only) };
    all(atoms).into_iter().filter(asked).collect()
}

/// Every case.
fn all(atoms: usize) -> Vec<Case> {
    let file = |name, stem, kinds, copies, spacing| Case {
        name,
        with_paper: stem == "2hhb",
        huge: false,
        source: Source::File { stem, kinds, copies },
        spacing,
    };
    vec![
        Case {
            name: "ball-0.5",
            with_paper: true,
            huge: false,
            source: Source::MadeUp(atoms),
            spacing: Spacing::Is(0.5),
        },
        file("2hhb-7.27M", "2hhb", "polymer", [1, 1], Spacing::Cells(PAPER_CUBES)),
        file("1aon-0.5", "1aon", "polymer,ligand", [1, 1], Spacing::Is(0.5)),
        file("7cgo-0.5", "7cgo", "polymer", [1, 1], Spacing::Is(0.5)),
        file("7cgo-1.0", "7cgo", "polymer", [1, 1], Spacing::Is(1.0)),
        file("7cgo-x9-1.0", "7cgo", "polymer", [3, 3], Spacing::Is(1.0)),
        Case { huge: true, ..file("7cgo-x9-0.5", "7cgo", "polymer", [3, 3], Spacing::Is(0.5)) },
    ]
}

impl Case {
    /// Its spheres, and the default surface at its spacing.
    ///
    /// # Errors
    /// In words, where there is no file or nothing to mesh in it.
    pub(super) fn load(&self, folder: Option<&Path>) -> Result<(Spheres, SurfaceParams), String> {
        let spheres = match self.source {
            Source::MadeUp(n) => ball(n, 1),
            Source::File { stem, kinds, copies } => {
                let folder = folder.ok_or_else(|| format!("{stem} is a file: --data DIR says where it is"))?;
                tiled(&read(&find(folder, stem)?, kinds)?, copies)?
            }
        };
        let params = |spacing| {
            let options = SurfaceOptions { resolution: Some(spacing), ..SurfaceOptions::default() };
            SurfaceParams::new(&options).map_err(|e| e.to_string())
        };
        let params = match self.spacing {
            Spacing::Is(spacing) => params(spacing)?,
            Spacing::Cells(cells) => {
                let of = |spacing| -> Result<f64, String> {
                    Ok(Lattice::new(&spheres, &params(spacing)?).map_err(|e| e.to_string())?.box_cells as f64)
                };
                params(spacing_for(cells, &of)?)?
            }
        };
        Ok((spheres, params))
    }
}

/// A spacing at which `cells_at` gives `cells` within 1 %. More cells come with less spacing.
fn spacing_for(cells: f64, cells_at: &dyn Fn(f64) -> Result<f64, String>) -> Result<f64, String> {
    let (mut fine, mut coarse) = (0.02, 10.0);
    for _ in 0..60 {
        let middle = f64::sqrt(fine * coarse);
        let found = cells_at(middle)?;
        if (found / cells - 1.0).abs() < 0.001 {
            return Ok(middle);
        }
        if found > cells { fine = middle } else { coarse = middle }
    }
    let found = cells_at(coarse)?;
    if (found / cells - 1.0).abs() < 0.01 { Ok(coarse) } else { Err(format!("no spacing gives {cells} cells")) }
}

/// The file of `folder` with the name `stem`, whatever its extensions are.
fn find(folder: &Path, stem: &str) -> Result<PathBuf, String> {
    let entries = fs::read_dir(folder).map_err(|e| format!("{}: {e}", folder.display()))?;
    let named = |path: &PathBuf| {
        let name = path.file_name().map(|n| n.to_string_lossy().to_lowercase()).unwrap_or_default();
        let first = name.split('.').next().unwrap_or_default();
        first == stem || first.strip_prefix("pdb") == Some(stem)
    };
    let mut found: Vec<_> = entries.flatten().map(|e| e.path()).filter(named).collect();
    found.sort();
    found.into_iter().next().ok_or_else(|| format!("no file {stem} in {}", folder.display()))
}

fn read(path: &Path, kinds: &str) -> Result<Spheres, String> {
    let words = |e: &dyn std::fmt::Display| format!("{}: {e}", path.display());
    let bytes = fs::read(path).map_err(|e| words(&e))?;
    let structure = structure::read(&bytes, &ReadLimits::default()).map_err(|e| words(&e))?;
    let mut selection = Selection::default();
    selection.set_kinds(kinds).map_err(|e| e.to_string())?;
    let selected = structure::select(&structure, &selection).map_err(|e| words(&e))?;
    selected.spheres(&structure).map_err(|e| words(&e))
}

/// Copies side by side along x and y, 3 Å between their boxes of centres.
fn tiled(one: &Spheres, copies: [u32; 2]) -> Result<Spheres, String> {
    let Some([lo, hi]) = one.bounds() else { return Err("no atoms".to_owned()) };
    let (mut columns, mut radii) = ([const { Vec::new() }; 3], Vec::new());
    for copy in (0..copies[1]).flat_map(|y| (0..copies[0]).map(move |x| [f64::from(x), f64::from(y), 0.0])) {
        for i in 0..one.len() {
            let centre = one.centre(i);
            (0..3).for_each(|k| columns[k].push(centre[k] + copy[k] * (hi[k] - lo[k] + 3.0)));
            radii.push(one.radius(i));
        }
    }
    let [x, y, z] = columns;
    Spheres::new(x, y, z, radii).map_err(|e| e.to_string())
}

/// `n` atoms in a ball, as dense as the heavy atoms of proteins (one in 19.3 Å³): on a shaken cubic lattice, so that there
/// are neither clumps nor holes. The same `n` and `seed` give the same atoms.
pub(super) fn ball(n: usize, seed: u64) -> Spheres {
    let mut shake = Shake::new(seed);
    let half = (1_i32..2000).find(|h| 4.0 * f64::from(*h).powi(3) > n as f64).unwrap_or(1) + 1;
    let mut places: Vec<[i32; 3]> =
        (-half..=half).flat_map(|z| (-half..=half).flat_map(move |y| (-half..=half).map(move |x| [x, y, z]))).collect();
    places.sort_by_key(|p| (p.iter().map(|c| c * c).sum::<i32>(), *p));
    places.truncate(n);
    let (mut columns, mut radii) = ([const { Vec::new() }; 3], Vec::new());
    for place in places {
        (0..3).for_each(|k| columns[k].push(SIDE * (f64::from(place[k]) + 0.5 * shake.next())));
        radii.push(radius(shake.next() + 0.5));
    }
    let [x, y, z] = columns;
    Spheres::new(x, y, z, radii).unwrap_or_default()
}

/// Å between atoms on a cubic lattice that is as dense as the heavy atoms of proteins.
pub(super) const SIDE: f64 = 2.683;

/// Numbers of [−½, ½) that look random and are the same for the same seed.
pub(super) struct Shake(u64);

impl Shake {
    pub(super) const fn new(seed: u64) -> Self {
        Self(seed)
    }

    pub(super) fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 11) as f64 / (1_u64 << 53) as f64 - 0.5
    }
}

/// The radius, Å, of the element at a number of [0, 1): carbon, nitrogen and oxygen as often as in proteins.
pub(super) fn radius(element: f64) -> f32 {
    if element < 0.63 {
        1.7
    } else if element < 0.80 {
        1.55
    } else {
        1.52
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ball_is_round_dense_and_the_same_every_time() {
        let ball_of = |n| ball(n, 7);
        let spheres = ball_of(5000);
        assert_eq!((spheres.len(), spheres == ball_of(5000), spheres == ball(5000, 8)), (5000, true, false));
        let radius = (5000.0_f64 * 19.3 * 3.0 / 4.0 / std::f64::consts::PI).cbrt();
        let [lo, hi] = spheres.bounds().unwrap();
        for k in 0..3 {
            assert!((hi[k] - radius).abs() < 2.0 && (lo[k] + radius).abs() < 2.0, "{lo:?} {hi:?} {radius}");
        }
    }

    #[test]
    fn gigabytes_are_measured_only_by_name() {
        let names = |only| chosen(1, only).iter().map(|case| case.name).collect::<Vec<_>>();
        assert_eq!(names("x9"), ["7cgo-x9-1.0"]);
        assert_eq!(names("7cgo-x9-0.5"), ["7cgo-x9-0.5"]);
        assert_eq!(names("").len() + 1, all(1).len());
    }

    #[test]
    fn the_spacing_for_a_number_of_cells_is_found_or_refused() {
        let cells_at = |h: f64| Ok((50.0 / h).ceil().powi(3));
        let spacing = spacing_for(1e6, &cells_at).unwrap();
        assert!((cells_at(spacing).unwrap() / 1e6 - 1.0).abs() < 0.01);
        assert!(spacing_for(1e6, &|_| Ok(5e5)).is_err());
    }

    #[test]
    fn copies_stand_side_by_side_and_a_missing_file_is_named() {
        let one = ball(100, 1);
        let four = tiled(&one, [2, 2]).unwrap();
        assert_eq!(four.len(), 400);
        let [lo, hi] = one.bounds().unwrap();
        assert!((four.bounds().unwrap()[1][0] - (2.0 * hi[0] - lo[0] + 3.0)).abs() < 1e-9);
        let folder = tempfile::tempdir().unwrap();
        assert!(find(folder.path(), "2hhb").unwrap_err().contains("no file 2hhb"));
        fs::write(folder.path().join("pdb2HHB.ent.gz"), "").unwrap();
        assert!(find(folder.path(), "2hhb").is_ok());
    }
}
