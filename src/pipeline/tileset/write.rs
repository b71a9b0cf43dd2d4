//! All files of a tileset.

use std::collections::BTreeSet;
use std::io;
use std::ops::Deref;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use serde::Serialize;
use thiserror::Error;

use super::Tileset;
use crate::formats::Format;
use crate::formats::tileset::{TileAddress, TilesetUris, subtree, tileset_document};
use crate::pipeline::{Choice, Job, JobError, LeftOutReport, ProgressSink, StageClock};
use crate::structure::Structure;
use crate::surface::{Control, Reservation, SurfaceError, SurfaceLimits, threads};

/// Contents of a tileset.
#[derive(Debug, Clone, Serialize)]
pub struct TilesetReport {
    /// PDB id or data block name; null if the file has none.
    pub id: Option<String>,
    /// Number of meshed atoms.
    pub atoms: u64,
    /// Atoms of the selected models that are not meshed.
    pub left_out: LeftOutReport,
    /// Levels, coarsest first.
    pub levels: Vec<LevelReport>,
    /// Number of files.
    pub files: u64,
    /// Size of all files, bytes.
    pub bytes: u64,
}

/// Contents of a level.
#[derive(Debug, Clone, Default, Serialize)]
pub struct LevelReport {
    /// Grid spacing in Å, which is also the geometric error.
    pub spacing: f64,
    /// Number of tiles with triangles.
    pub tiles: u64,
    /// Number of triangles, including skirts.
    pub triangles: u64,
    /// Size of the tiles, bytes.
    pub bytes: u64,
    /// Size of the largest tile, bytes.
    pub largest_tile: u64,
}

/// Failure of writing a tileset.
#[derive(Debug, Error)]
pub enum WriteError {
    /// Meshing failed.
    #[error(transparent)]
    Job(#[from] JobError),
    /// A file cannot be written.
    #[error("cannot write {path}: {source}")]
    File {
        /// Path within the tileset.
        path: String,
        /// Cause.
        source: io::Error,
    },
}

impl<S: Deref<Target = Structure> + Sync> Tileset<S> {
    /// Meshes all tiles, in parallel, and passes each file with its path to `write`. `tileset.json` comes last, so that
    /// an incomplete tileset cannot be opened.
    ///
    /// # Errors
    /// Returns a [`WriteError`] for the first tile that cannot be meshed or written.
    pub fn write(
        &self,
        job: &Job,
        choice: &Choice<'_>,
        limits: &SurfaceLimits,
        control: &Control<'_>,
        progress: &dyn ProgressSink,
        write: impl Fn(&str, &[u8]) -> io::Result<()> + Sync,
    ) -> Result<TilesetReport, WriteError> {
        let store = |path: &str, bytes: &[u8]| {
            write(path, bytes).map_err(|source| WriteError::File { path: path.to_owned(), source })?;
            Ok::<_, WriteError>(bytes.len() as u64)
        };
        let colors = job.color.map(|coloring| self.colors(coloring, control)).transpose()?;
        let addresses: Vec<TileAddress> = self.tiles.iter().copied().collect();
        let done = AtomicUsize::new(0);
        // Not by parallel iterators: a thread that waits within a tile would begin other tiles, without a limit.
        let made = threads::each(addresses.len(), |i| {
            let address = addresses[i];
            // Releases all memory that is counted for the tile. The file is not counted.
            let control = &Control { memory: Arc::new(Reservation::new(&control.memory)), ..control.clone() };
            let job = Job { tile: Some(address), ..job.clone() };
            let tile = self.product((&job, colors.as_ref()), choice, limits, control, StageClock::new(&()), &())?;
            let n = done.fetch_add(1, Ordering::Relaxed) + 1;
            progress.progress("tiles", n as f64 / addresses.len() as f64);
            if tile.report.triangles == 0 {
                return Ok(None);
            }
            let mut glb = Vec::new();
            let written = tile.file(Format::Glb).map(|file| file.write(&mut glb));
            written.map_err(JobError::from)?.map_err(|_unreachable| JobError::from(SurfaceError::Sink))?;
            let bytes = store(&format!("{}.glb", address.path()), &glb)?;
            Ok::<_, WriteError>(Some((address, tile.report.triangles, bytes)))
        })?;
        let made: Vec<(TileAddress, u64, u64)> = made.into_iter().flatten().collect();
        if made.is_empty() {
            return Err(JobError::from(SurfaceError::NoSurface { isovalue: job.params.level() }).into());
        }
        let level = |level| LevelReport { spacing: self.spacing(level), ..LevelReport::default() };
        let mut levels: Vec<LevelReport> = (0..self.layout.levels).map(level).collect();
        for (address, triangles, bytes) in &made {
            let level = &mut levels[address.level as usize];
            level.tiles += 1;
            level.triangles += triangles;
            level.bytes += bytes;
            level.largest_tile = level.largest_tile.max(*bytes);
        }
        let with_content: BTreeSet<TileAddress> = made.iter().map(|(address, ..)| *address).collect();
        let (mut files, mut bytes) = (made.len() as u64, levels.iter().map(|level| level.bytes).sum::<u64>());
        let (bounds, is_tile) = (self.bounds(), |tile| self.tiles.contains(&tile));
        let subtree_levels = bounds.subtree_levels();
        for root in self.tiles.iter().filter(|tile| tile.level.is_multiple_of(subtree_levels)) {
            let file = subtree(*root, subtree_levels, is_tile, |tile| with_content.contains(&tile));
            bytes += store(&format!("subtrees/{}.subtree", root.path()), &file)?;
            files += 1;
        }
        let address = "{level}/{x}/{y}/{z}";
        let uris = TilesetUris { content: format!("{address}.glb"), subtrees: format!("subtrees/{address}.subtree") };
        bytes += store("tileset.json", tileset_document(&bounds, &uris).to_string().as_bytes())?;
        let (atoms, left_out) = (self.selected.atoms.len() as u64, LeftOutReport::new(&self.selected.left_out));
        Ok(TilesetReport { id: self.structure.id.clone(), atoms, left_out, levels, files: files + 1, bytes })
    }
}
