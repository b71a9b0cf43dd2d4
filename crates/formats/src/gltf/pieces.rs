//! Pieces of a mesh that are compressed independently, in parallel (`EXT_meshopt_compression`).
//!
//! A piece is a run of triangles of one part, with its own copy of every vertex that they use. The division depends on
//! the numbers of triangles only, so the file is the same on any number of threads. Vertices at seams are stored once
//! for each piece that uses them, with equal positions: merging vertices by position closes the mesh.

use std::ops::Range;

use rayon::prelude::*;
use serde_json::{Value, json};

use gltf_json::Root;
use gltf_json::mesh::Primitive;
use molmesh_surface::quantize::Step;
use molmesh_surface::vector::joined_bounds;
use molmesh_surface::{Mesh, Vertices};

use super::buffer::ColumnRows;
use super::document::{BufferColumns, buffer, material};
use super::layout::{AtomType, BufferLayout, BufferSpan, Drawn, IndexType, ROTATION_BYTES, TRANSLATION_BYTES};
use super::numbering::Numbering;
use crate::check::{Summary, check, in_range};
use crate::{Format, FormatError, Normals, Packing, Storage};

/// Extension of compressed buffer views. Marked as required, because the file has no uncompressed copy.
const MESHOPT: &str = "EXT_meshopt_compression";

/// Maximum number of triangles of a piece. The vertices of such a piece, about half as many and 3 % for its seams,
/// fit 16-bit indices. Smaller pieces have more seams; larger ones leave cores idle.
const PIECE_TRIANGLES: usize = 96 << 10;

/// Version of the vertex codec: the one that the extension defines. The newer one is for `KHR_meshopt_compression`.
const VERTEX_CODEC: i32 = 0;

/// Level of the vertex codec; this version has no others.
const LEVEL: i32 = 2;

/// Bits of each of the two numbers of a compressed normal.
const NORMAL_BITS: i32 = 8;

/// Compressed view of the buffer.
#[derive(Debug, Clone, Copy)]
struct Stream {
    /// Range in the data of the piece, bytes.
    start: usize,
    end: usize,
    /// Length of a decoded element, bytes.
    stride: u64,
    /// Number of elements.
    count: usize,
    /// Mode of the extension: `ATTRIBUTES` or `TRIANGLES`.
    mode: &'static str,
    /// Filter of the extension, which the decoder applies.
    filter: Option<&'static str>,
}

/// One compressed piece.
#[derive(Debug, Clone)]
struct Piece {
    /// Index of the part.
    part: usize,
    /// Layout of the decoded piece.
    layout: BufferLayout,
    n_vertices: u64,
    n_triangles: u64,
    /// Lowest and highest position, Å.
    bounds: [[f32; 3]; 2],
    /// Streams in the order of the views: attributes, then indices. Each starts at a multiple of 4.
    streams: Vec<Stream>,
    /// Compressed streams.
    data: Vec<u8>,
}

/// Mesh in compressed pieces.
#[derive(Debug, Clone)]
pub struct Pieces {
    pub(super) storage: Storage,
    pub(super) summary: Summary,
    /// In the order of the buffer.
    all: Vec<Piece>,
    /// Translations and rotations of instances, uncompressed, behind the pieces.
    pub(super) placements: Option<[BufferSpan; 2]>,
}

