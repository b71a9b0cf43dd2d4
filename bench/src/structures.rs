//! Structures to measure: files, the built-in sample, tiled copies, and generated atoms.

use std::fs;
use std::path::{Path, PathBuf};

use molmesh::structure::{self, ReadLimits, Selection};
use molmesh::surface::Spheres;

use crate::error::{Error, Result};

/// Built-in sample, 4PTI.
pub(crate) const SAMPLE: &[u8] = include_bytes!("../../samples/4pti.pdb");
/// Extensions of structure files, preferred ones first.
const EXTENSIONS: [&str; 4] = ["pdb", "ent", "cif", "bcif"];
/// Spacing of atoms on a cubic lattice as dense as the heavy atoms of proteins (one per 19.3 Å³), Å.
pub(crate) const ATOM_DISTANCE: f64 = 2.683;

/// Finds the file of an entry: `1abc`, `pdb1abc` or `pdb_00001abc`, in any case, plain or with `.gz` or `.zst`.
///
/// # Errors
/// Returns [`Error::File`] if the folder cannot be read.
pub(crate) fn find(folder: &Path, id: &str) -> Result<Option<PathBuf>> {
    let id = id.to_lowercase();
    let stems = [id.clone(), format!("pdb{id}"), format!("pdb_0000{id}")];
    let mut found: Vec<(usize, PathBuf)> = Vec::new();
    for entry in fs::read_dir(folder).map_err(Error::file(folder))? {
        let path = entry.map_err(Error::file(folder))?.path();
        let name = file_name(&path).to_lowercase();
        let plain = name.strip_suffix(".gz").or(name.strip_suffix(".zst")).unwrap_or(&name);
        let Some((stem, extension)) = plain.rsplit_once('.') else { continue };
        let rank = EXTENSIONS.iter().position(|known| *known == extension);
        if let Some(rank) = rank.filter(|_| stems.iter().any(|s| s == stem)) {
            found.push((rank, path));
        }
    }
    Ok(found.into_iter().min().map(|(_, path)| path))
}

/// Returns the last part of a path.
pub(crate) fn file_name(path: &Path) -> String {
    path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default()
}

/// Reads the atoms of a file: those of the given kinds, or the default selection.
///
/// # Errors
/// Returns [`Error::File`] if it cannot be read, and [`Error::Failed`] if it contains no structure.
pub(crate) fn read(path: &Path, kinds: Option<&str>) -> Result<Spheres> {
    let bytes = fs::read(path).map_err(Error::file(path))?;
    atoms(&bytes, kinds).map_err(|why| Error::Failed(format!("{}: {why}", path.display())))
}

/// Returns the atoms of the built-in sample.
///
/// # Errors
/// Returns [`Error::Failed`] if it cannot be parsed.
pub(crate) fn sample() -> Result<Spheres> {
    atoms(SAMPLE, None)
}

fn atoms(bytes: &[u8], kinds: Option<&str>) -> Result<Spheres> {
    let structure = structure::read(bytes, &ReadLimits::default()).map_err(Error::failed)?;
    let mut selection = Selection::default();
    if let Some(kinds) = kinds {
        selection.atoms = kinds.parse().map_err(Error::failed)?;
    }
    let selected = structure::select(&structure, &selection).map_err(Error::failed)?;
    selected.spheres(&structure).map_err(Error::failed)
}

/// Builds spheres from their centres, Å, and radii, Å.
pub(crate) fn spheres(atoms: impl IntoIterator<Item = ([f64; 3], f32)>) -> Result<Spheres> {
    let (mut columns, mut radii) = ([const { Vec::new() }; 3], Vec::new());
    for (centre, radius) in atoms {
        columns.iter_mut().zip(centre).for_each(|(column, c)| column.push(c));
        radii.push(radius);
    }
    let [x, y, z] = columns;
    Spheres::new(x, y, z, radii).map_err(Error::failed)
}

/// Tiles copies of a structure until there are `n` atoms: `columns` copies along x and y, then layers along z, with 3 Å
/// between the bounding boxes of the centres.
///
/// # Errors
/// Returns [`Error::Failed`] if the structure has no atoms.
pub(crate) fn tiled(one: &Spheres, n: usize, columns: [usize; 2]) -> Result<Spheres> {
    let [lo, hi] = one.bounds().ok_or_else(|| Error::failed("no atoms"))?;
    spheres((0..n).map(|i| {
        let (copy, atom) = (i / one.len(), i % one.len());
        let at = [copy % columns[0], copy / columns[0] % columns[1], copy / (columns[0] * columns[1])];
        let centre = one.centre(atom);
        (std::array::from_fn(|k| centre[k] + at[k] as f64 * (hi[k] - lo[k] + 3.0)), one.radius(atom))
    }))
}

