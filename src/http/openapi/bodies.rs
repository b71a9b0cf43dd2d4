//! Request bodies in the OpenAPI document.
//!
//! An operation declares the bytes of a file alone. Forms and JSON, which the server accepts as well, are components:
//! generators choose one body for an operation, most of them JSON if it is declared, and their clients could not send
//! files. With a form beside the file, the code of openapi-generator for TypeScript does not compile.

use serde_json::{Value, json};
use utoipa::openapi::schema::{AdditionalProperties, Type};
use utoipa::openapi::{KnownFormat, ObjectBuilder, RefOr, Schema, SchemaFormat};
use utoipa::{PartialSchema, ToSchema};

/// Description of a body with a structure to mesh.
pub(in crate::http) const STRUCTURE_TO_MESH: &str = "A structure file. The server detects the format from the content. \
Two other bodies are accepted: a form with the file, parameters and perhaps a map (component `StructureUpload`), and \
JSON that names a structure on the server (component `StructureByName`).";

/// Description of the same body for other operations.
pub(in crate::http) const AS_FOR_MESHES: &str = "The same bodies as for `POST /v1/meshes`.";

/// Returns the components for `requestBodies`: the bodies that no operation declares.
pub(super) fn request_bodies() -> Value {
    let schema = |name: &str| json!({ "schema": { "$ref": format!("#/components/schemas/{name}") } });
    json!({
        "StructureByName": {
            "description": "Body of `POST /v1/meshes`, `/v1/report` and `/v1/estimate` for a structure on the server.",
            "content": { "application/json": schema(&NamedStructure::name()) },
        },
        "StructureUpload": {
            "description": "Form with a structure file, for the same operations and for `POST /v1/structures`.",
            "content": { "multipart/form-data": schema(&StructureForm::name()) },
        },
    })
}

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

/// Form with a structure file.
pub(in crate::http) enum StructureForm {}

impl ToSchema for StructureForm {}

impl PartialSchema for StructureForm {
    fn schema() -> RefOr<Schema> {
        let doc = "Form with a structure file, and a map for `color=map`. The other fields are parameters, as in the \
                   query.";
        let map = "A CCP4, MRC or OpenDX map for `color=map`, uncompressed or compressed with gzip or zstd.";
        let form = ObjectBuilder::new()
            .description(Some(doc))
            .property("file", binary("The structure file."))
            .property("map", binary(map))
            .required("file")
            .additional_properties(Some(AdditionalProperties::FreeForm(true)));
        RefOr::T(form.build().into())
    }
}

/// JSON document that names a structure.
pub(in crate::http) enum NamedStructure {}

impl ToSchema for NamedStructure {}

impl PartialSchema for NamedStructure {
    fn schema() -> RefOr<Schema> {
        let text = |doc: &str| ObjectBuilder::new().schema_type(Type::String).description(Some(doc));
        let doc = "Structure on the server: `pdb_id` or `structure`. The other members are parameters, as in the query: \
                   text, numbers, true, false, or lists of them.";
        let document = ObjectBuilder::new()
            .description(Some(doc))
            .property("pdb_id", text("PDB id of an archive entry."))
            .property("structure", text("Digest of an uploaded structure."))
            .additional_properties(Some(AdditionalProperties::FreeForm(true)))
            .examples([json!({ "pdb_id": "4pti", "resolution": 0.7, "select": ["polymer", "ligand"] })]);
        RefOr::T(document.build().into())
    }
}
