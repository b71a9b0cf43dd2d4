//! Product of a job and its output file: a mesh file or a picture.

use std::io::{self, Write};

use molmesh_formats::{Compress, CompressedGlb, Encoder, Format, FormatError, Meta, Pieces, Storage};
use molmesh_surface::{Mesh, SurfaceError};

use super::{JobError, Options, Report, WorkScope};

/// Finished job.
#[derive(Debug, Clone)]
pub struct Product {
    /// Mesh.
    pub mesh: Mesh,
    /// Lowest and highest position of `mesh` relative to its centre, per axis, if the backend delivered them, Å.
    pub bounds: Option<[[f32; 3]; 2]>,
    /// Encoding in a file.
    pub storage: Storage,
    /// Report of the job.
    pub report: Report,
    /// Compressed form of the mesh, for [`Compress::Meshopt`]. The columns of `mesh` are empty then.
    pub pieces: Option<Pieces>,
    /// PNG of the mesh, if one was drawn. The mesh is empty then.
    pub picture: Option<Vec<u8>>,
    /// Length of the GLB, bytes, if the mesh was streamed into a sink. The columns of `mesh` are empty then.
    pub streamed_bytes: Option<u64>,
}

/// Output file that is planned but not yet written.
#[derive(Debug)]
pub enum File<'a> {
    /// Mesh file.
    Mesh(Encoder<'a>),
    /// GLB of a compressed mesh.
    Compressed(CompressedGlb<'a>),
    /// PNG of a picture.
    Picture(&'a [u8]),
}

impl Product {
    pub(super) fn new(mesh: Mesh, storage: Storage, report: Report) -> Self {
        Self { mesh, bounds: None, storage, report, pieces: None, picture: None, streamed_bytes: None }
    }

    /// Returns the metadata for a mesh file.
    #[must_use]
    pub fn meta(&self) -> Meta {
        Meta { name: self.report.id.clone(), extras: self.report.extras() }
    }

    /// Plans the file of this product in `format`.
    ///
    /// # Errors
    /// Returns a [`FormatError`]; [`FormatError::NotAMeshFormat`] for a picture that was not drawn.
    pub fn file(&self, format: Format) -> Result<File<'_>, FormatError> {
        let (mesh, meta) = (&self.mesh, self.meta());
        match (&self.picture, &self.pieces) {
            (Some(picture), _) if format.is_picture() => Ok(File::Picture(picture)),
            (_, Some(pieces)) if format == Format::Glb => {
                Ok(File::Compressed(CompressedGlb::new(mesh, pieces, &meta)?))
            }
            _ => Ok(File::Mesh(Encoder::with_bounds(format, self.storage, mesh, self.bounds, &meta)?)),
        }
    }

    /// Compresses the mesh and drops its columns if the job asks for it. Checks for cancellation between pieces.
    pub(super) fn compress(
        &mut self,
        options: &Options,
        WorkScope { clock, control }: &WorkScope<'_>,
    ) -> Result<(), JobError> {
        if options.compress != Compress::Meshopt {
            return Ok(());
        }
        let Self { mesh, storage, bounds, .. } = self;
        mesh.make_contiguous();
        let grow = |bytes| {
            control.check()?;
            control.memory.grow(bytes).map_err(|error| JobError::from(SurfaceError::from(error)))
        };
        let compress = || Pieces::new(mesh, *storage, *bounds, grow, |bytes| control.memory.shrink(bytes));
        self.pieces = Some(clock.time("encode", compress)?);
        mesh.drop_columns();
        self.report.add_timings(clock);
        Ok(())
    }
}

impl File<'_> {
    /// Returns the exact size of the file, bytes; `None` if it is known only after writing.
    #[must_use]
    pub fn bytes(&self) -> Option<u64> {
        match self {
            Self::Mesh(encoder) => encoder.encoded_len(),
            Self::Compressed(file) => Some(file.encoded_len()),
            Self::Picture(bytes) => Some(bytes.len() as u64),
        }
    }

    /// Returns an upper bound of the size of the file, bytes. It is exact if [`Self::bytes`] is known.
    #[must_use]
    pub fn bytes_bound(&self) -> u64 {
        match self {
            Self::Mesh(encoder) => encoder.encoded_len_bound(),
            Self::Compressed(file) => file.encoded_len(),
            Self::Picture(bytes) => bytes.len() as u64,
        }
    }

    /// Writes the file and flushes `out`.
    ///
    /// # Errors
    /// Returns the errors of `out`.
    pub fn write(&self, out: &mut dyn Write) -> io::Result<()> {
        match self {
            Self::Mesh(encoder) => encoder.write(out),
            Self::Compressed(file) => file.write(out),
            Self::Picture(bytes) => out.write_all(bytes).and_then(|()| out.flush()),
        }
    }
}

#[cfg(test)]
mod tests {
    use molmesh_surface::vector::joined_bounds;
    use molmesh_surface::{Control, CpuBackend};

    use super::*;
    use crate::{Choice, JobLimits, params, run};

    fn written(product: &Product, format: Format) -> Vec<u8> {
        let mut bytes = Vec::new();
        product.file(format).unwrap().write(&mut bytes).unwrap();
        bytes
    }

    #[test]
    fn delivered_bounds_are_exact_and_used() {
        let backend = CpuBackend::new(Some(2)).unwrap();
        let choice = Choice { backend: &backend, reason: "" };
        let cases: [&[(&str, &str)]; 6] = [
            &[],
            &[("compress", "quantize")],
            &[("surface", "ses"), ("atom_ids", "true")],
            &[("max_triangles", "5000")],
            &[("split", "residue-group"), ("select", "all")],
            &[("split", "residue-group"), ("select", "all"), ("compress", "quantize")],
        ];
        for pairs in cases {
            let options = params::parse(pairs.iter().copied()).unwrap().options;
            let sample = include_bytes!("../../../samples/4pti.pdb");
            let product =
                run(sample, &options, &JobLimits::default(), &choice, &Control::default(), &(), None).unwrap();
            let [low, high] = product.bounds.unwrap();
            assert_eq!([low, high], product.mesh.bounds(), "{pairs:?}");
            for part in &product.mesh.parts {
                let positions = part.vertices.clone().map(|v| [product.mesh.position(v); 2]);
                assert_eq!(Some(part.bounds), positions.reduce(joined_bounds), "{pairs:?}: {}", part.name);
            }
            let scanned = Product { bounds: None, ..product.clone() };
            let mut other = Product { bounds: Some([low, high.map(|v| 0.5 * v)]), ..product.clone() };
            other.mesh.parts.iter_mut().for_each(|part| part.bounds[0] = [0.0; 3]);
            for format in [Format::Glb, Format::Gltf] {
                let expected = written(&scanned, format);
                assert!(written(&product, format) == expected, "{pairs:?}");
                // Negative control: other bounds would be in the file.
                assert!(written(&other, format) != expected, "{pairs:?}");
            }
        }
    }
}
