//! A column of a mesh: a slice of plain rows in memory that costs little to get.
//!
//! Large columns come from the system as huge pages where it has them: faulting 350 MB in
//! pages of 4 KiB took half as long as meshing them.

use std::fmt;
use std::ops::{Deref, DerefMut};

use bytemuck::Pod;
use memmap2::MmapMut;

/// From this many bytes on, a column is mapped.
const MAP_FROM: usize = 64 << 10;
/// From this many bytes on, a mapped column asks for huge pages: two of them. Below, its pages are made present in one
/// call instead of by a page fault each.
const HUGE_FROM: usize = 4 << 20;

/// Rows of a mesh: behaves like a slice.
pub struct Column<T: Pod>(Storage<T>);

enum Storage<T> {
    Owned(Vec<T>),
    Mapped { map: MmapMut, bytes: usize },
}

impl<T: Pod> Column<T> {
    /// `n` rows of zeros.
    #[must_use]
    pub fn zeroed(n: usize) -> Self {
        let bytes = n * size_of::<T>();
        if bytes >= MAP_FROM
            && let Ok(map) = MmapMut::map_anon(bytes)
        {
            // Advice only: where the kernel has no huge pages, small ones do.
            #[cfg(target_os = "linux")]
            let _advised = map
                .advise(if bytes >= HUGE_FROM { memmap2::Advice::HugePage } else { memmap2::Advice::PopulateWrite })
                .is_ok();
            return Self(Storage::Mapped { map, bytes });
        }
        Self(Storage::Owned(vec![T::zeroed(); n]))
    }
}

impl<T: Pod> Column<T> {
    /// The rows as a vector, to add or remove some. Copies a mapped column.
    pub fn edit(&mut self) -> &mut Vec<T> {
        if let Storage::Mapped { .. } = &self.0 {
            self.0 = Storage::Owned(self.to_vec());
        }
        match &mut self.0 {
            Storage::Owned(rows) => rows,
            Storage::Mapped { .. } => unreachable!("owned by now"),
        }
    }
}

impl<T: Pod> Deref for Column<T> {
    type Target = [T];

    fn deref(&self) -> &[T] {
        match &self.0 {
            Storage::Owned(rows) => rows,
            // A mapping begins on a page boundary, so any plain row type is aligned.
            Storage::Mapped { map, bytes } => bytemuck::cast_slice(&map[..*bytes]),
        }
    }
}

impl<T: Pod> DerefMut for Column<T> {
    fn deref_mut(&mut self) -> &mut [T] {
        match &mut self.0 {
            Storage::Owned(rows) => rows,
            Storage::Mapped { map, bytes } => bytemuck::cast_slice_mut(&mut map[..*bytes]),
        }
    }
}

impl<T: Pod> From<Vec<T>> for Column<T> {
    fn from(rows: Vec<T>) -> Self {
        Self(Storage::Owned(rows))
    }
}

impl<T: Pod> FromIterator<T> for Column<T> {
    fn from_iter<I: IntoIterator<Item = T>>(rows: I) -> Self {
        Self::from(rows.into_iter().collect::<Vec<T>>())
    }
}

impl<T: Pod> Default for Column<T> {
    fn default() -> Self {
        Self(Storage::Owned(Vec::new()))
    }
}

impl<T: Pod> Clone for Column<T> {
    fn clone(&self) -> Self {
        let mut copy = Self::zeroed(self.len());
        copy.copy_from_slice(self);
        copy
    }
}

impl<T: Pod + PartialEq> PartialEq for Column<T> {
    fn eq(&self, other: &Self) -> bool {
        **self == **other
    }
}

impl<T: Pod + PartialEq> PartialEq<Column<T>> for Vec<T> {
    fn eq(&self, other: &Column<T>) -> bool {
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
    fn small_and_mapped_columns_behave_alike() {
        for n in [0, 1, 1000, MAP_FROM / 12 - 1, MAP_FROM / 12 + 1, MAP_FROM, HUGE_FROM / 12 + 1] {
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
