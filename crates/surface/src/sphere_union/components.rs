//! Connected components of the boundary of a union of spheres.
//!
//! Arcs that share a vertex belong to one component. A face may have several boundary curves; great circles through
//! them find those that bound the same face. Let F be a face, and let a path on its sphere lead from one boundary curve
//! of F to another. Where the path leaves F, it crosses a boundary curve of F, and it can come back only across that
//! curve. So the parts of the path within F, each of which joins the curves at its ends, join both curves.
//!
//! All lengths are in grid spacings.

use std::sync::{Mutex, PoisonError};

use rayon::prelude::*;
use rustc_hash::FxHashMap;

use super::caps::{self, Cap, Cover, TOLERANCE};
use super::cells::Cells;
use super::circle::Uncovered;
use super::great_circle::GreatCircle;
use super::{CELLS_PER_PART, CapScratch, Circle, radius};
use crate::candidates::{Comparisons, OverlapCount};
use crate::control::Control;
use crate::error::SurfaceError;
use crate::groups::Groups;
use crate::lattice::{LatticeAtom, to_i32, to_u32};
use crate::params::SurfaceLimits;
use crate::union_find::UnionFind;
use crate::vector::{add, dot, squared_distance, sub, unit};

/// Distance within which ends of arcs are the same vertex, Å. The tolerance of caps moves the ends of arcs that meet at
/// a small angle by up to its square root. Components that come closer than this are joined.
const JOIN: f64 = 2e-3;
/// Ends of arcs are stored once per vertex, up to this distance, Å.
const SAME: f64 = JOIN / 4.0;

/// Memory of a component that is one sphere, with its measures, bytes.
const WHOLE_BYTES: u64 = 256;

/// Exposed arc of the circle of two spheres.
#[derive(Debug, Clone, Copy)]
pub(super) struct Arc {
    pub(super) spheres: [u32; 2],
    /// Centre of the circle, relative to the centre of the first sphere.
    pub(super) centre: [f64; 3],
    /// Unit vector from the first to the second sphere.
    pub(super) axis: [f64; 3],
    /// Unit vector to the middle of the arc.
    pub(super) middle: [f64; 3],
    /// Unit vector perpendicular to both.
    pub(super) side: [f64; 3],
    pub(super) radius: f64,
    /// Cosine and sine of the half-angle.
    pub(super) half: [f64; 2],
}

impl Arc {
    /// Returns the point in the direction of an angle from the middle, relative to the first sphere.
    fn point(&self, [cos, sin]: [f64; 2]) -> [f64; 3] {
        std::array::from_fn(|k| self.centre[k] + self.radius * (cos * self.middle[k] + sin * self.side[k]))
    }

    /// Returns both ends and the middle, relative to the first sphere.
    pub(super) fn points(&self) -> [[f64; 3]; 3] {
        let [cos, sin] = self.half;
        [[cos, -sin], [cos, sin], [1.0, 0.0]].map(|angle| self.point(angle))
    }

    /// Returns the squared distance from a point, relative to the first sphere.
    fn distance2(&self, x: [f64; 3]) -> f64 {
        let from = sub(x, self.centre);
        let [p, q, z] = [self.middle, self.side, self.axis].map(|axis| dot(from, axis));
        let ([cos, sin], s) = (self.half, p.hypot(q));
        let (to_p, to_q) = (p - self.radius * cos, q.abs() - self.radius * sin);
        z * z + if p >= s * cos { (s - self.radius).powi(2) } else { to_p * to_p + to_q * to_q }
    }
}

/// Boundary of a union of spheres, divided into connected components.
pub(crate) struct Components<'a> {
    pub(super) atoms: &'a [LatticeAtom],
    pub(super) arcs: Vec<Arc>,
    /// Component of each arc.
    pub(super) of_arc: Vec<u32>,
    /// Numbers of the arcs on each sphere.
    by_sphere: Groups,
    /// Caps of the spheres on which several sets of arcs lie.
    caps: FxHashMap<u32, Vec<Cap>>,
    /// Spheres whose whole surface is exposed, ascending. They have no arcs. Their components have the last numbers.
    pub(super) whole: Vec<u32>,
    tolerance: f64,
    pub(super) n: u32,
}

