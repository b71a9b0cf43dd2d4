//! `molmesh-bench fetch`: downloads the paper's structures from the configured archive.

use std::fs;
use std::path::{Path, PathBuf};

use molmesh::archive::{Archive, FetchError};
use molmesh::config::{self, Config};
use molmesh::memory_budget::Budget;
use molmesh::structure::{self, EntryId, ReadLimits, SourceFormat};

use super::{replace, selected_entries};
use crate::error::{Error, Result};
use crate::{print, structures};

/// Arguments of `molmesh-bench fetch`.
#[derive(Debug, clap::Args)]
pub(crate) struct FetchArgs {
    /// Folder for the files, created if missing
    #[arg(long, value_name = "DIR", default_value = "structures")]
    data: PathBuf,
    /// Download only these structures
    #[arg(long, value_name = "IDS", value_delimiter = ',')]
    only: Vec<String>,
    /// Configuration file of the service, which specifies the archive
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Set a configuration key, such as archive.url=https://host/{id}.cif
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
}

/// Runs the command.
pub(crate) fn run(args: &FetchArgs) -> Result<()> {
    let entries = selected_entries(&args.only)?;
    let pair = |set: &String| set.split_once('=').map(|(key, value)| (key.to_owned(), value.to_owned()));
    let pairs: Option<Vec<_>> = args.set.iter().map(pair).collect();
    let pairs = pairs.ok_or_else(|| Error::Usage("--set must be KEY=VALUE".to_owned()))?;
    let loaded = config::load_process(args.config.as_deref(), &pairs).map_err(|e| Error::Usage(e.to_string()))?;
    let mut config = loaded.config;
    if config.archive.url.is_none() {
        return Err(Error::Usage("no archive is configured: set archive.url".to_owned()));
    }
    fs::create_dir_all(&args.data).map_err(Error::file(&args.data))?;
    // Copies of the archive are stored in a temporary folder.
    let temporary = Temporary::new(&args.data)?;
    config.archive.dir = Some(temporary.0.join("none"));
    config.server.data_dir.clone_from(&temporary.0);
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build();
    let runtime = runtime.map_err(Error::failed)?;
    let archive = Archive::new(&config, Budget::unlimited());
    for entry in entries {
        if let Some(path) = structures::find(&args.data, entry.id)? {
            print(&format!("{}: {} exists\n", entry.id, path.display()))?;
            continue;
        }
        let id: EntryId =
            entry.id.parse().map_err(|_not_an_id| Error::Failed(format!("{} is not an entry id", entry.id)))?;
        match runtime.block_on(archive.fetch(&id)) {
            Ok(found) => {
                let path = keep(&args.data, entry.id, &found.bytes, &config)?;
                print(&format!("{}: {}, {} bytes\n", entry.id, path.display(), found.bytes.len()))?;
            }
            Err(error @ FetchError::NotFound { .. }) => print(&format!("{}: {error}\n", entry.id))?,
            Err(error) => {
                let folder = args.data.display();
                return Err(Error::Failed(format!("{error}; without a network, copy the files to {folder} yourself")));
            }
        }
    }
    runtime.shutdown_background();
    Ok(())
}

/// Writes an entry's file under its id, with the extension of its format.
fn keep(folder: &Path, id: &str, bytes: &[u8], config: &Config) -> Result<PathBuf> {
    let limits = ReadLimits { max_inflated_bytes: config.limits.inflated_bytes, ..ReadLimits::default() };
    let read = structure::read(bytes, &limits).map_err(|e| Error::Failed(format!("{id}: {e}")))?;
    let extension = match read.format {
        SourceFormat::Pdb => "pdb",
        SourceFormat::Mmcif => "cif",
        SourceFormat::BinaryCif => "bcif",
        SourceFormat::Pqr => "pqr",
        SourceFormat::Xyz => "xyz",
    };
    let compressed = if bytes.starts_with(&[0x1f, 0x8b]) { ".gz" } else { "" };
    let path = folder.join(format!("{}.{extension}{compressed}", id.to_lowercase()));
    replace(&path, bytes)?;
    Ok(path)
}

/// Temporary folder, removed on drop.
struct Temporary(PathBuf);

impl Temporary {
    fn new(folder: &Path) -> Result<Self> {
        let path = folder.join(format!(".fetch-{}", std::process::id()));
        fs::create_dir_all(&path).map_err(Error::file(&path))?;
        Ok(Self(path))
    }
}

impl Drop for Temporary {
    fn drop(&mut self) {
        // A folder that cannot be removed is hidden and small.
        drop(fs::remove_dir_all(&self.0));
    }
}
