//! Stage `classify`: inside bits, crossing edges with their parameters, active cells with their cases.
//!
//! The inside bits of a brick are eight 64-bit words, one per z layer, bit `8·y + x`. Every test on them is a shift.

use std::num::NonZeroU16;

use super::edge::Edge;
use super::field::BrickField;
use crate::cases::CASES;
use crate::lattice::{BRICK_POINTS, EDGE_MARGIN, to_u32};
use crate::simd::dispatched;
use crate::sphere_union::Feature;

/// Inside bits of a brick: word z, bit `8·y + x`.
pub(super) type Inside = [u64; 8];

/// Brick that the surface intersects, in the form that the later stages need.
#[derive(Debug, Clone)]
pub(super) struct SurfaceBrick {
    /// Slot within the tile (0 to 8 per axis; 8 never occurs here).
    pub(super) slot: u16,
    /// Crossing edges: word `3·z + axis`, bit `8·y + x` of the owning grid point. Vertices are numbered in this order.
    pub(super) crossing: [u64; 24],
    /// Vertices of the brick before each word.
    pub(super) before: [u16; 24],
    /// Active cells: word z, bit `8·y + x`.
    pub(super) active: [u64; 8],
    /// First vertex, counted within the tile.
    pub(super) vertex: u32,
    /// First triangle, counted within the tile.
    pub(super) triangle: u32,
    /// First case of the brick in the tile's list.
    pub(super) case: u32,
    /// Candidates in the tile's list of kept candidates.
    pub(super) candidates: [u32; 2],
    /// Number of connected sheets of surface within the brick; `None` if a cell holds two of them, which requires a
    /// search.
    pub(super) n_sheets: Option<NonZeroU16>,
    /// The cells of each sheet in the tile's list, if there are several sheets.
    pub(super) sheets: u32,
}

/// Results of `classify` for the bricks of one tile, appended brick by brick.
#[derive(Debug, Default)]
pub(super) struct ClassifiedBricks {
    /// Bricks with surface, by slot.
    pub(super) bricks: Vec<SurfaceBrick>,
    /// Parameter of each vertex along its edge, from the owning grid point, in vertex order. `interpolate` refines it.
    pub(super) t: Vec<f32>,
    /// Edge of each vertex, in vertex order.
    pub(super) edges: Vec<Edge>,
    /// Case of each active cell, in cell order.
    pub(super) cases: Vec<u8>,
    /// Vertices so far.
    pub(super) vertices: u32,
    /// Triangles so far.
    pub(super) triangles: u32,
    /// Candidates of the bricks with surface.
    pub(super) candidates: Vec<u32>,
    /// For surfaces of spheres, the part of their boundary that is nearest to each vertex.
    pub(super) features: Vec<Feature>,
    /// For surfaces of spheres, the sphere that is nearest to each vertex, if requested.
    pub(super) spheres: Vec<u32>,
    /// Cells of the sheets of bricks with several: word z, bit `8·y + x`.
    pub(super) sheets: Vec<[u64; 8]>,
}

/// Upper bound of the mean numbers of vertices and of active cells per brick in reach of an atom. Structures rarely
/// exceed it.
const USUAL: usize = 96;

/// Counts of a tile before a brick.
#[derive(Debug, Clone, Copy)]
pub(super) struct CountsBefore {
    pub(super) vertices: usize,
    pub(super) triangles: usize,
    pub(super) cases: usize,
}

