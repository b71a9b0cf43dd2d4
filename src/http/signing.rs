//! Check of addresses before they are signed.

use axum::extract::Query;
use axum::http::{Method, Uri};

use super::batch_plan::BatchPlan;
use super::batch_state::Page;
use super::jobs::{MAX_WAIT_S, Poll};
use super::operations::{Operation, Parameters, TABLE};
use super::parsed_request::parse_address;
use super::problem::Problem;
use super::{atom_parameters, color_parameters, results};
use crate::formats::Format;
use crate::pipeline::params;
use crate::store::Namespace;

/// Checks that a signature can open `target`, a path with or without a query.
///
/// # Errors
/// Returns the reason for which it cannot.
pub fn check_signable(target: &str) -> Result<(), String> {
    let uri: Uri = target.parse().map_err(|error| format!("it is not a path with a query: {error}"))?;
    let rows = || TABLE.iter().filter(|row| matches(row.path, uri.path()));
    // A literal segment precedes a placeholder, as in the router.
    let row = rows().filter(|row| row.method == Method::GET).min_by_key(|row| row.path.matches('{').count());
    let Some(row) = row else {
        return Err(if rows().next().is_some() {
            "a signature allows GET only, which this path does not have".to_owned()
        } else {
            "the service has no such path".to_owned()
        });
    };
    if row.scope.is_none() {
        return Err("this path needs no signature".to_owned());
    }
    let file = uri.path().rsplit('/').next().filter(|_| row.path.ends_with("/{file}"));
    if let Some(file) = file.filter(|_| row.path.starts_with("/v1/results/"))
        && results::parse(file, Namespace::default()).is_none()
    {
        let extensions = Format::ALL.map(Format::name).join(", ");
        return Err(format!("a result has a name of 64 digits and one of the extensions {extensions}"));
    }
    check_parameters(row, file, &uri)
}

/// Returns true if a route matches a path.
fn matches(route: &str, path: &str) -> bool {
    let mut segments = path.split('/');
    let fits = |expected: &str| {
        segments.next().is_some_and(|found| expected == found || expected.starts_with('{') && !found.is_empty())
    };
    route.split('/').all(fits) && segments.next().is_none()
}

fn check_parameters(row: &Operation, file: Option<&str>, uri: &Uri) -> Result<(), String> {
    let Query(pairs) = Query::<Vec<(String, String)>>::try_from_uri(uri).map_err(|error| error.body_text())?;
    match row.parameters {
        Parameters::Mesh => parse_address(file, &pairs).map(drop).map_err(Problem::into_detail),
        Parameters::Atoms => atom_parameters::parse(&pairs).map(drop).map_err(|error| error.to_string()),
        Parameters::Areas => params::areas::parse(&pairs).map(drop).map_err(|error| error.to_string()),
        Parameters::Colors => color_parameters::parse(&pairs).map(drop).map_err(|error| error.to_string()),
        Parameters::Tileset => Err("a signature is valid for one URL, and a tileset has many; use a key".to_owned()),
        Parameters::Jobs => Err("a signature is valid for one URL, and a list has many pages; use a key".to_owned()),
        Parameters::Wait => {
            let Query(poll) = Query::<Poll>::try_from_uri(uri).map_err(|error| error.body_text())?;
            if poll.wait() <= MAX_WAIT_S { Ok(()) } else { Err(format!("`wait` is more than {MAX_WAIT_S} s")) }
        }
        Parameters::Batch => BatchPlan::parse(&pairs).map(drop).map_err(|error| error.to_string()),
        Parameters::Page => Page::parse(&pairs).map(drop).map_err(|error| error.to_string()),
        Parameters::None => match pairs.first() {
            Some((name, _)) => Err(format!("unknown parameter `{name}`; this path has none")),
            None => Ok(()),
        },
    }
}

#[cfg(test)]
mod tests {
    use super::check_signable;

    #[test]
    fn only_what_a_signature_opens_is_signable() {
        let digest = "0123456789abcdef".repeat(4);
        for good in [
            "/v1/pdb/4pti/surface.glb?resolution=1&chains=A,B",
            "/v1/pdb/4pti/report.json?preset=ses-like",
            "/v1/pdb/4pti/atoms",
            "/v1/capabilities",
            "/v1/jobs/7?wait=20",
            "/v1/jobs/7/events",
            "/v1/jobs/7/result",
            "/v1/batches/7?offset=100&limit=50",
            "/v1/batches/7/results.tar",
            &format!("/v1/structures/{digest}/surface.stl"),
            &format!("/v1/structures/{digest}/atoms"),
            &format!("/v1/results/{digest}.glb"),
            &format!("/v1/results/{digest}/report.json"),
        ] {
            assert_eq!(check_signable(good), Ok(()), "{good}");
        }
        for (bad, why) in [
            ("/nonexistent", "no such path"),
            ("/v1/pdb//surface.glb", "no such path"),
            ("/v1/capabilities/", "no such path"),
            ("/v1/meshes", "GET only"),
            ("/v1/estimate?resolution=1", "GET only"),
            ("/docs", "needs no signature"),
            ("/v1/pdb/4pti/surface.txt", "it has surface.glb"),
            ("/v1/pdb/4pti/mesh.glb", "no `mesh.glb`"),
            ("/v1/results/7.glb", "64 digits"),
            ("/v1/pdb/4pti/surface.glb?resolutoin=1", "did you mean `resolution`"),
            ("/v1/pdb/4pti/surface.glb?resolution=fine", "parameter `resolution`"),
            ("/v1/pdb/4pti/surface.glb?format=glb", "already names glb"),
            ("/v1/pdb/4pti/surface.glb?width=100", "`width`"),
            ("/v1/pdb/4pti/tileset.json", "a tileset has many"),
            ("/v1/jobs?limit=10", "a list has many pages"),
            ("/v1/jobs/7?wait=99", "more than 55"),
            ("/v1/batches/7?limit=1001", "from 1 to 1000"),
            ("/v1/jobs/7?wiat=9", "unknown field `wiat`"),
            ("/v1/jobs/7/result?wait=9", "`wait`; this path has none"),
        ] {
            let error = check_signable(bad).unwrap_err();
            assert!(error.contains(why), "{bad}: {error}");
        }
    }
}
