//! Bodies that are files in the OpenAPI document.
//!
//! An operation declares the bytes of a file alone. Forms and JSON, which the server accepts as well, are components:
//! generators choose one body for an operation, most of them JSON if it is declared, and their clients could not send
//! files. With a form beside the file, the code of openapi-generator for TypeScript does not compile.

use utoipa::openapi::schema::Type;
use utoipa::openapi::{KnownFormat, ObjectBuilder, RefOr, Schema, SchemaFormat};
use utoipa::{PartialSchema, ToSchema};

/// Description of a body with a structure to mesh.
pub(in crate::http) const STRUCTURE_TO_MESH: &str = "A structure file. The server detects the format from the content. \
Two other bodies are accepted: a form with the file, parameters and perhaps a map (component `StructureUpload`), and \
JSON that names a structure on the server (component `StructureByName`).";

/// Description of the same body for other operations.
pub(in crate::http) const AS_FOR_MESHES: &str = "The same bodies as for `POST /v1/meshes`.";

/// Description of the body of a batch.
pub(in crate::http) const BATCH_FILES: &str = "A tar archive, plain or compressed with gzip, or a zip archive. JSON is \
accepted as well: `pdb_ids`, a list of PDB ids, and parameters.";

/// Returns a schema for bytes.
pub(super) fn binary(doc: &str) -> ObjectBuilder {
    let binary = SchemaFormat::KnownFormat(KnownFormat::Binary);
    ObjectBuilder::new().schema_type(Type::String).format(Some(binary)).description(Some(doc))
}

/// Bytes of a structure file.
pub(in crate::http) enum StructureFile {}

impl ToSchema for StructureFile {}

impl PartialSchema for StructureFile {
    fn schema() -> RefOr<Schema> {
        RefOr::T(
            binary("A PDB, mmCIF, BinaryCIF, PQR or XYZ file, uncompressed or compressed with gzip or zstd.").into(),
        )
    }
}

/// Bytes of a subtree of a tileset.
pub(in crate::http) enum SubtreeFile {}

impl ToSchema for SubtreeFile {}

impl PartialSchema for SubtreeFile {
    fn schema() -> RefOr<Schema> {
        RefOr::T(binary("A subtree of 3D Tiles 1.1.").into())
    }
}

/// Bytes of an archive.
pub(in crate::http) enum ArchiveFile {}

impl ToSchema for ArchiveFile {}

impl PartialSchema for ArchiveFile {
    fn schema() -> RefOr<Schema> {
        RefOr::T(binary("An archive of files.").into())
    }
}
