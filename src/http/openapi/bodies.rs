//! Request bodies in the OpenAPI document.
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
