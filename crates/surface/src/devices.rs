//! Descriptions of devices: the user's choice, the devices that were found, and the status of those in use. The GPU
//! backend opens and uses them.

use std::fmt;
use std::str::FromStr;
use std::time::Duration;

use crate::named;

/// Default of the minimum number of bricks per device in a multi-device job. On an H200 these bricks take about 3 ms. A
/// partition costs 10 to 25 % more than its bricks alone: one halo brick in twenty, two round trips, and the exchange
/// of counts.
pub const MIN_PARTITION_BRICKS: u64 = 32_768;

/// Choice of the devices that may be used.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub enum DeviceChoice {
    /// All GPUs of the best kind that is available; no software devices.
    #[default]
    Auto,
    /// All GPUs of any kind; no software devices.
    All,
    /// No device: the CPU backend.
    Cpu,
    /// Listed devices, in ascending order without duplicates.
    Listed(Vec<DeviceName>),
}

/// Name of a device in a list.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum DeviceName {
    /// Number of the device as `molmesh doctor` lists it.
    Number(usize),
    /// All software devices, for tests.
    Software,
}

/// Syntax of a choice, for messages.
pub const EXPECTED: &str = "auto, all, cpu, or a list of device numbers and `software` such as 0,2";

impl FromStr for DeviceChoice {
    type Err = String;

    /// Parses `auto`, `all`, `cpu` or a list such as `0,2`. The error states the expected syntax.
    fn from_str(text: &str) -> Result<Self, String> {
        let invalid = || format!("`{text}` is not allowed; expected {EXPECTED}");
        match text.trim() {
            "auto" => return Ok(Self::Auto),
            "all" => return Ok(Self::All),
            "cpu" => return Ok(Self::Cpu),
            _ => {}
        }
        let name = |part: &str| match part.trim() {
            "software" => Ok(DeviceName::Software),
            // `parse` would accept `+1`.
            digits if digits.bytes().all(|b| b.is_ascii_digit()) => {
                digits.parse().map(DeviceName::Number).map_err(|_too_large_or_empty| invalid())
            }
            _ => Err(invalid()),
        };
        let mut names = text.split(',').map(name).collect::<Result<Vec<_>, _>>()?;
        names.sort_unstable();
        names.dedup();
        Ok(Self::Listed(names))
    }
}

impl fmt::Display for DeviceChoice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Auto => f.write_str("auto"),
            Self::All => f.write_str("all"),
            Self::Cpu => f.write_str("cpu"),
            Self::Listed(names) => {
                let name = |name: &DeviceName| match name {
                    DeviceName::Number(n) => n.to_string(),
                    DeviceName::Software => "software".to_owned(),
                };
                f.write_str(&names.iter().map(name).collect::<Vec<_>>().join(","))
            }
        }
    }
}

/// Kind of a device, best first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum DeviceKind {
    /// Card with its own memory.
    Discrete,
    /// Virtual GPU.
    Virtual,
    /// Part of the processor, with shared memory.
    Integrated,
    /// Kind that the driver does not report.
    Unknown,
    /// Software implementation on the CPU.
    Software,
}

named!(DeviceKind, Discrete => "discrete", Virtual => "virtual", Integrated => "integrated", Unknown => "unknown",
    Software => "software");

/// Properties that a device reports.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DeviceFacts {
    /// Name.
    pub name: String,
    /// Kind.
    pub kind: DeviceKind,
    /// Graphics API, such as `vulkan`.
    pub api: &'static str,
    /// Name and version of the driver.
    pub driver: String,
    /// Bus address; empty if the driver does not report it.
    pub bus: String,
    /// Largest storage binding, bytes.
    pub binding_bytes: u64,
    /// Largest buffer, bytes.
    pub buffer_bytes: u64,
    /// Workgroup memory, bytes.
    pub workgroup_bytes: u64,
    /// Maximum number of threads per workgroup.
    pub workgroup_size: u64,
    /// Maximum number of storage buffers per stage.
    pub storage_buffers: u64,
    /// True if timestamps are supported.
    pub timestamps: bool,
    /// Minimum and maximum subgroup size; `None` without subgroup operations.
    pub subgroups: Option<[u32; 2]>,
}

/// Device that was found.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FoundDevice {
    /// Number, by which it can be requested.
    pub number: usize,
    /// Properties.
    pub facts: DeviceFacts,
    /// True if the device is used.
    pub selected: bool,
    /// Reason for using it or not.
    pub reason: String,
}

/// Status of a device in use.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct DeviceStatus {
    /// Number.
    pub number: usize,
    /// Name.
    pub name: String,
    /// Reason why it accepts no jobs; `None` while it is up.
    pub down: Option<String>,
    /// Number of jobs that wait or run.
    pub waiting: usize,
    /// Number of finished jobs, including partitions.
    pub finished: u64,
    /// Number of jobs that failed because of the device.
    pub failed: u64,
    /// Time spent on jobs.
    pub busy: Duration,
    /// Number of failures after which its executor was discarded.
    pub lost: u64,
    /// Number of hangs after which its thread was replaced.
    pub hung: u64,
    /// Number of rebuilds after failures.
    pub rebuilds: u64,
    /// Number of submissions that several jobs shared.
    pub shared: u64,
    /// Number of finished partitions of multi-device jobs.
    pub partitions: u64,
    /// Bytes of device memory that are held, in use and pooled.
    pub held_bytes: u64,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn choices_are_parsed_and_formatted() {
        use DeviceName::{Number, Software};
        let list = DeviceChoice::Listed;
        for (text, choice, written) in [
            ("auto", DeviceChoice::Auto, "auto"),
            (" all ", DeviceChoice::All, "all"),
            ("cpu", DeviceChoice::Cpu, "cpu"),
            ("2,0, 2", list(vec![Number(0), Number(2)]), "0,2"),
            ("software,1", list(vec![Number(1), Software]), "1,software"),
        ] {
            let read: DeviceChoice = text.parse().unwrap();
            assert_eq!((read.to_string().as_str(), read), (written, choice), "{text}");
        }
    }

    #[test]
    fn invalid_choices_are_rejected() {
        for text in ["", ",", "0,", "-1", "+1", "0.5", "gpu", "cpu,0", "all,0", "0;1", "99999999999999999999999"] {
            let error = text.parse::<DeviceChoice>().unwrap_err();
            assert!(error.contains(&format!("`{text}`")) && error.contains("0,2"), "{error}");
        }
    }

    #[test]
    fn better_kinds_come_first() {
        assert!(DeviceKind::Discrete < DeviceKind::Integrated && DeviceKind::Unknown < DeviceKind::Software);
    }
}
