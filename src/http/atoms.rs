//! `…/atoms`: identity of the atoms of a structure, in columns that are indexed by `_ATOM` of a mesh.

use axum::body::Body;
use axum::extract::State;
use axum::http::header::{self, HeaderMap};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use utoipa::ToSchema;

use super::guard::Caller;
use super::kinds::Kind;
use super::openapi::meshes::NotModified;
use super::openapi::parameters::{ConditionHeaders, EntryPath, StructurePath};
use super::openapi::problem_responses;
use super::openapi::problems::READING;
use super::problem::Problem;
use super::source::{Loaded, StructureSource};
use super::state::{Delivery, Shared};
use crate::structure::{Structure, element};

/// Memory charged for the document, bytes per atom: two numbers, and a tenth of a residue with five.
const BYTES_PER_ATOM: u64 = 24;

/// Atoms of all models in file order. Row `i` describes the atom with index `i` in `_ATOM` of a mesh.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct AtomsDocument {
    /// Number of atoms, the length of each column of `atoms`.
    count: usize,
    /// Distinct atom names.
    names: Vec<String>,
    /// Distinct element symbols; `?` for an unknown element.
    elements: Vec<&'static str>,
    /// Columns with one row per atom.
    atoms: AtomColumns,
    /// Columns with one row per residue.
    residues: ResidueColumns,
}

/// Columns with one row per atom.
#[derive(Debug, Default, Serialize, ToSchema)]
struct AtomColumns {
    /// Index into `names`.
    name: Vec<u32>,
    /// Index into `elements`.
    element: Vec<u8>,
}

/// Columns with one row per residue.
#[derive(Debug, Default, Serialize, ToSchema)]
struct ResidueColumns {
    /// Index of the first atom. The residue ends before the first atom of the next one.
    first: Vec<usize>,
    /// Residue name.
    name: Vec<String>,
    /// Residue number given by the author.
    number: Vec<i32>,
    /// Insertion code; empty if there is none.
    insertion_code: Vec<String>,
    /// Chain name given by the author; empty if the file leaves it blank.
    chain: Vec<String>,
    /// Model number.
    model: Vec<i32>,
    /// Kind of the first atom: `protein`, `nucleic`, `polymer` (any other polymer), `cofactor`, `glycan`, `ligand`
    /// (any other ligand), `ion`, `water` or `virtual` (a site that is not an atom).
    kind: Vec<&'static str>,
}

problem_responses!(StructureProblems: [
    READING,
    [
        Kind::BadRequest, Kind::BadParameter, Kind::NoSuchStructure, Kind::PreconditionFailed,
        Kind::TooMuchMemory, Kind::MemoryFull,
        Kind::QueueFull, Kind::TooManyDeliveries, Kind::ShareExceeded, Kind::StoreFailed,
    ],
]);
problem_responses!(EntryProblems: [READING, [
    Kind::BadRequest, Kind::BadParameter, Kind::NotInArchive, Kind::EntryTooLarge, Kind::ArchiveUnavailable,
    Kind::PreconditionFailed, Kind::TooMuchMemory, Kind::MemoryFull, Kind::QueueFull,
    Kind::TooManyDeliveries, Kind::ShareExceeded,
]]);

/// List the atoms of a structure
///
/// A mesh with `atom_ids=true` has a vertex attribute `_ATOM` (`atom` in PLY): the row of the nearest atom in this
/// list.
#[utoipa::path(get, path = "/v1/structures/{digest}/atoms", tag = "structures", operation_id = "listAtoms",
    params(StructurePath, ConditionHeaders),
    responses(
        (status = 200, description = "The atoms.", body = AtomsDocument, headers(
            ("ETag" = String, description = "Strong validator: equal tags mean equal bytes."),
            ("Cache-Control" = String, description = "Caching rules."),
        )),
        NotModified, StructureProblems,
    ))]
pub(super) async fn of_structure(
    State(app): State<Shared>,
    caller: Caller,
    source: StructureSource,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    source
        .document(&app, &caller, &headers, "", async |loaded, delivery| list(&app, &caller, loaded, delivery).await)
        .await
}

/// List the atoms of an archive entry
///
/// A mesh with `atom_ids=true` has a vertex attribute `_ATOM` (`atom` in PLY): the row of the nearest atom in this
/// list.
#[utoipa::path(get, path = "/v1/pdb/{id}/atoms", tag = "structures", operation_id = "listEntryAtoms",
    params(EntryPath, ConditionHeaders),
    responses(
        (status = 200, description = "The atoms.", body = AtomsDocument, headers(
            ("ETag" = String, description = "Strong validator: equal tags mean equal bytes."),
            ("Cache-Control" = String, description = "Caching rules."),
        )),
        NotModified, EntryProblems,
    ))]
