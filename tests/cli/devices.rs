//! `--devices` and the reports on devices, through the binary.

use crate::cli_support;

use cli_support::{Folder, Service, assert_code, doctor, mesh, molmesh, rod, run, stderr, stdout};

fn report(flags: &[&str]) -> serde_json::Value {
    let folder = Folder::new();
    let input = folder.file("in.pdb", rod());
    let done = mesh(&input, &folder.path("out.glb"), &[flags, &["--report", "json"]].concat());
    assert_code(&done, 0);
    serde_json::from_str(&stdout(&done)).unwrap()
}

#[test]
fn rejects_invalid_devices() {
    for devices in ["", "gpu", "-1", "0,", "cpu,0", "0 1"] {
        let flag = format!("--devices={devices}");
        for command in [&["mesh", "a.pdb", "-o", "b.glb", &flag][..], &["doctor", &flag]] {
            let done = run(command);
            assert_eq!(done.status.code(), Some(2), "{command:?}: {}", stderr(&done));
            assert!(stderr(&done).contains("auto, all, cpu"), "{}", stderr(&done));
        }
        let done = run(["serve", "--listen", "127.0.0.1:0", &flag]);
        assert_code(&done, 2);
        assert!(stderr(&done).contains("devices.use") && stderr(&done).contains("auto, all, cpu"), "{}", stderr(&done));
    }
    let done = run(["mesh", "a.pdb", "-o", "b.glb", "--backend", "gpu", "--devices", "cpu"]);
    assert_code(&done, 2);
}

#[test]
fn flags_override_the_environment() {
    let bad = molmesh().env("MOLMESH__DEVICES__USE", "abacus").args(["doctor"]).output().unwrap();
    assert_eq!(bad.status.code(), Some(2), "{}", stderr(&bad));
    let folder = Folder::new();
    let input = folder.file("in.pdb", rod());
    let mesh = |devices: &str, flags: &[&str]| {
        let mut command = molmesh();
        command.env("MOLMESH__DEVICES__USE", devices).arg("mesh").arg(&input).arg("-o").arg(folder.path("out.glb"));
        command.args(flags).output().unwrap()
    };
    assert_eq!(mesh("abacus", &[]).status.code(), Some(2));
    assert_code(&mesh("abacus", &["--devices", "cpu"]), 0);
    assert_code(&mesh("77", &["--devices", "cpu"]), 0);
}

#[test]
fn reason_names_the_flag_that_requested_the_cpu() {
    for (flags, reason) in [(&["--devices", "cpu"][..], "--devices cpu"), (&["--backend", "cpu"], "requested")] {
        let report = report(flags);
        assert_eq!((&report["backend"], &report["backend_reason"]), (&"cpu".into(), &reason.into()), "{flags:?}");
    }
}

#[test]
#[cfg(feature = "gpu")]
fn missing_device_is_an_error_without_fallback() {
    let folder = Folder::new();
    let input = folder.file("in.pdb", rod());
    for flags in [&["--devices", "77"][..], &["--backend", "gpu", "--devices", "77"]] {
        let done = mesh(&input, &folder.path("out.glb"), flags);
        assert_code(&done, 6);
        assert!(stderr(&done).contains("there is no device 77"), "{}", stderr(&done));
    }
    assert_code(&run(["serve", "--listen", "127.0.0.1:0", "--devices", "77"]), 6);
    assert_eq!(folder.entries(), ["in.pdb"]);
}

#[test]
fn doctor_lists_every_device_with_its_reason() {
    let done = doctor(&[]);
    assert_code(&done, 0);
    let text = stdout(&done);
    for row in ["cpu", "reference", "gpu", "auto"] {
        assert!(text.lines().any(|line| line.trim_start().starts_with(row)), "no `{row}` in\n{text}");
    }
    if cfg!(feature = "gpu") && std::env::var_os("CI").is_some() {
        assert!(text.contains("device 0"), "CI has software Vulkan:\n{text}");
    }
    for line in text.lines().filter(|line| line.trim_start().starts_with("device ")) {
        let (_, device) = line.split_once("device ").unwrap();
        assert!(device.contains("yes ") || device.contains("no "), "{line}");
        assert!(device.contains(": "), "no reason: {line}");
    }
    let cpu = doctor(&["--devices", "cpu"]);
    for line in stdout(&cpu).lines().filter(|line| line.trim_start().starts_with("device ")) {
        assert!(line.contains("the CPU was requested"), "{line}");
    }
}

#[test]
fn banner_names_the_devices() {
    let folder = Folder::new();
    let service = Service::start(&folder, &["--devices", "cpu"]);
    assert!(service.banner.contains("cpu: ") && service.banner.contains("(--devices cpu)"), "{}", service.banner);
    assert!(service.banner.contains("not gpu: "), "{}", service.banner);
}
