//! Request bodies in the description: a structure's bytes, a form around them, a document that names one.

use utoipa::openapi::schema::{AdditionalProperties, Type};
use utoipa::openapi::{KnownFormat, ObjectBuilder, OneOfBuilder, RefOr, Schema, SchemaFormat};
use utoipa::{PartialSchema, ToSchema};

use super::parameters::{Place, schema};
use crate::pipeline::params::TABLE;

fn file(doc: &str) -> ObjectBuilder {
    let binary = SchemaFormat::KnownFormat(KnownFormat::Binary);
    ObjectBuilder::new().schema_type(Type::String).format(Some(binary)).description(Some(doc))
}

fn with_parameters(object: ObjectBuilder, place: Place) -> ObjectBuilder {
    let object = TABLE.iter().fold(object, |object, p| object.property(p.name, schema(p, place)));
    object.additional_properties(Some(AdditionalProperties::FreeForm(false)))
}

/// The bytes of a structure.
pub(in crate::http) enum StructureFile {}

impl ToSchema for StructureFile {}

impl PartialSchema for StructureFile {
    fn schema() -> RefOr<Schema> {
        RefOr::T(file("A PDB, mmCIF or BinaryCIF file, as it is or compressed with gzip or zstd.").into())
    }
}

/// A form with a structure.
pub(in crate::http) enum StructureForm {}

impl ToSchema for StructureForm {}

impl PartialSchema for StructureForm {
    fn schema() -> RefOr<Schema> {
        let form = ObjectBuilder::new()
            .description(Some("A form with one file, in a field named `file` or `structure`."))
            .property("file", file("The structure."))
            .required("file")
            .additional_properties(Some(AdditionalProperties::FreeForm(false)));
        RefOr::T(form.into())
    }
}

/// A form with a structure, and parameters in its other fields.
pub(in crate::http) enum MeshForm {}

impl ToSchema for MeshForm {}

impl PartialSchema for MeshForm {
    fn schema() -> RefOr<Schema> {
        let form = ObjectBuilder::new()
            .description(Some("A form with one file, in a field named `file` or `structure`; parameters beside it."))
            .property("file", file("The structure."))
            .required("file");
        RefOr::T(with_parameters(form, Place::Form).into())
    }
}

/// A document that names a structure, with parameters beside it.
pub(in crate::http) enum MeshOrder {}

impl ToSchema for MeshOrder {}

impl PartialSchema for MeshOrder {
    fn schema() -> RefOr<Schema> {
        let named = |name: &str, doc: &str, pattern: &str| {
            let id = ObjectBuilder::new().schema_type(Type::String).pattern(Some(pattern)).description(Some(doc));
            with_parameters(ObjectBuilder::new().property(name, id).required(name), Place::Json)
        };
        let entry = "^([0-9][A-Za-z0-9]{3}|[Pp][Dd][Bb]_[A-Za-z0-9]{8})$";
        let order = OneOfBuilder::new()
            .description(Some("What is to be meshed, by its name, with parameters beside it."))
            .item(named("pdb_id", "An entry of the archive.", entry))
            .item(named("structure", "A structure that was uploaded, by its digest.", "^[0-9a-f]{64}$"));
        RefOr::T(order.build().into())
    }
}
