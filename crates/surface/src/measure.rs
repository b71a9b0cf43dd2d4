//! Measures of a mesh (area, volume, components) and the validation that it is closed.

use super::control::Control;
use super::error::SurfaceError;
use super::mesh::Mesh;
use super::sums::edge_shares;
use super::topology::{self, Topology};
use super::union_find::UnionFind;
use super::vector::{area_vector, length};
use crate::named;

/// Method of validating closedness and manifoldness.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Validation {
    /// A 64-bit checksum over the directed edges of the index buffer. Opposite directions cancel, so a mesh that is not
    /// closed and consistently wound leaves a remainder, with a probability of error of 2⁻⁶⁴. For meshes of a backend,
    /// the case table, which the tests verify, then ensures that no edge is used more than twice.
    #[default]
    Checksum,
    /// A check of every edge, and of the fan of triangles around every vertex, for any mesh. Takes about three times as
    /// long as meshing.
    Exact,
}

named!(Validation, Checksum => "checksum", Exact => "exact");

/// One connected component of a mesh.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Component {
    /// Its triangles.
    pub triangles: u64,
    /// Its vertices.
    pub vertices: u64,
    /// Area, Å².
    pub area: f64,
    /// Signed volume, Å³: positive for an outer shell, negative for a void.
    pub volume: f64,
    /// First moment of the enclosed volume about the mesh's centre, Å⁴; signed like the volume.
    pub moment: [f64; 3],
}

impl Component {
    /// Centroid of the enclosed volume, relative to the mesh's centre, Å. Not finite if the volume is 0.
    #[must_use]
    pub fn centroid(&self) -> [f64; 3] {
        self.moment.map(|moment| moment / self.volume)
    }
}

/// Measures of a mesh.
#[derive(Debug, Clone, PartialEq)]
pub struct Measures {
    /// Total area, Å².
    pub area: f64,
    /// Enclosed volume, Å³: the sum of the components' signed volumes.
    pub volume: f64,
    /// V − E + F.
    pub euler: i64,
    /// True if every edge is used as often in one direction as in the other.
    pub closed: bool,
    /// True if neighbouring triangles wind the same way: no directed edge is used twice.
    pub oriented: bool,
    /// True if every edge has exactly two triangles and the triangles around every vertex form one closed fan.
    pub manifold: bool,
    /// Validation method of the last three fields.
    pub validation: Validation,
    /// Connected components, largest area first.
    pub components: Vec<Component>,
}

impl Measures {
    /// Measures `mesh` with its vertices as stored, including rounding, on one thread. Used if the backend has not
    /// measured the mesh.
    ///
    /// # Errors
    /// [`SurfaceError::Cancelled`].
    pub fn of(mesh: &Mesh, validation: Validation, control: &Control<'_>) -> Result<Self, SurfaceError> {
        control.check()?;
        let labels = control.reserve(2 * size_of::<u32>() as u64 * mesh.n_vertices() as u64)?;
        let (mut components, _) = components_of(mesh, control)?;
        components.retain(|component| component.triangles > 0);
        drop(labels);
        let size = [components.iter().map(|c| c.vertices).sum(), mesh.n_triangles() as u64];
        let (mut checksum, mut degenerate) = (0_u64, false);
        for chunk in mesh.triangles.chunks(TRIANGLES_PER_CHECK) {
            control.check()?;
            let (shares, twice) = edge_shares(chunk);
            checksum = checksum.wrapping_add(shares);
            degenerate |= twice;
        }
        if checksum == 0 && !degenerate {
            return Self::balanced(components, size).validated(validation, &mesh.triangles, control);
        }
        let topology = topology::check(&mesh.triangles, control)?;
        let topology = match validation {
            Validation::Exact => topology,
            Validation::Checksum => Topology { closed: false, oriented: false, manifold: false, ..topology },
        };
        Ok(Self::new(components, size, topology, validation))
    }

    /// Measures a part of a closed manifold mesh, with `boundary` edges where it was cut. The topology follows from the
    /// numbers of vertices, triangles and these edges.
    ///
    /// # Errors
    /// [`SurfaceError::Memory`], [`SurfaceError::Cancelled`].
    pub fn of_part(mesh: &Mesh, boundary: usize, control: &Control<'_>) -> Result<Self, SurfaceError> {
        let _labels = control.reserve(2 * size_of::<u32>() as u64 * mesh.n_vertices() as u64)?;
        let (components, _) = components_of(mesh, control)?;
        let (vertices, triangles) = (mesh.n_vertices() as u64, mesh.n_triangles() as u64);
        let topology = Topology::of_part(triangles, boundary as u64);
        Ok(Self::new(components, [vertices, triangles], topology, Validation::Checksum))
    }

