//! All files of a tileset.

use std::collections::BTreeSet;
use std::io;
use std::ops::Deref;
use std::sync::atomic::{AtomicUsize, Ordering};

use molmesh_formats::Format;
use molmesh_formats::tileset::{TileAddress, TilesetUris, assembly_document, subtree, tileset_document};
use molmesh_structure::{Structure, StructureError, Unit};
use molmesh_surface::{Control, SurfaceError, SurfaceLimits, threads};
use serde::Serialize;
use thiserror::Error;

use super::{AssemblyTileset, StructureStream, Tileset};
use crate::{Choice, JobError, JobLimits, LeftOut, Options, Product, ProgressSink, StageClock, WorkScope};

/// Contents of a tileset.
#[derive(Debug, Clone, Default, Serialize)]
pub struct TilesetReport {
    /// PDB id or data block name; null if the file has none.
    pub id: Option<String>,
    /// Number of meshed atoms.
    pub atoms: u64,
    /// Atoms of the selected models that are not meshed.
    pub left_out: LeftOut,
    /// Levels, coarsest first; empty with `instances`.
    pub levels: Vec<LevelReport>,
    /// Units of the assembly with `instances`; otherwise empty.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub units: Vec<UnitReport>,
    /// Number of files.
    pub files: u64,
    /// Size of all files, bytes.
    pub bytes: u64,
}

/// Tileset of a unit.
#[derive(Debug, Clone, Serialize)]
pub struct UnitReport {
    /// Author names of its chains.
    pub name: String,
    /// Number of atoms.
    pub atoms: u64,
    /// Number of instances.
    pub instances: u64,
    /// Levels, coarsest first.
    pub levels: Vec<LevelReport>,
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

/// Meshes all tiles of the structure that `read` returns, in parallel, and passes each file with its path to `write`.
/// With `instances`, writes the tileset of each unit into a folder `unit-NUMBER`. `tileset.json` comes last, so that an
/// incomplete tileset cannot be opened. Ignores the parameters that
/// [`params::parse_tileset`](crate::params::parse_tileset) rejects.
///
/// # Errors
/// Returns a [`WriteError`] if the structure cannot be read, or for the first tile that cannot be meshed or written.
pub fn write<S: Deref<Target = Structure> + Sync>(
    read: impl FnOnce(&Control<'_>) -> Result<S, StructureError>,
    options: &Options,
    choice: &Choice<'_>,
    limits: &JobLimits,
    control: &Control<'_>,
    progress: &dyn ProgressSink,
    write: impl Fn(&str, &[u8]) -> io::Result<()> + Sync,
) -> Result<TilesetReport, WriteError> {
    let clock = StageClock::new(progress);
    let scope = WorkScope::new(&clock, control);
    let store = |path: &str, bytes: &[u8]| store(&write, path, bytes);
    if !options.selection.instances {
        let tileset = Tileset::new(read, options, &limits.read, &scope)?;
        return tileset.write(options, choice, &limits.surface, control, progress, store);
    }
    let assembly = AssemblyTileset::new(read, options, &limits.read, &scope)?;
    let units = assembly.units();
    let mut all = TilesetReport::default();
    for (number, Unit { name, rows, operators, .. }) in (1..).zip(units) {
        // Releases all memory that is counted for the unit.
        let control = &control.metered();
        let (options, structure) = (assembly.unit_options(options, number), &**assembly.structure());
        let tileset = Tileset::new(|_| Ok(structure), &options, &limits.read, &WorkScope::new(&clock, control))?;
        let part = Part { sink: progress, index: number - 1, count: units.len() };
        let in_folder = |path: &str, bytes: &[u8]| store(&format!("{}/{path}", unit_folder(number)), bytes);
        let report = tileset.write(&options, choice, &limits.surface, control, &part, in_folder)?;
        let (name, atoms, instances) = (name.clone(), rows.len() as u64, operators.len() as u64);
        all.units.push(UnitReport { name, atoms, instances, levels: report.levels });
        all.atoms += atoms;
        all.files += report.files;
        all.bytes += report.bytes;
    }
    let root = format!("{}.glb", TileAddress::ROOT.path());
    // Progress counts the units only, so the root reports none.
    let clock = StageClock::new(&());
    let product = assembly.root(options, limits, choice, &WorkScope::new(&clock, control))?;
    all.bytes += store(&root, &glb_of(&product)?)?;
    let repeated = assembly.repeated(|number| format!("{}/tileset.json", unit_folder(number)));
    let document = assembly_document(&root, &repeated).to_string();
    all.bytes += store("tileset.json", document.as_bytes())?;
    all.files += 2;
    (all.id, all.left_out) = (assembly.structure().id.clone(), product.report.left_out);
    Ok(all)
}

/// Writes all files of a tileset as [`write()`] does, of a structure that is read as a stream. The job has no
/// `instances`.
///
/// # Errors
/// Returns the errors of [`write()`], and those of the temporary file.
pub fn write_stream(
    stream: StructureStream<'_>,
    options: &Options,
    choice: &Choice<'_>,
    limits: &JobLimits,
    control: &Control<'_>,
    progress: &dyn ProgressSink,
    write: impl Fn(&str, &[u8]) -> io::Result<()> + Sync,
) -> Result<TilesetReport, WriteError> {
    let clock = StageClock::new(progress);
    let tileset = Tileset::of_stream(stream, options, &limits.read, &WorkScope::new(&clock, control))?;
    let store = |path: &str, bytes: &[u8]| store(&write, path, bytes);
    tileset.write(options, choice, &limits.surface, control, progress, store)
}

/// Passes a file to `write`. Returns its size, bytes.
fn store(write: impl Fn(&str, &[u8]) -> io::Result<()>, path: &str, bytes: &[u8]) -> Result<u64, WriteError> {
    write(path, bytes).map_err(|source| WriteError::File { path: path.to_owned(), source })?;
    Ok(bytes.len() as u64)
}

/// Returns the folder of the tileset of a unit, numbered from 1.
#[must_use]
pub fn unit_folder(number: usize) -> String {
    format!("unit-{number}")
}

/// Returns the GLB of a product.
fn glb_of(product: &Product) -> Result<Vec<u8>, JobError> {
    let mut glb = Vec::new();
    let written = product.file(Format::Glb).map(|file| file.write(&mut glb));
    written?.map_err(|_unreachable| SurfaceError::Sink)?;
    Ok(glb)
}

/// Progress of one of several tilesets, as a part of the progress of all.
struct Part<'a> {
    sink: &'a dyn ProgressSink,
    index: usize,
    count: usize,
}

impl ProgressSink for Part<'_> {
    fn progress(&self, stage: &'static str, fraction: f64) {
        self.sink.progress(stage, (self.index as f64 + fraction) / self.count as f64);
    }
}