impl Pieces {
    /// Compresses a mesh with quantized vertices. `bounds` are the lowest and highest position, if known, Å.
    ///
    /// Runs on all threads of the current pool. Calls `grow` with a number of bytes before it allocates them, several
    /// times for each piece, and stops at its first error. Calls `shrink` with bytes that are free again.
    ///
    /// # Errors
    /// Returns a [`FormatError`] of a mesh that the format cannot hold, and the errors of `grow`.
    pub fn new<E: From<FormatError> + Send>(
        mesh: &Mesh,
        storage: impl Into<Storage>,
        bounds: Option<[[f32; 3]; 2]>,
        grow: impl Fn(u64) -> Result<(), E> + Sync,
        shrink: impl Fn(u64) + Sync,
    ) -> Result<Self, E> {
        let storage = storage.into();
        let source = Source::new(mesh, storage)?;
        let summary = check(mesh, Format::Glb, bounds)?;
        in_range(&mesh.triangles, mesh.n_vertices())?;
        let atoms = summary.max_atom.map(AtomType::for_largest).transpose()?;
        let run = |(part, triangles): (usize, Range<usize>)| {
            let rows = &mesh.triangles[triangles];
            let numbering_bytes = Numbering::TRIANGLE_BYTES * rows.len() as u64;
            grow(numbering_bytes)?;
            let numbering = Numbering::new(rows);
            let layout = layout(&numbering, storage, mesh.colors.is_some(), atoms)?;
            // The columns of the piece, their forms in the file, and the outputs of the encoder, each as long as the
            // decoded piece at most. The filter of normals needs 16 bytes of input per vertex.
            let scratch = 3 * layout.len + 16 * numbering.vertices.len() as u64;
            grow(scratch)?;
            let piece = source.compress(part, &numbering, layout)?;
            shrink((numbering_bytes + scratch).saturating_sub(piece.data.len() as u64));
            Ok(piece)
        };
        let pieces = runs(&Drawn::of(mesh, &summary)).into_par_iter().map(run).collect::<Result<Vec<_>, E>>()?;
        let placed = mesh.placements.as_ref().map_or(0, |placements| placements.rotations.len() as u64);
        let placements = (placed > 0).then(|| {
            let offset = pieces.iter().map(|piece| piece.data.len() as u64).sum();
            let translations = BufferSpan { offset, len: TRANSLATION_BYTES * placed };
            [translations, BufferSpan { offset: offset + translations.len, len: ROTATION_BYTES * placed }]
        });
        Ok(Self { storage, summary, all: pieces, placements })
    }

    /// Memory of the pieces, bytes.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        self.all.iter().map(|piece| piece.data.len() as u64).sum()
    }

    /// Returns true if the mesh has no triangles.
    pub(super) fn is_empty(&self) -> bool {
        self.all.is_empty()
    }

    /// Returns the compressed data in the order of the buffer.
    pub(super) fn data(&self) -> impl Iterator<Item = &[u8]> {
        self.all.iter().map(|piece| &piece.data[..])
    }

    /// Returns the length of the buffer, bytes.
    pub(super) fn buffer_bytes(&self) -> u64 {
        self.bytes() + self.placements.map_or(0, |spans| spans.iter().map(|span| span.len).sum())
    }

    /// Returns the layout of the first piece.
    pub(super) fn layout(&self) -> Option<&BufferLayout> {
        self.all.first().map(|piece| &piece.layout)
    }

    /// Adds the buffers, views and accessors of all pieces. Returns the primitives of each part.
    pub(super) fn primitives(&self, root: &mut Root, n_parts: usize, summary: &Summary) -> Vec<Vec<Primitive>> {
        let _compressed = buffer(root, self.buffer_bytes());
        let decoded = buffer(root, self.all.iter().map(Piece::decoded_bytes).sum());
        let material = root.push(material(self.layout().is_some_and(|layout| layout.colors.is_some()), summary));
        let mut primitives = vec![Vec::new(); n_parts];
        let mut offset = 0;
        for piece in &self.all {
            let layout = piece.layout.moved(offset);
            let columns = BufferColumns::new(root, decoded, &layout, true, material);
            let (vertices, triangles) = (0..piece.n_vertices, 0..piece.n_triangles);
            let drawn = Drawn { name: None, vertices, triangles, bounds: piece.bounds, placements: 0..0 };
            primitives[piece.part].push(columns.primitive(root, &layout, &drawn));
            offset += piece.decoded_bytes();
        }
        primitives
    }

    /// Adds the extension to the views and to the second buffer, which exists only after decoding. The first views of
    /// the document are those of the pieces, in the order of their streams.
    pub(super) fn add_extensions(&self, document: &mut Value) {
        let mut start = 0;
        let mut views = 0..;
        for piece in &self.all {
            for (stream, view) in piece.streams.iter().zip(&mut views) {
                let extension = &mut document["bufferViews"][view]["extensions"][MESHOPT];
                *extension = json!({
                    "buffer": 0,
                    "byteOffset": start + stream.start,
                    "byteLength": stream.end - stream.start,
                    "byteStride": stream.stride,
                    "count": stream.count,
                    "mode": stream.mode,
                });
                if let Some(filter) = stream.filter {
                    extension["filter"] = Value::from(filter);
                }
            }
            start += piece.data.len();
        }
        document["buffers"][1]["extensions"] = json!({ MESHOPT: { "fallback": true } });
        for list in ["extensionsUsed", "extensionsRequired"] {
            if let Some(names) = document[list].as_array_mut() {
                names.push(Value::from(MESHOPT));
            }
        }
    }
}

