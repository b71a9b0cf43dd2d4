//! Measured costs of the backends on this machine, in the cache folder of the user. `molmesh doctor --calibrate` writes
//! them, and commands with `--backend auto` read them.

use std::io;
use std::path::{Path, PathBuf};

use molmesh::pipeline::cost::Cost;
use molmesh::surface::FoundDevice;
use serde::{Deserialize, Serialize};

use super::estimate::{GpuCost, MachineCosts};

/// Maximum size of the file, bytes.
const MAX_BYTES: u64 = 64 << 10;

/// Content of the file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Calibration {
    /// Version of the program that measured.
    pub(super) version: String,
    /// Cost on one thread of the CPU.
    pub(super) cpu: Cost,
    /// The GPU, if there is one.
    pub(super) gpu: Option<MeasuredGpu>,
}

/// GPU that was measured.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct MeasuredGpu {
    pub(super) device: String,
    pub(super) driver: String,
    pub(super) cost: GpuCost,
}

impl MeasuredGpu {
    /// Returns true if this is one of the devices in use.
    pub(super) fn is_among(&self, devices: &[FoundDevice]) -> bool {
        let same = |device: &FoundDevice| device.facts.name == self.device && device.facts.driver == self.driver;
        devices.iter().any(|device| device.selected && same(device))
    }
}

impl Calibration {
    /// Reads the calibration of this machine; `None` without one.
    ///
    /// # Errors
    /// Returns the reason if the file cannot be used.
    pub(super) fn load() -> Result<Option<Self>, String> {
        path().map_or(Ok(None), |path| Self::read(&path))
    }

    fn read(path: &Path) -> Result<Option<Self>, String> {
        let unusable = |why: &dyn std::fmt::Display| format!("{} is ignored: {why}", path.display());
        let text = std::fs::metadata(path).and_then(|file| {
            let is_sane = file.is_file() && file.len() <= MAX_BYTES;
            if is_sane { std::fs::read(path) } else { Err(io::Error::other("not a small file")) }
        });
        let text = match text {
            Ok(text) => text,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(unusable(&error)),
        };
        let found: Self = serde_json::from_slice(&text).map_err(|error| unusable(&error))?;
        if found.version != env!("CARGO_PKG_VERSION") {
            return Err(unusable(&format!("it was written by molmesh {}", found.version)));
        }
        let gpu = found.gpu.as_ref().map(|gpu| gpu.cost);
        let numbers = gpu.is_none_or(|gpu| {
            gpu.warm.is_valid() && [gpu.start, gpu.first_use].iter().all(|s| s.is_finite() && *s >= 0.0)
        });
        if !numbers || !found.cpu.is_valid() {
            return Err(unusable(&"its numbers are out of range"));
        }
        Ok(Some(found))
    }

    /// Returns the costs, with the default for a GPU that was not measured.
    pub(super) fn costs(&self) -> MachineCosts {
        let default = MachineCosts::default();
        MachineCosts { cpu: self.cpu, gpu: self.gpu.as_ref().map_or(default.gpu, |gpu| gpu.cost), measured: true }
    }

    /// Writes the file, complete or not at all. Returns its path.
    #[cfg(feature = "server")]
    pub(super) fn save(&self) -> io::Result<PathBuf> {
        let path = path().ok_or_else(|| io::Error::other("neither XDG_CACHE_HOME nor HOME is an absolute path"))?;
        let folder = path.parent().unwrap_or(&path);
        std::fs::create_dir_all(folder)?;
        let text = serde_json::to_vec_pretty(self).map_err(io::Error::other)?;
        let staged = folder.join(format!(".calibration.{}", std::process::id()));
        std::fs::write(&staged, text).and_then(|()| std::fs::rename(&staged, &path)).inspect_err(|_failed| {
            drop(std::fs::remove_file(&staged));
        })?;
        Ok(path)
    }
}

/// Returns the path of the file, if a cache folder is known.
fn path() -> Option<PathBuf> {
    let folder = |name: &str| std::env::var_os(name).map(PathBuf::from).filter(|path| path.is_absolute());
    let cache = folder("XDG_CACHE_HOME").or_else(|| Some(folder("HOME")?.join(".cache")));
    Some(cache?.join("molmesh/calibration.json"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use molmesh::surface::{DeviceFacts, DeviceKind};

    const COST: Cost = Cost { per_job: 0.001, per_unit: 1e-6 };

    fn calibration() -> Calibration {
        let cost = GpuCost { start: 0.2, first_use: 1e-7, warm: COST };
        let gpu = MeasuredGpu { device: "card".to_owned(), driver: "driver 1".to_owned(), cost };
        Calibration { version: env!("CARGO_PKG_VERSION").to_owned(), cpu: COST, gpu: Some(gpu) }
    }

    fn read(text: &str) -> Result<Option<Calibration>, String> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("calibration.json");
        std::fs::write(&path, text).unwrap();
        Calibration::read(&path)
    }

    #[test]
    fn a_file_of_this_version_is_used_and_any_other_ignored() {
        let text = serde_json::to_string(&calibration()).unwrap();
        assert_eq!(read(&text), Ok(Some(calibration())));
        assert!(calibration().costs().measured);
        for (from, to, why) in [
            (env!("CARGO_PKG_VERSION"), "0.0.1-old", "written by molmesh 0.0.1-old"),
            ("0.001", "-1", "out of range"),
            ("0.2", "-0.2", "out of range"),
            ("{", "", "is ignored"),
            ("card", &"x".repeat(70_000), "not a small file"),
        ] {
            let error = read(&text.replacen(from, to, 1)).unwrap_err();
            assert!(error.contains(why) && error.contains("calibration.json"), "{error}");
        }
        let folder = tempfile::tempdir().unwrap();
        assert_eq!(Calibration::read(&folder.path().join("none")), Ok(None));
        assert!(Calibration::read(folder.path()).unwrap_err().contains("not a small file"));
    }

    #[test]
    fn device_and_driver_are_compared() {
        let device = |name: &str, driver: &str, selected| FoundDevice {
            number: 0,
            facts: DeviceFacts {
                name: name.to_owned(),
                kind: DeviceKind::Discrete,
                api: "vulkan",
                driver: driver.to_owned(),
                bus: String::new(),
                binding_bytes: 0,
                buffer_bytes: 0,
                workgroup_bytes: 0,
                workgroup_size: 0,
                storage_buffers: 0,
                timestamps: false,
                subgroups: None,
            },
            selected,
            reason: String::new(),
        };
        let gpu = calibration().gpu.unwrap();
        assert!(gpu.is_among(&[device("other", "driver 1", true), device("card", "driver 1", true)]));
        assert!(!gpu.is_among(&[device("card", "driver 2", true), device("other", "driver 1", true)]));
        assert!(!gpu.is_among(&[device("card", "driver 1", false)]));
    }
}
