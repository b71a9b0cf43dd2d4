//! API keys in the OpenAPI document: the scopes of each operation and its 401, 403 and 429 responses.

use utoipa::openapi::OpenApi;
use utoipa::openapi::path::Operation;
use utoipa::openapi::security::SecurityRequirement;

use super::problems;
use crate::access::Scope;
use crate::http::operations::{Parameters, TABLE};

/// Adds the security requirements, from the table that authorizes requests.
pub(super) fn restrict_operations(api: &mut OpenApi) {
    for row in TABLE {
        let Some(scope) = row.scope else { continue };
        let item = api.paths.paths.get_mut(row.path);
        let operation = item.and_then(|item| match row.method.as_str() {
            "GET" => item.get.as_mut(),
            "POST" => item.post.as_mut(),
            "DELETE" => item.delete.as_mut(),
            _ => None,
        });
        if let Some(operation) = operation {
            // A signature is valid for one URL; a list and a tileset have many.
            let is_signable = row.method == axum::http::Method::GET
                && !matches!(row.parameters, Parameters::Jobs | Parameters::Tileset);
            restrict(operation, scope, is_signable);
        }
    }
}

fn restrict(operation: &mut Operation, scope: Scope, is_signable: bool) {
    let scopes = || [scope.name()];
    let nothing: [&str; 0] = [];
    // The empty requirement: a server without keys accepts every request.
    let mut security = vec![
        SecurityRequirement::default(),
        SecurityRequirement::new("bearer", scopes()),
        SecurityRequirement::new("apiKey", scopes()),
    ];
    let mut groups = vec![problems::KEY];
    if is_signable {
        security.push(SecurityRequirement::new("signedAddress", nothing));
        groups.push(problems::SIGNED_URL);
    }
    operation.security = Some(security);
    operation.responses.responses.extend(problems::responses(&groups));
}
