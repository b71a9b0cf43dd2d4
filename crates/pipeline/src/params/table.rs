//! Table of parameters: names, domains and descriptions.

use std::str::FromStr;

use molmesh_formats::{Compress, Format, Normals, Units};
use molmesh_picture::{Background, MAX_SIDE, Style, View};
use molmesh_structure::{Context, Split};
use molmesh_surface::params::{MAX_PROBE, MAX_RESOLUTION, MIN_RESOLUTION};
use molmesh_surface::{POCKET_PROBES, Preset, SurfaceKind, TriangleQuality, Validation};

use super::{Domain, ParamError};
use crate::color::{ColorBlend, Palette};
use crate::spacing::{MAX_TRIANGLE_LIMIT, MIN_TRIANGLE_LIMIT};
use crate::{Cavities, SIMPLIFY_ERRORS, areas, color};

/// One parameter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Parameter {
    /// Name in queries and, with hyphens for underscores, on the command line.
    pub name: &'static str,
    /// Domain.
    pub domain: Domain,
    /// Default value, or a description of it.
    pub default: &'static str,
    /// Description, one sentence.
    pub doc: &'static str,
}

impl Parameter {
    /// Returns the description with the range or the form of the values, and the default.
    #[must_use]
    pub fn describe(&self) -> String {
        let values = match self.domain {
            Domain::Number { min, max, unit } => format!(" Range: {}.", format!("{min} to {max} {unit}").trim_end()),
            Domain::Integer { min, max } => format!(" Range: {min} to {max}."),
            Domain::Text { expected } => format!(" Value: {expected}."),
            Domain::Choice(_) | Domain::Flag => String::new(),
        };
        let default = Some(self.default).filter(|default| *default != "absent");
        format!("{}{values}{}", self.doc, default.map_or(String::new(), |default| format!(" Default: {default}.")))
    }

    /// Returns the error for a value that is not valid.
    pub(super) fn invalid(&self, value: &str) -> ParamError {
        ParamError::bad_value(self.name, value, self.domain.expected())
    }

    /// Returns true if `text` equals the declared default. Defaults in words, such as `the first model of the file`,
    /// are not values and equal nothing.
    #[must_use]
    pub fn is_default(&self, text: &str) -> bool {
        match self.domain {
            Domain::Number { .. } => same_number::<f64>(text, self.default),
            Domain::Integer { .. } => same_number::<i64>(text, self.default),
            Domain::Flag => flag(text).is_some_and(|value| flag(self.default) == Some(value)),
            Domain::Choice(words) => text == self.default && words.contains(&text),
            Domain::Text { .. } => false,
        }
    }
}

fn same_number<T: FromStr + PartialEq>(text: &str, default: &str) -> bool {
    text.trim().parse::<T>().is_ok_and(|value| default.parse().is_ok_and(|default: T| value == default))
}

/// Domain of a flag.
pub(super) fn flag(text: &str) -> Option<bool> {
    match text {
        "true" | "True" | "1" => Some(true), // Python writes `True`.
        "false" | "False" | "0" => Some(false),
        _ => None,
    }
}

/// Returns a flag that is off by default.
const fn switch(name: &'static str, doc: &'static str) -> Parameter {
    Parameter { name, domain: Domain::Flag, default: "false", doc }
}

const fn number(
    name: &'static str,
    [min, max]: [f64; 2],
    unit: &'static str,
    default: &'static str,
    doc: &'static str,
) -> Parameter {
    Parameter { name, domain: Domain::Number { min, max, unit }, default, doc }
}

/// Returns the usual range of a number, for sliders; by default its bounds.
#[must_use]
pub fn usual_range(parameter: &Parameter) -> Option<[f64; 2]> {
    let Domain::Number { min, max, .. } = parameter.domain else { return None };
    Some(match parameter.name {
        "resolution" => [0.2, 2.0],
        "isovalue" => [0.2, 4.0],
        "smoothness" => [0.4, 10.0],
        "probe" => [1.0, 2.0],
        "pocket_probe" => [3.0, 8.0],
        "radius_scale" => [0.5, 2.0],
        "radius_offset" => [-1.0, 3.0],
        "cutoff_tolerance" => [1e-4, 0.1],
        _ => [min, max],
    })
}

