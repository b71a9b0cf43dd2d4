//! Configuration of the store: location, capacity and retention.

use std::borrow::Cow;
use std::fmt;
use std::path::PathBuf;

use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// Store of inputs, results and job records.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct StoreConfig {
    /// Location of the store: `s3://bucket`, `s3://bucket/prefix`, or with `broker.url` a folder that all nodes share,
    /// such as `file:///shared/store`. Default `none`: the folder `store` in `server.data_dir`.
    pub url: Option<String>,
    /// URL of an S3-compatible service, such as `https://minio.example:9000`. Default `none`: `AWS_ENDPOINT_URL`, else
    /// AWS in the region.
    pub endpoint: Option<String>,
    /// Region of the bucket. Default `none`: `AWS_REGION`, else `us-east-1`.
    pub region: Option<String>,
    /// Allows an endpoint with plain `http`. Default false: contents would not be encrypted.
    pub allow_http: bool,
    /// Access key id. Default `none`: `AWS_ACCESS_KEY_ID`, else the other AWS credential sources of the machine.
    pub access_key_id: Option<String>,
    /// Secret access key. Default `none`: `AWS_SECRET_ACCESS_KEY`. Prefer the environment variable or
    /// `secret_access_key_file` to the configuration file.
    pub secret_access_key: Option<Secret>,
    /// File that contains the value of `secret_access_key`, such as a mounted container secret; one line break at its
    /// end is ignored. Default `none`. Excludes `secret_access_key`.
    pub secret_access_key_file: Option<PathBuf>,
    /// Time without a response after which a request to S3 fails or is retried, and time limit of an operation of a
    /// folder, ms. Default 30,000: a part of 8 MiB at 2 Mbit/s, or an upload of 256 MiB on a slow disk.
    pub timeout_ms: u64,
    /// Minimum time between health checks of the store, ms; `/readyz` writes, reads and removes a small object. Fixed:
    /// orchestrators send a request every few seconds.
    #[serde(skip)]
    pub check_interval_ms: u64,
    /// Time between removals of expired objects, ms. Fixed: times to live are hours.
    #[serde(skip)]
    pub sweep_ms: u64,
    /// Capacity for results and inputs together, bytes. Default 10 GiB: thousands of meshes. The least recently used
    /// objects are evicted.
    pub max_bytes: u64,
    /// Maximum number of results, their reports and inputs together. Fixed: their index takes up to 200 MB of memory.
    /// The least recently used objects are evicted.
    #[serde(skip)]
    pub max_objects: u64,
    /// Time that a result and the record of a job are kept after their last use, ms. Default 86,400,000 (a day): most
    /// repeated requests come soon.
    pub result_ttl_ms: u64,
    /// Time that an input is kept after its last use, ms. Default 604,800,000 (7 days): users mesh a structure again
    /// with other parameters.
    pub input_ttl_ms: u64,
    /// Memory for cached small results, bytes. Fixed: thousands of small proteins.
    #[serde(skip)]
    pub memory_bytes: u64,
    /// Largest result that is cached in memory, bytes. Fixed: dozens of results of that size fit.
    #[serde(skip)]
    pub memory_object_bytes: u64,
}

impl Default for StoreConfig {
    fn default() -> Self {
        Self {
            url: None,
            endpoint: None,
            region: None,
            allow_http: false,
            access_key_id: None,
            secret_access_key: None,
            secret_access_key_file: None,
            timeout_ms: 30_000,
            check_interval_ms: 5000,
            sweep_ms: 60_000,
            max_bytes: 10 << 30,
            max_objects: 500_000,
            result_ttl_ms: 86_400_000,
            input_ttl_ms: 604_800_000,
            memory_bytes: 256 << 20,
            memory_object_bytes: 4 << 20,
        }
    }
}

/// Text that `Debug`, serialization and error messages never show.
#[derive(Clone, PartialEq, Eq)]
pub struct Secret(String);

/// Replacement text for a [`Secret`].
pub(super) const HIDDEN: &str = "(hidden)";

impl Secret {
    /// Creates a secret from `text`.
    #[must_use]
    pub fn new(text: impl Into<String>) -> Self {
        Self(text.into())
    }

    /// Returns the text.
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
        // Through a value, because serde's own error would quote the secret.
        match serde_json::Value::deserialize(deserializer)? {
            serde_json::Value::String(text) => Ok(Self(text)),
            _ => Err(serde::de::Error::custom("a string")),
        }
    }
}