impl Piece {
    /// Returns the length of the decoded piece, padded so that the next one starts at a multiple of 4, bytes.
    fn decoded_bytes(&self) -> u64 {
        self.layout.len.next_multiple_of(4)
    }
}

/// Divides the triangles of each part into runs of almost equal length. Returns each run with the index of its part.
fn runs(drawn: &[Drawn<'_>]) -> Vec<(usize, Range<usize>)> {
    let bound = |row: u64| usize::try_from(row).unwrap_or(usize::MAX);
    let runs = drawn.iter().enumerate().flat_map(|(part, rows)| {
        let (start, end) = (bound(rows.triangles.start), bound(rows.triangles.end));
        let most = (end - start).div_ceil((end - start).div_ceil(PIECE_TRIANGLES).max(1)).max(1);
        (start..end).step_by(most).map(move |first| (part, first..end.min(first + most)))
    });
    runs.collect()
}

/// Returns the layout of a decoded piece.
fn layout(
    numbering: &Numbering,
    storage: Storage,
    colors: bool,
    atoms: Option<AtomType>,
) -> Result<BufferLayout, FormatError> {
    let (n_vertices, n_triangles) = (numbering.vertices.len() as u64, numbering.triangles.len() as u64);
    // The codec has no 8-bit indices.
    let n_indexed = n_vertices.max(1 << 8);
    BufferLayout::new([n_vertices, n_triangles, 0], n_indexed, storage, colors, atoms)
}

/// Columns of the mesh that is compressed.
struct Source<'a> {
    step: Step,
    positions: &'a [[i16; 4]],
    /// `None` for a file without normals.
    normals: Option<&'a [[i8; 4]]>,
    colors: Option<&'a [[u8; 4]]>,
    atoms: Option<&'a [u32]>,
}

impl<'a> Source<'a> {
    fn new(mesh: &'a Mesh, storage: Storage) -> Result<Self, FormatError> {
        let Vertices::Quantized { step, positions, normals } = mesh.vertices() else {
            return Err(FormatError::NotQuantized);
        };
        if storage.packing != Packing::Quantized(step) {
            return Err(FormatError::AlreadyQuantized { step: step.length() });
        }
        let normals = (storage.normals == Normals::Smooth).then_some(normals);
        Ok(Self { step, positions, normals, colors: mesh.colors.as_deref(), atoms: mesh.atom_ids.as_deref() })
    }

