//! Configuration of the GPUs.

use serde::{Deserialize, Deserializer, Serializer};

use crate::surface::DeviceChoice;
use crate::surface::devices::EXPECTED;

/// Number of concurrent jobs per device and lane, if that exceeds `jobs.workers`: a device finishes a small job before
/// the next file is read, and only concurrent jobs can share a submission.
pub const JOBS_PER_DEVICE: usize = 16;

section! {
    /// GPUs.
    DevicesConfig;
    /// Permitted devices: `auto`, `all`, `cpu`, or a list such as `0,2` or `software`. Default `auto`: the best kind of
    /// GPU that is present, else the CPU.
    #[serde(rename = "use", serialize_with = "write", deserialize_with = "read")]
    #[schemars(with = "String")]
    choice: DeviceChoice = DeviceChoice::Auto;
    /// Readback buffers per device, bytes of host memory: allocated before the first job and kept while the device is
    /// idle. Default 2 GiB: meshes of up to 40 million triangles. The driver takes half a second to allocate it, for
    /// which the first large mesh would wait. 0: none.
    readback_bytes: u64 = 2 << 30;
}

fn write<S: Serializer>(choice: &DeviceChoice, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_str(choice)
}

fn read<'de, D: Deserializer<'de>>(deserializer: D) -> Result<DeviceChoice, D::Error> {
    let text = String::deserialize(deserializer)?;
    text.parse().map_err(|_refused: String| serde::de::Error::custom(EXPECTED))
}
