//! Which devices run the meshing, and how much of it at once.

use schemars::JsonSchema;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::surface::DeviceChoice;
use crate::surface::devices::{EXPECTED, SPREAD_BRICKS};

/// GPUs.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct DevicesConfig {
    /// Which devices may be used: `auto`, `all`, `cpu`, or a list such as `0,2` or `software`. Default `auto`: the
    /// best kind of GPU that there is, else the CPU.
    #[serde(rename = "use", serialize_with = "write", deserialize_with = "read")]
    #[schemars(with = "String")]
    pub choice: DeviceChoice,
    /// Jobs that run at once for each device, instead of `jobs.workers` where there are more of them so. Default 16: a
    /// device is done with a small job before the next file is read, and only jobs that are there can share a
    /// submission.
    pub jobs: usize,
    /// Small jobs that may share a submission. Default 16: a submission costs as much as meshing one of them, so that a
    /// longer batch gains little and delays its first job.
    pub batch: usize,
    /// Bricks of 8 × 8 × 8 cells that each device gets at least of one structure that several make together; none: every
    /// structure is made by one. Default 32,768, about 130,000 atoms at 1 Å: what a device saves with fewer is little beside
    /// what handing over costs.
    pub spread_bricks: Option<u64>,
}

impl Default for DevicesConfig {
    fn default() -> Self {
        Self { choice: DeviceChoice::Auto, jobs: 16, batch: 16, spread_bricks: Some(SPREAD_BRICKS) }
    }
}

fn write<S: Serializer>(choice: &DeviceChoice, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_str(choice)
}

fn read<'de, D: Deserializer<'de>>(deserializer: D) -> Result<DeviceChoice, D::Error> {
    let text = String::deserialize(deserializer)?;
    text.parse().map_err(|_refused: String| serde::de::Error::custom(EXPECTED))
}
