//! Configuration of the store: location, capacity and retention.

use std::borrow::Cow;
use std::fmt;
use std::path::PathBuf;

use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::{Deserialize, Deserializer, Serialize, Serializer};

section! {
    /// Store of inputs, results and job records.
    StoreConfig;
    /// Location of the store: `s3://bucket`, `s3://bucket/prefix`, or with `broker.url` a folder that all nodes share,
    /// such as `file:///shared/store`. Default `none`: the folder `store` in `server.data_dir`.
    url: Option<String> = None;
    /// URL of an S3-compatible service, such as `https://minio.example:9000`. Default `none`: `AWS_ENDPOINT_URL`, else
    /// AWS in the region.
    endpoint: Option<String> = None;
    /// Region of the bucket. Default `none`: `AWS_REGION`, else `us-east-1`.
    region: Option<String> = None;
    /// Allows an endpoint with plain `http`. Default false: contents would not be encrypted.
    allow_http: bool = false;
    /// Access key id. Default `none`: `AWS_ACCESS_KEY_ID`, else the other AWS credential sources of the machine.
    access_key_id: Option<String> = None;
    /// Secret access key. Default `none`: `AWS_SECRET_ACCESS_KEY`. Prefer the environment variable or
    /// `secret_access_key_file` to the configuration file.
    secret_access_key: Option<Secret> = None;
    /// File that contains the value of `secret_access_key`, such as a mounted container secret; one line break at its
    /// end is ignored. Default `none`. Excludes `secret_access_key`.
    secret_access_key_file: Option<PathBuf> = None;
    /// Time without a response after which a request to S3 fails or is retried, and time limit of an operation of a
    /// folder, ms. Default 30,000: a part of 8 MiB at 2 Mbit/s, or an upload of 256 MiB on a slow disk.
    timeout_ms: u64 = 30_000;
    /// Minimum time between health checks of the store, ms; `/readyz` writes, reads and removes a small object. Fixed:
    /// orchestrators send a request every few seconds.
    #[serde(skip)]
    check_interval_ms: u64 = 5000;
    /// Time between removals of expired objects, ms. Fixed: times to live are hours.
    #[serde(skip)]
    sweep_ms: u64 = 60_000;
    /// Capacity for results and inputs together, bytes. Default 10 GiB: thousands of meshes. The least recently used
    /// objects are evicted.
    max_bytes: u64 = 10 << 30;
    /// Maximum number of results, their reports and inputs together. Fixed: their index takes up to 200 MB of memory.
    /// The least recently used objects are evicted.
    #[serde(skip)]
    max_objects: u64 = 500_000;
    /// Time that a result and the record of a job are kept after their last use, ms. Default 86,400,000 (a day): most
    /// repeated requests come soon.
    result_ttl_ms: u64 = 86_400_000;
    /// Time that an input is kept after its last use, ms. Default 604,800,000 (7 days): users mesh a structure again
    /// with other parameters.
    input_ttl_ms: u64 = 604_800_000;
    /// Memory for cached small results, bytes. Fixed: thousands of small proteins.
    #[serde(skip)]
    memory_bytes: u64 = 256 << 20;
    /// Largest result that is cached in memory, bytes. Fixed: dozens of results of that size fit.
    #[serde(skip)]
    memory_object_bytes: u64 = 4 << 20;
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
