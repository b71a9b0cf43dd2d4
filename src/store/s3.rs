//! S3 and compatible services.

use std::error::Error as StdError;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use object_store::aws::{AmazonS3, AmazonS3Builder, AmazonS3ConfigKey};
use object_store::client::{HttpClient, HttpConnector as _, HttpRequest, HttpRequestBody, ReqwestConnector};
use object_store::multipart::MultipartStore as _;
use object_store::path::Path;
use object_store::prefix::PrefixStore;
use object_store::signer::{SignedUrlOptions, Signer as _};
use object_store::{BackoffConfig, ClientConfigKey, ClientOptions, ObjectStore, RetryConfig};

use super::name::Name;
use super::stale::is_stale;
use crate::config::StoreConfig;

/// Time limit for retries. Readiness probes must not exceed the timeout of their caller.
const RETRY: Duration = Duration::from_secs(10);

/// Bucket, for operations that [`ObjectStore`] lacks.
pub(super) struct Bucket {
    s3: AmazonS3,
    client: HttpClient,
    prefix: Path,
}

/// Splits `s3://bucket/prefix` into bucket and prefix.
fn split(url: &str) -> Option<(&str, Path)> {
    let rest = url.strip_prefix("s3://")?;
    let (bucket, prefix) = rest.split_once('/').unwrap_or((rest, ""));
    let good = |c: u8| c.is_ascii_alphanumeric() || matches!(c, b'-' | b'.' | b'_');
    (!bucket.is_empty() && bucket.bytes().all(good)).then_some(())?;
    Some((bucket, Path::parse(prefix).ok()?))
}

/// Values of environment variables that mean true.
const TRUE: [&str; 5] = ["1", "true", "on", "yes", "y"];

/// Returns the object store below the prefix, and the bucket. Sends nothing yet.
pub(super) fn connect(config: &StoreConfig, url: &str) -> Result<(Arc<dyn ObjectStore>, Bucket), String> {
    let (name, prefix) = split(url).ok_or("expected s3://bucket or s3://bucket/prefix")?;
    let key = AmazonS3ConfigKey::Client;
    let mut builder = AmazonS3Builder::from_env()
        .with_bucket_name(name)
        // Not every service supports bulk deletion, and few objects are deleted at once.
        .with_disable_bulk_delete(true)
        // Clients may read slowly, so only the time between two reads of a body is limited, not the total.
        .with_config(key(ClientConfigKey::Timeout), "1day")
        .with_config(key(ClientConfigKey::ReadTimeout), format!("{}ms", config.timeout_ms))
        .with_config(key(ClientConfigKey::ConnectTimeout), format!("{}ms", config.timeout_ms.min(5000)))
        .with_retry(RetryConfig { backoff: BackoffConfig::default(), max_retries: 3, retry_timeout: RETRY });
    let mut plain = ClientOptions::new().with_timeout(Duration::from_millis(config.timeout_ms));
    if config.allow_http {
        builder = builder.with_allow_http(true);
        plain = plain.with_allow_http(true);
    }
    if let Some(region) = &config.region {
        builder = builder.with_region(region);
    }
    if let Some(endpoint) = &config.endpoint {
        let endpoint = endpoint.trim_end_matches('/');
        // `AWS_ENDPOINT_URL_S3` precedes the other one.
        builder = builder.with_endpoint(endpoint).with_config(AmazonS3ConfigKey::S3Endpoint, endpoint);
    }
    if let Some(id) = &config.access_key_id {
        builder = builder.with_access_key_id(id);
    }
    if let Some(secret) = &config.secret_access_key {
        builder = builder.with_secret_access_key(secret.reveal());
    }
    let value = |key| builder.get_config_value(&key);
    let allows_http =
        value(key(ClientConfigKey::AllowHttp)).is_some_and(|value| TRUE.contains(&value.to_ascii_lowercase().as_str()));
    let endpoint = value(AmazonS3ConfigKey::S3Endpoint).or_else(|| value(AmazonS3ConfigKey::Endpoint));
    if let Some(endpoint) = endpoint.filter(|url| url.starts_with("http://") && !allows_http) {
        return Err(format!("the endpoint {endpoint} is not encrypted; store.allow_http permits it"));
    }
    crate::tls::install_provider();
    let s3 = builder.build().map_err(|e| e.to_string())?;
    let client = ReqwestConnector::default().connect(&plain).map_err(|e| e.to_string())?;
    let objects: Arc<dyn ObjectStore> = Arc::new(PrefixStore::new(s3.clone(), prefix.clone()));
    Ok((objects, Bucket { s3, client, prefix }))
}

