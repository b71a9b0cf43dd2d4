//! Connected components of a mesh's vertices.
//!
//! Each part of the mesh labels its own vertices in one pass over its triangles, in parallel and in cache: a vertex
//! takes the lowest label among its triangle's corners, a triangle without any label starts a new one, and labels
//! that meet are made equal in a small table. Edges that leave a part are joined afterwards.

use rayon::prelude::*;
use rustc_hash::FxHashMap;

use super::lattice::to_u32;
use super::measure::Component;
use super::mesh::Mesh;

/// No label yet. Vertices that no triangle uses keep it.
const NONE: u32 = u32::MAX;

/// The component of every vertex.
pub(super) struct Labels {
    /// A label per vertex.
    of_vertex: Vec<u32>,
    /// The component that a label stands for: the lowest label in it.
    equal: Vec<u32>,
}

/// The vertices and triangles of one part of a mesh.
struct Part<'a> {
    first: u32,
    labels: &'a mut [u32],
    triangles: &'a [[u32; 3]],
}

/// What a part hands on: its table of equal labels, and the edges that leave it.
#[derive(Default)]
struct Joined {
    equal: Vec<u32>,
    leaving: Vec<[u32; 2]>,
}

impl Labels {
    /// Labels the components of `mesh`.
    pub(super) fn of(mesh: &Mesh) -> Self {
        let mut of_vertex = vec![NONE; mesh.n_vertices()];
        let joined: Vec<Joined> = split(mesh, &mut of_vertex).into_par_iter().map(Part::label).collect();
        // Labels are counted per part: number them through.
        let mut equal = Vec::new();
        let mut offsets = Vec::with_capacity(joined.len());
        for part in &joined {
            let offset = to_u32(equal.len());
            offsets.push(offset);
            equal.extend(part.equal.iter().map(|label| label + offset));
        }
        split(mesh, &mut of_vertex).into_par_iter().zip(&offsets).for_each(|(part, offset)| {
            part.labels.iter_mut().filter(|label| **label != NONE).for_each(|label| *label += offset);
        });
        let mut last = [NONE; 2];
        for &[a, b] in joined.iter().flat_map(|part| &part.leaving) {
            // Neighbouring triangles mostly ask for what the last one asked for.
            let pair = [of_vertex[a as usize], of_vertex[b as usize]];
            if pair != last {
                join(&mut equal, pair[0], pair[1]);
                last = pair;
            }
        }
        for label in 0..equal.len() {
            // Ascending, so the lower label that this one equals is final already.
            equal[label] = equal[equal[label] as usize];
        }
        Self { of_vertex, equal }
    }

    /// The component of a vertex that some triangle uses.
    #[inline(always)]
    pub(super) fn component(&self, v: u32) -> u32 {
        self.equal[self.of_vertex[v as usize] as usize]
    }

    /// Adds the vertices of each component; returns how many belong to any triangle.
    pub(super) fn count_vertices(&self, components: &mut FxHashMap<u32, Component>) -> u64 {
        let mut counts = vec![0_u64; self.equal.len()];
        for run in self.of_vertex.chunk_by(|a, b| a == b) {
            if let Some(&component) = self.equal.get(run[0] as usize) {
                counts[component as usize] += run.len() as u64;
            }
        }
        for (label, &n) in (0_u32..).zip(&counts).filter(|(_, n)| **n > 0) {
            if let Some(component) = components.get_mut(&label) {
                component.vertices += n;
            }
        }
        counts.iter().sum()
    }
}

/// Makes two labels equal. Entries only ever get lower.
fn join(equal: &mut [u32], a: u32, b: u32) {
    let find = |mut label: u32| {
        while equal[label as usize] != label {
            label = equal[label as usize];
        }
        label
    };
    let (root_a, root_b) = (find(a), find(b));
    let low = root_a.min(root_b);
    for label in [a, b, root_a, root_b] {
        equal[label as usize] = low;
    }
}

/// Cuts the labels and the triangles into the mesh's parts; one part where it names none.
fn split<'a>(mesh: &'a Mesh, labels: &'a mut [u32]) -> Vec<Part<'a>> {
    let whole = [(0, 0)];
    let starts = if mesh.parts.is_empty() { &whole[..] } else { &mesh.parts[..] };
    let mut rest = labels;
    let mut parts = Vec::with_capacity(starts.len());
    for (i, &(first, triangle)) in starts.iter().enumerate() {
        let (v, t) = starts.get(i + 1).copied().unwrap_or((mesh.n_vertices(), mesh.n_triangles()));
        let (own, after) = std::mem::take(&mut rest).split_at_mut(v - first);
        rest = after;
        let first = u32::try_from(first).unwrap_or(u32::MAX);
        parts.push(Part { first, labels: own, triangles: &mesh.triangles[triangle..t] });
    }
    parts
}

impl Part<'_> {
    /// Labels the part's own vertices, with labels from 0.
    fn label(self) -> Joined {
        let mut joined = Joined::default();
        let (first, labels) = (self.first, self.labels);
        for &[a, b, c] in self.triangles {
            let own = |v: u32| labels.get(v.wrapping_sub(first) as usize).copied();
            let (i, j, k) = (own(a), own(b), own(c));
            if [i, j, k].contains(&None) {
                joined.leaving.extend([[a, b], [b, c]]);
            }
            // A foreign corner counts as one without a label here.
            let (i, j, k) = (i.unwrap_or(NONE), j.unwrap_or(NONE), k.unwrap_or(NONE));
            let mut low = i.min(j).min(k);
            if low == NONE {
                low = to_u32(joined.equal.len());
                joined.equal.push(low);
            }
            for v in [a, b, c] {
                if let Some(label) = labels.get_mut(v.wrapping_sub(first) as usize) {
                    *label = low;
                }
            }
            let differs = |label: u32| label != low && label != NONE;
            for label in [i, j, k] {
                if differs(label) {
                    join(&mut joined.equal, label, low);
                }
            }
        }
        joined
    }
}
