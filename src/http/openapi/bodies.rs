//! Request bodies in the OpenAPI document.
//!
//! The document declares the bytes of a file alone. The server also accepts forms and JSON, but generators choose one
//! body for an operation, most of them JSON, and the clients could not send files.

use utoipa::openapi::schema::Type;
use utoipa::openapi::{KnownFormat, ObjectBuilder, RefOr, Schema, SchemaFormat};
use utoipa::{PartialSchema, ToSchema};

/// Description of a body with a structure to mesh.
pub(in crate::http) const STRUCTURE_TO_MESH: &str = "A structure file. The server detects the format from the content.

Two other bodies are accepted. `application/json` names a structure on the server and holds the parameters: \
`{\"pdb_id\": \"4pti\", \"resolution\": 0.7}` for an archive entry, `\"structure\"` with a digest instead of \
`\"pdb_id\"` for an uploaded structure. `multipart/form-data` has the file in the field `file` and the parameters in \
the other fields.";

/// Description of the same body for other operations.
pub(in crate::http) const AS_FOR_MESHES: &str =
    "A structure file, or another of the bodies that `POST /v1/meshes` accepts.";

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
