//! Configuration of the trace export.

use std::path::PathBuf;

use reqwest::Url;
use reqwest::header::{HeaderMap, HeaderName, HeaderValue};
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use super::Secret;
use super::store::HIDDEN;

section! {
    /// Export of traces to a collector with OTLP over HTTP (protobuf). Off by default.
    TelemetryConfig;
    /// Base URL of the collector, such as `http://localhost:4318`; spans are sent to `/v1/traces` below it. Default
    /// `none`: no spans are recorded. Trace ids are passed on and logged in any case.
    #[serde(deserialize_with = "endpoint")]
    #[schemars(regex(pattern = "^(none|https?://[^?#@]+)$"))]
    endpoint: Option<String> = None;
    /// Fraction of new traces that are sampled, from 0 to 1. Default 1. The sampled flag of
    /// `traceparent` decides for requests that have one.
    #[serde(deserialize_with = "ratio")]
    #[schemars(range(min = 0, max = 1))]
    sample_ratio: f64 = 1.0;
    /// HTTP headers for the collector, as `name=value,name=value`, such as an API key. Default `none`. Prefer the
    /// environment variable or `secret_headers_file` to the configuration file.
    #[schemars(with = "Option<Secret>")]
    secret_headers: Option<SecretHeaders> = None;
    /// File that contains the value of `secret_headers`. Default `none`.
    secret_headers_file: Option<PathBuf> = None;
    /// Maximum time to send a batch, retries included, ms. Fixed: the default of OpenTelemetry's exporters.
    #[serde(skip)]
    timeout_ms: u64 = 10_000;
    /// Maximum number of spans that wait for export; further ones are dropped. Fixed: the spans of some 250 requests,
    /// about 2 MB.
    #[serde(skip)]
    queue: usize = 4096;
    /// Maximum time to export the queued spans when the service stops, ms. Fixed: a running collector needs a fraction
    /// of it, and an unreachable one must not delay the stop.
    #[serde(skip)]
    flush_timeout_ms: u64 = 2000;
}

/// Deserializes a number from 0 to 1.
pub(super) fn ratio<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    let ratio = f64::deserialize(deserializer)?;
    let is_valid = (0.0..=1.0).contains(&ratio);
    if is_valid { Ok(ratio) } else { Err(serde::de::Error::custom("a number from 0 to 1")) }
}

/// Deserializes the base URL of a collector: `http(s)://host:port` with an optional path, without user name, password
/// or query.
fn endpoint<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<String>, D::Error> {
    let endpoint: Option<String> = Option::deserialize(deserializer)?;
    let is_valid = |url: Url| {
        let bare = url.username().is_empty() && url.password().is_none();
        ["http", "https"].contains(&url.scheme())
            && url.has_host()
            && bare
            && url.query().is_none()
            && url.fragment().is_none()
    };
    if endpoint.as_ref().is_none_or(|text| text.parse().is_ok_and(is_valid)) {
        return Ok(endpoint);
    }
    let expected = "none, or http(s)://host:port without a password; put secrets into secret_headers";
    Err(serde::de::Error::custom(expected))
}

/// HTTP headers that are never displayed or logged: their values are marked as sensitive.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SecretHeaders(HeaderMap);

impl SecretHeaders {
    /// Returns the headers.
    pub(crate) fn reveal(&self) -> &HeaderMap {
        &self.0
    }
}

impl Serialize for SecretHeaders {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(HIDDEN)
    }
}

impl<'de> Deserialize<'de> for SecretHeaders {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = Secret::deserialize(deserializer)?;
        let mut headers = HeaderMap::new();
        for pair in text.reveal().split(',').map(str::trim).filter(|pair| !pair.is_empty()) {
            let header = pair.split_once('=').and_then(|(name, value)| {
                let name = HeaderName::try_from(name.trim()).ok()?;
                let mut value = HeaderValue::try_from(value.trim()).ok()?;
                value.set_sensitive(true);
                Some((name, value))
            });
            let (name, value) = header.ok_or_else(|| serde::de::Error::custom("none, or name=value,name=value"))?;
            headers.insert(name, value);
        }
        Ok(Self(headers))
    }
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    #[test]
    fn urls_ratios_and_headers_are_validated() {
        let is_valid =
            |key: &str, value: Value| serde_json::from_value::<TelemetryConfig>(json!({ key: value })).is_ok();
        for good in ["http://localhost:4318", "https://c.example/otlp/"] {
            assert!(is_valid("endpoint", good.into()), "{good}");
        }
        for bad in ["localhost:4318", "ftp://h", "http://u:p@h", "http://u@h", "http://h/?key=1", "http://h/#x", ""] {
            assert!(!is_valid("endpoint", bad.into()), "{bad}");
        }
        for (ratio, good) in [(0.0, true), (0.25, true), (1.0, true), (1.1, false), (-0.1, false)] {
            assert_eq!(is_valid("sample_ratio", ratio.into()), good, "{ratio}");
        }
        let headers: SecretHeaders = serde_json::from_value(json!("api-key=sesame, x=a=b")).unwrap();
        assert_eq!(
            (&headers.reveal()["api-key"], &headers.reveal()["x"]),
            (&"sesame".parse().unwrap(), &"a=b".parse().unwrap())
        );
        let shown = format!("{headers:?} {:?} {}", headers.reveal(), serde_json::to_string(&headers).unwrap());
        assert!(!shown.contains("sesame"), "{shown}");
        for bad in ["sesame", "a b=sesame", "a=sesame\nx"] {
            let refused = serde_json::from_value::<SecretHeaders>(json!(bad)).unwrap_err().to_string();
            assert!(!refused.contains("sesame"), "{refused}");
        }
    }
}
