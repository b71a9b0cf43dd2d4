//! `molmesh sign`: signs a URL with a key of the service. The URL works without an API key until it expires.

use std::time::SystemTime;

use molmesh::access::SigningKeys;
use molmesh::config::Config;
use molmesh::http::check_signable;
use molmesh::pipeline::params::ParamError;

use super::args::SignArgs;
use super::error::CliError;
use super::key;

/// Runs the command: prints the signed URL.
pub(super) fn run(args: &SignArgs) -> Result<(), CliError> {
    let keys = keys(&super::config::load_with(args.config.as_deref(), &args.set, [])?.config)?;
    let (origin, target) = split(&args.url)?;
    let end = key::end(&args.expires)?;
    let expires = end.duration_since(SystemTime::UNIX_EPOCH).map(|since| since.as_secs()).unwrap_or_default();
    let signed = keys.sign(args.key_id.as_deref(), target, expires);
    let refused = |why: String| CliError::usage(format!("cannot sign `{}`: {why}", args.url));
    let signed = signed.map_err(|why| refused(why.to_string()))?;
    check_signable(target).map_err(refused)?;
    super::print(&format!("{origin}{signed}\n"))
}

fn keys(config: &Config) -> Result<SigningKeys, CliError> {
    let hint = "create one with `molmesh key signing`; set it in --config or MOLMESH__ACCESS__SIGNING_SECRET";
    let missing = || CliError::usage_with_hint("no signing key: access.signing_secret is not set", hint);
    let secret = config.access.signing_secret.as_ref().ok_or_else(missing)?;
    SigningKeys::parse(secret.reveal()).map_err(|why| CliError::usage(format!("access.signing_secret: {why}")))
}

/// Splits a URL into its origin, which is not signed, and the rest. The origin of a path is empty.
fn split(url: &str) -> Result<(&str, &str), CliError> {
    let Some((scheme, rest)) = url.split_once("://").filter(|(scheme, _)| !scheme.contains('/')) else {
        return Ok(("", url));
    };
    let path = rest.find('/').filter(|_| ["http", "https"].contains(&scheme));
    let at = path.ok_or_else(|| ParamError::bad_value("url", url, "http(s)://host/path, or a path"))?;
    Ok(url.split_at(scheme.len() + "://".len() + at))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn splits_a_url_before_its_path() {
        for (url, parts) in [
            ("https://h:8080/v1/x?a=b", Some(("https://h:8080", "/v1/x?a=b"))),
            ("/v1/x?next=http://h/", Some(("", "/v1/x?next=http://h/"))),
            ("https://h", None),
            ("ftp://h/x", None),
        ] {
            assert_eq!(split(url).ok(), parts, "{url}");
        }
    }
}