impl<'a> Components<'a> {
    /// Finds the components of the boundary of `atoms`, whose radius is the length scale.
    ///
    /// # Errors
    /// [`SurfaceError::Limit`], [`SurfaceError::Memory`], [`SurfaceError::Cancelled`].
    pub(crate) fn new(
        atoms: &'a [LatticeAtom],
        spacing: f64,
        limits: &SurfaceLimits,
        control: &Control<'_>,
    ) -> Result<Self, SurfaceError> {
        let (tolerance, cells, overlaps) =
            (TOLERANCE / spacing, Cells::new(atoms, control)?, OverlapCount::new(limits));
        let search = CapSearch { atoms, cells: &cells, overlaps: &overlaps, tolerance, control };
        let whole = Mutex::new(Vec::new());
        let arcs: Vec<Vec<Arc>> = search.for_each_sphere(
            |_| true,
            |own, scratch, arcs, comparisons| {
                if scratch.caps.is_empty() {
                    control.memory.grow(WHOLE_BYTES)?;
                    whole.lock().unwrap_or_else(PoisonError::into_inner).push(own);
                }
                arcs_of(atoms, own, scratch, tolerance, arcs, comparisons)
            },
        )?;
        let arcs = arcs.concat();
        control.memory.grow(5 * size_of::<u32>() as u64 * (arcs.len() + atoms.len()) as u64)?;
        let mut sets = UnionFind::new(arcs.len());
        join_ends(atoms, &arcs, spacing, &mut sets, control)?;
        let on_spheres = (0..).zip(&arcs).flat_map(|(number, arc)| arc.spheres.map(|sphere| (sphere as usize, number)));
        let by_sphere = Groups::new(atoms.len(), on_spheres);
        let mut numbers = Vec::new();
        sets.number_sets(&mut numbers);
        let mut whole = whole.into_inner().unwrap_or_else(PoisonError::into_inner);
        whole.sort_unstable();
        let caps = FxHashMap::default();
        let mut found = Self { atoms, arcs, of_arc: numbers, by_sphere, caps, whole, tolerance, n: 0 };
        let several = |own: &u32| !found.on(*own).is_empty() && found.only(*own).is_none();
        let pairs = search.for_each_sphere(several, |own, scratch, out, _| {
            let pairs = found.shared_faces(own, &scratch.caps, &mut scratch.uncovered);
            out.push((own, scratch.caps.clone(), pairs));
            Ok(())
        })?;
        for (own, caps, pairs) in pairs.into_iter().flatten() {
            for [a, b] in pairs {
                sets.union(a, b);
            }
            found.caps.insert(own, caps);
        }
        found.n = sets.number_sets(&mut found.of_arc) + to_u32(found.whole.len());
        Ok(found)
    }

    /// Returns the numbers of the arcs on a sphere.
    pub(super) fn on(&self, sphere: u32) -> &[u32] {
        self.by_sphere.get(sphere as usize)
    }

    /// Returns the vector from the centre of sphere `a` to that of sphere `b`.
    pub(super) fn between(&self, a: u32, b: u32) -> [f64; 3] {
        let [a, b] = [a, b].map(|i| &self.atoms[i as usize]);
        std::array::from_fn(|k| f64::from(b.cell[k] - a.cell[k]) + (f64::from(b.frac[k]) - f64::from(a.frac[k])))
    }

    /// Returns pairs of arcs on a sphere that bound the same face.
    fn shared_faces(&self, own: u32, caps: &[Cap], uncovered: &mut Uncovered) -> Vec<[u32; 2]> {
        let arcs = self.on(own);
        let (mut pairs, mut reached) = (Vec::new(), vec![self.of_arc[arcs[0] as usize]]);
        let start = unit(self.middle(arcs[0], own));
        for &arc in arcs {
            let set = self.of_arc[arc as usize];
            if reached.contains(&set) {
                continue;
            }
            reached.push(set);
            let plane = GreatCircle::through(start, self.middle(arc, own));
            plane.uncover(caps, self.tolerance / radius(&self.atoms[own as usize]), uncovered);
            uncovered.arcs(|part| {
                let [cos, sin] = part.half;
                let ends = if cos <= -1.0 {
                    [arcs[0], arc]
                } else {
                    [-sin, sin].map(|sin| self.nearest_arc(own, plane.direction(part.middle, [cos, sin])))
                };
                pairs.push(ends);
            });
        }
        pairs
    }

