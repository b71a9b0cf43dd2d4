//! Steps on the mesh of a job, in their order: cavities, simplification, colours, atom indices, instances, measures.

use molmesh_structure::Selected;
use molmesh_surface::{Control, Measures, Mesh, Pockets, Stage, SurfaceError, Validation};

use super::cavities::{self, FoundCavities};
use super::clock::WorkScope;
use super::color::{ColorReport, MeshColors, MeshedSurface};
use super::meshing::Meshing;
use super::{JobError, JobMesh, Options, SimplificationReport, TriangleReport, instances, simplify};

/// Number of atom indices that are converted between two checks for cancellation.
const IDS_PER_CHECK: usize = 1 << 20;

/// Input of the steps.
pub(super) struct Steps<'a> {
    pub(super) options: &'a Options,
    pub(super) selected: &'a Selected,
    pub(super) pockets: Option<&'a Pockets>,
    pub(super) meshing: &'a Meshing<'a>,
}

/// Results of the steps for the report.
pub(super) struct StepResults {
    pub(super) cavities: Option<FoundCavities>,
    pub(super) simplification: Option<SimplificationReport>,
    pub(super) color: Option<ColorReport>,
    pub(super) measures: Measures,
    pub(super) shapes: Option<TriangleReport>,
}

impl Steps<'_> {
    /// Applies the steps that the job requires to its mesh.
    pub(super) fn apply(
        &self,
        JobMesh { output, params, .. }: &mut JobMesh,
        colors: Option<MeshColors>,
        scope: &WorkScope<'_>,
    ) -> Result<StepResults, JobError> {
        let WorkScope { clock, control } = scope;
        let Self { options, selected, pockets, meshing: Meshing { spheres, parts, cut, limits, .. } } = *self;
        let search = |mode| clock.time("cavities", || cavities::search(mode, spheres, params, limits, output, control));
        let cavities = options.cavities.map(search).transpose()?;
        let simplification = simplify::apply(options, params, output, scope)?;
        let mesh = &mut output.mesh;
        let surface = MeshedSurface { spheres, params, limits, parts: *parts };
        let color = |colors: MeshColors| clock.time("color", || colors.apply(mesh, &surface, pockets, control));
        let color = colors.map(color).transpose()?;
        to_atom_indices(mesh, options, selected, control)?;
        instances::place(mesh, &selected.units, control)?;
        let measures = match output.measures.take() {
            // The cut has validated the surface before it divided it.
            Some(measures) if cut.is_some() || measures.validation == options.validation => measures,
            found => clock.time(Stage::Measure.name(), || measures_of(mesh, found, options.validation, control))?,
        };
        let shapes = TriangleReport::for_job(options, mesh, clock);
        Ok(StepResults { cavities, simplification, color, measures, shapes })
    }
}

/// Measures and validates a mesh, or only validates it if its measures are `found`.
fn measures_of(
    mesh: &mut Mesh,
    found: Option<Measures>,
    validation: Validation,
    control: &Control<'_>,
) -> Result<Measures, SurfaceError> {
    mesh.make_geometry_contiguous();
    match found {
        Some(measures) => measures.validated(validation, &mesh.triangles, control),
        None => Measures::of(mesh, validation, control),
    }
}

/// Converts indices of spheres to indices of atoms in the file, or drops them if the job does not ask for them.
fn to_atom_indices(
    mesh: &mut Mesh,
    options: &Options,
    selected: &Selected,
    control: &Control<'_>,
) -> Result<(), JobError> {
    if !options.params.atom_ids {
        mesh.atom_ids = None;
    }
    for (n, id) in mesh.atom_ids.iter_mut().flat_map(|ids| ids.iter_mut()).enumerate() {
        control.check_every(n, IDS_PER_CHECK)?;
        *id = selected.atoms[*id as usize];
    }
    Ok(())
}
