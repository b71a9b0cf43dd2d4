//! `molmesh tileset`: meshes one structure into the files of a tileset.

use std::fs;
use std::io::{self, Write as _};
use std::path::Path;
use std::time::Instant;

use molmesh::pipeline::params::Request;
use molmesh::pipeline::tileset::TilesetReport;

use super::args::{ReportStyle, TilesetArgs};
use super::backend::Purpose;
use super::error::CliError;
use super::job::CommandJob;
use super::page::Page;
use super::request;
use super::style::Style;

/// Runs the command.
pub(super) fn run(args: &TilesetArgs) -> Result<(), CliError> {
    let Request { job, strict, .. } = request::parse_tileset(args)?;
    let start = Instant::now();
    let folder = args.output.as_path();
    let (job, ()) =
        CommandJob::prepare_for(Purpose::Mesh, job, strict, &args.input, &args.job, |_| create_empty(folder))?;
    let write = |path: &str, bytes: &[u8]| {
        let path = folder.join(path);
        path.parent().map_or(Ok(()), fs::create_dir_all)?;
        fs::write(path, bytes)
    };
    let report = job.write_tileset(write)?;
    drop(job);
    match args.job.report {
        ReportStyle::Text if args.job.quiet => Ok(()),
        ReportStyle::Text => {
            let text = summary(&report, folder, start.elapsed().as_secs_f64(), Style::stderr());
            // The tileset is complete, so a closed stderr is not an error.
            drop(io::stderr().write_all(text.as_bytes()));
            Ok(())
        }
        ReportStyle::Json => {
            let failed = |error: serde_json::Error| CliError::Internal(error.to_string());
            super::print(&format!("{}\n", serde_json::to_string_pretty(&report).map_err(failed)?))
        }
    }
}

/// Creates the folder, unless it exists and is empty.
fn create_empty(folder: &Path) -> Result<(), CliError> {
    let failed = |source| CliError::Output { name: folder.display().to_string(), source };
    fs::create_dir_all(folder).map_err(failed)?;
    if fs::read_dir(folder).map_err(failed)?.next().is_some() {
        let message = format!("`{}` is not empty", folder.display());
        return Err(CliError::Usage { message, hint: Some("name another folder with -o".to_owned()) });
    }
    Ok(())
}

/// Formats the report as text.
fn summary(report: &TilesetReport, folder: &Path, seconds: f64, style: Style) -> String {
    let mut page = Page::new(style, report.id.as_deref().unwrap_or("structure"), &format!("{} atoms", report.atoms));
    for (number, level) in report.levels.iter().enumerate() {
        let megabytes = level.bytes as f64 / 1e6;
        page.row(
            &format!("level {number}"),
            &format!("{} Å: {} tiles, {} triangles, {megabytes:.1} MB", level.spacing, level.tiles, level.triangles),
        );
    }
    let megabytes = report.bytes as f64 / 1e6;
    page.row("time", &format!("{seconds:.1} s"));
    page.row("wrote", &format!("{} ({} files, {megabytes:.1} MB)", folder.display(), report.files));
    page.finish()
}
