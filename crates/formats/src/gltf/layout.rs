//! Layout of the buffer of a glTF, computed from counts alone, so that files of any size can be planned.

use std::ops::Range;

use molmesh_surface::{Exceeded, Limit, Mesh};

use crate::check::Summary;
use crate::{FormatError, Storage};

/// Limit up to which every integer is exact in a 32-bit float.
const MAX_EXACT_F32: u32 = 1 << 24;

/// Lengths of the translation and the rotation of an instance.
pub(super) const TRANSLATION_BYTES: u64 = 12;
pub(super) const ROTATION_BYTES: u64 = 16;
/// Length of an atom index in either type.
pub(super) const ATOM_BYTES: u64 = 4;

/// Component type of the indices.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum IndexType {
    U8,
    U16,
    U32,
}

impl IndexType {
    /// Returns the smallest type for the indices of `n_vertices` vertices; `None` beyond 32 bits. The largest value of
    /// each type is the primitive restart index.
    pub(super) fn for_vertices(n_vertices: u64) -> Option<Self> {
        match n_vertices {
            0..=0xff => Some(Self::U8),
            0x100..=0xffff => Some(Self::U16),
            0x1_0000..=0xffff_ffff => Some(Self::U32),
            _ => None,
        }
    }

    pub(super) const fn bytes(self) -> u64 {
        match self {
            Self::U8 => 1,
            Self::U16 => 2,
            Self::U32 => 4,
        }
    }
}

/// Component type of `_ATOM`. glTF has no 32-bit integers as vertex attributes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum AtomType {
    /// 16-bit integers, each followed by two zero bytes: rows of attributes start at multiples of 4.
    U16,
    /// Floats, exact up to 2^24.
    F32,
}

impl AtomType {
    /// Returns the type that holds atom indices up to `max`.
    pub(super) fn for_largest(max: u32) -> Result<Self, FormatError> {
        if u16::try_from(max).is_ok() {
            Ok(Self::U16)
        } else if max <= MAX_EXACT_F32 {
            Ok(Self::F32)
        } else {
            Err(Exceeded::new(Limit::AtomIndex, MAX_EXACT_F32.into()).error())
        }
    }
}

/// A range of the buffer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct BufferSpan {
    /// First byte; a multiple of 4.
    pub(super) offset: u64,
    /// Bytes.
    pub(super) len: u64,
}

/// Rows of the mesh that one primitive draws.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Drawn<'a> {
    /// Name of its node; `None` if the mesh is not divided.
    pub(super) name: Option<&'a str>,
    /// Rows of its vertices.
    pub(super) vertices: Range<u64>,
    /// Rows of its triangles. In the file, their indices count from the first of its vertices.
    pub(super) triangles: Range<u64>,
    /// Lowest and highest relative position per axis, Å.
    pub(super) bounds: [[f32; 3]; 2],
    /// Rows of its placements; empty if it is placed once.
    pub(super) placements: Range<u64>,
}

impl<'a> Drawn<'a> {
    /// Returns the parts that have triangles, or the whole mesh if it is not divided.
    pub(super) fn of(mesh: &'a Mesh, summary: &Summary) -> Vec<Self> {
        if mesh.parts.is_empty() {
            return vec![Self::whole([mesh.n_vertices(), mesh.n_triangles()].map(|n| n as u64), summary)];
        }
        let rows = |range: &Range<usize>| range.start as u64..range.end as u64;
        let parts = mesh.parts.iter().filter(|part| !part.triangles.is_empty()).map(|part| Self {
            name: Some(&part.name),
            vertices: rows(&part.vertices),
            triangles: rows(&part.triangles),
            // Adding zero turns −0 into 0. JSON distinguishes them.
            bounds: part.bounds.map(|row| row.map(|v| v + 0.0)),
            placements: rows(&part.placements),
        });
        parts.collect()
    }

    /// Returns a whole mesh with these numbers of vertices and triangles.
    pub(super) fn whole([n_vertices, n_triangles]: [u64; 2], summary: &Summary) -> Self {
        let (vertices, triangles) = (0..n_vertices, 0..n_triangles);
        Self { name: None, vertices, triangles, bounds: summary.bounds, placements: 0..0 }
    }
}

/// Layout of the buffer: attributes in multiples of four bytes per vertex, placements, then indices, which may end
/// unaligned.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct BufferLayout {
    pub(super) storage: Storage,
    pub(super) positions: BufferSpan,
    pub(super) normals: Option<BufferSpan>,
    pub(super) colors: Option<BufferSpan>,
    pub(super) atoms: Option<(AtomType, BufferSpan)>,
    /// Translations and rotations of instances.
    pub(super) placements: Option<[BufferSpan; 2]>,
    pub(super) indices: (IndexType, BufferSpan),
    /// Length of the whole buffer, bytes.
    pub(super) len: u64,
}

impl BufferLayout {
    /// Returns the layout of `mesh`; `None` if it has no triangles, as glTF has no empty accessors.
    pub(super) fn of(mesh: &Mesh, storage: Storage, summary: &Summary) -> Result<Option<Self>, FormatError> {
        let (n_vertices, n_triangles) = (mesh.n_vertices() as u64, mesh.triangles.len() as u64);
        if n_triangles == 0 {
            return Ok(None);
        }
        let atoms = summary.max_atom.map(AtomType::for_largest).transpose()?;
        // Indices count from the first vertex of a part.
        let most = mesh.parts.iter().map(|part| part.vertices.len() as u64).max();
        let most = most.unwrap_or(n_vertices);
        let placed = mesh.placements.as_ref().map_or(0, |placements| placements.rotations.len() as u64);
        Self::new([n_vertices, n_triangles, placed], most, storage, mesh.colors.is_some(), atoms).map(Some)
    }

