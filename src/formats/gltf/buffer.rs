//! The bytes of the buffer, in the order of the layout.

use std::io::{self, Write};

use super::layout::{AtomType, IndexType, Layout};
use crate::formats::block::{convert_words, write_rows};
use crate::formats::{Packing, quantize};
use crate::surface::Mesh;

/// Writes the buffer of `mesh`: `layout.len` bytes.
pub(super) fn write_buffer(mesh: &Mesh, layout: &Layout, out: &mut dyn Write) -> io::Result<()> {
    // Writes each chunk of a column directly, without joining the chunks.
    let packing = layout.storage.packing;
    let normals = layout.normals.is_some();
    if let Some(quantized) = &mesh.quantized {
        quantized.positions.pieces().try_for_each(|rows| write_rows(out, rows))?;
        if normals {
            quantized.normals.pieces().try_for_each(|rows| write_rows(out, rows))?;
        }
    } else {
        mesh.positions.pieces().try_for_each(|rows| write_positions(out, packing, rows))?;
        if normals {
            mesh.normals.pieces().try_for_each(|rows| write_normals(out, packing, rows))?;
        }
    }
    if let Some(colors) = &mesh.colors {
        let linear = linear_of_srgb();
        convert_words(out, &colors[..], |[r, g, b, a]| {
            [linear[usize::from(r)], linear[usize::from(g)], linear[usize::from(b)], a]
        })?;
    }
    if let (Some(ids), Some((atom_type, _))) = (&mesh.atom_ids, layout.atoms) {
        match atom_type {
            // A small 32-bit integer, low byte first, is a 16-bit integer and two zero bytes.
            AtomType::U16 => ids.pieces().try_for_each(|rows| write_rows(out, rows))?,
            AtomType::F32 => ids.pieces().try_for_each(|rows| convert_words(out, rows, exact_f32_bytes))?,
        }
    }
    mesh.triangles.pieces().try_for_each(|rows| write_indices(out, layout.indices.0, rows.as_flattened()))
}

/// Writes positions relative to the mesh's centre, Å, in the packing of the layout.
pub(super) fn write_positions(out: &mut dyn Write, packing: Packing, rows: &[[f32; 3]]) -> io::Result<()> {
    match packing {
        Packing::Full => write_rows(out, rows),
        Packing::Quantized(step) => convert_words(out, rows, |row| {
            let [x, y, z] = step.position(row).map(i16::to_le_bytes);
            [x[0], x[1], y[0], y[1], z[0], z[1], 0, 0]
        }),
    }
}

/// Writes unit normals in the packing of the layout.
pub(super) fn write_normals(out: &mut dyn Write, packing: Packing, rows: &[[f32; 3]]) -> io::Result<()> {
    match packing {
        Packing::Full => write_rows(out, rows),
        Packing::Quantized(_) => convert_words(out, rows, |row| {
            let [x, y, z] = quantize::normal(row).map(|v| v.to_le_bytes()[0]);
            [x, y, z, 0]
        }),
    }
}

/// Writes indices in the type of the layout.
pub(super) fn write_indices(out: &mut dyn Write, index_type: IndexType, indices: &[u32]) -> io::Result<()> {
    match index_type {
        IndexType::U8 => convert_words(out, indices, |index| [index.to_le_bytes()[0]]),
        IndexType::U16 => convert_words(out, indices, |index| {
            let [low, high, ..] = index.to_le_bytes();
            [low, high]
        }),
        IndexType::U32 => write_rows(out, indices),
    }
}

#[expect(clippy::cast_precision_loss, reason = "the layout takes floats only where they are exact")]
fn exact_f32_bytes(value: u32) -> [u8; 4] {
    (value as f32).to_le_bytes()
}

/// sRGB to linear light, both as bytes: glTF multiplies linear colours (transfer function of IEC 61966-2-1).
#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a number from 0 to 255 that was rounded")]
fn linear_of_srgb() -> [u8; 256] {
    std::array::from_fn(|byte| {
        let s = f64::from(u8::try_from(byte).unwrap_or(u8::MAX)) / 255.0;
        let linear = if s <= 0.04045 { s / 12.92 } else { ((s + 0.055) / 1.055).powf(2.4) };
        (linear * 255.0).round() as u8
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colours_become_linear_light() {
        let table = linear_of_srgb();
        assert_eq!((table[0], table[128], table[188], table[255]), (0, 55, 128, 255));
        assert!(table.is_sorted());
    }

    #[test]
    fn atoms_as_floats_are_exact_to_their_limit() {
        for value in [0, 65_536, 16_777_215, 16_777_216] {
            assert_eq!(f32::from_le_bytes(exact_f32_bytes(value)).to_string(), value.to_string());
        }
    }
}
