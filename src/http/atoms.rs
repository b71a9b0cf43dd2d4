//! `…/atoms`: identity of the atoms of a structure, in columns that are indexed by `_ATOM` of a mesh, or the atoms of a
//! mesh with their positions. Labels in the mesh itself would double the size of a small one.

use axum::body::Body;
use axum::http::header;
use axum::response::{IntoResponse, Response};
use serde::{Serialize, Serializer};
use utoipa::ToSchema;

use super::atom_parameters::{self, Positions};
use super::document;
use super::guard::Caller;
use super::openapi::meshes::NotModified;
use super::openapi::parameters::{AtomParameters, ConditionHeaders, StructurePath};
use super::openapi::problem_responses;
use super::parsed_request::Pairs;
use super::problem::Problem;
use super::source::{DocumentRequest, Loaded};
use super::state::{Delivery, Shared};
use crate::structure::{self, Selected, Structure, element};
use crate::surface::{MemoryMeter, OutOfMemory, Reservation};

/// Memory of a selected atom while atoms are selected, bytes: its index in a part, in the whole, and in the whole as it
/// grows.
pub(super) const SELECTED_BYTES: u64 = 3 * size_of::<u32>() as u64;

/// Atoms of all models in file order: row `i` describes the atom with index `i` in `_ATOM` of a mesh. With
/// `positions=true`, the atoms of a mesh in its order.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct AtomsDocument<'a> {
    /// Number of atoms, the length of each column of `atoms`.
    count: usize,
    /// Distinct atom names.
    names: Vec<&'a str>,
    /// Distinct element symbols; `?` for an unknown element.
    elements: Vec<&'static str>,
    /// Columns with one row per atom.
    atoms: AtomColumns<'a>,
    /// Columns with one row per residue.
    residues: ResidueColumns<'a>,
}

/// Columns with one row per atom.
#[derive(Debug, Default, Serialize, ToSchema)]
struct AtomColumns<'a> {
    /// Index into `names`.
    name: Vec<u32>,
    /// Index into `elements`.
    element: Vec<u8>,
    /// Index of the atom in the file, as in `_ATOM`; with `positions=true` only.
    #[serde(skip_serializing_if = "Option::is_none")]
    index: Option<&'a [u32]>,
    /// First coordinate in Å, rounded to 0.001 Å; with `positions=true` only, like `y` and `z`.
    #[serde(skip_serializing_if = "Option::is_none")]
    x: Option<Vec<f64>>,
    /// Second coordinate in Å.
    #[serde(skip_serializing_if = "Option::is_none")]
    y: Option<Vec<f64>>,
    /// Third coordinate in Å.
    #[serde(skip_serializing_if = "Option::is_none")]
    z: Option<Vec<f64>>,
}

/// Columns with one row per residue.
#[derive(Debug, Default, Serialize, ToSchema)]
struct ResidueColumns<'a> {
    /// Index of the first atom. The residue ends before the first atom of the next one.
    first: Vec<usize>,
    /// Residue name.
    name: Vec<&'a str>,
    /// Residue number given by the author.
    number: Vec<i32>,
    /// Insertion code; empty if there is none.
    #[schema(value_type = Vec<String>)]
    insertion_code: Vec<InsertionCode>,
    /// Chain name given by the author; empty if the file leaves it blank.
    chain: Vec<&'a str>,
    /// Model number.
    model: Vec<i32>,
    /// Kind of the first atom: `protein`, `nucleic`, `polymer` (any other polymer), `cofactor`, `glycan`, `ligand`
    /// (any other ligand), `ion`, `water` or `virtual` (a site that is not an atom).
    kind: Vec<&'static str>,
}

/// Insertion code as a text; 0 is none.
#[derive(Debug, PartialEq)]
struct InsertionCode(u8);

impl ResidueColumns<'_> {
    /// Memory of a residue, bytes.
    const BYTES_PER_ROW: u64 =
        (size_of::<usize>() + 3 * size_of::<&str>() + 2 * size_of::<i32>() + size_of::<InsertionCode>()) as u64;
}

impl Serialize for InsertionCode {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        if self.0 == 0 { serializer.serialize_str("") } else { serializer.serialize_char(char::from(self.0)) }
    }
}

problem_responses!(Problems: [READING LISTING] TooManyCopies);

