//! Benchmark cases: structures at grid spacings.

use std::path::Path;

use molmesh::surface::lattice::Lattice;
use molmesh::surface::{Control, Spheres, SurfaceOptions, SurfaceParams};

use crate::error::{Error, Result};
use crate::{grid, structures};

/// Number of cubes of the largest structure of the 2010 paper, 1BIJ, which 2HHB replaces.
const PAPER_CUBES: u64 = 7_267_456;

/// Source of atoms.
#[derive(Debug, Clone, Copy)]
enum Source {
    /// Atoms of these kinds of an entry, with `copies` copies along x and y.
    File { id: &'static str, kinds: &'static str, copies: usize },
    /// Ball of this number of generated atoms.
    Ball(usize),
}

/// Choice of the grid spacing.
#[derive(Debug, Clone, Copy)]
enum Spacing {
    /// Given spacing, Å.
    Is(f64),
    /// Spacing at which the bounding box has this number of cells.
    Cells(u64),
}

/// Structure at a grid spacing.
#[derive(Debug, Clone, Copy)]
pub(super) struct Case {
    /// Name, for `--only`.
    pub(super) name: &'static str,
    source: Source,
    spacing: Spacing,
}

/// Case with gigabytes of mesh.
const HUGE: &str = "7cgo-x9-0.5";

/// Returns the cases whose names contain one of `only`, or all if it is empty; [`HUGE`] must be named in full. The
/// generated case has `atoms` atoms.
pub(super) fn selected(atoms: usize, only: &[String]) -> Vec<Case> {
    let file = |name, id, kinds, copies, spacing| Case { name, source: Source::File { id, kinds, copies }, spacing };
    let all = [
        Case { name: "ball-0.5", source: Source::Ball(atoms), spacing: Spacing::Is(0.5) },
        file("2hhb-7.27M", "2hhb", "polymer", 1, Spacing::Cells(PAPER_CUBES)),
        file("1aon-0.5", "1aon", "polymer,ligand,ion", 1, Spacing::Is(0.5)),
        file("7cgo-0.5", "7cgo", "polymer", 1, Spacing::Is(0.5)),
        file("7cgo-1.0", "7cgo", "polymer", 1, Spacing::Is(1.0)),
        file("7cgo-x9-1.0", "7cgo", "polymer", 3, Spacing::Is(1.0)),
        file(HUGE, "7cgo", "polymer", 3, Spacing::Is(0.5)),
    ];
    let wanted = |case: &Case| match case.name {
        HUGE => only.iter().any(|name| name == HUGE),
        name => only.is_empty() || only.iter().any(|part| name.contains(part.as_str())),
    };
    all.into_iter().filter(wanted).collect()
}

impl Case {
    /// Loads the spheres. Returns them with the default parameters at the case's spacing.
    ///
    /// # Errors
    /// Returns an [`Error`] if the file is missing or contains no structure.
    pub(super) fn load(&self, folder: Option<&Path>) -> Result<(Spheres, SurfaceParams)> {
        let spheres = match self.source {
            Source::Ball(n) => structures::ball(n, 1)?,
            Source::File { id, kinds, copies } => {
                let folder = folder.ok_or_else(|| Error::Failed(format!("--data must name a folder with {id}")))?;
                let path = structures::find(folder, id)?
                    .ok_or_else(|| Error::Failed(format!("no file {id} in {}", folder.display())))?;
                let one = structures::read(&path, Some(kinds))?;
                structures::tiled(&one, one.len() * copies * copies, [copies; 2])?
            }
        };
        let params = |spacing| {
            let options = SurfaceOptions { resolution: Some(spacing), ..SurfaceOptions::default() };
            SurfaceParams::new(&options).map_err(Error::failed)
        };
        let cells = |spacing| {
            Lattice::new(&spheres, &params(spacing)?, &Control::default())
                .map(|lattice| lattice.box_cells)
                .map_err(Error::failed)
        };
        let spacing = match self.spacing {
            Spacing::Is(spacing) => spacing,
            Spacing::Cells(n) => grid::for_cubes(n, &cells)?.spacing,
        };
        let params = params(spacing)?;
        Ok((spheres, params))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_huge_case_is_measured_only_by_name() {
        let names = |only: &[&str]| {
            let only: Vec<String> = only.iter().copied().map(str::to_owned).collect();
            selected(1, &only).iter().map(|case| case.name).collect::<Vec<_>>()
        };
        assert_eq!(names(&["x9"]), ["7cgo-x9-1.0"]);
        assert_eq!(names(&[HUGE]), [HUGE]);
        assert_eq!(names(&["2hhb", "1aon"]), ["2hhb-7.27M", "1aon-0.5"]);
        assert_eq!(names(&[]).len(), 6);
    }

    #[test]
    fn missing_files_are_reported() {
        let folder = tempfile::tempdir().unwrap();
        let [case] = selected(1, &["2hhb".to_owned()])[..] else { panic!("one case") };
        assert!(case.load(Some(folder.path())).unwrap_err().to_string().contains("no file 2hhb"));
        assert!(case.load(None).unwrap_err().to_string().contains("--data"));
    }
}
