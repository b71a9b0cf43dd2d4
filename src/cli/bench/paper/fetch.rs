//! `molmesh bench fetch`: the paper's structures from the remote archive of the service's configuration, under its rules for
//! addresses and sizes.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use clap::Args as ClapArgs;
use molmesh::archive::{Archive, FetchError, Uncounted};
use molmesh::config::Config;
use molmesh::structure::{self, EntryId, ReadLimits, SourceFormat};

use super::super::super::config;
use super::super::super::error::CliError;
use super::entries::ENTRIES;
use super::source;

/// `molmesh bench fetch`.
#[derive(Debug, ClapArgs)]
pub(crate) struct FetchArgs {
    /// Folder for the files; it is made where it is missing
    #[arg(long, value_name = "DIR", default_value = "structures")]
    pub(crate) data: PathBuf,
    /// Only these structures
    #[arg(long, value_name = "IDS", value_delimiter = ',')]
    pub(crate) only: Vec<String>,
    /// Configuration file of the service, whose archive is asked
    #[arg(long, value_name = "FILE")]
    pub(crate) config: Option<PathBuf>,
    /// Set one key of the configuration, such as archive.url=https://host/{id}.cif
    #[arg(long, value_name = "KEY=VALUE")]
    pub(crate) set: Vec<String>,
}

/// Runs the command.
pub(in crate::cli::bench) fn run(args: &FetchArgs) -> Result<(), CliError> {
    super::check_ids(&args.only)?;
    let mut config = config::of(args.config.as_deref(), &args.set, [])?.config;
    let Some(urls) = &config.archive.url else {
        return Err(CliError::usage("no remote archive is configured: archive.url is `none`"));
    };
    let hosts: Vec<String> = urls.as_slice().iter().map(|template| template.host().to_owned()).collect();
    let failed = |source| CliError::Output { name: args.data.display().to_string(), source };
    fs::create_dir_all(&args.data).map_err(failed)?;
    // Copies of the service's own kind lie in a folder that goes away; what is kept are the files.
    let work = Work::new(&args.data)?;
    config.archive.dir = Some(work.0.join("none"));
    config.server.data_dir.clone_from(&work.0);
    let failed = |e: std::io::Error| CliError::Service(format!("cannot start the runtime: {e}"));
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().map_err(failed)?;
    let archive = Archive::new(&config, Arc::new(Uncounted));
    let wanted = |id: &str| args.only.is_empty() || args.only.iter().any(|only| only.eq_ignore_ascii_case(id));
    let mut done = 0;
    for entry in ENTRIES.iter().filter(|entry| wanted(entry.id)) {
        if let Some(path) = source::file(Some(&args.data), entry.id)? {
            super::super::super::say(&format!("{}: {} is there\n", entry.id, path.display()))?;
            continue;
        }
        let id: EntryId =
            entry.id.parse().map_err(|_not_an_id| CliError::Internal(format!("{} is no id", entry.id)))?;
        let bytes = match runtime.block_on(archive.fetch(&id)) {
            Ok(found) => found.bytes,
            Err(error @ FetchError::NotFound { .. }) => {
                super::super::super::say(&format!("{}: {error}\n", entry.id))?;
                continue;
            }
            Err(error) => {
                let hosts = hosts.join(", ");
                let words = format!(
                    "{error}; {done} structures were fetched before. Without a network to {hosts}, put files into {} by hand, or use the stand-ins",
                    args.data.display()
                );
                return Err(CliError::Service(words));
            }
        };
        let path = keep(&args.data, entry.id, &bytes, &config)?;
        done += 1;
        super::super::super::say(&format!("{}: {}, {} bytes\n", entry.id, path.display(), bytes.len()))?;
    }
    runtime.shutdown_background();
    Ok(())
}

/// Writes an entry's file under its id and the extension of what it is.
fn keep(folder: &Path, id: &str, bytes: &[u8], config: &Config) -> Result<PathBuf, CliError> {
    let limits = ReadLimits { max_inflated_bytes: config.limits.inflated_bytes, ..ReadLimits::default() };
    let read = structure::read(bytes, &limits).map_err(|e| CliError::Job {
        name: format!("{id}, as it was sent"),
        source: e.into(),
        opinion: None,
    })?;
    let extension = match read.format {
        SourceFormat::Pdb => "pdb",
        SourceFormat::Mmcif => "cif",
        SourceFormat::BinaryCif => "bcif",
    };
    let compressed = if bytes.starts_with(&[0x1f, 0x8b]) { ".gz" } else { "" };
    let path = folder.join(format!("{}.{extension}{compressed}", id.to_lowercase()));
    super::put(&path, bytes)?;
    Ok(path)
}

/// A folder that is gone afterwards.
struct Work(PathBuf);

impl Work {
    fn new(folder: &Path) -> Result<Self, CliError> {
        let path = folder.join(format!(".fetch-{}", std::process::id()));
        fs::create_dir_all(&path).map_err(|source| CliError::Output { name: path.display().to_string(), source })?;
        Ok(Self(path))
    }
}

impl Drop for Work {
    fn drop(&mut self) {
        // What is left behind is hidden and small.
        drop(fs::remove_dir_all(&self.0));
    }
}