    /// Returns the measures of a mesh of `triangles` with the result of `validation`.
    ///
    /// # Errors
    /// [`SurfaceError::Cancelled`].
    pub fn validated(
        self,
        validation: Validation,
        triangles: &[[u32; 3]],
        control: &Control<'_>,
    ) -> Result<Self, SurfaceError> {
        if validation == self.validation {
            return Ok(self);
        }
        let size = [self.components.iter().map(|c| c.vertices).sum(), triangles.len() as u64];
        Ok(Self::new(self.components, size, topology::check(triangles, control)?, validation))
    }

    /// Joins the measures of meshes that share no vertex. All components must be relative to the same centre. Returns
    /// `None` if there are no meshes.
    #[must_use]
    pub fn joined(meshes: Vec<Self>) -> Option<Self> {
        let mut all = meshes.into_iter().reduce(|mut all, next| {
            all.euler += next.euler;
            all.closed &= next.closed;
            all.oriented &= next.oriented;
            all.manifold &= next.manifold;
            all.components.extend(next.components);
            all
        })?;
        all.components.sort_by(|a, b| b.area.total_cmp(&a.area));
        all.area = all.components.iter().map(|c| c.area).sum();
        all.volume = all.components.iter().map(|c| c.volume).sum();
        Some(all)
    }

    /// Returns the measures of a mesh of these components and numbers of vertices and triangles. The checksum of its
    /// directed edges is zero, and triangles use every vertex.
    pub(super) fn balanced(components: Vec<Component>, size: [u64; 2]) -> Self {
        Self::new(components, size, Topology::of_closed(size[1]), Validation::Checksum)
    }

    fn new(
        mut components: Vec<Component>,
        [vertices, faces]: [u64; 2],
        topology: Topology,
        validation: Validation,
    ) -> Self {
        components.sort_by(|a, b| b.area.total_cmp(&a.area));
        let Topology { edges, closed, oriented, manifold } = topology;
        Self {
            // An empty sum is −0.
            area: components.iter().map(|c| c.area).sum::<f64>() + 0.0,
            volume: components.iter().map(|c| c.volume).sum::<f64>() + 0.0,
            euler: (vertices + faces).cast_signed() - edges.cast_signed(),
            closed,
            oriented,
            manifold,
            validation,
            components,
        }
    }
}

/// Triangles between two checks of the cancellation flag: a fraction of a millisecond.
const TRIANGLES_PER_CHECK: usize = 1 << 14;

/// Returns the connected components of `mesh`, in double precision, and the component of each vertex. A vertex without
/// triangles is a component of its own. The caller has reserved eight bytes for each vertex.
pub(super) fn components_of(mesh: &Mesh, control: &Control<'_>) -> Result<(Vec<Component>, Vec<u32>), SurfaceError> {
    let mut joined = UnionFind::new(mesh.n_vertices());
    for chunk in mesh.triangles.chunks(TRIANGLES_PER_CHECK) {
        control.check()?;
        for &[a, b, c] in chunk {
            joined.union(a, b);
            joined.union(b, c);
        }
    }
    let mut of_vertex = Vec::new();
    let mut components = vec![Component::default(); joined.number_sets(&mut of_vertex) as usize];
    for component in &of_vertex {
        components[*component as usize].vertices += 1;
    }
    let position = mesh.relative_positions();
    for chunk in mesh.triangles.chunks(TRIANGLES_PER_CHECK) {
        control.check()?;
        for triangle in chunk {
            let corners = triangle.map(|v| position(v as usize).map(f64::from));
            components[of_vertex[triangle[0] as usize] as usize].add(corners);
        }
    }
    Ok((components, of_vertex))
}

impl Component {
    /// Moves the component by `shift`, Å.
    pub fn shift(&mut self, shift: [f64; 3]) {
        (0..3).for_each(|k| self.moment[k] += self.volume * shift[k]);
    }

