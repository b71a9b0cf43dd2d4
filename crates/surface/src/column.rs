//! Column of a mesh: a slice of plain rows.
//!
//! Large columns are mapped with huge pages if the system has them: for 350 MB, page faults of 4 KiB took half as long
//! as meshing. Without huge pages, a mesh in memory takes up to 17 % more processor time on an idle host; on a busy
//! one, the gain is uncertain. Smaller columns come from the allocator, which reuses their pages: tiles of a tileset
//! take 10 % less time.

use std::fmt;
use std::ops::{Deref, DerefMut, Range};
use std::sync::{Arc, OnceLock};

use bytemuck::Pod;
use memmap2::MmapMut;
use rayon::prelude::*;

/// Size from which a column is mapped, bytes.
const MAP_FROM: usize = 4 << 20;

/// Bytes per copying task.
const COPIED: usize = 4 << 20;

/// Memory with another owner, released with the last reference.
pub type SharedBytes = Arc<dyn AsRef<[u8]> + Send + Sync>;

/// Rows of a mesh; dereferences to a slice. A column in several chunks is copied into one when it is first used as a
/// slice; [`Self::pieces`] returns the chunks without a copy.
pub struct Column<T: Pod>(ColumnStorage<T>);

enum ColumnStorage<T: Pod> {
    Owned(Vec<T>),
    Mapped {
        map: MmapMut,
        bytes: usize,
    },
    Shared {
        owner: SharedBytes,
        bytes: Range<usize>,
    },
    /// In order; no chunk is itself in chunks.
    Chunks {
        chunks: Vec<Column<T>>,
        joined: OnceLock<Box<Column<T>>>,
    },
}

impl<T: Pod> Column<T> {
    /// `n` rows of zeros.
    #[must_use]
    pub fn zeroed(n: usize) -> Self {
        let bytes = n * size_of::<T>();
        match mapped(bytes) {
            Some(map) => Self(ColumnStorage::Mapped { map, bytes }),
            None => Self(ColumnStorage::Owned(vec![T::zeroed(); n])),
        }
    }
}

/// Maps zeroed memory. Returns `None` if the column is small or the system cannot map it.
fn mapped(bytes: usize) -> Option<MmapMut> {
    let map = MmapMut::map_anon(bytes).ok().filter(|_| bytes >= MAP_FROM)?;
    // Advice only: kernels without huge pages ignore it.
    #[cfg(target_os = "linux")]
    let _advised = map.advise(memmap2::Advice::HugePage).is_ok();
    Some(map)
}

impl<T: Pod> Column<T> {
    /// Column over `bytes` of shared memory, without a copy; the memory is kept until the column is dropped or written
    /// to. `None` if the range is out of bounds, misaligned, or not a whole number of rows.
    #[must_use]
    pub fn shared(owner: SharedBytes, bytes: Range<usize>) -> Option<Self> {
        let rows = (*owner).as_ref().get(bytes.clone())?;
        bytemuck::try_cast_slice::<u8, T>(rows).ok()?;
        Some(Self(ColumnStorage::Shared { owner, bytes }))
    }

    /// Concatenates columns without a copy.
    #[must_use]
    pub fn from_chunks(columns: Vec<Self>) -> Self {
        let mut chunks = Vec::with_capacity(columns.len());
        for column in columns {
            match column.0 {
                ColumnStorage::Chunks { chunks: own, .. } => chunks.extend(own),
                _ if column.is_empty() => {}
                _ => chunks.push(column),
            }
        }
        match chunks.len() {
            0 => Self::default(),
            1 => chunks.swap_remove(0),
            _ => Self(ColumnStorage::Chunks { chunks, joined: OnceLock::new() }),
        }
    }

    /// Adds the rows of `next` without a copy.
    pub(crate) fn append(&mut self, next: Self) {
        *self = Self::from_chunks(vec![std::mem::take(self), next]);
    }

    /// Contiguous runs of rows, in order: one unless the column is in chunks.
    pub fn pieces(&self) -> impl Iterator<Item = &[T]> {
        let (whole, chunks): (Option<&[T]>, &[Self]) = match &self.0 {
            ColumnStorage::Chunks { chunks, joined } if joined.get().is_none() => (None, chunks),
            _ => (Some(self), &[]),
        };
        whole.into_iter().chain(chunks.iter().map(|chunk| &**chunk))
    }