/// List the atoms of a structure
///
/// A mesh with `atom_ids=true` has a vertex attribute `_ATOM` (`atom` in PLY): the row of the nearest atom in this
/// list. With `positions=true`, the list has the atoms of a mesh only, and their positions.
#[utoipa::path(get, path = "/v1/structures/{digest}/atoms", tag = "structures", operation_id = "listAtoms",
    params(StructurePath, AtomParameters, ConditionHeaders),
    responses(
        (status = 200, description = "The atoms.", body = AtomsDocument, headers(("ETag"), ("Cache-Control"))),
        NotModified, Problems,
    ))]
pub(super) async fn list(request: DocumentRequest, query: Pairs) -> Result<Response, Problem> {
    let positions = atom_parameters::parse(&query.0)?;
    let variant = positions.as_ref().map_or_else(String::new, |positions| positions.canonical.clone());
    let write = async |loaded, delivery| write_list(&request.app, &request.caller, loaded, delivery, positions).await;
    request.document(&variant, None, write).await
}

async fn write_list(
    app: &Shared,
    caller: &Caller,
    loaded: Loaded,
    delivery: Delivery,
    positions: Option<Positions>,
) -> Result<Response, Problem> {
    let listing = loaded.list_atoms(app, caller, delivery, move |structure, limits, control, memory| {
        let select =
            |Positions { selection, .. }: Positions| structure::select_with(structure, &selection, limits, control);
        if positions.is_some() {
            control.memory.grow(SELECTED_BYTES * structure.len() as u64)?;
        }
        let selected = positions.map(select).transpose()?;
        let columns = Reservation::new(&control.memory);
        let document = document(structure, selected.as_ref(), &columns)?;
        document::collect(memory, control, |out| Ok(serde_json::to_writer(out, &document)?))
    });
    Ok(([(header::CONTENT_TYPE, "application/json")], Body::from(listing.await?)).into_response())
}

/// Builds the columns, of the selected atoms with their positions or of all atoms, charged to `memory`.
fn document<'a>(
    structure: &'a Structure,
    selected: Option<&'a Selected>,
    memory: &Reservation,
) -> Result<AtomsDocument<'a>, OutOfMemory> {
    let count = selected.map_or(structure.len(), |selected| selected.atoms.len());
    let index = |row: usize| selected.map_or(row, |selected| selected.atoms[row] as usize);
    let copies = selected.map_or(&[][..], |selected| &selected.copies);
    // Copies are in the order of their rows.
    let starts_copy = |row: usize| copies.binary_search_by_key(&row, |copy| copy.rows.start).is_ok();
    let starts_residue =
        |row: usize| row == 0 || starts_copy(row) || !structure.same_residue(index(row - 1), index(row));
    let mut residues = ResidueColumns::default();
    let n_residues = (0..count).filter(|row| starts_residue(*row)).count();
    memory.grow(ResidueColumns::BYTES_PER_ROW * n_residues as u64)?;
    residues.first.reserve_exact(n_residues);
    residues.first.extend((0..count).filter(|row| starts_residue(*row)));
    let first = || residues.first.iter().map(|row| index(*row));
    residues.name = first().map(|i| structure.residue.get(i)).collect();
    residues.number = first().map(|i| structure.residue_number[i]).collect();
    residues.insertion_code = first().map(|i| InsertionCode(structure.insertion_code[i])).collect();
    residues.chain = first().map(|i| structure.chain.get(i)).collect();
    residues.model = first().map(|i| structure.model[i]).collect();
    residues.kind = first().map(|i| structure.kind[i].name()).collect();
    let mut elements: Vec<&'static str> = Vec::new();
    // Index of each atomic number in `elements`.
    let mut element_at = [u8::MAX; 1 + element::SYMBOLS.len()];
    let mut element = |i: usize| {
        let number = usize::from(structure.element[i]);
        if element_at[number] == u8::MAX {
            element_at[number] = u8::try_from(elements.len()).unwrap_or(0);
            elements.push(if number == 0 { "?" } else { element::SYMBOLS[number - 1] });
        }
        element_at[number]
    };
    memory.grow((size_of::<u32>() + size_of::<u8>()) as u64 * count as u64)?;
    let mut atoms = AtomColumns {
        name: (0..count).map(|row| structure.name.id(index(row))).collect(),
        element: (0..count).map(|row| element(index(row))).collect(),
        ..AtomColumns::default()
    };
    if let Some(selected) = selected {
        memory.grow(6 * size_of::<f64>() as u64 * count as u64)?;
        let [x, y, z] = positions(structure, selected);
        atoms.index = Some(&selected.atoms);
        (atoms.x, atoms.y, atoms.z) = (Some(x), Some(y), Some(z));
    }
    memory.grow((size_of::<&str>() * structure.name.texts().len()) as u64)?;
    Ok(AtomsDocument { count, names: structure.name.texts().collect(), elements, atoms, residues })
}

