//! Decoded columns of a category: values, and the rows without a value.

use std::borrow::Cow;

/// Texts by row.
#[derive(Debug)]
pub(super) struct Texts<'a> {
    pub(super) joined: Cow<'a, [u8]>,
    /// Start of each text in `joined`, followed by the end of the last one.
    pub(super) offsets: Vec<u32>,
    /// Text id by row; negative if there is none.
    pub(super) ids: Vec<i32>,
    /// True if the texts are converted integers.
    pub(super) are_written: bool,
}

impl Texts<'_> {
    /// Creates a column without rows for converted integers.
    pub(super) fn written() -> Self {
        Self { joined: Cow::Owned(Vec::new()), offsets: vec![0], ids: Vec::new(), are_written: true }
    }

    /// Returns the range in `joined` of the text of a row.
    #[inline]
    pub(super) fn range(&self, row: usize) -> Option<(usize, usize)> {
        let id = usize::try_from(self.ids[row]).ok()?;
        Some((self.offsets[id] as usize, self.offsets[id + 1] as usize))
    }

    /// Adds rows of integers, converted to texts, one for each run of equal values.
    pub(super) fn write(&mut self, values: &[i32]) {
        let joined = self.joined.to_mut();
        let mut id = i32::try_from(self.offsets.len()).unwrap_or(i32::MAX) - 2;
        for (i, value) in values.iter().enumerate() {
            if i == 0 || values[i - 1] != *value {
                joined.extend_from_slice(itoa::Buffer::new().format(*value).as_bytes());
                self.offsets.push(u32::try_from(joined.len()).unwrap_or(u32::MAX));
                id += 1;
            }
            self.ids.push(id);
        }
    }

    /// Removes the first `n` rows. Texts of a dictionary remain.
    fn remove(&mut self, n: usize) {
        self.ids.drain(..n);
        if !self.are_written {
            return;
        }
        let first = self.ids.first().copied();
        let n_texts = first.map_or(self.offsets.len() - 1, |id| usize::try_from(id).unwrap_or(0));
        let start = self.offsets[n_texts];
        self.joined.to_mut().drain(..start as usize);
        self.offsets.drain(..n_texts);
        for offset in &mut self.offsets {
            *offset -= start;
        }
        for id in &mut self.ids {
            *id -= first.unwrap_or(0);
        }
    }
}

/// Decoded values of a column.
#[derive(Debug)]
pub(super) enum Cells<'a> {
    Int(Vec<i32>),
    Real(Vec<f64>),
    Text(Texts<'a>),
}

/// A decoded column.
#[derive(Debug)]
pub(super) struct DecodedColumn<'a> {
    pub(super) cells: Cells<'a>,
    /// By row: true if there is no value.
    pub(super) mask: Option<Vec<bool>>,
}

impl DecodedColumn<'_> {
    #[inline]
    pub(super) fn is_null(&self, row: usize) -> bool {
        self.mask.as_ref().is_some_and(|mask| mask[row])
    }

    /// Returns the text of a row, or `None` if it has none.
    pub(super) fn text(&self, row: usize) -> Option<&[u8]> {
        let Cells::Text(texts) = &self.cells else { return None };
        let (start, end) = texts.range(row).filter(|_| !self.is_null(row))?;
        Some(&texts.joined[start..end])
    }

    /// Returns the value of a row as text, which is empty if it has none. Numbers are written with all digits.
    pub(super) fn shown(&self, row: usize) -> Cow<'_, [u8]> {
        match &self.cells {
            _ if self.is_null(row) => Cow::Borrowed(b""),
            Cells::Int(values) => Cow::Owned(values[row].to_string().into_bytes()),
            Cells::Real(values) => Cow::Owned(values[row].to_string().into_bytes()),
            Cells::Text(_) => Cow::Borrowed(self.text(row).unwrap_or_default()),
        }
    }

    /// Returns true if some row has no value.
    fn has_nulls(&self) -> bool {
        self.mask.as_ref().is_some_and(|mask| mask.contains(&true))
            || matches!(&self.cells, Cells::Text(texts) if texts.ids.iter().any(|&id| id < 0))
    }

    /// Returns true if some row may have no usable value: no value, or text in a column of numbers.
    pub(super) fn lacks_values(&self, texts: bool) -> bool {
        self.has_nulls() || (!texts && matches!(self.cells, Cells::Text(_)))
    }

    /// Reserves capacity for `n` more rows.
    pub(super) fn reserve(&mut self, n: usize) {
        match &mut self.cells {
            Cells::Int(values) => values.reserve(n),
            Cells::Real(values) => values.reserve(n),
            Cells::Text(texts) => texts.ids.reserve(n),
        }
        if let Some(mask) = &mut self.mask {
            mask.reserve(n);
        }
    }

    /// Removes the first `n` rows.
    pub(super) fn remove(&mut self, n: usize) {
        match &mut self.cells {
            Cells::Int(values) => drop(values.drain(..n)),
            Cells::Real(values) => drop(values.drain(..n)),
            Cells::Text(texts) => texts.remove(n),
        }
        if let Some(mask) = &mut self.mask {
            mask.drain(..n);
        }
    }

    /// Copies the texts of the file.
    pub(super) fn into_owned(self) -> DecodedColumn<'static> {
        let cells = match self.cells {
            Cells::Int(values) => Cells::Int(values),
            Cells::Real(values) => Cells::Real(values),
            Cells::Text(Texts { joined, offsets, ids, are_written }) => {
                let joined = Cow::Owned(joined.into_owned());
                Cells::Text(Texts { joined, offsets, ids, are_written })
            }
        };
        DecodedColumn { cells, mask: self.mask }
    }

    /// Returns the memory of the texts, bytes.
    pub(super) fn text_bytes(&self) -> u64 {
        let Cells::Text(texts) = &self.cells else { return 0 };
        (texts.joined.len() + size_of::<u32>() * texts.offsets.len()) as u64
    }
}
