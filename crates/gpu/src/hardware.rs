//! Detection of GPU device nodes without loading a driver. Loading all drivers takes 50 ms, ten times as long as
//! meshing a small structure.

use std::path::Path;

/// Device nodes of GPUs: folder and prefixes of names. Every Linux driver with compute support creates one of them.
const NODES: [(&str, &[&str]); 3] = [
    ("dev/dri", &["renderD"]),
    // `#` is a digit: nvidiactl and nvidia-uvm exist on machines without a card.
    ("dev", &["nvidia#", "dxg", "kgsl-3d0", "mali0", "nvhost-gpu", "pvr"]),
    ("dev/nvgpu", &[""]),
];

/// Lists the device nodes of GPUs. Systems other than Linux have none, so a GPU is assumed there.
///
/// # Errors
/// A message if there is no GPU.
pub(super) fn device_nodes() -> Result<String, String> {
    if cfg!(target_os = "linux") {
        nodes_under(Path::new("/"))
    } else {
        Ok("unknown before drivers are loaded".to_owned())
    }
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
        return Err("no GPU device node exists (/dev/dri/renderD*, /dev/nvidia0 or similar)".to_owned());
    }
    Ok(found.join(", "))
}

/// Returns true if `name` begins with `start`, in which `#` is a digit.
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
    fn nodes_are_found_and_similar_names_are_not() {
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