/// Returns the coordinates of the selected atoms, with their copies, in Å, rounded to 0.001 Å.
fn positions(structure: &Structure, selected: &Selected) -> [Vec<f64>; 3] {
    let position = |row: usize| {
        let i = selected.atoms[row] as usize;
        [structure.x[i], structure.y[i], structure.z[i]]
    };
    let mut all: Vec<[f64; 3]> = (0..selected.atoms.len()).map(position).collect();
    for copy in &selected.copies {
        all[copy.rows.clone()].iter_mut().for_each(|place| *place = copy.operator.apply(*place));
    }
    [0, 1, 2].map(|axis| all.iter().map(|place| (place[axis] * 1000.0).round() / 1000.0).collect())
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::jobs::Budget;
    use crate::structure::{ReadLimits, Selection};
    use crate::surface::Control;

    #[test]
    fn columns_are_charged_before_they_are_built() {
        let structure = structure::read(include_bytes!("../../samples/4pti.pdb"), &ReadLimits::default()).unwrap();
        let listed = |limit: u64| {
            let memory: Arc<dyn MemoryMeter> = Arc::new(Budget::new(limit).reservation());
            let columns = Reservation::new(&memory);
            let listed = document(&structure, None, &columns)?;
            let rows = (5 * listed.count + 65 * listed.residues.first.len()) as u64;
            Ok::<_, OutOfMemory>((rows, memory.budget().unwrap()[1]))
        };
        let (rows, held) = listed(1 << 20).unwrap();
        assert!((rows..rows + 4096).contains(&held), "{rows} {held}");
        for limit in [100, rows / 2, held - 1] {
            assert!(matches!(listed(limit), Err(OutOfMemory::Limit { .. })), "{limit}");
        }
    }

    #[test]
    fn rows_are_those_of_the_file() {
        let text = include_bytes!("../../samples/4pti.pdb");
        let structure = structure::read(text, &ReadLimits::default()).unwrap();
        let memory = Reservation::new(&Control::default().memory);
        let listed = document(&structure, None, &memory).unwrap();
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
    }

    #[test]
    fn copies_of_an_assembly_are_listed_with_their_positions() {
        // Read at run time: the build of a container has no tests.
        let packed = std::fs::read(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/structures/1pfe.cif.gz")).unwrap();
        let structure = structure::read(&packed, &ReadLimits::default()).unwrap();
        let mut selection = Selection { atoms: "ligand".parse().unwrap(), ..Selection::default() };
        let memory = Reservation::new(&Control::default().memory);
        let unit = structure::select(&structure, &selection).unwrap();
        let one = document(&structure, Some(&unit), &memory).unwrap();
        selection.assembly = Some("1".to_owned());
        let assembly = structure::select(&structure, &selection).unwrap();
        let two = document(&structure, Some(&assembly), &memory).unwrap();
        // Two quinoxaline-2-carboxylic acids with 12 atoms each; the assembly has two copies.
        assert_eq!((one.count, two.count), (24, 48));
        assert_eq!((&one.residues.name[..], &one.residues.first[..]), (&["QUI", "QUI"][..], &[0, 12][..]));
        assert_eq!(two.residues.first, [0, 12, 24, 36]);
        let placed = |listed: &AtomsDocument<'_>| -> Vec<(u32, [f64; 3])> {
            let AtomColumns { index, x, y, z, .. } = &listed.atoms;
            let [x, y, z] = [x, y, z].map(|axis| axis.clone().unwrap());
            index.unwrap().iter().enumerate().map(|(row, &i)| (i, [x[row], y[row], z[row]])).collect()
        };
        let (unit, assembly) = (placed(&one), placed(&two));
        assert_eq!(assembly[..24], unit);
        // Operator 2 of the file: -x, -x + y, -z of a hexagonal cell.
        let sine = 0.866_025_403_8;
        for ((index, [x, y, z]), (copied, moved)) in unit.into_iter().zip(&assembly[24..]) {
            let row = index as usize;
            assert!((x - structure.x[row]).abs() < 6e-4 && structure.residue.get(row) == "QUI", "{row}");
            let expected = [-0.5 * x - sine * y, -sine * x + 0.5 * y, -z];
            let error = expected.iter().zip(moved).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            assert!(error < 2e-3 && *copied == index, "{row}: {error}");
        }
    }
}