/// Tiles the built-in sample in a cube until there are `n` atoms.
///
/// # Errors
/// Returns the errors of [`tiled`].
pub(crate) fn tiled_sample(n: usize) -> Result<Spheres> {
    let sample = sample()?;
    let copies = n.div_ceil(sample.len());
    let edge = (1..=copies).find(|e| e.pow(3) >= copies).unwrap_or(1);
    tiled(&sample, n, [edge, edge])
}

/// Generates `n` atoms in a ball on a perturbed cubic lattice, as dense as the heavy atoms of proteins. The same `n`
/// and `seed` give the same atoms.
///
/// # Errors
/// Returns [`Error::Failed`] for 0 atoms.
pub(crate) fn ball(n: usize, seed: u64) -> Result<Spheres> {
    let mut random = Random::new(seed);
    let half = (1_i32..2000).find(|h| 4.0 * f64::from(*h).powi(3) > n as f64).unwrap_or(1) + 1;
    let mut points: Vec<[i32; 3]> =
        (-half..=half).flat_map(|z| (-half..=half).flat_map(move |y| (-half..=half).map(move |x| [x, y, z]))).collect();
    points.sort_by_key(|p| (p.iter().map(|c| c * c).sum::<i32>(), *p));
    spheres(points.into_iter().take(n).map(|point| {
        let centre = point.map(|c| ATOM_DISTANCE * (f64::from(c) + 0.5 * random.next()));
        (centre, random.radius())
    }))
}

/// Seeded pseudorandom numbers.
#[derive(Debug)]
pub(crate) struct Random(u64);

impl Random {
    pub(crate) const fn new(seed: u64) -> Self {
        Self(seed)
    }

    /// Returns a number in [−½, ½).
    pub(crate) fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 11) as f64 / (1_u64 << 53) as f64 - 0.5
    }

    /// Returns the radius of carbon, nitrogen or oxygen, Å, in the proportions of proteins.
    pub(crate) fn radius(&mut self) -> f32 {
        match self.next() + 0.5 {
            element if element < 0.63 => 1.7,
            element if element < 0.80 => 1.55,
            _ => 1.52,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ball_is_round_dense_and_reproducible() {
        let ball_of = |n| ball(n, 7).unwrap();
        let spheres = ball_of(5000);
        assert_eq!((spheres.len(), spheres == ball_of(5000), spheres == ball(5000, 8).unwrap()), (5000, true, false));
        let radius = (5000.0_f64 * 19.3 * 3.0 / 4.0 / std::f64::consts::PI).cbrt();
        let [lo, hi] = spheres.bounds().unwrap();
        for k in 0..3 {
            assert!((hi[k] - radius).abs() < 2.0 && (lo[k] + radius).abs() < 2.0, "{lo:?} {hi:?} {radius}");
        }
    }

    #[test]
    fn copies_are_placed_side_by_side() {
        let one = ball(100, 1).unwrap();
        let four = tiled(&one, 400, [2, 2]).unwrap();
        assert_eq!(four.len(), 400);
        let [lo, hi] = one.bounds().unwrap();
        assert!((four.bounds().unwrap()[1][0] - (2.0 * hi[0] - lo[0] + 3.0)).abs() < 1e-9);
        let sample = sample().unwrap();
        let [lo, hi] = sample.bounds().unwrap();
        let mut first = sample.centre(0);
        first[0] += hi[0] - lo[0] + 3.0;
        let many = tiled_sample(3_000).unwrap();
        assert_eq!((many.len(), many.centre(454)), (3_000, first));
        let few = tiled_sample(100).unwrap();
        assert_eq!((few.len(), few.centre(99)), (100, sample.centre(99)));
    }

    #[test]
    fn files_are_found_by_id_and_must_contain_a_structure() {
        let folder = tempfile::tempdir().unwrap();
        let found = |id: &str| find(folder.path(), id).unwrap().map(|path| file_name(&path));
        for name in ["2hhb.cif.txt", "1ql2_old.pdb", "pdb1BK2.ent.gz", "1bk2.cif", "pdb_00004pti.bcif.zst"] {
            fs::write(folder.path().join(name), "no structure").unwrap();
        }
        assert_eq!((found("2HHB"), found("1ql2")), (None, None));
        assert_eq!(
            (found("1BK2").unwrap(), found("4pti").unwrap()),
            ("pdb1BK2.ent.gz".into(), "pdb_00004pti.bcif.zst".into())
        );
        assert!(matches!(read(&folder.path().join("1bk2.cif"), None), Err(Error::Failed(_))));
        assert!(matches!(find(&folder.path().join("none"), "1bk2"), Err(Error::File { .. })));
    }
}