    /// Adds a triangle. By the divergence theorem, its contribution to the volume's moment along an axis is the
    /// integral of half the squared coordinate times the normal.
    pub fn add(&mut self, [a, b, c]: [[f64; 3]; 3]) {
        let n = area_vector([a, b, c]);
        self.triangles += 1;
        self.area += 0.5 * length(n);
        for (k, n) in n.into_iter().enumerate() {
            let [a, b, c] = [a[k], b[k], c[k]];
            self.volume += a * n / 6.0;
            self.moment[k] += n * (a * (a + b + c) + b * (b + c) + c * c) / 24.0;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A tetrahedron with corner vertices from `first` on, wound outwards.
    fn tetrahedron(mesh: &mut Mesh, at: [f32; 3], flip: bool) {
        let first = u32::try_from(mesh.n_vertices()).unwrap();
        let corners = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        let placed = corners.map(|c: [f32; 3]| [c[0] + at[0], c[1] + at[1], c[2] + at[2]]);
        mesh.positions = mesh.positions.iter().copied().chain(placed).collect();
        mesh.normals = mesh.positions.iter().map(|_| [0.0, 0.0, 1.0]).collect();
        let faces = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]].map(|t: [u32; 3]| t.map(|v| v + first));
        let faces = faces.map(|[a, b, c]| if flip { [a, c, b] } else { [a, b, c] });
        mesh.triangles = mesh.triangles.iter().copied().chain(faces).collect();
    }

    fn both(mesh: &Mesh) -> [Measures; 2] {
        [Validation::Checksum, Validation::Exact]
            .map(|validation| Measures::of(mesh, validation, &Control::default()).unwrap())
    }

    #[test]
    fn a_tetrahedron_and_a_void() {
        let mut mesh = Mesh::default();
        tetrahedron(&mut mesh, [10.0, -3.0, 7.0], false);
        tetrahedron(&mut mesh, [0.0; 3], true);
        for m in both(&mesh) {
            assert!(m.closed && m.oriented && m.manifold, "{m:?}");
            assert_eq!((m.euler, m.components.len()), (4, 2));
            let area = 1.5 + 3.0_f64.sqrt() / 2.0;
            assert!((m.area - 2.0 * area).abs() < 1e-6 && m.volume.abs() < 1e-6, "{m:?}");
            let volumes: Vec<f64> = m.components.iter().map(|c| (c.volume * 6.0).round()).collect();
            assert!(volumes.contains(&1.0) && volumes.contains(&-1.0), "{m:?}");
            assert!(m.components.iter().all(|c| c.vertices == 4 && c.triangles == 4));
            for component in &m.components {
                // A tetrahedron's centroid is the mean of its corners.
                let at = if component.volume > 0.0 { [10.25, -2.75, 7.25] } else { [0.25; 3] };
                let off = (0..3).map(|k| (component.centroid()[k] - at[k]).abs()).fold(0.0, f64::max);
                assert!(off < 1e-4, "{component:?}");
            }
        }
    }

    #[test]
    fn both_validations_detect_defects() {
        let mut whole = Mesh::default();
        tetrahedron(&mut whole, [0.0; 3], false);
        let mut hole = whole.clone();
        hole.triangles = whole.triangles[..3].to_vec().into();
        let mut flipped = whole.clone();
        flipped.triangles[0].swap(0, 1);
        let mut collapsed = whole.clone();
        collapsed.triangles[3] = [1, 1, 3];
        for (what, mesh) in [("hole", hole), ("flipped", flipped), ("collapsed", collapsed)] {
            for m in both(&mesh) {
                assert!(!(m.manifold || m.closed && m.oriented), "{what}: {m:?}");
            }
        }
    }

    #[test]
    fn a_shared_edge_and_a_shared_vertex_are_not_manifold() {
        let mut mesh = Mesh::default();
        tetrahedron(&mut mesh, [0.0; 3], false);
        tetrahedron(&mut mesh, [-1.0; 3], true);
        let [_, apart] = both(&mesh);
        assert!(apart.manifold);
        for shared in [&[(4, 0)][..], &[(4, 0), (5, 1)]] {
            let mut joined = mesh.clone();
            for t in joined.triangles.iter_mut() {
                for v in t {
                    *v = shared.iter().find(|(from, _)| from == v).map_or(*v, |(_, to)| *to);
                }
            }
            let m = Measures::of(&joined, Validation::Exact, &Control::default()).unwrap();
            assert!(m.closed && !m.manifold && m.components.len() == 1, "{shared:?} {m:?}");
        }
    }

    #[test]
    fn an_empty_mesh_has_no_measures() {
        for m in both(&Mesh::default()) {
            assert_eq!((m.euler, m.components.len(), m.area), (0, 0, 0.0));
        }
    }
}
