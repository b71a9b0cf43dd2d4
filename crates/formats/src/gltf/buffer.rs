//! Bytes of the buffer: rows of its columns. Each row has a fixed offset, so rows can be written in any order to an
//! output with random access.

use std::io::{self, Write};

use molmesh_surface::{Mesh, MeshPart, Vertices};

use super::layout::{ATOM_BYTES, AtomType, BufferLayout, IndexType, ROTATION_BYTES, TRANSLATION_BYTES};
use crate::block::{convert_words, write_rows};
use crate::{Packing, Step, quantize};

/// Consecutive rows of one column of a mesh.
#[derive(Debug, Clone, Copy)]
pub(super) enum ColumnRows<'a> {
    /// Positions relative to the mesh's centre, Å.
    Positions(&'a [[f32; 3]]),
    /// Positions relative to the mesh's centre, in steps.
    QuantizedPositions(&'a [[i16; 4]]),
    /// Unit normals.
    Normals(&'a [[f32; 3]]),
    /// Unit normals, in units of 1/127.
    QuantizedNormals(&'a [[i8; 4]]),
    /// Colours: sRGB and alpha.
    Colors(&'a [[u8; 4]]),
    /// Atom indices.
    Atoms(&'a [u32]),
    /// Translations of instances, Å.
    Translations(&'a [[f32; 3]]),
    /// Rotations of instances: unit quaternions.
    Rotations(&'a [[f32; 4]]),
    /// Vertex indices, and the vertex that has index 0 in the file.
    Triangles(&'a [[u32; 3]], u32),
}

impl<'a> ColumnRows<'a> {
    /// Returns the columns of a part, each with the index of its first row in the mesh.
    pub(super) fn of_part(part: &MeshPart<'a>) -> [(u64, Self); 3] {
        let (positions, normals) = match part.vertices {
            Vertices::Single { positions, normals } => (Self::Positions(positions), Self::Normals(normals)),
            Vertices::Quantized { positions, normals, .. } => {
                (Self::QuantizedPositions(positions), Self::QuantizedNormals(normals))
            }
        };
        let [vertex, triangle] = [part.first_vertex as u64, part.first_triangle as u64];
        [(vertex, positions), (vertex, normals), (triangle, Self::Triangles(part.triangles, 0))]
    }

    /// Returns the chunks of the columns of a mesh in the order of the layout, each with the index of its first row.
    fn of_mesh(mesh: &'a Mesh) -> Vec<(u64, Self)> {
        let mut all = Vec::new();
        if let Some(quantized) = &mesh.quantized {
            append(&mut all, quantized.positions.pieces(), Self::QuantizedPositions);
            append(&mut all, quantized.normals.pieces(), Self::QuantizedNormals);
        } else {
            append(&mut all, mesh.positions.pieces(), Self::Positions);
            append(&mut all, mesh.normals.pieces(), Self::Normals);
        }
        if let Some(colors) = &mesh.colors {
            append(&mut all, colors.pieces(), Self::Colors);
        }
        if let Some(atoms) = &mesh.atom_ids {
            append(&mut all, atoms.pieces(), Self::Atoms);
        }
        if let Some(placements) = &mesh.placements {
            append(&mut all, placements.translations.pieces(), Self::Translations);
            append(&mut all, placements.rotations.pieces(), Self::Rotations);
        }
        if mesh.parts.is_empty() {
            append(&mut all, mesh.triangles.pieces(), |rows| Self::Triangles(rows, 0));
        }
        for part in &mesh.parts {
            // The layout ensures that indices fit 32 bits.
            let first = u32::try_from(part.vertices.start).unwrap_or(u32::MAX);
            let rows = Self::Triangles(&mesh.triangles[part.triangles.clone()], first);
            all.push((part.triangles.start as u64, rows));
        }
        all
    }

    /// Returns the byte offset of these rows in the buffer; `None` if the layout lacks the column. `first` is the index
    /// of the first row in the mesh.
    pub(super) fn offset(self, layout: &BufferLayout, first: u64) -> Option<u64> {
        let packing = layout.storage.packing;
        let (span, row_bytes) = match self {
            Self::Positions(_) | Self::QuantizedPositions(_) => (layout.positions, packing.position_bytes()),
            Self::Normals(_) | Self::QuantizedNormals(_) => (layout.normals?, packing.normal_bytes()),
            Self::Colors(_) => (layout.colors?, packing.color_bytes()),
            Self::Atoms(_) => (layout.atoms?.1, ATOM_BYTES),
            Self::Translations(_) => (layout.placements?[0], TRANSLATION_BYTES),
            Self::Rotations(_) => (layout.placements?[1], ROTATION_BYTES),
            Self::Triangles(..) => (layout.indices.1, 3 * layout.indices.0.bytes()),
        };
        Some(span.offset + row_bytes * first)
    }

    /// Writes these rows in the types of the layout.
    pub(super) fn write(self, layout: &BufferLayout, out: &mut dyn Write) -> io::Result<()> {
        match (self, layout.storage.packing) {
            (Self::QuantizedPositions(rows), _) => write_rows(out, rows),
            (Self::QuantizedNormals(rows), _) => write_rows(out, rows),
            (Self::Positions(rows) | Self::Normals(rows), Packing::Full) => write_rows(out, rows),
            (Self::Positions(rows), Packing::Quantized(step)) => convert_words(out, rows, |row| {
                let [x, y, z] = step.position(row).map(i16::to_le_bytes);
                [x[0], x[1], y[0], y[1], z[0], z[1], 0, 0]
            }),
            (Self::Normals(rows), Packing::Quantized(_)) => convert_words(out, rows, |row| {
                let [x, y, z] = quantize::normal(row).map(|v| v.to_le_bytes()[0]);
                [x, y, z, 0]
            }),
            (Self::Colors(rows), Packing::Full) => {
                let linear = linear_of_srgb().map(|level| f32::from(level) / 65_535.0);
                convert_words(out, rows, |[r, g, b, a]| {
                    let [r, g, b] = [r, g, b].map(|byte| linear[usize::from(byte)]);
                    bytemuck::cast::<_, [u8; 16]>([r, g, b, f32::from(a) / 255.0].map(f32::to_le_bytes))
                })
            }
            (Self::Colors(rows), Packing::Quantized(_)) => {
                let linear = linear_of_srgb();
                convert_words(out, rows, |[r, g, b, a]| {
                    // 255 · 257 = 65,535
                    let [r, g, b] = [r, g, b].map(|byte| linear[usize::from(byte)]);
                    bytemuck::cast::<_, [u8; 8]>([r, g, b, 257 * u16::from(a)].map(u16::to_le_bytes))
                })
            }
            (Self::Atoms(rows), _) => match layout.atoms {
                Some((AtomType::F32, _)) => convert_words(out, rows, exact_f32_bytes),
                // A small 32-bit integer, low byte first, is a 16-bit integer and two zero bytes.
                _ => write_rows(out, rows),
            },
            (Self::Translations(rows), packing) => {
                // The scale of the node applies to translations as well.
                let scale = packing.step().map_or(1.0, Step::length);
                convert_words(out, rows, |row| bytemuck::cast::<_, [u8; 12]>(row.map(|v| (v / scale).to_le_bytes())))
            }
            (Self::Rotations(rows), _) => write_rows(out, rows),
            (Self::Triangles(rows, first), _) => write_indices(out, layout.indices.0, rows.as_flattened(), first),
        }
    }
}

/// Appends the chunks of a column.
fn append<'a, T>(
    all: &mut Vec<(u64, ColumnRows<'a>)>,
    chunks: impl Iterator<Item = &'a [T]>,
    rows: fn(&'a [T]) -> ColumnRows<'a>,
) {
    let mut first = 0;
    for chunk in chunks {
        all.push((first, rows(chunk)));
        first += chunk.len() as u64;
    }
}

/// Writes the buffer of `mesh` in order: `layout.len` bytes.
pub(super) fn write_buffer(mesh: &Mesh, layout: &BufferLayout, out: &mut dyn Write) -> io::Result<()> {
    let columns = ColumnRows::of_mesh(mesh).into_iter().filter(|(first, rows)| rows.offset(layout, *first).is_some());
    columns.map(|(_, rows)| rows).try_for_each(|rows| rows.write(layout, out))
}

/// Writes indices, counted from `first`, in the type of the layout.
fn write_indices(out: &mut dyn Write, index_type: IndexType, indices: &[u32], first: u32) -> io::Result<()> {
    // The check before writing ensures that no index is lower than `first`.
    let bytes = |index: u32| index.wrapping_sub(first).to_le_bytes();
    match index_type {
        IndexType::U8 => convert_words(out, indices, |index| [bytes(index)[0]]),
        IndexType::U16 => convert_words(out, indices, |index| {
            let [low, high, ..] = bytes(index);
            [low, high]
        }),
        IndexType::U32 if first > 0 => convert_words(out, indices, bytes),
        IndexType::U32 => write_rows(out, indices),
    }
}

#[expect(clippy::cast_precision_loss, reason = "the layout takes floats only where they are exact")]
fn exact_f32_bytes(value: u32) -> [u8; 4] {
    (value as f32).to_le_bytes()
}

/// Returns 16 bits of linear light for each byte of sRGB (transfer function of IEC 61966-2-1). glTF multiplies linear
/// colours; 8 bits would merge dark tones.
#[expect(
    clippy::cast_precision_loss,
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "0 to 255, and 0 to 65,535 after rounding"
)]
#[must_use]
pub fn linear_of_srgb() -> [u16; 256] {
    std::array::from_fn(|byte| {
        let s = byte as f64 / 255.0;
        let linear = if s <= 0.04045 { s / 12.92 } else { ((s + 0.055) / 1.055).powf(2.4) };
        (linear * 65_535.0).round() as u16
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colours_become_linear_light() {
        let table = linear_of_srgb();
        // Values of the standard's formula.
        assert_eq!([0, 1, 10, 128, 188, 255].map(|i: usize| table[i]), [0, 20, 199, 14_146, 32_957, 65_535]);
        assert!(table.is_sorted_by(|a, b| a < b), "no two levels are merged");
    }

    #[test]
    fn atoms_as_floats_are_exact_to_their_limit() {
        for value in [0, 65_536, 16_777_215, 16_777_216] {
            assert_eq!(f32::from_le_bytes(exact_f32_bytes(value)).to_string(), value.to_string());
        }
    }
}
