//! Warnings about positions that are probably errors: atoms far from all others, and many atoms at one position.

use std::cmp::Reverse;
use std::ops::Range;

use molmesh_surface::vector::{dot, joined_bounds, map_components, sub};
use rustc_hash::FxHashMap;

use super::atoms::Columns;
use super::duplicates;
use super::error::StructureError;
use super::read::Reading;

/// Distance from all others at which an atom is probably misplaced, Å. Also the edge of the cubes that are compared.
const FAR: f64 = 1000.0;
/// Maximum number of cubes whose distances are compared, each with all others. A structure occupies a few.
const MAX_CUBES: usize = 128;
/// Rows between two checks of the cancellation flag: about a millisecond.
const ROWS_PER_CHECK: usize = 1 << 17;

/// Atoms in a cube.
#[derive(Debug, Clone, Copy)]
struct Content {
    first: usize,
    atoms: u64,
    /// Lowest and highest coordinates.
    bounds: [[f64; 3]; 2],
}

/// Rejects too many atoms at one position, and returns warnings about suspect positions. A block of a file has no
/// warnings.
///
/// # Errors
/// Returns the errors of [`duplicates::check`].
pub(super) fn check(columns: &Columns, reading: &Reading<'_>) -> Result<Vec<String>, StructureError> {
    let row = |row| columns.model_and_position(row);
    if reading.is_block {
        return duplicates::check(columns.len(), row, reading).map(|()| Vec::new());
    }
    let crowded = duplicates::warning(columns.len(), row, reading)?;
    Ok(far_atoms(columns, reading)?.into_iter().chain(crowded).collect())
}

/// Returns a warning about atoms that are far from the largest group of their model, for the first such model. Models
/// that occupy too many cubes have none.
fn far_atoms(columns: &Columns, reading: &Reading<'_>) -> Result<Option<String>, StructureError> {
    let mut first = 0;
    for model in columns.model.chunk_by(|a, b| a == b) {
        reading.check()?;
        let rows = first..first + model.len();
        first = rows.end;
        let Some(cubes) = cubes(columns, rows.clone(), reading)? else { continue };
        if cubes.len() < 2 {
            continue;
        }
        let groups = groups(&cubes);
        let mut n_atoms = vec![0; cubes.len()];
        for (group, cube) in groups.iter().zip(&cubes) {
            n_atoms[*group] += cube.atoms;
        }
        let Some(largest) = (0..cubes.len()).max_by_key(|&group| (n_atoms[group], Reverse(group))) else { continue };
        let far: Vec<&Content> =
            groups.iter().zip(&cubes).filter(|(group, _)| **group != largest).map(|(_, cube)| cube).collect();
        let Some(example) = far.iter().map(|cube| cube.first).min() else { continue };
        let atoms: u64 = far.iter().map(|cube| cube.atoms).sum();
        let (_, [x, y, z]) = columns.model_and_position(example);
        return Ok(Some(format!(
            "{atoms} of {} atoms lie more than {FAR} Å from the others, the first is atom {} at ({x}, {y}, {z})",
            rows.len(),
            example + 1
        )));
    }
    Ok(None)
}

/// Returns the occupied cubes of a model in the order of their first atoms. `None` if there are too many.
fn cubes(columns: &Columns, rows: Range<usize>, reading: &Reading<'_>) -> Result<Option<Vec<Content>>, StructureError> {
    let mut indices: FxHashMap<[i32; 3], usize> = FxHashMap::default();
    let mut cubes: Vec<Content> = Vec::new();
    let mut latest = None;
    for i in rows {
        reading.check_every(i, ROWS_PER_CHECK)?;
        let (_, at) = columns.model_and_position(i);
        #[expect(clippy::cast_possible_truncation, reason = "coordinates are within ±100,000 Å")]
        let cube = at.map(|c| (c / FAR).floor() as i32);
        let cube_ix = match latest {
            Some((known, cube_ix)) if known == cube => cube_ix,
            _ => *indices.entry(cube).or_insert(cubes.len()),
        };
        latest = Some((cube, cube_ix));
        if cube_ix == cubes.len() {
            if cube_ix == MAX_CUBES {
                return Ok(None);
            }
            cubes.push(Content { first: i, atoms: 0, bounds: [at; 2] });
        }
        let content = &mut cubes[cube_ix];
        content.atoms += 1;
        content.bounds = joined_bounds(content.bounds, [at; 2]);
    }
    Ok(Some(cubes))
}

/// Returns the group of each cube, named by its first cube: cubes whose atoms have boxes at most [`FAR`] apart,
/// directly or through others.
fn groups(cubes: &[Content]) -> Vec<usize> {
    let mut groups = vec![usize::MAX; cubes.len()];
    for start in 0..cubes.len() {
        if groups[start] != usize::MAX {
            continue;
        }
        let mut open = vec![start];
        groups[start] = start;
        while let Some(cube) = open.pop() {
            for other in 0..cubes.len() {
                if groups[other] == usize::MAX && are_near(&cubes[cube], &cubes[other]) {
                    groups[other] = start;
                    open.push(other);
                }
            }
        }
    }
    groups
}

fn are_near(a: &Content, b: &Content) -> bool {
    let ([a_low, a_high], [b_low, b_high]) = (a.bounds, b.bounds);
    let gap = map_components(sub(a_low, b_high), sub(b_low, a_high), f64::max).map(|gap| gap.max(0.0));
    dot(gap, gap) <= FAR * FAR
}