    fn compress(&self, part: usize, numbering: &Numbering, layout: BufferLayout) -> Result<Piece, FormatError> {
        let Numbering { vertices, triangles } = numbering;
        // In parallel, because a small mesh is one piece.
        let (shape, rest) = rayon::join(
            || {
                let mut streams = Streams::default();
                let positions = gathered(self.positions, vertices);
                streams.attribute(&positions, None)?;
                if let Some(normals) = self.normals {
                    let rows = gathered(normals, vertices).into_iter().map(|row| row.map(|v| f32::from(v) / 127.0));
                    let rows: Vec<[f32; 4]> = rows.collect();
                    streams.attribute(&meshopt::encode_filter_oct::<i8>(&rows, NORMAL_BITS), Some("OCTAHEDRAL"))?;
                }
                Ok::<_, FormatError>((bounds(&positions), streams))
            },
            || {
                let mut streams = Streams::default();
                if let Some(colors) = self.colors {
                    let bytes = written(ColumnRows::Colors(&gathered(colors, vertices)), &layout)?;
                    streams.attribute(bytes.as_chunks::<8>().0, None)?;
                }
                if let Some(atoms) = self.atoms {
                    let bytes = written(ColumnRows::Atoms(&gathered(atoms, vertices)), &layout)?;
                    streams.attribute(bytes.as_chunks::<4>().0, None)?;
                }
                streams.indices(triangles, vertices.len(), layout.indices.0)?;
                Ok::<_, FormatError>(streams)
            },
        );
        let ([low, high], mut streams) = shape?;
        streams.append(&rest?);
        let Streams { all: streams, mut data } = streams;
        data.shrink_to_fit();
        let (n_vertices, n_triangles) = (vertices.len() as u64, triangles.len() as u64);
        let bounds = [self.step.decoded(low), self.step.decoded(high)];
        Ok(Piece { part, layout, n_vertices, n_triangles, bounds, streams, data })
    }
}

/// Streams of a piece.
#[derive(Default)]
struct Streams {
    all: Vec<Stream>,
    data: Vec<u8>,
}

impl Streams {
    /// Adds a column of the vertices.
    fn attribute<T>(&mut self, rows: &[T], filter: Option<&'static str>) -> Result<(), FormatError> {
        let encoded = meshopt::encode_vertex_buffer_level(rows, LEVEL, Some(VERTEX_CODEC)).map_err(failed)?;
        self.add(&encoded, size_of::<T>() as u64, rows.len(), "ATTRIBUTES", filter);
        Ok(())
    }

    /// Adds the indices.
    fn indices(&mut self, triangles: &[[u32; 3]], n_vertices: usize, index: IndexType) -> Result<(), FormatError> {
        let indices = triangles.as_flattened();
        let encoded = meshopt::encode_index_buffer(indices, n_vertices).map_err(failed)?;
        self.add(&encoded, index.bytes(), indices.len(), "TRIANGLES", None);
        Ok(())
    }

    fn add(&mut self, encoded: &[u8], stride: u64, count: usize, mode: &'static str, filter: Option<&'static str>) {
        let start = self.data.len();
        self.data.extend_from_slice(encoded);
        self.all.push(Stream { start, end: self.data.len(), stride, count, mode, filter });
        self.data.resize(self.data.len().next_multiple_of(4), 0);
    }

    /// Adds the streams of `next`.
    fn append(&mut self, next: &Self) {
        let moved = |at: usize| self.data.len() + at;
        self.all.extend(next.all.iter().map(|s| Stream { start: moved(s.start), end: moved(s.end), ..*s }));
        self.data.extend_from_slice(&next.data);
    }
}

#[expect(clippy::needless_pass_by_value, reason = "the form that `map_err` needs")]
fn failed(error: meshopt::Error) -> FormatError {
    FormatError::Compression { reason: error.to_string() }
}

/// Returns the rows of `vertices`.
fn gathered<T: Copy>(column: &[T], vertices: &[u32]) -> Vec<T> {
    vertices.iter().map(|&vertex| column[vertex as usize]).collect()
}

/// Returns rows as bytes of the file.
fn written(rows: ColumnRows<'_>, layout: &BufferLayout) -> Result<Vec<u8>, FormatError> {
    let mut bytes = Vec::new();
    // Writing to memory cannot fail.
    rows.write(layout, &mut bytes).map_err(|error| FormatError::Compression { reason: error.to_string() })?;
    Ok(bytes)
}

/// Returns the lowest and highest position per axis, in steps.
fn bounds(positions: &[[i16; 4]]) -> [[i16; 3]; 2] {
    let start = [[i16::MAX; 3], [i16::MIN; 3]];
    positions.iter().fold(start, |bounds, [x, y, z, _]| joined_bounds(bounds, [[*x, *y, *z]; 2]))
}
