//! Components of a mesh: sheets of neighbouring bricks are joined where they share vertices.
//!
//! A sheet is a connected part of the triangles of one brick. Every backend that works by bricks sums its sheets while
//! it makes them; no vertex is read again.

use rayon::prelude::*;

use super::lattice::to_u32;
use super::measure::{Component, Measures};
use super::union_find::UnionFind;

/// Sums over the triangles of a sheet. Lengths are in a unit of the backend, relative to `origin`.
#[derive(Debug, Default, Clone, Copy)]
pub(crate) struct Sheet {
    /// Offset of the origin from the mesh's centre, in units.
    pub(crate) origin: [i32; 3],
    pub(crate) triangles: u32,
    /// Number of vertices that the brick owns.
    pub(crate) vertices: u32,
    /// Neighbours that own vertices of the sheet: bit n for neighbour n (bits of n: 0 x, 1 y, 2 z).
    pub(crate) above: u8,
    /// Neighbours in the opposite directions that use vertices of the sheet: bit n for the brick that has this one as
    /// neighbour n.
    pub(crate) below: u8,
    /// Twice the area.
    pub(crate) area: f64,
    /// Sum of the normals n, which have the length of twice the area.
    pub(crate) vector: [f64; 3],
    /// Sum of n (a + b + c) over the corners, per axis: six times the volume, for a closed surface.
    pub(crate) product: [f64; 3],
    /// Sum of n (a² + b² + c² + ab + bc + ca), per axis: 24 times the volume's first moment, for a closed surface.
    pub(crate) moment: [f64; 3],
}

impl Sheet {
    /// Adds the sheet to its component, which contains `first`. Volumes are relative to the origin of `first`: relative
    /// to a distant origin, small errors of the area vectors would be as large as a molecule.
    fn add_to(&self, component: &mut Component, first: &Self, unit: f64) {
        let h2 = unit * unit;
        component.triangles += u64::from(self.triangles);
        component.vertices += u64::from(self.vertices);
        component.area += 0.5 * self.area * h2;
        for k in 0..3 {
            // The sums after moving the corners by the offset.
            let offset = f64::from(self.origin[k] - first.origin[k]);
            let product = self.product[k] + 3.0 * offset * self.vector[k];
            let moment = self.moment[k] + offset * (4.0 * self.product[k] + 6.0 * offset * self.vector[k]);
            component.volume += product / 18.0 * h2 * unit;
            component.moment[k] += moment / 24.0 * h2 * h2;
        }
    }

    /// Moves the reference point of a finished component's moment from the sheet's origin to the mesh's centre.
    fn refer_moment(&self, component: &mut Component, unit: f64) {
        for (moment, origin) in component.moment.iter_mut().zip(self.origin) {
            *moment += component.volume * f64::from(origin) * unit;
        }
    }
}

/// Sheets of a brick, numbered in its [`SheetSums`].
#[derive(Debug, Clone, Copy)]
pub(crate) struct BrickSheets {
    /// The brick's first sheet.
    pub(crate) first: u32,
    /// Number of sheets.
    pub(crate) n: u16,
    /// Start of its vertices in `near`, and of those of its neighbours in `far`, if it has several sheets.
    pub(crate) near: u32,
    pub(crate) far: u32,
}

/// Vertex on a sheet of a brick with several sheets.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SharedVertex {
    /// The brick that owns it: 0 for the brick itself, else the number of the neighbour (bits: 0 x, 1 y, 2 z).
    pub(crate) owner: u8,
    /// Layer (3 bits), axis (2 bits) and bit `8·y + x` (6 bits) of its edge in its owner.
    pub(crate) key: u16,
    /// Sheet of the brick.
    pub(crate) sheet: u16,
}

/// Sums over a run of bricks that the surface intersects.
#[derive(Debug, Default)]
pub(crate) struct SheetSums {
    /// Sum of the shares of all directed edges.
    pub(crate) checksum: u64,
    /// True if a triangle has a corner twice.
    pub(crate) degenerate: bool,
    /// Sheets of all bricks.
    pub(crate) sheets: Vec<Sheet>,
    pub(crate) bricks: Vec<BrickSheets>,
    /// Vertices of bricks with several sheets that other bricks use, brick by brick in the order of keys.
    pub(crate) near: Vec<SharedVertex>,
    /// Vertices of neighbours on sheets of bricks with several sheets.
    pub(crate) far: Vec<SharedVertex>,
}

