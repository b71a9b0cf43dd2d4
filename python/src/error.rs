//! Errors of calls as exceptions: `molmesh.Error` with the fields of a problem document, `ValueError` for arguments,
//! `OSError` for files.

use std::io;
use std::path::PathBuf;

use molmesh_formats::FormatError;
use molmesh_pipeline::JobError;
use molmesh_pipeline::params::ParamError;
use molmesh_structure::StructureError;
use molmesh_surface::{Exceeded, SurfaceError};
use pyo3::create_exception;
use pyo3::exceptions::{PyException, PyOSError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyType;

create_exception!(
    molmesh,
    Error,
    PyException,
    "Error of a structure, a limit or a surface.\n\n\
     Attributes\n----------\n\
     type : str\n    Name of the problem type of the service, such as ``no-surface``.\n\
     limit : int or None\n    Limit that is exceeded.\n\
     value : int, str or None\n    Number or text that was found.\n\
     suggested_resolution : float or None\n    Grid spacing that should fit, in Å.\n\
     line, column : int or None\n    Position of a syntax error in the file, from 1.\n"
);

/// Fields of an error besides its type. They are `None` where they are unknown.
const FIELDS: [&str; 5] = ["limit", "value", "suggested_resolution", "line", "column"];

/// Returns the class of the errors, with the defaults of their fields.
pub(crate) fn class(py: Python<'_>) -> PyResult<Bound<'_, PyType>> {
    let class = py.get_type::<Error>();
    for field in FIELDS {
        class.setattr(field, py.None())?;
    }
    class.setattr("type", INTERNAL)?;
    Ok(class)
}

/// Problem type of a defect of the package.
const INTERNAL: &str = "internal";

/// Reason why a call fails.
pub(crate) enum Failure {
    /// The job failed.
    Job(JobError),
    /// A file cannot be read or written.
    File { path: PathBuf, source: io::Error },
    /// The strict validator found errors.
    Check { errors: usize, first: String, line: Option<u64> },
    /// An argument is invalid.
    Argument(String),
    /// The work panicked.
    Panicked,
}

impl<E: Into<JobError>> From<E> for Failure {
    fn from(error: E) -> Self {
        Self::Job(error.into())
    }
}

impl From<Failure> for PyErr {
    fn from(failure: Failure) -> Self {
        match failure {
            Failure::Job(error) => job_error(&error),
            Failure::File { path, source } => file_error(path, &source),
            Failure::Check { errors, first, line } => {
                let message = format!("the strict check found {errors} errors; the first: {first}");
                exception("unreadable-structure", message, &Fields { line, ..Fields::default() })
            }
            Failure::Argument(message) => PyValueError::new_err(message),
            Failure::Panicked => {
                let message = "internal error: the work ended without a result; standard error has the details";
                exception(INTERNAL, message.to_owned(), &Fields::default())
            }
        }
    }
}

/// Converts an error of parameters.
pub(crate) fn parameter_error(error: &ParamError) -> PyErr {
    PyValueError::new_err(error.to_string())
}

/// Values of [`FIELDS`].
#[derive(Default)]
struct Fields<'a> {
    exceeded: Option<&'a Exceeded>,
    value: Option<&'a str>,
    line: Option<u64>,
    column: Option<u64>,
}

fn job_error(error: &JobError) -> PyErr {
    let (kind, message) = (error.problem(), error.to_string());
    let is_argument = match error {
        // The format cannot hold this mesh. The other errors are limits and defects.
        JobError::Format(error) => matches!(
            error,
            FormatError::CoordinateTooLarge { .. }
                | FormatError::OutOfQuantizationRange { .. }
                | FormatError::QuantizationNotSupported { .. }
                | FormatError::InstancesNotSupported { .. }
                | FormatError::UnitsNotSupported { .. }
        ),
        _ => kind == "bad-parameter",
    };
    if is_argument {
        return PyValueError::new_err(message);
    }
    let fields = match error {
        JobError::Surface(SurfaceError::Limit(exceeded)) | JobError::Format(FormatError::Limit(exceeded)) => {
            Fields { exceeded: Some(exceeded), ..Fields::default() }
        }
        JobError::Structure(StructureError::Syntax { line, column, .. }) => {
            Fields { line: Some(*line), column: Some(*column), ..Fields::default() }
        }
        JobError::Structure(StructureError::NotFound { requested, .. }) => {
            Fields { value: Some(requested.trim_matches('`')), ..Fields::default() }
        }
        _ => Fields::default(),
    };
    exception(kind, message, &fields)
}

/// Returns a `molmesh.Error`.
fn exception(kind: &str, message: String, fields: &Fields<'_>) -> PyErr {
    Python::attach(|py| {
        let error = Error::new_err(message);
        let value = error.value(py);
        let set = || -> PyResult<()> {
            value.setattr("type", kind)?;
            value.setattr("value", fields.value)?;
            value.setattr("line", fields.line)?;
            value.setattr("column", fields.column)?;
            if let Some(exceeded) = fields.exceeded {
                value.setattr("limit", exceeded.max)?;
                value.setattr("value", exceeded.actual)?;
                value.setattr("suggested_resolution", exceeded.suggested_resolution)?;
            }
            Ok(())
        };
        set().err().unwrap_or(error)
    })
}

/// Returns the `OSError` of a file: Python chooses the class by the number of the error.
fn file_error(path: PathBuf, source: &io::Error) -> PyErr {
    match source.raw_os_error() {
        Some(number) => {
            let text = source.to_string();
            let message = text.split(" (os error").next().unwrap_or(&text).to_owned();
            PyOSError::new_err((number, message, path.into_os_string()))
        }
        None => io::Error::new(source.kind(), format!("{}: {source}", path.display())).into(),
    }
}
