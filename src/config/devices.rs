//! Configuration of the GPUs.

use schemars::JsonSchema;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::surface::DeviceChoice;
use crate::surface::devices::{EXPECTED, MIN_PARTITION_BRICKS};

/// GPUs.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct DevicesConfig {
    /// Permitted devices: `auto`, `all`, `cpu`, or a list such as `0,2` or `software`. Default `auto`: the best kind of
    /// GPU that is present, else the CPU.
    #[serde(rename = "use", serialize_with = "write", deserialize_with = "read")]
    #[schemars(with = "String")]
    pub choice: DeviceChoice,
    /// Number of concurrent jobs per device and lane, if that exceeds `jobs.workers`. Default 16: a device finishes a
    /// small job before the next file is read, and only concurrent jobs can share a submission.
    pub jobs: usize,
    /// Maximum number of small jobs in a submission. Default 16: a submission costs as much as meshing one small job,
    /// so a larger batch gains little and delays its first job.
    pub batch: usize,
    /// Minimum number of bricks (8 × 8 × 8 cells) per device if a job is divided among several devices; `none` never
    /// divides jobs. Default 32,768, about 130,000 atoms at 1 Å: below that, the transfer costs more than another
    /// device saves.
    pub min_partition_bricks: Option<u64>,
    /// Readback buffers per device, bytes of host memory: allocated before the first job and kept while the device is
    /// idle. Default 2 GiB: meshes of up to 40 million triangles. The driver takes half a second to allocate it, for
    /// which the first large mesh would wait. 0: none.
    pub readback_bytes: u64,
    /// Maximum time of a submission in ms. A device that takes longer is considered hung: its jobs are repeated
    /// elsewhere, and it cools down. Large submissions to a slow device may take a hundred times their estimate;
    /// opening a device may take three times this limit.
    /// Default 10,000: a submission takes less than a second.
    pub hang_timeout_ms: u64,
    /// Pause in ms before a device that hung or failed repeatedly is used again. Doubled each time until the device
    /// finishes a job, to 64 times at most. Default 60,000.
    pub cool_down_ms: u64,
}

impl Default for DevicesConfig {
    fn default() -> Self {
        Self {
            choice: DeviceChoice::Auto,
            jobs: 16,
            batch: 16,
            min_partition_bricks: Some(MIN_PARTITION_BRICKS),
            readback_bytes: 2 << 30,
            hang_timeout_ms: 10_000,
            cool_down_ms: 60_000,
        }
    }
}

fn write<S: Serializer>(choice: &DeviceChoice, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_str(choice)
}

fn read<'de, D: Deserializer<'de>>(deserializer: D) -> Result<DeviceChoice, D::Error> {
    let text = String::deserialize(deserializer)?;
    text.parse().map_err(|_refused: String| serde::de::Error::custom(EXPECTED))
}