impl SheetSums {
    /// Vertices of brick `ix` in `near` and in `far`.
    pub(crate) fn shared_by(&self, ix: usize) -> [&[SharedVertex]; 2] {
        let [start, end] = [ix, ix + 1].map(|ix| {
            self.bricks.get(ix).map_or([self.near.len(), self.far.len()], |b| [b.near as usize, b.far as usize])
        });
        [&self.near[start[0]..end[0]], &self.far[start[1]..end[1]]]
    }
}

/// Returns the measures of a mesh, given by the sums of runs of bricks, its unit in Å, and its numbers of vertices and
/// triangles; `None` if it is not closed, as its edges then have to be counted. `near(run)` returns a function from a
/// brick of the run and the number of one of its neighbours to the neighbour's run and its index there.
pub(crate) fn measures<F: Fn(usize, usize) -> Option<(usize, usize)>>(
    all: &[&SheetSums],
    near: impl Fn(usize) -> F + Sync,
    unit: f64,
    size: [usize; 2],
) -> Option<Measures> {
    let checksum = all.iter().fold(0_u64, |sum, sums| sum.wrapping_add(sums.checksum));
    if checksum != 0 || all.iter().any(|sums| sums.degenerate) {
        return None;
    }
    // Sheets are numbered per run: these are the first numbers of the runs in the mesh.
    let mut n = 0;
    let mut first = Vec::with_capacity(all.len());
    for sums in all {
        first.push(to_u32(n));
        n += sums.sheets.len();
    }
    let pairs: Vec<Vec<[u32; 2]>> =
        (0..all.len()).into_par_iter().map(|run| pairs_of(all, &first, run, near(run))).collect();
    let mut joined = UnionFind::new(n);
    pairs.into_iter().flatten().for_each(|[a, b]| joined.union(a, b));
    let mut components = vec![Component::default(); n];
    let sheets: Vec<&Sheet> = all.iter().flat_map(|sums| &sums.sheets).collect();
    for (sheet, of) in sheets.iter().zip(joined.into_representatives()) {
        sheet.add_to(&mut components[of as usize], sheets[of as usize], unit);
    }
    for (component, sheet) in components.iter_mut().zip(&sheets) {
        sheet.refer_moment(component, unit);
    }
    Some(Measures::balanced(components, size.map(|n| n as u64)))
}

/// Pairs of sheets that the bricks of run `run` share with their neighbours; `first` is the first sheet of each run.
fn pairs_of(
    all: &[&SheetSums],
    first: &[u32],
    run: usize,
    near: impl Fn(usize, usize) -> Option<(usize, usize)>,
) -> Vec<[u32; 2]> {
    let sums = all[run];
    let mut pairs: Vec<[u32; 2]> = Vec::with_capacity(4 * sums.bricks.len());
    for (ix, brick) in sums.bricks.iter().enumerate() {
        let own = &sums.sheets[brick.first as usize..][..usize::from(brick.n)];
        let shared = own.iter().fold(0, |all, sheet| all | sheet.above);
        let number = |sheet: usize| first[run] + brick.first + to_u32(sheet);
        let mut several = [None; 8];
        for (neighbour, several) in several.iter_mut().enumerate().filter(|(n, _)| shared >> n & 1 == 1) {
            let Some((other_run, other)) = near(ix, neighbour) else { continue };
            let theirs = all[other_run].bricks[other];
            let their_first = first[other_run] + theirs.first;
            if theirs.n == 1 {
                let on = own.iter().enumerate().filter(|(_, sheet)| sheet.above >> neighbour & 1 == 1);
                pairs.extend(on.map(|(sheet, _)| [number(sheet), their_first]));
            } else if brick.n == 1 {
                let sheets = all[other_run].sheets[theirs.first as usize..].iter().zip(their_first..);
                let on = sheets.take(usize::from(theirs.n)).filter(|(sheet, _)| sheet.below >> neighbour & 1 == 1);
                pairs.extend(on.map(|(_, sheet)| [number(0), sheet]));
            } else {
                *several = Some((their_first, all[other_run].shared_by(other)[0]));
            }
        }
        for vertex in sums.shared_by(ix)[1] {
            let Some((their_first, near)) = several[usize::from(vertex.owner)] else { continue };
            let Ok(at) = near.binary_search_by_key(&vertex.key, |theirs| theirs.key) else { continue };
            let sheets = [number(usize::from(vertex.sheet)), their_first + u32::from(near[at].sheet)];
            if pairs.last() != Some(&sheets) {
                pairs.push(sheets);
            }
        }
    }
    pairs
}
