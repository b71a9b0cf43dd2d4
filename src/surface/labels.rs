//! Connected components of a mesh's vertices.
//!
//! Each part of the mesh labels its own vertices in one pass over its triangles, in parallel and in cache: a vertex
//! takes the lowest label of its triangle's corners, a triangle without a label starts a new one, and labels that meet
//! are united. Edges that leave a part are joined afterwards.

use rayon::prelude::*;

use super::column::Column;
use super::control::Control;
use super::error::SurfaceError;
use super::measure::Component;
use super::mesh::Mesh;
use super::sums::NONE;
use super::union_find::UnionFind;

/// Triangles between two checks of the cancellation flag: a fraction of a millisecond.
pub(super) const TRIANGLES_PER_CHECK: usize = 1 << 16;

/// Component of every vertex.
pub(super) struct Labels {
    /// Label per vertex; [`NONE`] for vertices that no triangle uses.
    of_vertex: Column<u32>,
    /// Lowest label of the component, by label.
    component_of: Vec<u32>,
}

/// Vertices and triangles of one part of a mesh.
pub(super) struct Part<'a> {
    /// First vertex of the part.
    pub(super) first: u32,
    /// Labels of its vertices.
    pub(super) labels: &'a mut [u32],
    /// Its triangles.
    pub(super) triangles: &'a [[u32; 3]],
}

/// Labels of a part and the edges that connect it to others.
#[derive(Default)]
pub(super) struct PartLabels {
    /// Labels of the part, from 0; those of one component are united.
    pub(super) equal: UnionFind,
    /// Edges that leave the part.
    leaving: Vec<[u32; 2]>,
}

impl Labels {
    /// Joins the parts of `mesh`, whose vertices have been labelled part by part.
    pub(super) fn join(mesh: &Mesh, mut of_vertex: Column<u32>, joined: &[PartLabels]) -> Self {
        // Labels start at 0 in every part.
        let mut equal = UnionFind::default();
        let offsets: Vec<u32> = joined.iter().map(|part| equal.append(&part.equal)).collect();
        split(mesh, &mut of_vertex).into_par_iter().zip(&offsets).for_each(|(part, offset)| {
            part.labels.iter_mut().filter(|label| **label != NONE).for_each(|label| *label += offset);
        });
        let mut last = [NONE; 2];
        for &[a, b] in joined.iter().flat_map(|part| &part.leaving) {
            // Consecutive triangles mostly have the same labels.
            let pair = [of_vertex[a as usize], of_vertex[b as usize]];
            if pair != last {
                equal.union(pair[0], pair[1]);
                last = pair;
            }
        }
        Self { of_vertex, component_of: equal.into_representatives() }
    }

    /// The label of a vertex that some triangle uses. Several labels may stand for one component.
    pub(super) fn label(&self, v: u32) -> u32 {
        self.of_vertex[v as usize]
    }

    /// Component of a label.
    pub(super) fn component_of(&self, label: u32) -> u32 {
        self.component_of[label as usize]
    }

    /// One entry per label; the vertices of a component are counted at its lowest label.
    pub(super) fn count_vertices(&self) -> Vec<Component> {
        let mut components = vec![Component::default(); self.component_of.len()];
        for run in self.of_vertex.chunk_by(|a, b| a == b) {
            if let Some(&component) = self.component_of.get(run[0] as usize) {
                components[component as usize].vertices += run.len() as u64;
            }
        }
        components
    }
}

/// Splits the labels and the triangles into the mesh's parts, or one part if it has none.
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
    /// Labels the part's own vertices, with labels from 0. Fails if the run is cancelled.
    pub(super) fn label(&mut self, control: &Control<'_>) -> Result<PartLabels, SurfaceError> {
        let mut joined = PartLabels::default();
        let (first, labels) = (self.first, &mut *self.labels);
        labels.fill(NONE);
        for (n, &[a, b, c]) in self.triangles.iter().enumerate() {
            if n % TRIANGLES_PER_CHECK == 0 {
                control.check()?;
            }
            let own = |v: u32| labels.get(v.wrapping_sub(first) as usize).copied();
            let (i, j, k) = (own(a), own(b), own(c));
            if [i, j, k].contains(&None) {
                joined.leaving.extend([[a, b], [b, c]]);
            }
            // A corner in another part counts as unlabelled here.
            let (i, j, k) = (i.unwrap_or(NONE), j.unwrap_or(NONE), k.unwrap_or(NONE));
            let mut low = i.min(j).min(k);
            if low == NONE {
                low = joined.equal.push();
            }
            for v in [a, b, c] {
                if let Some(label) = labels.get_mut(v.wrapping_sub(first) as usize) {
                    *label = low;
                }
            }
            // Selections instead of branches, which would be unpredictable.
            let known = |label: u32| if label == NONE { low } else { label };
            if known(i).max(known(j)).max(known(k)) != low {
                for label in [i, j, k].map(known) {
                    joined.equal.union(label, low);
                }
            }
        }
        Ok(joined)
    }
}
