//! Writers of columns. They copy a column from memory if the layouts agree, and otherwise convert it through one reused
//! block of fixed-size records.

use std::io::{self, Write};
use std::ops::Range;

use molmesh_surface::Mesh;

use super::Units;

/// Bytes converted per write call: fits the second-level cache and makes the cost of a call negligible.
pub(super) const BLOCK_BYTES: usize = 512 << 10;

/// Writes `n` records of `N` bytes; `fill` converts a range of rows into as many records.
pub(super) fn write_records<const N: usize>(
    out: &mut dyn Write,
    n: usize,
    fill: impl Fn(Range<usize>, &mut [[u8; N]]),
) -> io::Result<()> {
    let per_block = (BLOCK_BYTES / N).min(n);
    let mut block = vec![[0_u8; N]; per_block];
    let mut start = 0;
    while start < n {
        let end = n.min(start + per_block);
        let records = &mut block[..end - start];
        fill(start..end, records);
        out.write_all(records.as_flattened())?;
        start = end;
    }
    Ok(())
}

/// Writes rows of numbers as they are in memory.
pub(super) fn write_rows<T: bytemuck::NoUninit>(out: &mut dyn Write, rows: &[T]) -> io::Result<()> {
    const { assert!(cfg!(target_endian = "little"), "files are little-endian") };
    out.write_all(bytemuck::must_cast_slice(rows))
}

/// Writes one record of `N` bytes per value.
pub(super) fn convert_words<const N: usize, T: Copy>(
    out: &mut dyn Write,
    values: &[T],
    bytes_of: impl Fn(T) -> [u8; N],
) -> io::Result<()> {
    write_records(out, values.len(), |range, records| {
        for (record, &value) in records.iter_mut().zip(&values[range]) {
            *record = bytes_of(value);
        }
    })
}

/// Transformation of a vertex into the coordinates of the structure file.
#[derive(Debug, Clone, Copy)]
pub(super) struct Placement {
    /// Centre of the mesh, Å.
    centre: [f64; 3],
    /// Scale factor: file units per Å.
    scale: f64,
}

impl Placement {
    /// Returns the transformation of vertices of `mesh` to coordinates in `units`.
    pub(super) fn new(mesh: &Mesh, units: Units) -> Self {
        Self { centre: mesh.centre, scale: units.scale() }
    }

    /// Returns a vertex in the structure file's coordinates and the file's units: computed in double precision and
    /// rounded once.
    #[inline]
    #[expect(clippy::cast_possible_truncation, reason = "the file formats require f32")]
    pub(super) fn absolute(self, position: [f32; 3]) -> [f32; 3] {
        std::array::from_fn(|k| ((self.centre[k] + f64::from(position[k])) * self.scale) as f32)
    }
}

/// Writes three floats to `bytes`.
#[inline]
pub(super) fn put_floats(bytes: &mut [u8; 12], row: [f32; 3]) {
    let (words, _) = bytes.as_chunks_mut::<4>();
    for (word, value) in words.iter_mut().zip(row) {
        *word = value.to_le_bytes();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_are_little_endian() {
        let mut bytes = Vec::new();
        write_rows(&mut bytes, &[[1.0_f32, -1.5, 0.0]]).unwrap();
        write_rows(&mut bytes, &[[1_i16, -2, 1, 0]]).unwrap();
        assert_eq!(bytes, [0, 0, 0x80, 0x3f, 0, 0, 0xc0, 0xbf, 0, 0, 0, 0, 1, 0, 0xfe, 0xff, 1, 0, 0, 0]);
    }

    #[test]
    fn records_cross_blocks_without_gap_or_overlap() {
        for n in [0, 1, BLOCK_BYTES / 5 - 1, BLOCK_BYTES / 5, BLOCK_BYTES / 5 + 1, BLOCK_BYTES] {
            let mut bytes = Vec::new();
            write_records::<5>(&mut bytes, n, |range, records| {
                for (i, record) in range.zip(records) {
                    record[..4].copy_from_slice(&u32::try_from(i).unwrap().to_le_bytes());
                }
            })
            .unwrap();
            assert_eq!(bytes.len(), 5 * n);
            for (i, record) in bytes.as_chunks::<5>().0.iter().enumerate() {
                assert_eq!(u32::from_le_bytes(record[..4].try_into().unwrap()) as usize, i);
            }
        }
    }
}
