//! Descriptions of devices.

use crate::surface::DeviceFacts;

/// Name of the arithmetic of a device: model and driver, and the processor, which prepares jobs and measures meshes.
pub(super) fn arithmetic(name: &str, device: &str) -> String {
    format!("{name} {device} {}", crate::surface::arithmetic())
}

/// Describes a device and its driver, for display.
pub(super) fn describe(facts: &DeviceFacts) -> String {
    let DeviceFacts { name, kind, api, driver, .. } = facts;
    let driver = if driver.is_empty() { String::new() } else { format!(", {driver}") };
    format!("{name} ({}, {api}{driver})", kind.name())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::DeviceKind;

    #[test]
    fn the_arithmetic_names_model_driver_and_processor() {
        let facts = |name: &str, driver: &str| DeviceFacts {
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
        };
        let arithmetic_of = |name, driver| arithmetic("gpu", &describe(&facts(name, driver)));
        assert_eq!(arithmetic_of("card", "driver 1"), arithmetic_of("card", "driver 1"));
        assert_ne!(arithmetic_of("card", "driver 1"), arithmetic_of("card", "driver 2"));
        assert_ne!(arithmetic_of("card", "driver 1"), arithmetic_of("other card", "driver 1"));
        assert!(arithmetic_of("card", "driver 1").ends_with(&crate::surface::arithmetic()), "without the processor");
    }
}
