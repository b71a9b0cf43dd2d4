//! Components of a mesh: sheets of neighbouring bricks are joined where they share vertices.
//!
//! A sheet is a connected part of the triangles of one brick. A backend that works by bricks computes the sums over a
//! sheet together with its triangles; no vertex is read again.
//!
//! Groups of bricks are joined and summed in parallel. One thread then joins and adds up the few remaining sets in
//! order. Groups depend on the mesh alone, so the sums are the same on any number of threads.

use std::ops::Range;

use rayon::prelude::*;

use super::lattice::to_u32;
use super::measure::{Component, Measures};
use super::union_find::UnionFind;

/// Sums over the triangles of a sheet. Lengths are in a unit of the backend, relative to `origin`.
#[derive(Debug, Default, Clone, Copy)]
pub struct Sheet {
    /// Offset of the origin from the mesh's centre, in units.
    pub origin: [i32; 3],
    /// Number of triangles.
    pub triangles: u32,
    /// Number of vertices that the brick owns.
    pub vertices: u32,
    /// Neighbours that own vertices of the sheet: bit n for neighbour n (bits of n: 0 x, 1 y, 2 z).
    pub above: u8,
    /// Neighbours in the opposite directions that use vertices of the sheet: bit n for the brick that has this one as
    /// neighbour n.
    pub below: u8,
    /// Twice the area.
    pub area: f64,
    /// Sum of the normals n of the triangles. The length of a normal is twice the triangle's area.
    pub vector: [f64; 3],
    /// Sum of n (a + b + c) over the corners, per axis: six times the volume, for a closed surface.
    pub product: [f64; 3],
    /// Sum of n (a² + b² + c² + ab + bc + ca), per axis: 24 times the volume's first moment, for a closed surface.
    pub moment: [f64; 3],
}

impl Sheet {
    /// Adds another sheet. Its sums are moved to the origin of this one: relative to a distant origin, small errors of
    /// the area vectors would add up to an error as large as the molecule.
    fn add_sheet(&mut self, other: &Self) {
        self.triangles += other.triangles;
        self.vertices += other.vertices;
        self.area += other.area;
        for k in 0..3 {
            let offset = f64::from(other.origin[k] - self.origin[k]);
            let (vector, product) = (other.vector[k], other.product[k]);
            self.vector[k] += vector;
            self.product[k] += product + 3.0 * offset * vector;
            self.moment[k] += other.moment[k] + offset * (4.0 * product + 6.0 * offset * vector);
        }
    }

    /// Adds the sheet to its component, whose moment is relative to `origin`.
    fn add_to(&self, component: &mut Component, origin: [i32; 3], unit: f64) {
        let h2 = unit * unit;
        let mut moved = Self { origin, ..Self::default() };
        moved.add_sheet(self);
        component.triangles += u64::from(self.triangles);
        component.vertices += u64::from(self.vertices);
        component.area += 0.5 * self.area * h2;
        for k in 0..3 {
            component.volume += moved.product[k] / 18.0 * h2 * unit;
            component.moment[k] += moved.moment[k] / 24.0 * h2 * h2;
        }
    }
}

/// Sheets of a brick, numbered in its [`SheetSums`]; none if the surface does not intersect the brick.
#[derive(Debug, Clone, Copy)]
pub struct BrickSheets {
    /// The brick's first sheet.
    pub first: u32,
    /// Number of sheets.
    pub n: u16,
    /// Start of its vertices in [`SheetSums::near`], if it has several sheets.
    pub near: u32,
    /// Start of the vertices of its neighbours in [`SheetSums::far`], if it has several sheets.
    pub far: u32,
}

/// Vertex on a sheet of a brick with several sheets.
#[derive(Debug, Clone, Copy)]
pub struct SharedVertex {
    /// The brick that owns it: 0 for the brick itself, else the number of the neighbour (bits: 0 x, 1 y, 2 z).
    pub owner: u8,
    /// Layer (3 bits), axis (2 bits) and bit `8·y + x` (6 bits) of its edge in its owner.
    pub key: u16,
    /// Sheet of the brick.
    pub sheet: u16,
}