    /// Returns the middle of an arc relative to a sphere on which it lies.
    fn middle(&self, arc: u32, sphere: u32) -> [f64; 3] {
        let arc = &self.arcs[arc as usize];
        add(arc.point([1.0, 0.0]), self.between(sphere, arc.spheres[0]))
    }

    /// Returns the arc on a sphere that is nearest to the point in the direction `n`.
    fn nearest_arc(&self, sphere: u32, n: [f64; 3]) -> u32 {
        let r = radius(&self.atoms[sphere as usize]);
        let distance2 = |arc: u32| {
            let of = &self.arcs[arc as usize];
            of.distance2(add(n.map(|c| r * c), self.between(of.spheres[0], sphere)))
        };
        let distances = self.on(sphere).iter().map(|&arc| (distance2(arc), arc));
        distances.min_by(|a, b| a.0.total_cmp(&b.0)).map_or(0, |(_, arc)| arc)
    }

    /// Returns the component of the arc on a sphere that is nearest to the point in the direction `n`.
    pub(super) fn nearest(&self, sphere: u32, n: [f64; 3]) -> u32 {
        self.only(sphere).unwrap_or_else(|| self.of_arc[self.nearest_arc(sphere, n) as usize])
    }

    /// Returns the component of all arcs on a sphere; `None` if there are several or none.
    fn only(&self, sphere: u32) -> Option<u32> {
        let mut of_arcs = self.on(sphere).iter().map(|arc| self.of_arc[*arc as usize]);
        let first = of_arcs.next()?;
        of_arcs.all(|other| other == first).then_some(first)
    }

    /// Returns a component with a face on a sphere; `None` if no part of the sphere is exposed.
    pub(super) fn first(&self, sphere: u32) -> Option<u32> {
        let arc = self.on(sphere).first().map(|arc| self.of_arc[*arc as usize]);
        arc.or_else(|| self.whole.binary_search(&sphere).ok().map(|i| self.first_whole() + to_u32(i)))
    }

    /// Returns the component of the first sphere whose whole surface is exposed.
    pub(super) fn first_whole(&self) -> u32 {
        self.n - to_u32(self.whole.len())
    }

    /// Returns the component of the exposed point of a sphere in the direction `n`, a unit vector; `None` if no part of
    /// the sphere is exposed.
    pub(crate) fn at(&self, sphere: u32, n: [f64; 3]) -> Option<u32> {
        if let Some(only) = self.only(sphere) {
            return Some(only);
        }
        let Some(caps) = self.caps.get(&sphere) else { return self.first(sphere) };
        let arcs = self.on(sphere);
        let (plane, mut uncovered) = (GreatCircle::through(n, self.middle(arcs[0], sphere)), Uncovered::default());
        plane.uncover(caps, self.tolerance / radius(&self.atoms[sphere as usize]), &mut uncovered);
        let (mut deepest, mut found) = (f64::MIN, self.of_arc[arcs[0] as usize]);
        uncovered.arcs(|part| {
            // The part that contains the start of the plane, up to rounding.
            let [cos, sin] = part.half;
            if part.middle[0] - cos > deepest {
                deepest = part.middle[0] - cos;
                found = self.of_arc[self.nearest_arc(sphere, plane.direction(part.middle, [cos, sin])) as usize];
            }
        });
        Some(found)
    }
}

/// Search for the caps of spheres, cell by cell.
struct CapSearch<'a> {
    atoms: &'a [LatticeAtom],
    cells: &'a Cells<'a>,
    overlaps: &'a OverlapCount,
    tolerance: f64,
    control: &'a Control<'a>,
}