/// All parameters in documentation order. A test checks that the bounds equal those of
/// [`molmesh_surface::SurfaceParams::new`].
pub const TABLE: &[Parameter] = &[
    Parameter {
        name: "preset",
        domain: Domain::Choice(Preset::NAMES),
        default: "default",
        doc: "A named pair of smoothness and isovalue for the gaussian kernel. ses-like approximates the solvent-excluded surface without a probe: area within −6.2 to +11.9 % and volume within −0.3 to +6.8 % on 18 proteins, worse for small structures (volume +9 to +15 % for three short DNA helices).",
    },
    Parameter {
        name: "surface",
        domain: Domain::Choice(SurfaceKind::NAMES),
        default: "gaussian",
        doc: "Surface to triangulate. gaussian, soft-object and inverse-square: isosurface of atomic densities with this kernel. vdw: van der Waals surface; sas: solvent-accessible surface; ses: solvent-excluded surface.",
    },
    number("probe", [0.0, MAX_PROBE], "Å", "1.4", "Radius of the probe (a solvent molecule); sas and ses only."),
    number(
        "resolution",
        [MIN_RESOLUTION, MAX_RESOLUTION],
        "Å",
        "0.5",
        "Grid spacing. At most one of resolution, detail and max_triangles can be set; with simplify, max_triangles as well.",
    ),
    Parameter {
        name: "detail",
        domain: Domain::Integer { min: 0, max: 6 },
        default: "absent",
        doc: "Grid spacing by level: 2, 1.4, 1, 0.7, 0.5, 0.35 or 0.25 Å for up to 10,000 atoms; for more atoms multiplied by the cube root of atoms/10,000, at most 4 Å. Replaces resolution.",
    },
    Parameter {
        name: "max_triangles",
        domain: Domain::Integer { min: MIN_TRIANGLE_LIMIT as i64, max: MAX_TRIANGLE_LIMIT as i64 },
        default: "absent",
        doc: "Maximum number of triangles: selects the finest grid spacing from 0.25 to 4 Å that does not exceed it, and replaces resolution. With simplify, the mesh at resolution or detail is simplified to this number.",
    },
    number(
        "isovalue",
        [1e-3, 1e6],
        "",
        "1, or the preset's",
        "Density at the surface. At 1 the surface of an isolated atom lies at its radius.",
    ),
    number(
        "smoothness",
        [0.1, 40.0],
        "",
        "1.25, or the preset's",
        "Decay of the gaussian kernel: small values give a smooth surface, large values follow the atoms closely.",
    ),
    number("radius_scale", [0.1, 10.0], "", "1", "Factor applied to the van der Waals radii, before radius_offset."),
    number("radius_offset", [-5.0, 10.0], "Å", "0", "Length added to the radii, after radius_scale."),
    number(
        "cutoff_tolerance",
        [1e-6, 0.2],
        "",
        "0.01",
        "Cut-off of the gaussian kernel, as a fraction of its value at the radius.",
    ),
    number(
        "paper_a",
        [1e-3, 1e6],
        "",
        "absent",
        "Constant a of Dias, Bora and Gomes 2010 for all atoms, instead of radii. gaussian: decay in Å⁻², at most 100; soft-object: height, at least 0.01.",
    ),
    number(
        "paper_b",
        [1e-2, 1e6],
        "",
        "absent",
        "Constant b of Dias, Bora and Gomes 2010. gaussian: height; soft-object and inverse-square: radius of support in Å, 0.1 to 50.",
    ),
    number("paper_c", [1e-6, 1.0], "Å²", "absent", "Constant C of Dias, Bora and Gomes 2010; inverse-square only."),
    switch("atom_ids", "Stores the index of the nearest atom with every vertex: `_ATOM` in glTF, `atom` in PLY."),
    switch("exact", "Adds exact areas and volume to the report, in total and by chain; surface=vdw, sas and ses only."),
    Parameter {
        name: "interface",
        domain: Domain::Text { expected: areas::EXPECTED },
        default: "absent",
        doc: "Adds to the report the exact surface area buried between two sets of chains, half the sum over both sides; needs exact=true.",
    },
    Parameter {
        name: "color",
        domain: Domain::Text { expected: color::EXPECTED },
        default: "none",
        doc: "Colours every vertex by its nearest atom: element (Jmol), chain, entity, residue name, secondary structure in the file (Jmol), B-factor, occupancy, pLDDT (classes of the AlphaFold database), hydrophobicity of the residue (Kyte–Doolittle or Wimley–White) or its formal charge at pH 7; or by the mean curvature of the surface, the distance from the centroid of the atoms (radial), the distance from the convex hull of the mesh (depth), the pocket that the vertex lines (pocket), or the values of a map sent beside the structure (map). STL has no colours.",
    },
    Parameter {
        name: "palette",
        domain: Domain::Choice(Palette::NAMES),
        default: "viridis for bfactor, occupancy, radial and depth, blue-white-red for hydrophobicity and curvature, red-white-blue for charge and map",
        doc: "Colours from the lowest to the highest value; for color=bfactor, occupancy, hydrophobicity, charge, curvature, radial, depth and map only.",
    },
    Parameter {
        name: "color_range",
        domain: Domain::Text { expected: "two numbers separated by a comma, the lower one first" },
        default: "the lowest and highest value of the meshed atoms, or of the mesh for radial and depth; symmetric around 0 for map, with the largest absolute value at the mesh; −4.5,4.5 or −2.02,2.02 for hydrophobicity, −1,1 for charge, −0.5,0.5 for curvature",
        doc: "Values at the ends of the palette. Values beyond an end have its colour.",
    },
    Parameter {
        name: "color_blend",
        domain: Domain::Choice(ColorBlend::NAMES),
        default: "nearest",
        doc: "Transition between colours: nearest has sharp borders, smooth averages colours along the surface over about 1 Å.",
    },
    number(
        "color_offset",
        [-10.0, 10.0],
        "Å",
        "1.4",
        "Distance from the surface, outward along its normals, at which the map is sampled; color=map only.",
    ),
    Parameter {
        name: "model",
        domain: Domain::Text { expected: "the number of a model of the file, or all" },
        default: "the first model of the file",
        doc: "Number of the model to mesh. all meshes every model and makes each one a part that is closed on its own; it needs split=none and assembly=asymmetric-unit.",
    },
    Parameter {
        name: "chains",
        domain: Domain::Text { expected: "chain names separated by commas" },
        default: "all",
        doc: "Chains to mesh, by the names given by the author, separated by commas.",
    },
    Parameter {
        name: "select",
        domain: Domain::Text {
            expected: "an expression such as polymer,ligand or (protein and chain A) within 5 of ion",
        },
        default: "polymer",
        doc: "Atoms to mesh: kinds (polymer, protein, nucleic, ligand, cofactor, glycan, ion, water, hydrogen, all), chain, resi, resn, name, elem, within, byres, and, or, not. Commas separate alternatives. The alternative hydrogens adds the hydrogen atoms of the others.",
    },
    Parameter {
        name: "altloc",
        domain: Domain::Text { expected: "one character" },
        default: "the location with the highest occupancy in each residue",
        doc: "Alternative location to mesh, one character.",
    },
    Parameter {
        name: "assembly",
        domain: Domain::Text { expected: "asymmetric-unit, or the id of an assembly of the file, such as 1" },
        default: "asymmetric-unit",
        doc: "Biological assembly to mesh: the selected atoms, copied by the operators of the file. asymmetric-unit meshes the atoms as they are in the file.",
    },
    switch(
        "instances",
        "Meshes each distinct set of chains of the assembly once and repeats the mesh by rotations and translations (EXT_mesh_gpu_instancing); glb and gltf only. Surfaces of neighbouring instances are not joined.",
    ),
    Parameter {
        name: "unit",
        domain: Domain::Integer { min: 1, max: 1_000_000 },
        default: "absent",
        doc: "Number of a unit of the assembly in the parts of a report with instances=true, from 1; only units with selected atoms count. Meshes this unit alone, where it is in the file.",
    },
    Parameter {
        name: "context",
        domain: Domain::Choice(Context::NAMES),
        default: "selection",
        doc: "Atoms whose surface is made. selection: the selected atoms alone. whole: the polymer of all chains and the selected atoms; the mesh is then cut, and only the triangles that are nearest to selected atoms remain. It is open along the cut.",
    },
    Parameter {
        name: "split",
        domain: Domain::Choice(Split::NAMES),
        default: "none",
        doc: "Divides the mesh into parts that are closed on their own: chain (per copy in an assembly), entity, or residue-group (polymer, ligand, glycan, ion, water). With context=whole, divides the triangles of one surface by their nearest atoms. pocket divides the triangles of one surface by the pockets that they line.",
    },
    Parameter {
        name: "cavities",
        domain: Domain::Choice(Cavities::NAMES),
        default: "absent",
        doc: "Searches for cavities, closed regions between the atoms that hold a probe, and lists them in the report. keep leaves the mesh as it is, drop removes its inner components around a cavity, only keeps nothing else.",
    },
    switch(
        "pockets",
        "Searches for pockets, regions outside the molecule that the probe can enter and a large probe cannot, and lists them in the report. color=pocket and split=pocket imply it.",
    ),
    number(
        "pocket_probe",
        POCKET_PROBES,
        "Å",
        "4",
        "Radius of the large probe of the search for pockets, larger than that of the probe; with pockets=true, color=pocket or split=pocket only.",
    ),
    number(
        "simplify",
        SIMPLIFY_ERRORS,
        "Å",
        "absent",
        "Error of a simplification of the mesh: fewer and larger triangles, whose vertices are vertices of the original mesh. A closed manifold mesh remains one. With max_triangles, ends at that number. The report states the measured deviation, which can be somewhat larger than the error.",
    ),
    Parameter {
        name: "tile",
        domain: Domain::Text { expected: "the address of a tile, level/x/y/z" },
        default: "absent",
        doc: "Tile of the structure's tileset to mesh, instead of the whole structure. Skirts at its border hide gaps between levels.",
    },
    Parameter {
        name: "quality",
        domain: Domain::Choice(TriangleQuality::NAMES),
        default: "standard",
        doc: "Quality of the triangles: high improves those of marching cubes, so that few have small angles; this takes 10 to 50 times as long as meshing. Not with simplify.",
    },
    Parameter {
        name: "validation",
        domain: Domain::Choice(Validation::NAMES),
        default: "checksum",
        doc: "Method that checks whether the mesh is watertight: a checksum of its edges, or exact matching of every edge and the triangles around every vertex.",
    },
    Parameter {
        name: "check",
        domain: Domain::Choice(&["strict"]),
        default: "absent",
        doc: "Rejects a file in which the strict validator finds errors, and reports its other findings.",
    },
    Parameter {
        name: "format",
        domain: Domain::Choice(Format::NAMES),
        default: "glb",
        doc: "Output format: a mesh format, or png for a picture of the mesh. vert and face are the two files that MSMS writes for one mesh.",
    },
    Parameter {
        name: "compress",
        domain: Domain::Choice(Compress::NAMES),
        default: "none",
        doc: "Storage of glb and gltf: quantize uses 12 bytes per vertex instead of 24 (16-bit positions, 8-bit normals; KHR_mesh_quantization). meshopt, for glb only, also compresses vertices and indices; the file has about a fifth of the size (EXT_meshopt_compression).",
    },
    Parameter {
        name: "normals",
        domain: Domain::Choice(Normals::NAMES),
        default: "smooth",
        doc: "Vertex normals. none omits them, and viewers shade each triangle flat; STL always has triangle normals, and vert vertex normals.",
    },
    Parameter {
        name: "units",
        domain: Domain::Choice(Units::NAMES),
        default: "angstrom",
        doc: "Unit of the coordinates in the file. glb and gltf scale their node, other formats their numbers (angstrom or nanometer only; vert and face angstrom only). Reports are always in Å.",
    },
    Parameter {
        name: "width",
        domain: Domain::Integer { min: 1, max: MAX_SIDE as i64 },
        default: "512",
        doc: "Width of the picture in pixels; png only.",
    },
    Parameter {
        name: "height",
        domain: Domain::Integer { min: 1, max: MAX_SIDE as i64 },
        default: "512",
        doc: "Height of the picture in pixels; png only.",
    },
    Parameter {
        name: "view",
        domain: Domain::Choice(View::NAMES),
        default: "principal",
        doc: "Viewing direction of the picture; png only. principal looks along the shortest principal axis with the longest one horizontal; the others look along the axes of the file, front from +z with y up.",
    },
    number(
        "azimuth",
        [-360.0, 360.0],
        "°",
        "0",
        "Rotation of the camera to the right about the vertical axis of the picture; png only.",
    ),
    number(
        "elevation",
        [-90.0, 90.0],
        "°",
        "0",
        "Elevation of the camera above the picture's horizontal plane, after azimuth; png only.",
    ),
    Parameter {
        name: "background",
        domain: Domain::Text { expected: Background::EXPECTED },
        default: "transparent",
        doc: "Background of the picture; png only.",
    },
    Parameter {
        name: "style",
        domain: Domain::Choice(Style::NAMES),
        default: "surface",
        doc: "Shading of the picture; png only. gouraud interpolates the light of the vertices; surface adds ambient occlusion and an outline.",
    },
];