impl Bucket {
    /// Aborts stale multipart uploads of the store. Handles one page of up to 1,000; the next call continues.
    pub(super) async fn clear_uploads(&self, now: SystemTime) -> Result<u64, Box<dyn StdError + Send + Sync>> {
        let query = SignedUrlOptions::new().with_query([("uploads", ""), ("prefix", self.prefix.as_ref())]);
        // The crate does not export the type of the method.
        let url = self.s3.signed_url_opts("GET".parse()?, &Path::default(), RETRY, &query).await?;
        let mut request = HttpRequest::new(HttpRequestBody::empty());
        *request.uri_mut() = url.as_str().parse()?;
        // The error message of the client would contain the signed URL.
        let answer = self.client.execute(request).await.map_err(|e| format!("no answer: {:?}", e.kind()))?;
        let status = answer.status();
        let body = answer.into_body().bytes().await?;
        if !status.is_success() {
            return Err(format!("unfinished uploads cannot be listed: {status}").into());
        }
        let mut removed = 0;
        for upload in uploads(&String::from_utf8_lossy(&body)) {
            // Other applications may use the bucket, with keys that are not valid paths.
            let Ok(path) = Path::parse(&upload.key) else { continue };
            let below = path.prefix_match(&self.prefix).map(Path::from_iter);
            let ours = below.is_some_and(|path| Name::from_path(path.as_ref()).is_some());
            if ours && is_stale(upload.begun, now) {
                self.s3.abort_multipart(&path, &upload.id).await?;
                removed += 1;
            }
        }
        Ok(removed)
    }
}

#[derive(Debug, PartialEq)]
struct Unfinished {
    key: String,
    id: String,
    begun: SystemTime,
}

/// Parses a `ListMultipartUploadsResult`. Ignores keys with escapes, which the store does not write.
fn uploads(xml: &str) -> Vec<Unfinished> {
    let one = |upload: &str| {
        let text = |tag: &str| {
            let (_, rest) = upload.split_once(&format!("<{tag}>"))?;
            rest.split_once("</").map(|(text, _)| text.trim().to_owned())
        };
        Some(Unfinished {
            key: text("Key")?,
            id: text("UploadId")?,
            begun: humantime::parse_rfc3339(&text("Initiated")?).ok()?,
        })
    };
    xml.split("<Upload>").skip(1).filter_map(one).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn urls_have_a_bucket_and_an_optional_prefix() {
        let of = |url| split(url).map(|(bucket, prefix)| (bucket, prefix.to_string()));
        assert_eq!(of("s3://meshes"), Some(("meshes", String::new())));
        assert_eq!(of("s3://meshes/"), Some(("meshes", String::new())));
        assert_eq!(of("s3://meshes/a/b/"), Some(("meshes", "a/b".to_owned())));
        for bad in
            ["", "meshes", "http://meshes", "s3://", "s3:///a", "s3://key:secret@meshes", "s3://m/a//b", "s3://m/../b"]
        {
            assert_eq!(of(bad), None, "{bad}");
        }
    }

    #[test]
    fn an_endpoint_without_encryption_must_be_permitted() {
        let mut config = StoreConfig { endpoint: Some("http://s3.test:9000".to_owned()), ..StoreConfig::default() };
        let refused = connect(&config, "s3://meshes").map(drop).unwrap_err();
        assert!(refused.contains("http://s3.test:9000") && refused.contains("store.allow_http"), "{refused}");
        config.allow_http = true;
        connect(&config, "s3://meshes").map(drop).unwrap();
    }

    #[test]
    fn uploads_are_parsed_and_malformed_ones_ignored() {
        let upload = |key: &str, time: &str| {
            format!("<Upload>\n<Key>{key}</Key><UploadId> x1 </UploadId><Initiated>{time}</Initiated></Upload>")
        };
        let xml = format!(
            "<ListMultipartUploadsResult><Bucket>b</Bucket>{}{}<Upload><Key>c</Key></Upload></ListMultipartUploadsResult>",
            upload("a/b", "1970-01-02T00:00:01.500Z"),
            upload("c", "yesterday"),
        );
        let begun = SystemTime::UNIX_EPOCH + Duration::from_millis(86_401_500);
        assert_eq!(uploads(&xml), [Unfinished { key: "a/b".to_owned(), id: "x1".to_owned(), begun }]);
        assert_eq!(uploads("<ListMultipartUploadsResult/>"), []);
        let hour = Duration::from_hours(1);
        assert!(is_stale(begun, begun + hour) && !is_stale(begun, begun + hour / 2) && !is_stale(begun, begun - hour));
    }
}
