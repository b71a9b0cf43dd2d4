//! Devices as data: which are asked for, which were found, how those that run are doing. What drives them is a
//! backend's business; nothing here opens one.

use std::fmt;
use std::str::FromStr;
use std::time::Duration;

/// Bricks that each device gets at least of a structure that several make together. On an H200 a brick takes about 0.1 µs
/// from the upload to the host's memory, so that these take 3 ms; a part costs a tenth to a quarter of that beside them:
/// bricks computed for its last cells' sake alone (one in twenty at this size, fewer at larger ones), two round trips, and
/// the hand-over.
pub const SPREAD_BRICKS: u64 = 32_768;

/// Which devices may be used.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub enum DeviceChoice {
    /// The best kind of GPU that there is; software and lesser kinds are left alone.
    #[default]
    Auto,
    /// Every GPU, of whatever kind.
    All,
    /// None: the native CPU.
    Cpu,
    /// These alone, in ascending order without repeats.
    These(Vec<DeviceName>),
}

/// How a list names a device.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum DeviceName {
    /// By the number that `molmesh doctor` gives it.
    Number(usize),
    /// Every device that is a program: good for tests.
    Software,
}

/// What a choice of devices may look like, for messages.
pub const EXPECTED: &str = "auto, all, cpu, or a list of device numbers and `software` such as 0,2";

impl FromStr for DeviceChoice {
    type Err = String;

    /// Reads `auto`, `all`, `cpu` or a list such as `0,2`. The error says what was expected.
    fn from_str(text: &str) -> Result<Self, String> {
        let refused = || format!("`{text}` is not allowed; expected {EXPECTED}");
        match text.trim() {
            "auto" => return Ok(Self::Auto),
            "all" => return Ok(Self::All),
            "cpu" => return Ok(Self::Cpu),
            _ => {}
        }
        let name = |part: &str| match part.trim() {
            "software" => Ok(DeviceName::Software),
            // A sign or an empty part is no number, though `parse` lets `+1` through.
            digits if digits.bytes().all(|b| b.is_ascii_digit()) => {
                digits.parse().map(DeviceName::Number).map_err(|_too_large_or_empty| refused())
            }
            _ => Err(refused()),
        };
        let mut names = text.split(',').map(name).collect::<Result<Vec<_>, _>>()?;
        names.sort_unstable();
        names.dedup();
        Ok(Self::These(names))
    }
}

impl fmt::Display for DeviceChoice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Auto => f.write_str("auto"),
            Self::All => f.write_str("all"),
            Self::Cpu => f.write_str("cpu"),
            Self::These(names) => {
                let name = |name: &DeviceName| match name {
                    DeviceName::Number(n) => n.to_string(),
                    DeviceName::Software => "software".to_owned(),
                };
                f.write_str(&names.iter().map(name).collect::<Vec<_>>().join(","))
            }
        }
    }
}

/// What sort of thing a device is, best first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum DeviceKind {
    /// A card with memory of its own.
    Discrete,
    /// A slice of somebody else's card.
    Virtual,
    /// Part of the processor, sharing its memory.
    Integrated,
    /// The driver does not say.
    Unknown,
    /// A program that plays a GPU on the CPU.
    Software,
}

impl DeviceKind {
    /// Its name, as `doctor` and `/v1/capabilities` spell it.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Discrete => "discrete",
            Self::Virtual => "virtual",
            Self::Integrated => "integrated",
            Self::Unknown => "unknown",
            Self::Software => "software",
        }
    }
}

/// What a device says of itself.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DeviceFacts {
    /// The device's own name.
    pub name: String,
    /// What sort of thing it is.
    pub kind: DeviceKind,
    /// The interface it is reached through, such as `vulkan`.
    pub api: &'static str,
    /// Name and version of its driver.
    pub driver: String,
    /// Where it sits on the bus; empty where the driver does not say.
    pub bus: String,
    /// Largest storage binding, bytes.
    pub binding_bytes: u64,
    /// Largest buffer, bytes.
    pub buffer_bytes: u64,
    /// Memory of a workgroup, bytes.
    pub workgroup_bytes: u64,
    /// Invocations of a workgroup.
    pub workgroup_size: u64,
    /// Storage buffers that a stage can bind.
    pub storage_buffers: u64,
    /// Whether it can time its stages.
    pub timestamps: bool,
    /// Smallest and largest subgroup, where it has subgroup operations.
    pub subgroups: Option<[u32; 2]>,
}

/// A device that was found, and whether it is taken.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FoundDevice {
    /// Its number, by which it can be asked for.
    pub number: usize,
    /// What it says of itself.
    pub facts: DeviceFacts,
    /// Whether it is taken.
    pub taken: bool,
    /// Why, or why not, in words.
    pub reason: String,
}

/// How a running device is doing.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DeviceStatus {
    /// Its number.
    pub number: usize,
    /// Its own name.
    pub name: String,
    /// Why it takes no jobs any more; none while it does.
    pub down: Option<String>,
    /// Jobs that wait for it or run on it.
    pub waiting: usize,
    /// Jobs it has finished.
    pub finished: u64,
    /// Jobs that failed for its sake.
    pub failed: u64,
    /// Time that it spent on jobs.
    pub busy: Duration,
    /// Times it failed and what ran on it was thrown away.
    pub lost: u64,
    /// Times it was built anew after a failure.
    pub rebuilds: u64,
    /// Submissions that several jobs shared.
    pub shared: u64,
    /// Jobs of which it made a part, others the rest; among the finished.
    pub spread: u64,
    /// Bytes of its memory that are held: in use and pooled.
    pub held_bytes: u64,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn choices_are_read_and_written() {
        use DeviceName::{Number, Software};
        let list = DeviceChoice::These;
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
    fn what_is_no_choice_is_refused() {
        for text in ["", ",", "0,", "-1", "+1", "0.5", "gpu", "cpu,0", "all,0", "0;1", "99999999999999999999999"] {
            let refused = text.parse::<DeviceChoice>().unwrap_err();
            assert!(refused.contains(&format!("`{text}`")) && refused.contains("0,2"), "{refused}");
        }
    }

    #[test]
    fn better_kinds_come_first() {
        assert!(DeviceKind::Discrete < DeviceKind::Integrated && DeviceKind::Unknown < DeviceKind::Software);
    }
}