impl<S: Deref<Target = Structure> + Sync> Tileset<S> {
    /// Meshes all tiles and passes each file with its path to `store`, which returns its size, bytes.
    fn write(
        &self,
        options: &Options,
        choice: &Choice<'_>,
        limits: &SurfaceLimits,
        control: &Control<'_>,
        progress: &dyn ProgressSink,
        store: impl Fn(&str, &[u8]) -> Result<u64, WriteError> + Sync,
    ) -> Result<TilesetReport, WriteError> {
        let colors = options.color.map(|coloring| self.colors(coloring, control)).transpose()?;
        let addresses: Vec<TileAddress> = self.tiles.iter().copied().collect();
        let done = AtomicUsize::new(0);
        // Not by parallel iterators: a thread that waits within a tile would begin other tiles, without a limit.
        let made = threads::each(addresses.len(), |i| {
            let address = addresses[i];
            // Releases all memory that is counted for the tile. The file is not counted.
            let control = &control.metered();
            let options = Options { tile: Some(address), ..options.clone() };
            let clock = StageClock::new(&());
            let tile = self.product(&options, colors.as_ref(), choice, limits, &WorkScope::new(&clock, control))?;
            let n = done.fetch_add(1, Ordering::Relaxed) + 1;
            progress.progress("tiles", n as f64 / addresses.len() as f64);
            if tile.report.triangles == 0 {
                return Ok(None);
            }
            let bytes = store(&format!("{}.glb", address.path()), &glb_of(&tile)?)?;
            Ok::<_, WriteError>(Some((address, tile.report.triangles, bytes)))
        })?;
        let made: Vec<(TileAddress, u64, u64)> = made.into_iter().flatten().collect();
        if made.is_empty() {
            return Err(JobError::from(SurfaceError::NoSurface { isovalue: options.params.level() }).into());
        }
        let level = |level| LevelReport { spacing: self.layout.spacing(level), ..LevelReport::default() };
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
        let (atoms, left_out) = (self.n_atoms(), self.selected.left_out.clone());
        Ok(TilesetReport {
            id: self.structure.id.clone(),
            atoms,
            left_out,
            levels,
            units: Vec::new(),
            files: files + 1,
            bytes,
        })
    }
}