    /// Copies the chunks into one and drops them, so that the rows are not held twice.
    pub fn make_contiguous(&mut self) {
        if let ColumnStorage::Chunks { chunks, joined } = &mut self.0 {
            let joined = joined.take().map(|column| *column);
            *self = joined.unwrap_or_else(|| {
                let n = chunks.iter().map(Self::len).sum();
                Self::copied(n, chunks.iter().map(|chunk| &**chunk))
            });
        }
    }

    /// Returns true if there are no rows.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Number of rows. Does not join chunks.
    #[must_use]
    pub fn len(&self) -> usize {
        match &self.0 {
            ColumnStorage::Owned(rows) => rows.len(),
            ColumnStorage::Mapped { bytes, .. } => bytes / size_of::<T>(),
            ColumnStorage::Shared { bytes, .. } => bytes.len() / size_of::<T>(),
            ColumnStorage::Chunks { chunks, .. } => chunks.iter().map(Self::len).sum(),
        }
    }

    /// Rows as a vector, for adding and removing. Copies the column if it is not one yet.
    pub fn edit(&mut self) -> &mut Vec<T> {
        if !matches!(self.0, ColumnStorage::Owned(_)) {
            self.0 = ColumnStorage::Owned(self.to_vec());
        }
        match &mut self.0 {
            ColumnStorage::Owned(rows) => rows,
            _ => unreachable!("owned by now"),
        }
    }

    /// Copies chunks into one column of `n` rows.
    fn copied<'a>(n: usize, chunks: impl Iterator<Item = &'a [T]>) -> Self
    where
        T: 'a,
    {
        let mut copy = Self::zeroed(n);
        let mut rest: &mut [u8] = bytemuck::cast_slice_mut(&mut copy[..]);
        let mut copies = Vec::new();
        for chunk in chunks {
            let chunk: &[u8] = bytemuck::cast_slice(chunk);
            let (target, tail) = std::mem::take(&mut rest).split_at_mut(chunk.len());
            copies.extend(target.chunks_mut(COPIED).zip(chunk.chunks(COPIED)));
            rest = tail;
        }
        copies.into_par_iter().for_each(|(target, source)| target.copy_from_slice(source));
        copy
    }
}

impl<T: Pod> Deref for Column<T> {
    type Target = [T];

    fn deref(&self) -> &[T] {
        match &self.0 {
            ColumnStorage::Owned(rows) => rows,
            // Mappings begin at a page boundary, which aligns every plain row type.
            ColumnStorage::Mapped { map, bytes } => bytemuck::cast_slice(&map[..*bytes]),
            // Checked when the column was created.
            ColumnStorage::Shared { owner, bytes } => bytemuck::cast_slice(&(**owner).as_ref()[bytes.clone()]),
            ColumnStorage::Chunks { chunks, joined } => {
                let rows = || chunks.iter().map(|chunk| &**chunk);
                joined.get_or_init(|| Box::new(Self::copied(self.len(), rows())))
            }
        }
    }
}

impl<T: Pod> DerefMut for Column<T> {
    fn deref_mut(&mut self) -> &mut [T] {
        if matches!(self.0, ColumnStorage::Shared { .. } | ColumnStorage::Chunks { .. }) {
            // Shared memory is read-only: the first write makes a copy.
            *self = self.clone();
        }
        match &mut self.0 {
            ColumnStorage::Owned(rows) => rows,
            ColumnStorage::Mapped { map, bytes } => bytemuck::cast_slice_mut(&mut map[..*bytes]),
            ColumnStorage::Shared { .. } | ColumnStorage::Chunks { .. } => unreachable!("copied by now"),
        }
    }
}

impl<T: Pod> From<Vec<T>> for Column<T> {
    fn from(rows: Vec<T>) -> Self {
        Self(ColumnStorage::Owned(rows))
    }
}

impl<T: Pod> FromIterator<T> for Column<T> {
    fn from_iter<I: IntoIterator<Item = T>>(rows: I) -> Self {
        Self::from(rows.into_iter().collect::<Vec<T>>())
    }
}

