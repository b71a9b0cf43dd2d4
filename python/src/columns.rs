//! Columns as numpy arrays that share their memory, through the array interface of numpy: read-only, and valid as long
//! as an array refers to them.

use std::sync::Arc;

use bytemuck::Pod;
use molmesh_surface::{Mesh, SharedBytes};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};

use crate::error::Failure;

/// Byte order of this machine in type names of numpy.
const ORDER: char = if cfg!(target_endian = "little") { '<' } else { '>' };
/// Maximum size of a column of texts, bytes. Each row takes the size of the longest text.
const MAX_TEXT_BYTES: usize = 1 << 30;

/// Memory of a column, and its type.
#[derive(Clone)]
pub(crate) struct ColumnData {
    owner: SharedBytes,
    shape: Vec<usize>,
    /// Name of the type, such as `<f4`.
    type_name: String,
    /// Names and types of the fields of a row; empty for a plain type.
    fields: Vec<(&'static str, String)>,
}

/// Type of a number with its name in numpy, without the byte order.
pub(crate) trait Number: Pod + Send + Sync {
    const NAME: &'static str;
}

macro_rules! numbers {
    ($($type:ty: $name:literal),+) => { $(impl Number for $type { const NAME: &'static str = $name; })+ };
}

numbers! { f32: "f4", f64: "f8", i32: "i4", u32: "u4", u64: "u8", u8: "u1" }

/// Rows that a column owns.
struct OwnedRows<T>(Vec<T>);

impl<T: Pod> AsRef<[u8]> for OwnedRows<T> {
    fn as_ref(&self) -> &[u8] {
        bytemuck::cast_slice(&self.0)
    }
}

/// Rows of a mesh.
struct MeshRows {
    mesh: Arc<Mesh>,
    bytes: fn(&Mesh) -> &[u8],
}

impl AsRef<[u8]> for MeshRows {
    fn as_ref(&self) -> &[u8] {
        (self.bytes)(&self.mesh)
    }
}

fn type_name(name: &str) -> String {
    format!("{ORDER}{name}")
}

impl ColumnData {
    /// Takes a column of numbers.
    pub(crate) fn from_numbers<T: Number>(rows: Vec<T>) -> Self {
        Self::new::<T>(vec![rows.len()], Arc::new(OwnedRows(rows)))
    }

    /// Takes a column of rows of `N` numbers.
    pub(crate) fn from_rows<T: Number, const N: usize>(rows: Vec<[T; N]>) -> Self {
        Self::new::<T>(vec![rows.len(), N], Arc::new(OwnedRows(rows.into_flattened())))
    }

    /// Refers to a column of a mesh, whose rows have `width` numbers.
    pub(crate) fn from_mesh<T: Number>(mesh: &Arc<Mesh>, width: usize, bytes: fn(&Mesh) -> &[u8]) -> Self {
        let n = bytes(mesh).len() / (width * size_of::<T>());
        Self::new::<T>(vec![n, width], Arc::new(MeshRows { mesh: Arc::clone(mesh), bytes }))
    }

    fn new<T: Number>(shape: Vec<usize>, owner: SharedBytes) -> Self {
        Self { owner, shape, type_name: type_name(T::NAME), fields: Vec::new() }
    }

    /// Copies texts, each in the space of the longest one, as numpy stores them.
    ///
    /// # Errors
    /// Returns [`Failure::Argument`] if the column would be too large.
    pub(crate) fn texts<'a>(texts: impl Iterator<Item = &'a str> + Clone) -> Result<Self, Failure> {
        let (width, n) = (width(texts.clone()), texts.clone().count());
        check_size(width, n)?;
        let mut characters = Vec::with_capacity(width * n);
        texts.for_each(|text| put(&mut characters, text, width));
        let owner = Arc::new(OwnedRows(characters));
        Ok(Self { owner, shape: vec![n], type_name: type_name(&format!("U{width}")), fields: Vec::new() })
    }

    /// Copies names, numbers and insertion codes of residues into rows with these fields.
    ///
    /// # Errors
    /// Returns the errors of [`Self::texts`].
    pub(crate) fn residues<'a>(rows: impl Iterator<Item = (&'a str, i32, u8)> + Clone) -> Result<Self, Failure> {
        let (width, n) = (width(rows.clone().map(|(name, ..)| name)), rows.clone().count());
        check_size(width + 2, n)?;
        let mut words = Vec::with_capacity((width + 2) * n);
        for (name, number, code) in rows {
            put(&mut words, name, width);
            words.push(number.cast_unsigned());
            words.push(u32::from(code));
        }
        let fields = vec![
            ("name", type_name(&format!("U{width}"))),
            ("number", type_name("i4")),
            ("insertion_code", type_name("U1")),
        ];
        let type_name = format!("|V{}", 4 * (width + 2));
        Ok(Self { owner: Arc::new(OwnedRows(words)), shape: vec![n], type_name, fields })
    }

    /// Returns an array of the column, which keeps its memory.
    pub(crate) fn array<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let owner = Bound::new(py, ArrayOwner(self.clone()))?;
        py.import("numpy")?.call_method1("asarray", (owner,))
    }
}

/// Returns the length of the longest text, at least 1.
fn width<'a>(texts: impl Iterator<Item = &'a str>) -> usize {
    texts.map(|text| text.chars().count()).max().unwrap_or(0).max(1)
}

/// Appends a text as characters of four bytes, filled with zeros.
fn put(characters: &mut Vec<u32>, text: &str, width: usize) {
    let end = characters.len() + width;
    characters.extend(text.chars().map(u32::from));
    characters.resize(end, 0);
}

fn check_size(width: usize, n: usize) -> Result<(), Failure> {
    let bytes = 4 * width.saturating_mul(n);
    if bytes <= MAX_TEXT_BYTES {
        return Ok(());
    }
    Err(Failure::Argument(format!(
        "an array of these {n} texts takes {bytes} bytes, the limit is {MAX_TEXT_BYTES}: one has {width} characters"
    )))
}

/// Object that owns the memory of an array.
#[pyclass(frozen, module = "molmesh", name = "ArrayOwner")]
struct ArrayOwner(ColumnData);

#[pymethods]
impl ArrayOwner {
    /// Address, type and shape of the memory, in the form that numpy defines.
    #[getter]
    fn __array_interface__<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let ColumnData { owner, shape, type_name, fields } = &self.0;
        let address = (**owner).as_ref().as_ptr().expose_provenance();
        let interface = PyDict::new(py);
        interface.set_item("version", 3)?;
        interface.set_item("shape", PyTuple::new(py, shape)?)?;
        interface.set_item("typestr", type_name)?;
        if !fields.is_empty() {
            interface.set_item("descr", fields)?;
        }
        // The array is read-only.
        interface.set_item("data", (address, true))?;
        Ok(interface)
    }
}
