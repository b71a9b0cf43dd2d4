//! Archive entries in the OpenAPI document. A handler below the path of an uploaded structure also answers below that
//! of an archive entry, and one description is for both.

use utoipa::IntoParams;
use utoipa::openapi::path::Operation;
use utoipa::openapi::{OpenApi, RefOr};

use super::components::PROBLEM_TYPES_EXTENSION;
use super::parameters::EntryPath;
use super::problems;
use crate::http::problem_types::{PROBLEM_TYPES, ProblemType};

/// Adds the operations on archive entries, and the problems of naming a structure or an entry.
pub(super) fn describe(api: &mut OpenApi) {
    let mut entries = Vec::new();
    for (path, item) in &mut api.paths.paths {
        let Some(end) = path.strip_prefix("/v1/structures/{digest}/") else { continue };
        let mut entry = item.clone();
        entry.get.iter_mut().for_each(name_entry);
        item.get.iter_mut().for_each(|operation| add_problems(operation, problems::STRUCTURE));
        entries.push((format!("/v1/pdb/{{id}}/{end}"), entry));
    }
    api.paths.paths.extend(entries);
}

/// Changes an operation on an uploaded structure to the same operation on an archive entry.
fn name_entry(operation: &mut Operation) {
    add_problems(operation, problems::ENTRY);
    operation.operation_id = operation.operation_id.as_deref().map(entry_operation_id);
    let summary = operation.summary.as_ref();
    operation.summary = summary
        .map(|text| text.replace("an uploaded structure", "a structure").replace("a structure", "an archive entry"));
    for parameter in operation.parameters.iter_mut().flatten() {
        if let RefOr::T(parameter) = parameter
            && parameter.name == "digest"
            && let Some(id) = EntryPath::into_params(|| None).pop()
        {
            *parameter = id;
        }
    }
}

/// Converts `meshStructure` to `meshEntry`, and `listAtoms` to `listEntryAtoms`.
fn entry_operation_id(id: &str) -> String {
    let verb = id.find(char::is_uppercase).unwrap_or(id.len());
    format!("{}Entry{}", &id[..verb], id[verb..].trim_start_matches("Structure"))
}

/// Adds problem types to the responses of an operation.
fn add_problems(operation: &mut Operation, more: &[ProblemType]) {
    let is_present = |problem_type: &ProblemType| {
        let all = operation.responses.responses.values();
        let mut lists = all.filter_map(|response| match response {
            RefOr::T(response) => response.extensions.as_ref()?.get(PROBLEM_TYPES_EXTENSION)?.as_array(),
            RefOr::Ref(_) => None,
        });
        lists.any(|slugs| slugs.iter().any(|slug| *slug == problem_type.row().slug))
    };
    let present: Vec<ProblemType> = PROBLEM_TYPES.iter().map(|row| row.problem_type).filter(is_present).collect();
    operation.responses.responses.extend(problems::responses(&[&present, more]));
}

#[cfg(test)]
mod tests {
    use super::entry_operation_id;

    #[test]
    fn operation_ids_name_the_entry() {
        let ids = ["meshStructure", "listAtoms", "colorAtoms", "showSubtree"].map(entry_operation_id);
        assert_eq!(ids, ["meshEntry", "listEntryAtoms", "colorEntryAtoms", "showEntrySubtree"]);
    }
}
