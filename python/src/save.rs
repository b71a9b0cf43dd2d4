//! `Mesh.save`: writes a file beside its destination and renames it.

use std::fs::{File, OpenOptions, Permissions};
use std::io::{self, Write};
use std::path::Path;

use molmesh_formats::{CompressedGlb, Encoder, Format, Pieces};
use molmesh_picture::PictureParams;
use molmesh_pipeline::JobError;
use molmesh_surface::{CancelToken, Control, SurfaceError};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use tempfile::NamedTempFile;

use crate::error::Failure;
use crate::mesh::MeshContent;
use crate::render;

/// Maximum size of one write, bytes. Cancellation is checked between writes.
const MAX_WRITE: usize = 1 << 20;

/// Returns the format with this name, or that of the extension of `path`.
///
/// # Errors
/// Returns `ValueError` for an unknown format.
pub(crate) fn format_of(path: &Path, name: Option<&str>) -> PyResult<Format> {
    let extension = path.extension().map(|extension| extension.to_string_lossy());
    let Some(name) = name.or(extension.as_deref()) else {
        let known = Format::NAMES.join(", ");
        let message = format!("`{}` has no extension; expected one of {known}, or the argument format", path.display());
        return Err(PyValueError::new_err(message));
    };
    name.parse::<Format>().map_err(|error| PyValueError::new_err(format!("`{}`: {error}", path.display())))
}

/// Writes a mesh, or its picture.
///
/// # Errors
/// Returns the failures of the format, of the file, and of cancellation. The file is then as it was before.
pub(crate) fn save(content: &MeshContent, format: Format, path: &Path, control: &Control<'_>) -> Result<(), Failure> {
    let failure = |source: io::Error| match control.check() {
        Err(cancelled) => cancelled.into(),
        Ok(()) => Failure::File { path: path.to_owned(), source },
    };
    // Resolves links to files that exist, so that the target is replaced instead of the link.
    let target = path.canonicalize().unwrap_or_else(|_| path.to_owned());
    let existing = target.metadata().ok();
    match &existing {
        Some(existing) if !existing.is_file() => {
            // A rename would replace the device or the pipe. A folder cannot be opened.
            let file = OpenOptions::new().write(true).open(&target).map_err(failure)?;
            return write(content, format, &file, &failure, control);
        }
        _ => {}
    }
    let staged = staged_file(&target, existing.map(|existing| existing.permissions())).map_err(failure)?;
    write(content, format, staged.as_file(), &failure, control)?;
    control.check()?;
    staged.persist(&target).map_err(|error| failure(error.error))?;
    Ok(())
}

/// Writes the content of a file. `failure` converts the errors of the file.
fn write(
    content: &MeshContent,
    format: Format,
    file: &File,
    failure: &dyn Fn(io::Error) -> Failure,
    control: &Control<'_>,
) -> Result<(), Failure> {
    let mut out = CancellableFile { file, cancel: &control.cancel };
    let (mesh, meta) = (&*content.mesh, content.meta());
    let written = if format.is_picture() {
        out.write_all(&render::picture(&content.mesh, &PictureParams::default(), control)?)
    } else if format == Format::Glb && content.is_meshopt {
        let check = |_bytes| control.check().map_err(JobError::from);
        let pieces = Pieces::new(mesh, content.storage, content.bounds, check, |_bytes| {})?;
        CompressedGlb::new(mesh, &pieces, &meta)?.write(&mut out)
    } else {
        Encoder::with_bounds(format, content.storage, mesh, content.bounds, &meta)?.write(&mut out)
    };
    written.map_err(failure)
}

/// Creates the file that is renamed to `target`, with these permissions, or those of a new file.
fn staged_file(target: &Path, permissions: Option<Permissions>) -> io::Result<NamedTempFile> {
    let folder = target.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    // `tempfile_in` would give the file permissions of its own, and its errors have no number.
    let create = |path: &Path| OpenOptions::new().write(true).create_new(true).open(path);
    let staged = tempfile::Builder::new().prefix(".molmesh-").suffix(".part").make_in(folder, create)?;
    if let Some(permissions) = permissions {
        // A read-only file must not be replaced through its folder.
        OpenOptions::new().write(true).open(target)?;
        staged.as_file().set_permissions(permissions)?;
    }
    Ok(staged)
}

/// File that cannot be written any more when the work is cancelled.
struct CancellableFile<'a> {
    file: &'a File,
    cancel: &'a CancelToken,
}

impl Write for CancellableFile<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        // Not `Interrupted`: callers retry a write that fails with it.
        if self.cancel.is_cancelled() {
            return Err(io::Error::other(SurfaceError::Cancelled));
        }
        self.file.write(&bytes[..bytes.len().min(MAX_WRITE)])
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}
