//! Configuration of the trace export.

use std::borrow::Cow;
use std::fmt;
use std::path::PathBuf;

use reqwest::Url;
use reqwest::header::{HeaderMap, HeaderName, HeaderValue};
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use super::Secret;

/// Export of traces to a collector with OTLP over HTTP (protobuf). Off by default.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct TelemetryConfig {
    /// Base URL of the collector, such as `http://localhost:4318`; spans are sent to `/v1/traces` below it. Default
    /// `none`: no spans are recorded. Trace ids are passed on and logged in any case.
    pub endpoint: Option<CollectorUrl>,
    /// Fraction of new traces that are sampled, from 0 to 1. Default 1. A request with `traceparent` is sampled as its
    /// sampled flag says.
    pub sample_ratio: Ratio,
    /// Value of the resource attribute `service.name`. Default `molmesh`.
    pub service_name: String,
    /// HTTP headers for the collector, as `name=value,name=value`, such as an API key. Default `none`. Prefer the
    /// environment variable or `secret_headers_file` to the configuration file.
    pub secret_headers: Option<SecretHeaders>,
    /// File that contains the value of `secret_headers`. Default `none`.
    pub secret_headers_file: Option<PathBuf>,
    /// Maximum time to send a batch, retries included, ms. Default 10,000, the default of OpenTelemetry's exporters.
    pub timeout_ms: u64,
    /// Maximum number of spans that wait for export; further ones are dropped. Default 4,096: the spans of some 250
    /// requests, about 2 MB.
    pub queue: usize,
    /// Maximum time to export the queued spans when the service stops, ms. Default 2,000: a running collector needs a
    /// fraction of it, and an unreachable one must not delay the stop.
    pub flush_timeout_ms: u64,
}

impl Default for TelemetryConfig {
    fn default() -> Self {
        Self {
            endpoint: None,
            sample_ratio: Ratio(1.0),
            service_name: "molmesh".to_owned(),
            secret_headers: None,
            secret_headers_file: None,
            timeout_ms: 10_000,
            queue: 4096,
            flush_timeout_ms: 2000,
        }
    }
}

/// Number from 0 to 1.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(transparent)]
pub struct Ratio(f64);

impl Ratio {
    /// Returns the number.
    #[must_use]
    pub fn get(self) -> f64 {
        self.0
    }
}

impl JsonSchema for Ratio {
    fn inline_schema() -> bool {
        true
    }

    fn schema_name() -> Cow<'static, str> {
        "Ratio".into()
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        json_schema!({ "type": "number", "minimum": 0, "maximum": 1 })
    }
}

impl<'de> Deserialize<'de> for Ratio {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let ratio = f64::deserialize(deserializer)?;
        let good = (0.0..=1.0).contains(&ratio);
        if good { Ok(Self(ratio)) } else { Err(serde::de::Error::custom("a number from 0 to 1")) }
    }
}

/// Base URL of a collector: `http(s)://host:port` with an optional path, without user name, password or query.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[serde(transparent)]
pub struct CollectorUrl(String);

impl CollectorUrl {
    /// Returns the URL that traces are sent to.
    #[must_use]
    pub fn traces(&self) -> String {
        format!("{}/v1/traces", self.0.trim_end_matches('/'))
    }
}

impl JsonSchema for CollectorUrl {
    fn inline_schema() -> bool {
        true
    }

    fn schema_name() -> Cow<'static, str> {
        "CollectorUrl".into()
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        json_schema!({ "type": "string", "pattern": "^(none|https?://[^?#@]+)$" })
    }
}

impl<'de> Deserialize<'de> for CollectorUrl {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)?;
        let good = text.parse().is_ok_and(|url: Url| {
            let bare = url.username().is_empty() && url.password().is_none();
            ["http", "https"].contains(&url.scheme())
                && url.has_host()
                && bare
                && url.query().is_none()
                && url.fragment().is_none()
        });
        let expected = "none, or http(s)://host:port without a password; put secrets into secret_headers";
        if good { Ok(Self(text)) } else { Err(serde::de::Error::custom(expected)) }
    }
}

/// HTTP headers that are never displayed or logged.
#[derive(Clone, PartialEq, Eq)]
pub struct SecretHeaders {
    text: Secret,
    headers: HeaderMap,
}

impl SecretHeaders {
    /// Returns the headers; the values are marked as sensitive.
    #[must_use]
    pub fn reveal(&self) -> &HeaderMap {
        &self.headers
    }
}

impl fmt::Debug for SecretHeaders {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.text.fmt(f)
    }
}

impl Serialize for SecretHeaders {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        self.text.serialize(serializer)
    }
}

impl JsonSchema for SecretHeaders {
    fn inline_schema() -> bool {
        true
    }

    fn schema_name() -> Cow<'static, str> {
        "SecretHeaders".into()
    }

    fn json_schema(generator: &mut SchemaGenerator) -> Schema {
        Secret::json_schema(generator)
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
        Ok(Self { text, headers })
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn urls_ratios_and_headers_are_validated() {
        let url = |text: &str| serde_json::from_value::<CollectorUrl>(json!(text));
        for (text, traces) in [
            ("http://localhost:4318", "http://localhost:4318/v1/traces"),
            ("https://c.example/otlp/", "https://c.example/otlp/v1/traces"),
        ] {
            assert_eq!(url(text).unwrap().traces(), traces);
        }
        for bad in ["localhost:4318", "ftp://h", "http://u:p@h", "http://u@h", "http://h/?key=1", "http://h/#x", ""] {
            assert!(url(bad).is_err(), "{bad}");
        }
        for (ratio, good) in [(0.0, true), (0.25, true), (1.0, true), (1.1, false), (-0.1, false)] {
            assert_eq!(serde_json::from_value::<Ratio>(json!(ratio)).is_ok(), good, "{ratio}");
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