/// Fields of a brick and of its seven neighbours towards +x, +y, +z: index bit 0 is x, 1 y, 2 z.
#[derive(Clone, Copy)]
pub(super) struct Neighbourhood<'a> {
    /// Inside bits of the brick and its neighbours.
    pub(super) inside: [&'a Inside; 8],
    /// Densities of the brick and its neighbours.
    pub(super) fields: [&'a BrickField; 8],
}

dispatched! {
/// Inside bits of a brick.
pub(super) fn inside_bits(field: &BrickField, iso: f32) -> Inside {
    // Written as loops: a closure does not always compile to the same instructions.
    let mut inside = [0; 8];
    for (z, word) in inside.iter_mut().enumerate() {
        for y in 0..8 {
            let mut row = 0_u64;
            for x in 0..8 {
                row |= u64::from(field[z * 64 + y * 8 + x] >= iso) << x;
            }
            *word |= row << (8 * y);
        }
    }
    inside
}
}

/// Inside bits shifted by one grid point along the axes of `shift` (bit 0 x, 1 y, 2 z), for layer z.
#[inline(always)]
fn shifted(inside: &[&Inside; 8], shift: usize, z: usize) -> u64 {
    const FIRST_COLUMN: u64 = 0x0101_0101_0101_0101;
    let (z, far_z) = if shift & 4 != 0 { ((z + 1) % 8, if z == 7 { 4 } else { 0 }) } else { (z, 0) };
    let word = |near: usize| inside[near | far_z][z];
    let along_x = |near: usize| (word(near) >> 1 & !(FIRST_COLUMN << 7)) | (word(near | 1) & FIRST_COLUMN) << 7;
    match shift & 3 {
        0 => word(0),
        1 => along_x(0),
        2 => word(0) >> 8 | word(2) << 56,
        _ => along_x(0) >> 8 | along_x(2) << 56,
    }
}

impl ClassifiedBricks {
    /// Returns an empty value with capacity for `bricks` bricks, usually more than required: growing would copy, and
    /// untouched memory costs nothing.
    pub(super) fn with_capacity(bricks: usize) -> Self {
        Self {
            bricks: Vec::with_capacity(bricks),
            t: Vec::with_capacity(USUAL * bricks),
            edges: Vec::with_capacity(USUAL * bricks),
            cases: Vec::with_capacity(USUAL * bricks),
            candidates: Vec::with_capacity(USUAL * bricks),
            ..Self::default()
        }
    }

    /// Returns the memory of the records, bytes.
    pub(super) fn bytes(&self) -> u64 {
        let of_vertex = size_of::<f32>() + size_of::<Edge>();
        let of_bricks = size_of::<SurfaceBrick>() * self.bricks.len() + size_of::<u32>() * self.candidates.len();
        let of_features = size_of::<Feature>() * self.features.len() + size_of::<u32>() * self.spheres.len();
        let of_cells = self.cases.len() + size_of::<[u64; 8]>() * self.sheets.len();
        (of_bricks + of_vertex * self.t.len() + of_features + of_cells) as u64
    }

    /// Returns the memory that is set aside for the records of `bricks` bricks in reach of an atom, bytes, without
    /// candidates.
    pub(super) const fn max_bytes(bricks: usize) -> u64 {
        let of_vertex = size_of::<f32>() + size_of::<Edge>() + size_of::<u8>();
        (bricks * (size_of::<SurfaceBrick>() + USUAL * of_vertex)) as u64
    }

    /// Returns unused memory to the allocator, for the next tile.
    pub(super) fn shrink_to_fit(&mut self) {
        self.bricks.shrink_to_fit();
        self.t.shrink_to_fit();
        self.edges.shrink_to_fit();
        self.cases.shrink_to_fit();
        self.candidates.shrink_to_fit();
        self.features.shrink_to_fit();
        self.spheres.shrink_to_fit();
        self.sheets.shrink_to_fit();
    }

    /// Appends the results of the bricks that follow.
    pub(super) fn append(&mut self, next: &Self) {
        let (vertex, triangle) = (self.vertices, self.triangles);
        let [case, candidate, sheet] = [self.cases.len(), self.candidates.len(), self.sheets.len()].map(to_u32);
        self.bricks.extend(next.bricks.iter().map(|brick| SurfaceBrick {
            vertex: brick.vertex + vertex,
            triangle: brick.triangle + triangle,
            case: brick.case + case,
            candidates: brick.candidates.map(|at| at + candidate),
            sheets: brick.sheets + sheet,
            ..*brick
        }));
        self.t.extend_from_slice(&next.t);
        self.edges.extend_from_slice(&next.edges);
        self.cases.extend_from_slice(&next.cases);
        self.candidates.extend_from_slice(&next.candidates);
        self.features.extend_from_slice(&next.features);
        self.spheres.extend_from_slice(&next.spheres);
        self.sheets.extend_from_slice(&next.sheets);
        self.vertices += next.vertices;
        self.triangles += next.triangles;
    }

    /// Returns the vertices, triangles and cases of the tile before brick `i`; the totals if `i` is the number of
    /// bricks.
    pub(super) fn before(&self, i: usize) -> CountsBefore {
        let all = CountsBefore {
            vertices: self.vertices as usize,
            triangles: self.triangles as usize,
            cases: self.cases.len(),
        };
        self.bricks.get(i).map_or(all, |brick| CountsBefore {
            vertices: brick.vertex as usize,
            triangles: brick.triangle as usize,
            cases: brick.case as usize,
        })
    }

    /// Classifies one brick and appends its results. Returns its index if it holds any surface.
    pub(super) fn add(&mut self, slot: usize, around: &Neighbourhood<'_>, iso: f32, candidates: &[u32]) -> Option<u16> {
        let n = self.bricks.len();
        classify(self, slot, around, iso, candidates);
        // A tile has 512 bricks.
        (self.bricks.len() > n).then(|| u16::try_from(n).ok()).flatten()
    }
}

dispatched! {
fn classify(found: &mut ClassifiedBricks, slot: usize, around: &Neighbourhood<'_>, iso: f32, candidates: &[u32]) {
    let corners: [[u64; 8]; 8] = std::array::from_fn(|z| std::array::from_fn(|c| shifted(&around.inside, c, z)));
    let active = corners.map(|c| c.iter().fold(0, |m, w| m | w) & !c.iter().fold(u64::MAX, |m, w| m & w));
    if active == [0; 8] {
        return;
    }
    let mut brick = SurfaceBrick {
        slot: u16::try_from(slot).unwrap_or(u16::MAX),
        crossing: [0; 24],
        before: [0; 24],
        active,
        vertex: found.vertices,
        triangle: found.triangles,
        case: to_u32(found.cases.len()),
        candidates: [to_u32(found.candidates.len()), to_u32(found.candidates.len() + candidates.len())],
        n_sheets: None,
        sheets: to_u32(found.sheets.len()),
    };
    found.candidates.extend_from_slice(candidates);
    let mut n = 0_u16;
    for (w, (crossing, before)) in brick.crossing.iter_mut().zip(&mut brick.before).enumerate() {
        let layer = &corners[w / 3];
        (*crossing, *before) = (layer[0] ^ layer[1 << (w % 3)], n);
        n += ones(*crossing);
    }
    edge_parameters(&brick.crossing, n, &around.fields, iso, found);
    let mut torn = false;
    for (layer, &cells) in corners.iter().zip(&active) {
        let mut cells = cells;
        while cells != 0 {
            let bit = cells.trailing_zeros();
            cells &= cells - 1;
            let case = (0..8).fold(0, |case, c| case | u8::from(layer[c] >> bit & 1 == 1) << c);
            found.cases.push(case);
            found.triangles += u32::from(CASES.count[usize::from(case)]);
            torn |= CASES.loops[usize::from(case)] > 1;
        }
    }
    found.vertices += u32::from(n);
    if !torn {
        brick.n_sheets = sheets(&active, &links(&corners), &mut found.sheets);
    }
    found.bricks.push(brick);
}
}

/// Returns the cells whose surface continues in the previous cell along x, y and z, if that is in the brick.
#[inline(always)]
fn links(corners: &[[u64; 8]; 8]) -> [[u64; 8]; 3] {
    const FIRST: [u64; 2] = [0x0101_0101_0101_0101, 0xff];
    let crossed = |layer: &[u64; 8], c: [usize; 4]| {
        (layer[c[0]] | layer[c[1]] | layer[c[2]] | layer[c[3]])
            & !(layer[c[0]] & layer[c[1]] & layer[c[2]] & layer[c[3]])
    };
    let z = |z: usize| if z == 0 { 0 } else { crossed(&corners[z], [0, 1, 2, 3]) };
    [
        std::array::from_fn(|z| crossed(&corners[z], [0, 2, 4, 6]) & !FIRST[0]),
        std::array::from_fn(|z| crossed(&corners[z], [0, 1, 4, 5]) & !FIRST[1]),
        std::array::from_fn(z),
    ]
}

/// Counts the sheets of a brick with one sheet per cell: cells are connected if the surface crosses the face between
/// them. Appends the cells of each sheet if there are several.
#[inline(always)]
fn sheets(active: &[u64; 8], links: &[[u64; 8]; 3], found: &mut Vec<[u64; 8]>) -> Option<NonZeroU16> {
    let mut left = *active;
    let mut n = 0;
    let first = found.len();
    while let Some(z) = left.iter().position(|&word| word != 0) {
        let mut sheet = [0; 8];
        sheet[z] = left[z] & left[z].wrapping_neg();
        flood(&mut sheet, links);
        for (left, taken) in left.iter_mut().zip(&sheet) {
            *left &= !taken;
        }
        n += 1;
        if n > 1 || left != [0; 8] {
            found.push(sheet);
        }
    }
    debug_assert!(n == 1 || found.len() == first + usize::from(n), "one mask per sheet, none for a single sheet");
    NonZeroU16::new(n)
}

/// Adds every cell to `sheet` that its links reach.
#[inline(always)]
fn flood(sheet: &mut [u64; 8], links: &[[u64; 8]; 3]) {
    let [lx, ly, lz] = links;
    loop {
        let before = *sheet;
        for z in 0..8 {
            let s = sheet[z];
            sheet[z] = s | (s << 1 & lx[z]) | (s & lx[z]) >> 1 | (s << 8 & ly[z]) | (s & ly[z]) >> 8;
        }
        let s = *sheet;
        for z in 0..7 {
            sheet[z] |= s[z + 1] & lz[z + 1];
        }
        for z in 1..8 {
            sheet[z] |= s[z - 1] & lz[z];
        }
        if *sheet == before {
            return;
        }
    }
}

/// Set bits of a word.
#[inline(always)]
fn ones(word: u64) -> u16 {
    // At most 64.
    u16::try_from(word.count_ones()).unwrap_or_default()
}

/// Returns the values at both ends of an edge.
#[inline(always)]
pub(super) fn at_ends(edge: Edge, fields: &[&BrickField; 8]) -> [f32; 2] {
    const STEP: [usize; 3] = [1, 8, 64];
    let (axis, at) = (usize::from(edge.axis()), edge.grid_point());
    let coordinate = [at & 7, at >> 3 & 7, at >> 6][axis];
    let (far, next) = if coordinate == 7 { (1 << axis, at - 7 * STEP[axis]) } else { (0, at + STEP[axis]) };
    [fields[0][at & 511], fields[far][next & 511]]
}

/// Computes the crossing edges, and the point along each at which the density is `iso`, by linear interpolation.
#[inline(always)]
fn edge_parameters(crossing: &[u64; 24], n: u16, fields: &[&BrickField; 8], iso: f32, found: &mut ClassifiedBricks) {
    let ClassifiedBricks { t, edges, .. } = found;
    let first = t.len();
    // Collects F(owner) − iso in `t` first, so that the divisions below are vectorized.
    t.resize(first + usize::from(n), 0.0);
    edges.resize(first + usize::from(n), Edge::default());
    // F(owner) − F(other end).
    let mut drop = [0.0; 3 * BRICK_POINTS];
    let mut ends = t[first..].iter_mut().zip(&mut drop).zip(&mut edges[first..]);
    for (w, &word) in crossing.iter().enumerate() {
        let (z, axis) = (w / 3, w % 3);
        let mut left = word;
        while left != 0 {
            let bit = left.trailing_zeros() as usize;
            left &= left - 1;
            let own = Edge::new(z, bit, axis);
            let [f0, f1] = at_ends(own, fields);
            if let Some(((above, drop), edge)) = ends.next() {
                (*above, *drop, *edge) = (f0 - iso, f0 - f1, own.starting_inside(f0 >= iso));
            }
        }
    }
    for (t, drop) in t[first..].iter_mut().zip(&drop) {
        *t = (*t / drop).clamp(EDGE_MARGIN, 1.0 - EDGE_MARGIN);
    }
}
