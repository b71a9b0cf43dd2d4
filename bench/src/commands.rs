//! `molmesh-bench commands`: time of whole `molmesh mesh` commands, from start to exit, on several backends in one run,
//! which take turns.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Instant;

use serde_json::json;

use crate::error::{Error, Result};
use crate::stats::Summary;
use crate::{print, structures, write_json};

/// Arguments of `molmesh-bench commands`.
#[derive(Debug, clap::Args)]
pub(crate) struct CommandsArgs {
    /// Binary to measure
    #[arg(long, value_name = "FILE", default_value = "target/release/molmesh")]
    binary: PathBuf,
    /// Backends: cpu, gpu, auto
    #[arg(long, value_name = "NAMES", value_delimiter = ',', default_value = "cpu,gpu,auto")]
    backends: Vec<String>,
    /// Folder with structures, plain or compressed
    #[arg(long, value_name = "DIR")]
    data: PathBuf,
    /// Structures of the folder
    #[arg(long, value_name = "IDS", value_delimiter = ',', required = true)]
    ids: Vec<String>,
    /// Number of measured commands for each structure and backend, after an unmeasured one
    #[arg(long, value_name = "N", default_value_t = 5)]
    runs: usize,
    /// Also write the results to this file, as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

/// Folder for the meshes. Dropping it removes it.
struct Scratch(PathBuf);

impl Scratch {
    fn new() -> Result<Self> {
        let folder = std::env::temp_dir().join(format!("molmesh-bench-{}-commands", std::process::id()));
        std::fs::create_dir(&folder).map_err(Error::file(&folder))?;
        Ok(Self(folder))
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        drop(std::fs::remove_dir_all(&self.0));
    }
}

/// Runs the binary. Returns its time, s.
fn time(binary: &Path, args: &[&str], files: &[&Path]) -> Result<f64> {
    let begin = Instant::now();
    let output =
        Command::new(binary).args(args).args(files).stdin(Stdio::null()).output().map_err(Error::file(binary))?;
    let seconds = begin.elapsed().as_secs_f64();
    if output.status.success() {
        Ok(seconds)
    } else {
        Err(Error::failed(format!("{args:?}: {}", String::from_utf8_lossy(&output.stderr))))
    }
}

/// Runs the command.
pub(crate) fn run(args: &CommandsArgs) -> Result<()> {
    if args.runs == 0 || args.backends.is_empty() {
        return Err(Error::Usage("--runs must be at least 1, and --backends must name one".to_owned()));
    }
    let find = |id: &String| {
        structures::find(&args.data, id)?.ok_or_else(|| Error::failed(format!("there is no file of {id}")))
    };
    let files = args.ids.iter().map(find).collect::<Result<Vec<_>>>()?;
    let scratch = Scratch::new()?;
    let mesh = scratch.0.join("mesh.glb");
    print(&format!(
        "medians, ms\n\n| structure | {} |\n|---|{}\n",
        args.backends.join(" | "),
        "---|".repeat(args.backends.len())
    ))?;
    let mut rows = Vec::new();
    for (id, file) in args.ids.iter().zip(&files) {
        let mut times = vec![Vec::new(); args.backends.len()];
        for run in 0..=args.runs {
            for (backend, times) in args.backends.iter().zip(&mut times) {
                let flags = ["mesh", "--resolution", "0.5", "--compress", "quantize", "--backend", backend, "-o"];
                let seconds = time(&args.binary, &flags, &[&mesh, file])?;
                if run > 0 {
                    times.push(seconds * 1e3);
                }
            }
        }
        let times: Vec<Summary> = times.into_iter().map(|ms| Summary::of(ms).rounded()).collect();
        let cells: Vec<String> = times.iter().map(|ms| format!("{:.1}", ms.median)).collect();
        print(&format!("| {id} | {} |\n", cells.join(" | ")))?;
        rows.push(json!({ "structure": id, "milliseconds": times }));
        write_json(args.json.as_deref(), &json!({ "backends": args.backends, "rows": rows }))?;
    }
    Ok(())
}