impl CapSearch<'_> {
    /// Calls `work` for each `wanted` sphere that has an exposed part or caps, with its caps in the scratch buffers.
    fn for_each_sphere<T: Send>(
        &self,
        wanted: impl Fn(&u32) -> bool + Sync,
        work: impl Fn(u32, &mut CapScratch, &mut Vec<T>, &mut Comparisons<'_>) -> Result<(), SurfaceError> + Sync,
    ) -> Result<Vec<Vec<T>>, SurfaceError> {
        let part = |scratch: &mut CapScratch, number: usize| {
            let mut out = Vec::new();
            let mut comparisons = Comparisons::new(self.overlaps, self.control);
            for cell in (number * CELLS_PER_PART..self.cells.len()).take(CELLS_PER_PART) {
                let mut around = None;
                for &own in self.cells.of(cell).iter().filter(|own| wanted(own)) {
                    self.control.check()?;
                    let around = around.get_or_insert_with(|| self.cells.around(cell));
                    around.neighbours(own, &mut scratch.neighbours);
                    self.overlaps.add(scratch.neighbours.len() as u64)?;
                    let r = radius(&self.atoms[own as usize]);
                    let CapScratch { neighbours, caps, .. } = scratch;
                    if caps::caps(own, r, neighbours, self.tolerance, caps, &mut comparisons)? == Cover::Caps {
                        let before = out.len();
                        work(own, scratch, &mut out, &mut comparisons)?;
                        // Twice for the capacity of a growing list, once for its copy in the result.
                        self.control.memory.grow(3 * (size_of::<T>() * (out.len() - before)) as u64)?;
                    }
                }
            }
            comparisons.count()?;
            Ok(out)
        };
        let n_parts = self.cells.len().div_ceil(CELLS_PER_PART);
        (0..n_parts).into_par_iter().map_init(CapScratch::default, part).collect()
    }
}

/// Adds the arcs of a sphere with spheres of higher numbers.
fn arcs_of(
    atoms: &[LatticeAtom],
    own: u32,
    scratch: &mut CapScratch,
    tolerance: f64,
    arcs: &mut Vec<Arc>,
    comparisons: &mut Comparisons<'_>,
) -> Result<(), SurfaceError> {
    let CapScratch { caps, uncovered, .. } = scratch;
    let r = radius(&atoms[own as usize]);
    for cap in caps.iter().filter(|cap| cap.index > own) {
        let circle = Circle::new(r, cap);
        circle.uncover(cap, caps, tolerance / r, uncovered, comparisons)?;
        uncovered.arcs(|arc| {
            let along = |[x, y]: [f64; 2]| std::array::from_fn(|k| x * circle.first[k] + y * circle.second[k]);
            let [x, y] = arc.middle;
            arcs.push(Arc {
                spheres: [own, cap.index],
                centre: circle.centre,
                axis: circle.axis,
                middle: along([x, y]),
                side: along([-y, x]),
                radius: circle.radius,
                half: arc.half,
            });
        });
    }
    Ok(())
}

/// Joins the sets of arcs that end at the same vertex.
fn join_ends(
    atoms: &[LatticeAtom],
    arcs: &[Arc],
    spacing: f64,
    sets: &mut UnionFind,
    control: &Control<'_>,
) -> Result<(), SurfaceError> {
    /// Arcs between two checks of the cancellation flag: a few milliseconds.
    const PER_CHECK: usize = 1 << 14;
    const NONE: u32 = u32::MAX;
    let (reach, same, side) = (JOIN / spacing, SAME / spacing, 8.0 * JOIN / spacing);
    // Cells hold lists of vertices: the first one of each cell, and the next one of each vertex.
    let mut cells: FxHashMap<[i32; 3], u32> = FxHashMap::default();
    let mut vertices: Vec<([f64; 3], u32, u32)> = Vec::new();
    let _memory = control.reserve(4 * size_of::<([f64; 3], u32, u32)>() as u64 * arcs.len() as u64)?;
    let cell = |x: [f64; 3]| x.map(|c| to_i32((c / side).floor()));
    for (n, arc) in (0_u32..).zip(arcs) {
        control.check_every(n as usize, PER_CHECK)?;
        let atom = &atoms[arc.spheres[0] as usize];
        let [from, to, _] = arc.points();
        for end in [from, to] {
            let x = add(atom.centre(), end);
            let ([lx, ly, lz], [hx, hy, hz]) = (cell(x.map(|c| c - reach)), cell(x.map(|c| c + reach)));
            let mut nearest = f64::MAX;
            let around = (lx..=hx).flat_map(|x| (ly..=hy).flat_map(move |y| (lz..=hz).map(move |z| [x, y, z])));
            for near in around {
                let mut next = cells.get(&near).copied().unwrap_or(NONE);
                while let Some(&(other, of, after)) = vertices.get(next as usize) {
                    let distance2 = squared_distance(x, other);
                    if distance2 <= reach * reach {
                        sets.union(n, of);
                        nearest = nearest.min(distance2);
                    }
                    next = after;
                }
            }
            if nearest > same * same {
                let first = cells.entry(cell(x)).or_insert(NONE);
                vertices.push((x, n, std::mem::replace(first, to_u32(vertices.len()))));
            }
        }
    }
    Ok(())
}