pub(super) async fn of_entry(
    State(app): State<Shared>,
    caller: Caller,
    source: StructureSource,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    source
        .document(&app, &caller, &headers, "", async |loaded, delivery| list(&app, &caller, loaded, delivery).await)
        .await
}

async fn list(app: &Shared, caller: &Caller, loaded: Loaded, delivery: Delivery) -> Result<Response, Problem> {
    let text = |structure: &Structure| serde_json::to_vec(&document(structure)).map_err(Problem::internal);
    let listing =
        loaded.list_atoms(app, caller, delivery, BYTES_PER_ATOM, move |structure, _, _| Ok((text(structure)?, ())));
    let (text, ()) = listing.await?;
    Ok(([(header::CONTENT_TYPE, "application/json")], Body::from(text)).into_response())
}

/// Builds the columns.
fn document(structure: &Structure) -> AtomsDocument {
    let count = structure.len();
    let mut elements: Vec<&'static str> = Vec::new();
    // Index of each atomic number in `elements`.
    let mut element_at = [u8::MAX; 1 + element::SYMBOLS.len()];
    let mut atoms = AtomColumns { name: structure.name.ids().to_vec(), element: Vec::with_capacity(count) };
    let mut residues = ResidueColumns::default();
    for i in 0..count {
        let number = usize::from(structure.element[i]);
        if element_at[number] == u8::MAX {
            element_at[number] = u8::try_from(elements.len()).unwrap_or(0);
            elements.push(if number == 0 { "?" } else { element::SYMBOLS[number - 1] });
        }
        atoms.element.push(element_at[number]);
        if i > 0 && same_residue(structure, i - 1, i) {
            continue;
        }
        residues.first.push(i);
        residues.name.push(structure.residue.get(i).to_owned());
        residues.number.push(structure.residue_number[i]);
        let code = structure.insertion_code[i];
        residues.insertion_code.push(if code == 0 { String::new() } else { char::from(code).to_string() });
        residues.chain.push(structure.chain.get(i).to_owned());
        residues.model.push(structure.model[i]);
        residues.kind.push(structure.kind[i].name());
    }
    AtomsDocument { count, names: structure.name.texts().map(str::to_owned).collect(), elements, atoms, residues }
}

fn same_residue(structure: &Structure, a: usize, b: usize) -> bool {
    structure.residue_number[a] == structure.residue_number[b]
        && structure.insertion_code[a] == structure.insertion_code[b]
        && structure.residue.id(a) == structure.residue.id(b)
        && structure.chain.id(a) == structure.chain.id(b)
        && structure.model[a] == structure.model[b]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::structure::{self, ReadLimits};

    #[test]
    fn rows_are_those_of_the_file() {
        let text = include_bytes!("../../samples/4pti.pdb");
        let structure = structure::read(text, &ReadLimits::default()).unwrap();
        let listed = document(&structure);
        let text = std::str::from_utf8(text).unwrap();
        let lines: Vec<&str> = text.lines().filter(|l| l.starts_with("ATOM") || l.starts_with("HETATM")).collect();
        assert_eq!(
            (listed.count, listed.atoms.name.len(), listed.atoms.element.len()),
            (lines.len(), lines.len(), lines.len())
        );
        let mut ends = listed.residues.first[1..].to_vec();
        ends.push(lines.len());
        for (r, (&first, &end)) in listed.residues.first.iter().zip(&ends).enumerate() {
            assert!(first < end);
            for (row, line) in lines.iter().enumerate().take(end).skip(first) {
                let [name, residue, chain, number] = [12..16, 17..20, 21..22, 22..26].map(|c| line[c].trim());
                assert_eq!(listed.names[listed.atoms.name[row] as usize], name, "{line}");
                assert_eq!(listed.elements[usize::from(listed.atoms.element[row])], line[76..78].trim(), "{line}");
                assert_eq!(listed.residues.name[r], residue, "{line}");
                assert_eq!(listed.residues.chain[r], chain, "{line}");
                assert_eq!(listed.residues.number[r].to_string(), number, "{line}");
            }
        }
        assert_eq!(listed.residues.kind.first(), Some(&"protein"));
        assert_eq!(listed.residues.kind.last(), Some(&"water"));
        // The charged memory suffices.
        let bytes = serde_json::to_vec(&listed).unwrap().len() as u64;
        assert!(bytes < BYTES_PER_ATOM * listed.count as u64, "{bytes}");
    }
}
