//! Connected components of a mesh's vertices.
//!
//! Each part of the mesh labels its own vertices in one pass over its triangles, in parallel and in cache: a vertex
//! takes the lowest label among its triangle's corners, a triangle without any label starts a new one, and labels
//! that meet are made equal in a small table. Edges that leave a part are joined afterwards.

use rayon::prelude::*;

use super::column::Column;
use super::lattice::to_u32;
use super::measure::Component;
use super::mesh::Mesh;
use super::sums::NONE;

/// The component of every vertex.
pub(super) struct Labels {
    /// A label per vertex; vertices that no triangle uses have none.
    of_vertex: Column<u32>,
    /// The component that a label stands for: the lowest label in it.
    equal: Vec<u32>,
}

/// The vertices and triangles of one part of a mesh.
pub(super) struct Part<'a> {
    /// The part's first vertex.
    pub(super) first: u32,
    /// Labels of its vertices.
    pub(super) labels: &'a mut [u32],
    /// Its triangles.
    pub(super) triangles: &'a [[u32; 3]],
}

/// What a part hands on.
#[derive(Default)]
pub(super) struct Joined {
    /// Per label of the part, from 0, a label that it equals: itself or a lower one.
    pub(super) equal: Vec<u32>,
    /// The edges that leave the part.
    leaving: Vec<[u32; 2]>,
}

impl Labels {
    /// Joins the parts of `mesh`, whose vertices have been labelled part by part.
    pub(super) fn join(mesh: &Mesh, mut of_vertex: Column<u32>, joined: &[Joined]) -> Self {
        // Labels are counted per part: number them through.
        let mut equal = Vec::new();
        let mut offsets = Vec::with_capacity(joined.len());
        for part in joined {
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

    /// The label of a vertex that some triangle uses. Several labels may stand for one component.
    pub(super) fn label(&self, v: u32) -> u32 {
        self.of_vertex[v as usize]
    }

    /// The component that a label stands for.
    pub(super) fn component_of(&self, label: u32) -> u32 {
        self.equal[label as usize]
    }

    /// One entry per label, with the vertices of the component that it stands for counted at the component's own.
    pub(super) fn count_vertices(&self) -> Vec<Component> {
        let mut components = vec![Component::default(); self.equal.len()];
        for run in self.of_vertex.chunk_by(|a, b| a == b) {
            if let Some(&component) = self.equal.get(run[0] as usize) {
                components[component as usize].vertices += run.len() as u64;
            }
        }
        components
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
pub(super) fn split<'a>(mesh: &'a Mesh, labels: &'a mut [u32]) -> Vec<Part<'a>> {
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
    pub(super) fn label(&mut self) -> Joined {
        let mut joined = Joined::default();
        let (first, labels) = (self.first, &mut *self.labels);
        labels.fill(NONE);
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
            // Selections, not branches: whether a corner has a label yet is a coin toss.
            let known = |label: u32| if label == NONE { low } else { label };
            if known(i).max(known(j)).max(known(k)) != low {
                for label in [i, j, k].map(known) {
                    join(&mut joined.equal, label, low);
                }
            }
        }
        joined
    }
}
