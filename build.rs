//! Build script: records the compiler, links the C++ standard library, and generates the table of web page files.

use std::path::PathBuf;

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    built_by();
    link_cpp();
    page::build();
}

/// Passes the target and the compiler version to the crate, for `molmesh doctor`.
fn built_by() {
    let target = std::env::var("TARGET").unwrap_or_default();
    let compiler = std::env::var_os("RUSTC").and_then(|rustc| {
        let output = std::process::Command::new(rustc).arg("--version").output().ok()?;
        Some(String::from_utf8(output.stdout).ok()?.trim().to_owned())
    });
    println!("cargo::rustc-env=MOLMESH_TARGET={target}");
    println!("cargo::rustc-env=MOLMESH_COMPILER={}", compiler.unwrap_or_default());
}

/// Links the C++ standard library statically on Linux, so that the executable starts faster and runs on systems without
/// it. Only meshoptimizer uses it, for memory allocation. If there is no static library, the dynamic one is linked.
fn link_cpp() {
    let [os, host, target] =
        ["CARGO_CFG_TARGET_OS", "HOST", "TARGET"].map(|name| std::env::var(name).unwrap_or_default());
    // The compiler of the host has libraries for its own architecture only.
    if os != "linux" || host.split('-').next() != target.split('-').next() {
        return;
    }
    println!("cargo::rerun-if-env-changed=CXX");
    let compiler = std::env::var_os("CXX").unwrap_or_else(|| "c++".into());
    let found = std::process::Command::new(compiler).arg("-print-file-name=libstdc++.a").output().ok();
    let library = found.and_then(|output| Some(PathBuf::from(String::from_utf8(output.stdout).ok()?.trim())));
    let out = PathBuf::from(std::env::var_os("OUT_DIR").expect("cargo sets OUT_DIR")).join("cpp");
    // The linker uses the first folder with either kind of library.
    let copied = library.filter(|path| path.is_absolute()).is_some_and(|path| {
        std::fs::create_dir_all(&out).and_then(|()| std::fs::copy(path, out.join("libstdc++.a"))).is_ok()
    });
    if copied {
        println!("cargo::rustc-link-search=native={}", out.display());
    }
}

/// Generates the table of the files of the web page in `web/dist`. It is empty if the page was not built.
mod page {
    use std::fmt::Write as _;
    use std::path::{Path, PathBuf};
    use std::{env, fs};

    pub(super) fn build() {
        let dist = Path::new("web/dist");
        // Cargo runs the script on every build if a watched path does not exist.
        let watched = if dist.is_dir() { dist } else { Path::new("web") };
        println!("cargo::rerun-if-changed={}", watched.display());
        let root = PathBuf::from(env::var_os("CARGO_MANIFEST_DIR").expect("cargo sets CARGO_MANIFEST_DIR"));
        let mut found = Vec::new();
        files(dist, &mut found);
        found.sort();
        let mut table = String::from("static FILES: &[(&str, &[u8])] = &[\n");
        for file in &found {
            let name =
                file.strip_prefix(dist).expect("all files are below web/dist").to_string_lossy().replace('\\', "/");
            let path = name.trim_end_matches(".gz");
            let file = root.join(file).display().to_string();
            writeln!(table, "    ({path:?}, include_bytes!({file:?})),").expect("writing to a string cannot fail");
        }
        table.push_str("];\n");
        let out = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets OUT_DIR"));
        fs::write(out.join("page.rs"), table).expect("OUT_DIR can be written");
    }

    /// Adds the compressed files below `folder` to `found`. Adds none if the folder does not exist.
    fn files(folder: &Path, found: &mut Vec<PathBuf>) {
        for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
            let path = entry.path();
            if path.is_dir() {
                files(&path, found);
            } else if path.extension().is_some_and(|extension| extension == "gz") {
                found.push(path);
            }
        }
    }
}
