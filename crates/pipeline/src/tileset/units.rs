//! Tileset of an assembly with `instances=true`. Each unit has its own tileset, which that of the assembly repeats.

use std::num::NonZeroU32;
use std::ops::Deref;
use std::sync::Arc;

use molmesh_formats::tileset::{RepeatedTileset, TilesetBounds};
use molmesh_structure::{ReadLimits, Selected, Selection, Structure, StructureError, Unit};
use molmesh_surface::{Control, Spheres, SurfaceError, SurfaceParams};

use super::layout::{CELLS, Layout};
use super::level::{Buckets, MIN_BUCKET, TilesetLevel};
use crate::color::{AtomColors, Coloring, Scheme};
use crate::load::{LoadedStructure, SPHERE_BYTES, load};
use crate::{Choice, JobError, JobLimits, Options, Product, Spacing, WorkScope, run_loaded};

/// Tileset of an assembly.
pub struct AssemblyTileset<S> {
    structure: S,
    selected: Selected,
    spheres: Spheres,
    /// Bounds of the tileset of each unit, in the coordinates of the structure.
    bounds: Vec<TilesetBounds>,
    /// Range of the colours for all units, if the request has none and the atoms determine it.
    color_range: Option<[f64; 2]>,
}

impl<S: Deref<Target = Structure>> AssemblyTileset<S> {
    /// Prepares the units of the structure that `read` returns. `options` has `instances`.
    ///
    /// # Errors
    /// Returns a [`JobError`] if reading or selecting fails, or the job is cancelled.
    pub fn new(
        read: impl FnOnce(&Control<'_>) -> Result<S, StructureError>,
        options: &Options,
        limits: &ReadLimits,
        scope: &WorkScope<'_>,
    ) -> Result<Self, JobError> {
        let LoadedStructure { structure, selected, spheres } = load(read, options, limits, scope)?;
        let control = &scope.control;
        let bounds = |unit: &Unit| {
            control.check()?;
            let _spheres = control.reserve((SPHERE_BYTES + 4) * unit.rows.len() as u64)?;
            let own = spheres.subset(&rows_of(unit));
            Ok(Layout::of(&own, &options.params_for(own.len()))?.bounds())
        };
        let bounds = selected.units.iter().map(bounds).collect::<Result<_, SurfaceError>>()?;
        let needs_range = |coloring: &&Coloring| {
            coloring.range.is_none() && matches!(coloring.scheme, Scheme::BFactor | Scheme::Occupancy)
        };
        let range = |coloring| Ok::<_, JobError>(AtomColors::new(&structure, &selected.atoms, coloring)?.range);
        let range = options.color.as_ref().filter(needs_range).map(range).transpose()?;
        // A range without extent cannot be requested, and is the same for all units.
        let color_range = range.filter(|[low, high]| low < high);
        Ok(Self { structure, selected, spheres, bounds, color_range })
    }

    /// Returns the structure.
    pub const fn structure(&self) -> &S {
        &self.structure
    }

    /// Returns the units.
    #[must_use]
    pub fn units(&self) -> &[Unit] {
        &self.selected.units
    }

    /// Returns the range of the colours for root and units, if the request has none and the atoms determine it.
    #[must_use]
    pub const fn color_range(&self) -> Option<[f64; 2]> {
        self.color_range
    }

    /// Returns the tilesets of the units with all placements. `uri` returns the URI of the tileset of a unit, numbered
    /// from 1.
    pub fn repeated(&self, uri: impl Fn(usize) -> String) -> Vec<RepeatedTileset> {
        let units = self.selected.units.iter().zip(&self.bounds).enumerate();
        let repeated = |(index, (unit, bounds)): (usize, (&Unit, &TilesetBounds))| {
            let placements = unit.operators.iter().map(|operator| operator.0).collect();
            RepeatedTileset { uri: uri(index + 1), bounds: *bounds, placements }
        };
        units.map(repeated).collect()
    }

    /// Returns the options of the tileset of a unit, numbered from 1.
    pub(super) fn unit_options(&self, options: &Options, number: usize) -> Options {
        let unit = u32::try_from(number).ok().and_then(NonZeroU32::new);
        let selection = Selection { instances: false, unit, ..options.selection.clone() };
        self.colored(Options { selection, ..options.clone() })
    }

    /// Sets the range of the colours.
    fn colored(&self, mut options: Options) -> Options {
        if let Some(coloring) = &mut options.color {
            coloring.range = coloring.range.or(self.color_range);
        }
        options
    }

    /// Meshes the root: all instances at the coarsest grid spacing of the units, or at the next level at which the grid
    /// does not miss the surface. Atoms are grouped as in coarse tiles. The report includes the times of the clock of
    /// `scope`, with those of levels that missed the surface.
    ///
    /// # Errors
    /// Returns the errors of meshing and compression.
    pub fn root(
        &self,
        options: &Options,
        limits: &JobLimits,
        choice: &Choice<'_>,
        scope: &WorkScope<'_>,
    ) -> Result<Product, JobError> {
        let coarsest = self.bounds.iter().fold(0.0_f64, |most, bounds| most.max(bounds.error));
        let levels = self.bounds.iter().map(|bounds| bounds.levels).max().unwrap_or(1);
        let mut level = 0;
        loop {
            let spacing = coarsest / f64::from(1_u32 << level);
            level += 1;
            match self.root_at(spacing, options, limits, choice, scope) {
                Err(JobError::Surface(SurfaceError::NoSurface { .. })) if level < levels => {}
                made => return made,
            }
        }
    }

    /// Meshes the root with a grid spacing, Å.
    fn root_at(
        &self,
        spacing: f64,
        options: &Options,
        limits: &JobLimits,
        choice: &Choice<'_>,
        scope: &WorkScope<'_>,
    ) -> Result<Product, JobError> {
        let grouped = || self.grouped(options, spacing, &scope.control);
        let (selected, spheres) = scope.clock.time("index", grouped)?;
        let params = SurfaceParams { resolution: spacing, ..options.params.clone() };
        let coarse = self.colored(Options { params, spacing: Spacing::Given, tile: None, ..options.clone() });
        let loaded = LoadedStructure { structure: &*self.structure, selected, spheres };
        let mut product = run_loaded(loaded, &coarse, limits, choice, scope, None)?;
        // The groups represent all atoms.
        let report = &mut product.report;
        report.atoms = self.selected.atoms.len() as u64;
        (report.resolution_from, report.detail) = (options.spacing.parameter(), options.spacing.detail());
        if let (Some(color), Some(coloring)) = (&mut report.color, &coarse.color) {
            let all = &self.selected.atoms;
            color.legend = AtomColors::new(&self.structure, all, coloring)?.report(all).legend;
        }
        for (part, unit) in report.parts.iter_mut().zip(&self.selected.units) {
            part.atoms = unit.rows.len() as u64;
        }
        if let Some(instances) = &mut report.instances {
            let atoms = |unit: &Unit| (unit.rows.len() * unit.operators.len()) as u64;
            instances.atoms_sum = self.selected.units.iter().map(atoms).sum();
        }
        Ok(product)
    }

    /// Returns the spheres of all units on a grid with this spacing, Å, with the atoms that represent them.
    fn grouped(
        &self,
        options: &Options,
        spacing: f64,
        control: &Control<'_>,
    ) -> Result<(Selected, Spheres), SurfaceError> {
        let [mut x, mut y, mut z] = [const { Vec::new() }; 3];
        let (mut radii, mut atoms, mut units) = (Vec::new(), Vec::new(), Vec::new());
        let mut side = CELLS * spacing;
        while side >= 2.0 * MIN_BUCKET {
            side *= 0.5;
        }
        for unit in &self.selected.units {
            // Releases the memory of the index of the unit.
            let unit_control = &control.metered();
            let rows = rows_of(unit);
            unit_control.memory.grow((SPHERE_BYTES + 4) * rows.len() as u64)?;
            let own = Arc::new(self.spheres.subset(&rows));
            let buckets = Arc::new(Buckets::new(&own, side, unit_control)?);
            let params = options.params_for(own.len());
            let level = TilesetLevel::new(&own, &buckets, &params, [spacing, CELLS * spacing], unit_control)?;
            control.memory.grow((SPHERE_BYTES + 4) * level.spheres.len() as u64)?;
            let first = atoms.len();
            for (number, sphere) in (0..level.spheres.len()).zip(0_u32..) {
                let centre = level.spheres.centre(number);
                x.push(centre[0]);
                y.push(centre[1]);
                z.push(centre[2]);
                radii.push(level.spheres.radius(number));
                atoms.push(self.selected.atoms[rows[level.row(sphere) as usize] as usize]);
            }
            units.push(Unit { rows: first..atoms.len(), ..unit.clone() });
        }
        let Selected { n_distinct, model, ref left_out, .. } = self.selected;
        let left_out = left_out.clone();
        let selected = Selected { atoms, marks: None, copies: Vec::new(), units, n_distinct, model, left_out };
        Ok((selected, Spheres::new(x, y, z, radii)?))
    }
}

/// Returns the rows of a unit. The reader limits the number of atoms, so they have 32 bits.
fn rows_of(unit: &Unit) -> Vec<u32> {
    unit.rows.clone().map(|row| u32::try_from(row).unwrap_or(u32::MAX)).collect()
}