/// Sums over a run of bricks that the surface intersects.
#[derive(Debug, Default)]
pub struct SheetSums {
    /// Sum of the shares of all directed edges.
    pub checksum: u64,
    /// True if a triangle has a corner twice.
    pub degenerate: bool,
    /// Sheets of all bricks.
    pub sheets: Vec<Sheet>,
    /// Bricks that the surface intersects.
    pub bricks: Vec<BrickSheets>,
    /// Vertices of bricks with several sheets that other bricks use, brick by brick in the order of keys.
    pub near: Vec<SharedVertex>,
    /// Vertices of neighbours on sheets of bricks with several sheets.
    pub far: Vec<SharedVertex>,
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

/// Returns the measures of a mesh from the sums of runs of bricks, the unit of these sums in Å, and the numbers of
/// vertices and triangles. Returns `None` if the mesh is not closed: its edges must then be counted. `near(run)`
/// returns a function that maps a brick of the run and the number of one of its neighbours to the neighbour's run and
/// its index in that run.
pub fn measures<F: Fn(usize, usize) -> Option<(usize, usize)>>(
    all: &[&SheetSums],
    near: impl Fn(usize) -> F + Sync,
    unit: f64,
    size: [usize; 2],
) -> Option<Measures> {
    let checksum = all.iter().fold(0_u64, |sum, sums| sum.wrapping_add(sums.checksum));
    if checksum != 0 || all.iter().any(|sums| sums.degenerate) {
        return None;
    }
    let groups = groups(all);
    let mut positions = Vec::with_capacity(all.len());
    for (group, runs) in groups.iter().enumerate() {
        let mut first = 0;
        for sums in &all[runs.clone()] {
            positions.push(RunPosition { group, first });
            first += to_u32(sums.sheets.len());
        }
    }
    let joined = each(groups.len(), |group| Group::join(all, &positions, groups[group].clone(), &near));
    let components = components(&joined, unit);
    Some(Measures::balanced(components, size.map(|n| n as u64)))
}

/// Number of bricks that are joined on one thread.
const GROUP: usize = 1024;

/// Position of a run of bricks: its group, and the number of its first sheet in the group.
#[derive(Debug, Clone, Copy)]
struct RunPosition {
    group: usize,
    first: u32,
}

/// Cuts the runs into groups of [`GROUP`] bricks or a little more.
fn groups(all: &[&SheetSums]) -> Vec<Range<usize>> {
    let (mut groups, mut start, mut bricks) = (Vec::new(), 0, 0);
    for (run, sums) in all.iter().enumerate() {
        bricks += sums.bricks.len();
        if bricks >= GROUP || run + 1 == all.len() {
            groups.push(start..run + 1);
            (start, bricks) = (run + 1, 0);
        }
    }
    groups
}

/// Runs `work` for 0 to `n`, in parallel unless `n` is so small that waking threads would take longer.
pub fn each<T: Send>(n: usize, work: impl Fn(usize) -> T + Sync + Send) -> Vec<T> {
    if n < 3 { (0..n).map(work).collect() } else { (0..n).into_par_iter().map(work).collect() }
}

/// Sets of the sheets of a group, each connected within the group.
#[derive(Debug, Default)]
struct Group {
    /// Set of each sheet. Sets are numbered in the order of their first sheets.
    sets: Vec<u32>,
    /// Sums over each set, relative to the origin of its first sheet.
    sums: Vec<Sheet>,
    /// Pairs of a set and a sheet of another group that share vertices: set, other group, and sheet.
    pairs: Vec<(u32, usize, u32)>,
}

impl Group {
    fn join<F: Fn(usize, usize) -> Option<(usize, usize)>>(
        all: &[&SheetSums],
        positions: &[RunPosition],
        runs: Range<usize>,
        near: &impl Fn(usize) -> F,
    ) -> Self {
        let sheets = || all[runs.clone()].iter().flat_map(|sums| &sums.sheets);
        let mut joined = UnionFind::new(all[runs.clone()].iter().map(|sums| sums.sheets.len()).sum());
        let mut pairs = Vec::new();
        for run in runs.clone() {
            let RunPosition { group, first } = positions[run];
            for_pairs(all, run, near(run), |own, other_run, other| {
                let (own, position) = (first + own, positions[other_run]);
                let other = position.first + other;
                if position.group == group {
                    joined.union(own, other);
                } else {
                    pairs.push((own, position.group, other));
                }
            });
        }
        let mut sets = Vec::new();
        let mut sums: Vec<Sheet> = Vec::with_capacity(joined.number_sets(&mut sets) as usize);
        for (sheet, set) in sheets().zip(&sets) {
            match sums.get_mut(*set as usize) {
                Some(sum) => sum.add_sheet(sheet),
                None => sums.push(*sheet),
            }
        }
        for (own, ..) in &mut pairs {
            *own = sets[*own as usize];
        }
        Self { sets, sums, pairs }
    }
}

/// Joins the sets of all groups. Returns the components in the order of their first sheets.
fn components(groups: &[Group], unit: f64) -> Vec<Component> {
    let mut n = 0;
    let mut first = Vec::with_capacity(groups.len());
    for group in groups {
        first.push(to_u32(n));
        n += group.sums.len();
    }
    let pairs = each(groups.len(), |group| {
        let number = |group: usize, set: u32| first[group] + set;
        let of_pair = |&(own, other, sheet): &(u32, usize, u32)| {
            [number(group, own), number(other, groups[other].sets[sheet as usize])]
        };
        let mut pairs: Vec<[u32; 2]> = groups[group].pairs.iter().map(of_pair).collect();
        pairs.sort_unstable();
        pairs.dedup();
        pairs
    });
    let mut joined = UnionFind::new(n);
    pairs.iter().flatten().for_each(|[a, b]| joined.union(*a, *b));
    let mut numbers = Vec::new();
    let n = joined.number_sets(&mut numbers);
    let mut components: Vec<(Component, [i32; 3])> = Vec::with_capacity(n as usize);
    for (sum, number) in groups.iter().flat_map(|group| &group.sums).zip(numbers) {
        if number as usize == components.len() {
            components.push((Component::default(), sum.origin));
        }
        let (component, origin) = &mut components[number as usize];
        sum.add_to(component, *origin, unit);
    }
    // Moves the reference points of the moments to the mesh's centre.
    let about_centre = |(mut component, origin): (Component, [i32; 3])| {
        component.shift(origin.map(|c| f64::from(c) * unit));
        component
    };
    components.into_iter().map(about_centre).collect()
}

/// Calls `pair` with each sheet of run `run`, and the run and number of a sheet of a neighbouring brick with which it
/// shares vertices.
fn for_pairs(
    all: &[&SheetSums],
    run: usize,
    near: impl Fn(usize, usize) -> Option<(usize, usize)>,
    mut pair: impl FnMut(u32, usize, u32),
) {
    let sums = all[run];
    for (ix, brick) in sums.bricks.iter().enumerate() {
        let own = &sums.sheets[brick.first as usize..][..usize::from(brick.n)];
        let shared = own.iter().fold(0, |all, sheet| all | sheet.above);
        let mut several = [None; 8];
        for (neighbour, several) in several.iter_mut().enumerate().filter(|(n, _)| shared >> n & 1 == 1) {
            let Some((other_run, other)) = near(ix, neighbour) else { continue };
            let theirs = all[other_run].bricks[other];
            if theirs.n == 1 {
                let on = (brick.first..).zip(own).filter(|(_, sheet)| sheet.above >> neighbour & 1 == 1);
                on.for_each(|(sheet, _)| pair(sheet, other_run, theirs.first));
            } else if brick.n == 1 {
                let sheets = &all[other_run].sheets[theirs.first as usize..][..usize::from(theirs.n)];
                let on = (theirs.first..).zip(sheets).filter(|(_, sheet)| sheet.below >> neighbour & 1 == 1);
                on.for_each(|(sheet, _)| pair(brick.first, other_run, sheet));
            } else {
                *several = Some((other_run, theirs.first, all[other_run].shared_by(other)[0]));
            }
        }
        let mut last = None;
        for vertex in sums.shared_by(ix)[1] {
            let Some((other_run, first, near)) = several[usize::from(vertex.owner)] else { continue };
            let Ok(at) = near.binary_search_by_key(&vertex.key, |theirs| theirs.key) else { continue };
            let found = (brick.first + u32::from(vertex.sheet), other_run, first + u32::from(near[at].sheet));
            if last.replace(found) != Some(found) {
                pair(found.0, found.1, found.2);
            }
        }
    }
}
