//! Writers of columns as little-endian bytes: copied from memory if the layouts agree, otherwise converted through one
//! reused block of fixed-size records.

use std::io::{self, Write};
use std::ops::Range;

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

/// Writes rows of three floats.
pub(super) fn write_floats(out: &mut dyn Write, rows: &[[f32; 3]]) -> io::Result<()> {
    if cfg!(target_endian = "little") {
        out.write_all(bytemuck::must_cast_slice(rows))
    } else {
        convert_words(out, rows.as_flattened(), f32::to_le_bytes)
    }
}

/// Writes rows of four 16-bit integers.
pub(super) fn write_shorts(out: &mut dyn Write, rows: &[[i16; 4]]) -> io::Result<()> {
    if cfg!(target_endian = "little") {
        out.write_all(bytemuck::must_cast_slice(rows))
    } else {
        convert_words(out, rows.as_flattened(), i16::to_le_bytes)
    }
}

/// Writes rows of four 8-bit integers.
pub(super) fn write_bytes(out: &mut dyn Write, rows: &[[i8; 4]]) -> io::Result<()> {
    out.write_all(bytemuck::must_cast_slice(rows))
}

/// Writes integers.
pub(super) fn write_integers(out: &mut dyn Write, values: &[u32]) -> io::Result<()> {
    if cfg!(target_endian = "little") {
        out.write_all(bytemuck::must_cast_slice(values))
    } else {
        convert_words(out, values, u32::to_le_bytes)
    }
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
pub(super) struct Place {
    /// Centre of the mesh, Å.
    pub(super) centre: [f64; 3],
    /// Scale factor: file units per Å.
    pub(super) scale: f64,
}

impl Place {
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
    fn the_conversion_for_other_byte_orders_writes_the_same_bytes() {
        let rows: Vec<[f32; 3]> = (0..60_000_u16).map(|i| [f32::from(i), -1.5, 1e-3 * f32::from(i)]).collect();
        let (mut direct, mut converted) = (Vec::new(), Vec::new());
        write_floats(&mut direct, &rows).unwrap();
        convert_words(&mut converted, rows.as_flattened(), f32::to_le_bytes).unwrap();
        assert_eq!(direct, converted);
        assert_eq!(&direct[12..16], &1.0_f32.to_le_bytes());
        let rows: Vec<[i16; 4]> = (0..30_000).map(|i| [i, -i, 1, 0]).collect();
        let (mut direct, mut converted) = (Vec::new(), Vec::new());
        write_shorts(&mut direct, &rows).unwrap();
        convert_words(&mut converted, rows.as_flattened(), i16::to_le_bytes).unwrap();
        assert_eq!(direct, converted);
        assert_eq!(&direct[8..12], &[1, 0, 0xff, 0xff]);
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
