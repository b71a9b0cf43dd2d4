//! Selection of devices, with a reason for each. Pure functions of the devices' properties and the user's choice.

use molmesh_surface::{DeviceChoice, DeviceFacts, DeviceKind, DeviceName, FoundDevice};

/// Requirements of the stages: name of the limit, its value on the device, and the minimum.
fn requirements(facts: &DeviceFacts) -> [(&'static str, u64, u64); 5] {
    [
        // The minimum of every WebGPU implementation; larger columns are bound in pieces.
        ("largest binding", facts.binding_bytes, 128 << 20),
        ("largest buffer", facts.buffer_bytes, 256 << 20),
        ("workgroup memory", facts.workgroup_bytes, 16 << 10),
        ("workgroup size", facts.workgroup_size, 256),
        ("storage buffers per stage", facts.storage_buffers, 14),
    ]
}

/// Numbers devices in the order of `facts` and selects some of them.
pub(super) fn select(facts: Vec<DeviceFacts>, choice: &DeviceChoice) -> Vec<FoundDevice> {
    let best_kind = facts.iter().filter(|f| check_requirements(f).is_ok()).map(|f| f.kind).min();
    let mut found: Vec<FoundDevice> = Vec::with_capacity(facts.len());
    for (number, facts) in facts.into_iter().enumerate() {
        let twin = found.iter().find(|other| same_device(&other.facts, &facts)).map(|other| other.number);
        let decision = match twin {
            Some(other) if !contains(choice, number) => Err(format!("the same device as {other}")),
            _ => decide(number, &facts, choice, best_kind),
        };
        let (selected, reason) = match decision {
            Ok(reason) => (true, reason),
            Err(reason) => (false, reason),
        };
        found.push(FoundDevice { number, facts, selected, reason });
    }
    found
}

fn decide(
    number: usize,
    facts: &DeviceFacts,
    choice: &DeviceChoice,
    best_kind: Option<DeviceKind>,
) -> Result<String, String> {
    let kind = facts.kind.name();
    match choice {
        DeviceChoice::Cpu => return Err("the CPU was requested".to_owned()),
        DeviceChoice::Listed(list) => {
            let software = facts.kind == DeviceKind::Software && list.contains(&DeviceName::Software);
            if !software && !contains(choice, number) {
                return Err(format!("not in --devices {choice}"));
            }
        }
        DeviceChoice::Auto | DeviceChoice::All if facts.kind == DeviceKind::Software => {
            return Err(format!("software: only if requested as {number} or software"));
        }
        DeviceChoice::Auto | DeviceChoice::All => {}
    }
    check_requirements(facts)?;
    match (choice, best_kind) {
        (DeviceChoice::Listed(_), _) => Ok("requested".to_owned()),
        (DeviceChoice::Auto, Some(best)) if facts.kind > best => {
            Err(format!("{kind}: a {} device is available", best.name()))
        }
        _ => Ok(kind.to_owned()),
    }
}

/// Returns true if the choice lists this number.
fn contains(choice: &DeviceChoice, number: usize) -> bool {
    matches!(choice, DeviceChoice::Listed(list) if list.contains(&DeviceName::Number(number)))
}

fn check_requirements(facts: &DeviceFacts) -> Result<(), String> {
    let lacking = requirements(facts).into_iter().find(|(_, has, needed)| has < needed);
    lacking.map_or(Ok(()), |(what, has, needed)| Err(format!("{what} is {}, below {}", size(has), size(needed))))
}

/// Returns true if `a` and `b` are one device with two drivers or two APIs. Bus addresses decide; without them, devices
/// of the same kind and name are considered one only if their APIs differ.
fn same_device(a: &DeviceFacts, b: &DeviceFacts) -> bool {
    if a.kind != b.kind {
        return false;
    }
    if a.bus.is_empty() || b.bus.is_empty() { a.name == b.name && a.api != b.api } else { a.bus == b.bus }
}

/// Formats a number of bytes, or a plain count, with the largest binary unit that divides it.
fn size(n: u64) -> String {
    match n {
        n if n >= 1 << 20 && n.is_multiple_of(1 << 20) => format!("{} MiB", n >> 20),
        n if n >= 1 << 10 && n.is_multiple_of(1 << 10) => format!("{} KiB", n >> 10),
        n => n.to_string(),
    }
}

/// Messages for the requested devices that do not exist.
pub(super) fn missing(found: &[FoundDevice], choice: &DeviceChoice) -> Vec<String> {
    let DeviceChoice::Listed(list) = choice else { return Vec::new() };
    let exists = |name: &DeviceName| match name {
        DeviceName::Number(n) => *n < found.len(),
        DeviceName::Software => found.iter().any(|device| device.facts.kind == DeviceKind::Software),
    };
    let text = |name: &DeviceName| match name {
        DeviceName::Number(n) => format!("there is no device {n}"),
        DeviceName::Software => "there is no software device".to_owned(),
    };
    list.iter().filter(|name| !exists(name)).map(text).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn device(name: &str, kind: DeviceKind, bus: &str) -> DeviceFacts {
        DeviceFacts {
            name: name.to_owned(),
            kind,
            api: "vulkan",
            driver: "d".to_owned(),
            bus: bus.to_owned(),
            binding_bytes: 128 << 20,
            buffer_bytes: 1 << 30,
            workgroup_bytes: 32 << 10,
            workgroup_size: 1024,
            storage_buffers: 14,
            timestamps: true,
            subgroups: None,
        }
    }

    fn machine() -> Vec<DeviceFacts> {
        vec![
            device("A", DeviceKind::Discrete, "0:1"),
            device("A", DeviceKind::Discrete, "0:2"),
            device("I", DeviceKind::Integrated, "0:3"),
            device("S", DeviceKind::Software, ""),
        ]
    }

    fn selected(found: &[FoundDevice]) -> Vec<usize> {
        found.iter().filter(|d| d.selected).map(|d| d.number).collect()
    }

    fn take(facts: Vec<DeviceFacts>, choice: &str) -> Vec<usize> {
        selected(&select(facts, &choice.parse().unwrap()))
    }

    #[test]
    fn software_is_selected_only_if_requested() {
        for (choice, expected) in [
            ("auto", vec![0, 1]),
            ("all", vec![0, 1, 2]),
            ("cpu", vec![]),
            ("2,0", vec![0, 2]),
            ("3", vec![3]),
            ("software", vec![3]),
            ("software,1", vec![1, 3]),
        ] {
            assert_eq!(take(machine(), choice), expected, "{choice}");
        }
        assert_eq!(take(vec![device("S", DeviceKind::Software, "")], "auto"), Vec::<usize>::new());
        assert_eq!(take(vec![device("I", DeviceKind::Integrated, "")], "auto"), [0], "the only one");
    }

    #[test]
    fn every_device_has_its_reason() {
        let reasons = |choice: &str| -> Vec<String> {
            select(machine(), &choice.parse().unwrap()).into_iter().map(|d| d.reason).collect()
        };
        assert_eq!(reasons("auto")[..2], ["discrete", "discrete"]);
        assert_eq!(reasons("auto")[2], "integrated: a discrete device is available");
        assert_eq!(reasons("auto")[3], "software: only if requested as 3 or software");
        assert_eq!(reasons("0")[1], "not in --devices 0");
        assert_eq!(reasons("0")[0], "requested");
        assert_eq!(reasons("cpu")[0], "the CPU was requested");
    }

    #[test]
    fn a_device_below_the_requirements_is_rejected_even_if_requested() {
        let facts = || vec![DeviceFacts { binding_bytes: 64 << 20, ..device("A", DeviceKind::Discrete, "0:1") }];
        for choice in ["auto", "all", "0"] {
            let found = select(facts(), &choice.parse().unwrap());
            assert_eq!(
                (found[0].selected, found[0].reason.as_str()),
                (false, "largest binding is 64 MiB, below 128 MiB")
            );
        }
        // The next best kind is selected instead.
        let mut both = facts();
        both.push(device("I", DeviceKind::Integrated, "0:2"));
        assert_eq!(take(both, "auto"), [1]);
    }

    #[test]
    fn a_device_is_selected_once() {
        let twice = || vec![device("A", DeviceKind::Discrete, "0:1"), device("B", DeviceKind::Discrete, "0:1")];
        let found = select(twice(), &DeviceChoice::All);
        assert_eq!((selected(&found), found[1].reason.as_str()), (vec![0], "the same device as 0"));
        assert_eq!(take(twice(), "1"), [1], "unless the other number is requested");
        let metal = DeviceFacts { api: "metal", ..device("M", DeviceKind::Integrated, "") };
        let vulkan = device("M", DeviceKind::Integrated, "");
        assert_eq!(take(vec![metal, vulkan.clone()], "all"), [0]);
        // Equal names without bus addresses may be two cards.
        assert_eq!(take(vec![vulkan.clone(), vulkan], "all"), [0, 1]);
    }

    #[test]
    fn missing_devices_are_named() {
        let found = select(machine(), &DeviceChoice::All);
        let missing = |choice: &str| missing(&found, &choice.parse().unwrap());
        assert_eq!(missing("0,7"), ["there is no device 7"]);
        assert_eq!(missing("0,3,software"), Vec::<String>::new());
        assert_eq!(missing("all"), Vec::<String>::new());
        assert_eq!(super::missing(&[], &"software".parse().unwrap()), ["there is no software device"]);
    }
}
