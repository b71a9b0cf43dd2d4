//! What the service keeps: where, how much of it, how long.

use std::borrow::Cow;
use std::fmt;
use std::path::PathBuf;
use std::time::Duration;

use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// The store of inputs, results and job documents.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct StoreConfig {
    /// `s3://bucket` or `s3://bucket/prefix`. Default `none`: the folder `store` in `server.data_dir`.
    pub url: Option<String>,
    /// Address of a service that speaks S3, such as `https://minio.example:9000`. Default `none`: that of AWS for the
    /// region, or `AWS_ENDPOINT_URL`.
    pub endpoint: Option<String>,
    /// Region of the bucket. Default `none`: `AWS_REGION`, else `us-east-1`.
    pub region: Option<String>,
    /// Whether the endpoint may be plain `http`. Default false: credentials and contents would travel in the clear.
    pub allow_http: bool,
    /// Whether the bucket is named in the path, not in the host. Default true: every service that speaks S3 takes it.
    pub path_style: bool,
    /// Key id. Default `none`: `AWS_ACCESS_KEY_ID`, or whatever else the machine has for AWS.
    pub access_key_id: Option<String>,
    /// Key. Default `none`: `AWS_SECRET_ACCESS_KEY`. Better given by the environment than by a file.
    pub secret_access_key: Option<Secret>,
    /// File that holds the key, one line break at its end aside. Default `none`. So that secrets that containers get as files
    /// stay there; it and `secret_access_key` exclude each other.
    pub secret_access_key_file: Option<PathBuf>,
    /// Time without an answer after which a request to S3 is given up or tried again, ms. Default 30,000: a part of
    /// 8 MiB at 2 Mbit/s.
    pub timeout_ms: u64,
    /// How long the answer to whether the store works is believed, ms: `/readyz` writes, reads and removes a small object
    /// no more often. Default 5,000: orchestrators ask every few seconds.
    pub probe_ms: u64,
    /// Time without an answer to that after which the store counts as not working, ms. Default 10,000: a busy disk takes
    /// seconds, and load shall not make the service unready.
    pub probe_timeout_ms: u64,
    /// How often what is too old is removed, ms. Default 60,000: times to live are hours.
    pub sweep_ms: u64,
    /// Bytes of results and inputs together. Default 10 GiB: thousands of meshes. What was used least recently goes
    /// when there is no room.
    pub max_bytes: u64,
    /// Time that a result is kept after its last use, ms. Default 86,400,000 (a day): whoever asks again, asks soon.
    pub result_ttl_ms: u64,
    /// Time that an input is kept after its last use, ms. Default 604,800,000 (7 days): people come back to a
    /// structure with other parameters.
    pub input_ttl_ms: u64,
    /// Time that the document of a job is kept after it was last written or read, ms. Default 86,400,000 (a day): as
    /// long as its result.
    pub job_ttl_ms: u64,
    /// Bytes of small results that are kept in memory as well. Default 256 MiB: thousands of small proteins.
    pub memory_bytes: u64,
    /// Largest result that is kept in memory. Default 4 MiB: a small protein, so that hundreds fit.
    pub memory_object_bytes: u64,
}

impl Default for StoreConfig {
    fn default() -> Self {
        Self {
            url: None,
            endpoint: None,
            region: None,
            allow_http: false,
            path_style: true,
            access_key_id: None,
            secret_access_key: None,
            secret_access_key_file: None,
            timeout_ms: 30_000,
            probe_ms: 5000,
            probe_timeout_ms: 10_000,
            sweep_ms: 60_000,
            max_bytes: 10 << 30,
            result_ttl_ms: 86_400_000,
            input_ttl_ms: 604_800_000,
            job_ttl_ms: 86_400_000,
            memory_bytes: 256 << 20,
            memory_object_bytes: 4 << 20,
        }
    }
}

impl StoreConfig {
    /// Time without an answer after which a request to S3 is given up or tried again.
    #[must_use]
    pub fn timeout(&self) -> Duration {
        Duration::from_millis(self.timeout_ms)
    }

    /// How long the answer to whether the store works is believed.
    #[must_use]
    pub fn probe(&self) -> Duration {
        Duration::from_millis(self.probe_ms)
    }

    /// Time without an answer to that after which the store counts as not working.
    #[must_use]
    pub fn probe_timeout(&self) -> Duration {
        Duration::from_millis(self.probe_timeout_ms)
    }

    /// How often what is too old is removed.
    #[must_use]
    pub fn sweep(&self) -> Duration {
        Duration::from_millis(self.sweep_ms)
    }

    /// Time that a result is kept after its last use.
    #[must_use]
    pub fn result_ttl(&self) -> Duration {
        Duration::from_millis(self.result_ttl_ms)
    }

    /// Time that an input is kept after its last use.
    #[must_use]
    pub fn input_ttl(&self) -> Duration {
        Duration::from_millis(self.input_ttl_ms)
    }

    /// Time that the document of a job is kept after it was last written or read.
    #[must_use]
    pub fn job_ttl(&self) -> Duration {
        Duration::from_millis(self.job_ttl_ms)
    }
}

/// A text that is never shown: not by `Debug`, not by serialisation, not in the refusal of a bad value.
#[derive(Clone, PartialEq, Eq)]
pub struct Secret(String);

/// What is shown in place of a [`Secret`].
pub(super) const HIDDEN: &str = "(hidden)";

impl Secret {
    /// Hides `text`.
    #[must_use]
    pub fn new(text: impl Into<String>) -> Self {
        Self(text.into())
    }

    /// The text, for whoever has to present it.
    #[must_use]
    pub fn reveal(&self) -> &str {
        &self.0
    }
}

impl fmt::Debug for Secret {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(HIDDEN)
    }
}

impl Serialize for Secret {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(HIDDEN)
    }
}

impl JsonSchema for Secret {
    fn inline_schema() -> bool {
        true
    }

    fn schema_name() -> Cow<'static, str> {
        "Secret".into()
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        json_schema!({ "type": "string", "writeOnly": true })
    }
}

impl<'de> Deserialize<'de> for Secret {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        // Through a value, since serde's own refusal would quote what it was given.
        match serde_json::Value::deserialize(deserializer)? {
            serde_json::Value::String(text) => Ok(Self(text)),
            _ => Err(serde::de::Error::custom("a text")),
        }
    }
}
