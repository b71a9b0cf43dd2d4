//! API keys in the OpenAPI document: security schemes, the scopes of each operation and its 401, 403 and 429 responses.

use utoipa::openapi::path::Operation;
use utoipa::openapi::security::{
    ApiKey, ApiKeyValue, HttpAuthScheme, HttpBuilder, SecurityRequirement, SecurityScheme,
};
use utoipa::openapi::{ComponentsBuilder, OpenApi};

use super::problems::responses;
use crate::access::{SIGNATURE, Scope};
use crate::http::operations::TABLE;
use crate::http::problem_types::ProblemType;

/// Names of the security schemes.
const BEARER: &str = "bearer";
const API_KEY: &str = "apiKey";
const SIGNED: &str = "signedAddress";

/// Problems of an operation that requires a scope.
const KEY_PROBLEMS: &[ProblemType] = &[
    ProblemType::KeyRequired,
    ProblemType::KeyInvalid,
    ProblemType::KeyExpired,
    ProblemType::ScopeMissing,
    ProblemType::QuotaExceeded,
];
/// Further problems of an operation that accepts signed URLs.
const SIGNED_URL_PROBLEMS: &[ProblemType] = &[ProblemType::SignatureInvalid, ProblemType::SignatureExpired];

/// Adds the security requirements, from the table that authorizes requests.
pub(super) fn restrict_operations(api: &mut OpenApi) {
    let components = api.components.get_or_insert_with(|| ComponentsBuilder::new().build());
    let bearer = HttpBuilder::new()
        .scheme(HttpAuthScheme::Bearer)
        .bearer_format("mm_ID_SECRET")
        .description(Some("API key, if the operator requires one."))
        .build();
    components.add_security_scheme(BEARER, SecurityScheme::Http(bearer));
    let header =
        ApiKeyValue::with_description("X-Api-Key", "The same API key, for clients that cannot set `Authorization`.");
    components.add_security_scheme(API_KEY, SecurityScheme::ApiKey(ApiKey::Header(header)));
    let query = ApiKeyValue::with_description(
        SIGNATURE,
        "Signature of a URL made by `molmesh sign`, beside `expires` and `key_id`. Replaces a key.",
    );
    components.add_security_scheme(SIGNED, SecurityScheme::ApiKey(ApiKey::Query(query)));
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
            restrict(operation, scope, row.method == axum::http::Method::GET);
        }
    }
}

fn restrict(operation: &mut Operation, scope: Scope, is_get: bool) {
    let scopes = || [scope.name()];
    let nothing: [&str; 0] = [];
    // The empty requirement: a server without keys accepts every request.
    let mut security = vec![
        SecurityRequirement::default(),
        SecurityRequirement::new(BEARER, scopes()),
        SecurityRequirement::new(API_KEY, scopes()),
    ];
    let mut groups = vec![KEY_PROBLEMS];
    if is_get {
        security.push(SecurityRequirement::new(SIGNED, nothing));
        groups.push(SIGNED_URL_PROBLEMS);
    }
    operation.security = Some(security);
    operation.responses.responses.extend(responses(&groups));
}
