//! A quick look for hardware, before any driver is loaded: a command that takes five milliseconds must not spend fifty
//! on asking drivers that have nothing to drive.

use std::path::Path;

/// Device nodes of GPUs: a folder and how names in it begin. Every Linux driver that can compute makes one of them.
const NODES: [(&str, &[&str]); 3] = [
    ("dev/dri", &["renderD"]),
    // Followed by a number: nvidiactl and nvidia-uvm are there on machines without a card.
    ("dev", &["nvidia#", "dxg", "kgsl-3d0", "mali0", "nvhost-gpu", "pvr"]),
    ("dev/nvgpu", &[""]),
];

/// Whether there may be a GPU, and what was looked at. On systems other than Linux nothing is known beforehand.
///
/// # Errors
/// The reason in words where there can be none.
pub(super) fn signs() -> Result<String, String> {
    if cfg!(target_os = "linux") { nodes_under(Path::new("/")) } else { Ok("drivers are asked".to_owned()) }
}

fn nodes_under(root: &Path) -> Result<String, String> {
    let mut found = Vec::new();
    for (folder, starts) in NODES {
        let Ok(entries) = root.join(folder).read_dir() else { continue };
        let names = entries.flatten().filter_map(|entry| entry.file_name().into_string().ok());
        let nodes = names.filter(|name| starts.iter().any(|start| begins(name, start)));
        found.extend(nodes.map(|name| format!("/{folder}/{name}")));
    }
    found.sort();
    if found.is_empty() {
        return Err("there is no device node of one (/dev/dri/renderD*, /dev/nvidia0 and the like)".to_owned());
    }
    Ok(found.join(", "))
}

/// Whether `name` begins with `start`, whose `#` stands for a digit.
fn begins(name: &str, start: &str) -> bool {
    match start.strip_suffix('#') {
        Some(start) => name.strip_prefix(start).is_some_and(|rest| rest.starts_with(|c: char| c.is_ascii_digit())),
        None => name.starts_with(start),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nodes_are_found_and_lookalikes_are_not() {
        let root = tempfile::tempdir().unwrap();
        let none = nodes_under(root.path()).unwrap_err();
        assert!(none.contains("renderD") && none.contains("nvidia"), "{none}");
        std::fs::create_dir_all(root.path().join("dev/dri")).unwrap();
        for lookalike in ["dev/nvidiactl", "dev/nvidia-uvm", "dev/dri/card0", "dev/null"] {
            std::fs::write(root.path().join(lookalike), "").unwrap();
        }
        assert_eq!(nodes_under(root.path()).unwrap_err(), none);
        for node in ["dev/nvidia1", "dev/dri/renderD128"] {
            std::fs::write(root.path().join(node), "").unwrap();
        }
        assert_eq!(nodes_under(root.path()).unwrap(), "/dev/dri/renderD128, /dev/nvidia1");
    }
}