impl<T: Pod> Default for Column<T> {
    fn default() -> Self {
        Self(ColumnStorage::Owned(Vec::new()))
    }
}

impl<T: Pod> Clone for Column<T> {
    fn clone(&self) -> Self {
        Self::copied(self.len(), self.pieces())
    }
}

impl<T: Pod + PartialEq> PartialEq for Column<T> {
    fn eq(&self, other: &Self) -> bool {
        **self == **other
    }
}

impl<T: Pod + fmt::Debug> fmt::Debug for Column<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Column({} rows)", self.len())
    }
}

impl<'a, T: Pod> IntoIterator for &'a Column<T> {
    type Item = &'a T;
    type IntoIter = std::slice::Iter<'a, T>;

    fn into_iter(self) -> Self::IntoIter {
        self.iter()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_shared_column_is_read_in_place_and_copied_when_written() {
        let owner: SharedBytes = Arc::new([7_u32, 8, 9, 10].iter().flat_map(|v| v.to_ne_bytes()).collect::<Vec<u8>>());
        let start = (*owner).as_ref().as_ptr().align_offset(4);
        assert_eq!(start, 0, "an allocation of 16 bytes is aligned to 4");
        let mut column: Column<u32> = Column::shared(owner.clone(), 4..12).unwrap();
        assert_eq!(column.to_vec(), [8, 9]);
        assert_eq!(Arc::strong_count(&owner), 2);
        column[0] = 1;
        assert_eq!((column.to_vec(), Arc::strong_count(&owner)), (vec![1, 9], 1));
        let mut other: Column<u32> = Column::shared(owner.clone(), 0..16).unwrap();
        other.edit().push(3);
        assert_eq!(other.to_vec(), [7, 8, 9, 10, 3]);
        for bad in [1..5, 0..6, 8..20] {
            assert!(Column::<u32>::shared(owner.clone(), bad).is_none());
        }
    }

    #[test]
    fn a_column_in_chunks_is_joined_when_used_as_a_slice() {
        let of = |rows: &[u32]| Column::from(rows.to_vec());
        let chunked =
            || Column::from_chunks(vec![of(&[1, 2]), of(&[]), Column::from_chunks(vec![of(&[3]), of(&[4, 5])])]);
        let column = chunked();
        assert_eq!(column.pieces().collect::<Vec<_>>(), [&[1, 2][..], &[3], &[4, 5]]);
        assert_eq!((column.len(), column.clone().pieces().count()), (5, 1));
        assert_eq!(column.pieces().count(), 3, "a copy leaves it as it is");
        assert_eq!((column[3], column.len()), (4, 5));
        assert_eq!(column.pieces().collect::<Vec<_>>(), [[1, 2, 3, 4, 5]]);
        let mut written = chunked();
        written[4] = 9;
        assert_eq!(written.to_vec(), [1, 2, 3, 4, 9]);
        let mut contiguous = chunked();
        contiguous.make_contiguous();
        assert_eq!(contiguous.pieces().collect::<Vec<_>>(), [[1, 2, 3, 4, 5]]);
        assert!(matches!(contiguous.0, ColumnStorage::Owned(_)));
        let mut longer = chunked();
        longer.edit().push(6);
        assert_eq!(longer.len(), 6);
        assert_eq!(Column::from_chunks(vec![of(&[]), of(&[7])]).pieces().collect::<Vec<_>>(), [[7]]);
        assert_eq!(Column::<u32>::from_chunks(Vec::new()).len(), 0);
    }

    #[test]
    fn small_and_mapped_columns_behave_alike() {
        for n in [0, 1, 1000, MAP_FROM / 12 - 1, MAP_FROM / 12 + 1] {
            let mut column: Column<[f32; 3]> = Column::zeroed(n);
            assert_eq!(column.len(), n);
            assert_eq!(column, Column::from(vec![[0.0; 3]; n]));
            if let Some(last) = column.last_mut() {
                *last = [1.0, 2.0, 3.0];
                assert_eq!(column.clone().last(), Some(&[1.0, 2.0, 3.0]));
                assert_ne!(column, Column::zeroed(n));
            }
            assert_eq!(column, column.clone());
            column.edit().push([4.0; 3]);
            assert_eq!((column.len(), column.last()), (n + 1, Some(&[4.0; 3])));
        }
    }
}