    pub(super) fn new(
        [n_vertices, n_triangles, n_placements]: [u64; 3],
        n_indexed: u64,
        storage: Storage,
        colors: bool,
        atoms: Option<AtomType>,
    ) -> Result<Self, FormatError> {
        let error = || Exceeded { actual: Some(n_indexed), ..Exceeded::new(Limit::FileVertices, u32::MAX.into()) };
        let index_type = IndexType::for_vertices(n_indexed).ok_or_else(|| error().error::<FormatError>())?;
        let mut end = 0;
        let mut span = |len: u64| {
            let offset = end;
            end += len;
            BufferSpan { offset, len }
        };
        let positions = span(storage.packing.position_bytes() * n_vertices);
        let normals = storage.normal_bytes().map(|bytes| span(bytes * n_vertices));
        let colors = colors.then(|| span(storage.packing.color_bytes() * n_vertices));
        let atoms = atoms.map(|atom_type| (atom_type, span(ATOM_BYTES * n_vertices)));
        let placements =
            (n_placements > 0).then(|| [TRANSLATION_BYTES, ROTATION_BYTES].map(|of| span(of * n_placements)));
        let indices = (index_type, span(3 * n_triangles * index_type.bytes()));
        Ok(Self { storage, positions, normals, colors, atoms, placements, indices, len: end })
    }

    /// Returns the layout `by` bytes further on in a longer buffer.
    pub(super) fn moved(self, by: u64) -> Self {
        let moved = |span: BufferSpan| BufferSpan { offset: span.offset + by, ..span };
        Self {
            positions: moved(self.positions),
            normals: self.normals.map(moved),
            colors: self.colors.map(moved),
            atoms: self.atoms.map(|(atom_type, span)| (atom_type, moved(span))),
            placements: self.placements.map(|spans| spans.map(moved)),
            indices: (self.indices.0, moved(self.indices.1)),
            ..self
        }
    }

    /// Returns the layout of a mesh without colours and atoms; `None` if it has no triangles.
    pub(super) fn plain(counts: [u64; 2], storage: impl Into<Storage>) -> Result<Option<Self>, FormatError> {
        let [n_vertices, n_triangles] = counts;
        let layout = || Self::new([n_vertices, n_triangles, 0], n_vertices, storage.into(), false, None);
        if n_triangles == 0 { Ok(None) } else { layout().map(Some) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Normals, Packing, Step};

    #[test]
    fn the_restart_value_is_never_an_index() {
        let cases = [
            (3, Some(IndexType::U8)),
            (255, Some(IndexType::U8)),
            (256, Some(IndexType::U16)),
            (65_535, Some(IndexType::U16)),
            (65_536, Some(IndexType::U32)),
            (u64::from(u32::MAX), Some(IndexType::U32)),
            (u64::from(u32::MAX) + 1, None),
        ];
        for (n_vertices, expected) in cases {
            assert_eq!(IndexType::for_vertices(n_vertices), expected, "{n_vertices}");
            if let Some(index_type) = expected {
                assert!(n_vertices - 1 < (1 << (8 * index_type.bytes())) - 1, "{n_vertices}");
            }
        }
        let error = Exceeded { actual: Some(1 << 32), ..Exceeded::new(Limit::FileVertices, u32::MAX.into()) };
        assert_eq!(BufferLayout::plain([1 << 32, 1], Packing::Full).err(), Some(error.error()));
    }

    #[test]
    fn atom_indices_are_exact_or_rejected() {
        assert_eq!(AtomType::for_largest(0), Ok(AtomType::U16));
        assert_eq!(AtomType::for_largest(65_535), Ok(AtomType::U16));
        assert_eq!(AtomType::for_largest(65_536), Ok(AtomType::F32));
        assert_eq!(AtomType::for_largest(16_777_216), Ok(AtomType::F32));
        let error = Exceeded::new(Limit::AtomIndex, 16_777_216).error();
        assert_eq!(AtomType::for_largest(16_777_217), Err(error));
    }

    #[test]
    fn spans_are_aligned_and_follow_each_other() {
        let quantized = Packing::Quantized(Step::covering(1.0));
        let bare = |packing: Packing| Storage { packing, normals: Normals::None, ..Storage::default() };
        for (storage, vertices) in [
            (Packing::Full.into(), 60 + 60 + 80),
            (quantized.into(), 40 + 20 + 40),
            (bare(Packing::Full), 60 + 80),
            (bare(quantized), 40 + 40),
        ] {
            let layout = BufferLayout::new([5, 3, 2], 5, storage, true, Some(AtomType::U16)).unwrap();
            let [translations, rotations] = layout.placements.unwrap();
            let rest = [layout.colors.unwrap(), layout.atoms.unwrap().1, translations, rotations, layout.indices.1];
            let mut end = 0;
            for span in [layout.positions].into_iter().chain(layout.normals).chain(rest) {
                assert_eq!((span.offset, span.offset % 4), (end, 0));
                end += span.len;
            }
            assert_eq!((end, layout.len), (vertices + 20 + 24 + 32 + 9, vertices + 85));
        }
    }
}
