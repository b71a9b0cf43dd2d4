//! Flags of the parameters of a request. Each is declared once; the declaration gives the argument of clap, and the
//! name and value for the parser.

use clap::{Arg, ArgAction, ArgMatches, Command, Error, FromArgMatches};

use FlagValue::{Fixed, Given};

/// Value of a flag.
enum FlagValue {
    /// Text that the user gives, with its name in the help.
    Given(&'static str),
    /// Text that the flag stands for.
    Fixed(&'static str),
}

/// Flag of a parameter, which has the same name with underscores.
struct ParameterFlag {
    name: &'static str,
    value: FlagValue,
    help: &'static str,
}

impl ParameterFlag {
    fn argument(&self, heading: Option<&'static str>) -> Arg {
        let argument = Arg::new(self.name).long(self.name).help(self.help.trim_start()).help_heading(heading);
        match self.value {
            // A range may begin with a minus sign, and is not a negative number.
            Given(name) => argument.value_name(name).allow_hyphen_values(name == "MIN,MAX"),
            Fixed(_) => argument.action(ArgAction::SetTrue),
        }
    }

    /// Returns the name and the value of the parameter, if the flag is given.
    fn pair(&self, matches: &ArgMatches) -> Option<(String, String)> {
        let value = match self.value {
            Given(_) => matches.get_one::<String>(self.name)?.clone(),
            Fixed(value) => matches.get_flag(self.name).then(|| value.to_owned())?,
        };
        Some((self.name.replace('-', "_"), value))
    }
}

/// Declares groups of flags: the heading in the help, and for each flag its help, its name and its value. A group
/// contains the names and values of the parameters that are given, as in a query.
macro_rules! parameter_flags {
    ($(
        $(#[doc = $about:literal])*
        $group:ident $(($heading:literal))? {
            $($(#[doc = $help:literal])* $name:literal: $value:expr,)*
        }
    )*) => {$(
        $(#[doc = $about])*
        #[derive(Debug)]
        pub(crate) struct $group(pub(crate) Vec<(String, String)>);

        impl $group {
            const FLAGS: &[ParameterFlag] =
                &[$(ParameterFlag { name: $name, value: $value, help: concat!($($help),*) }),*];
        }

        impl FromArgMatches for $group {
            fn from_arg_matches(matches: &ArgMatches) -> Result<Self, Error> {
                Ok(Self(Self::FLAGS.iter().filter_map(|flag| flag.pair(matches)).collect()))
            }

            fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), Error> {
                *self = Self::from_arg_matches(matches)?;
                Ok(())
            }
        }

        impl clap::Args for $group {
            fn augment_args(command: Command) -> Command {
                let heading: &[&'static str] = &[$($heading)?];
                command.args(Self::FLAGS.iter().map(|flag| flag.argument(heading.first().copied())))
            }

            fn augment_args_for_update(command: Command) -> Command {
                Self::augment_args(command)
            }
        }
    )*};
}

parameter_flags! {
    /// Content of a mesh file.
    FileArgs {
        /// Tile of the tileset of the structure to mesh, instead of the whole structure
        "tile": Given("LEVEL/X/Y/Z"),
        /// Storage of glb and gltf: none, quantize (12 bytes per vertex instead of 24: 16-bit positions, 8-bit
        /// normals), or meshopt (glb only: quantized and compressed to about a fifth) [default: none]
        "compress": Given("METHOD"),
        /// Vertex normals: smooth, or none (smaller files, flat shading) [default: smooth]
        "normals": Given("NORMALS"),
        /// Unit of lengths in the mesh file: angstrom, nanometer, or meter (glb and gltf only) [default: angstrom]
        "units": Given("UNIT"),
    }

    /// Checks of the structure and the mesh.
    CheckArgs {
        /// Reject a file in which the strict validator finds errors, and report its other findings
        "check": Fixed("strict"),
        /// Check that the mesh is watertight: checksum (of its edges, fast) or exact (edge by edge) [default: checksum]
        "validation": Given("METHOD"),
    }

    /// Surface.
    SurfaceArgs("Surface") {
        /// Surface: gaussian, soft-object or inverse-square (isosurfaces of densities), vdw (van der Waals), sas
        /// (solvent-accessible) or ses (solvent-excluded) [default: gaussian]
        "surface": Given("SURFACE"),
        /// Radius of the probe in Å, for `--surface sas` and `ses` [default: 1.4]
        "probe": Given("Å"),
        /// Values of parameters that are not given: default, ses-like, vdw-like, molstar, blinn or quicksurf.
        /// `ses-like` approximates the solvent-excluded surface: its area is off by -6.2 to +11.9 % and its volume by
        /// -0.3 to +6.8 % on 18 proteins, more for small structures (volume +9 to +15 % for three short DNA helices)
        "preset": Given("PRESET"),
        /// Grid spacing in Å [default: 0.5]
        "resolution": Given("Å"),
        /// Level of detail instead of a grid spacing: 0 (2 Å) to 6 (0.25 Å), coarser for more than 10,000 atoms
        "detail": Given("LEVEL"),
        /// Use the finest grid spacing, down to 0.25 Å, whose mesh has at most N triangles
        "max-triangles": Given("N"),
        /// Density at the surface [default: 1, the density of an isolated atom at its radius]
        "isovalue": Given("LEVEL"),
        /// Steepness of the gaussian; a higher value gives a less smooth surface [default: 1.25]
        "smoothness": Given("A"),
        /// Factor of all radii [default: 1]
        "radius-scale": Given("FACTOR"),
        /// Length added to all scaled radii, in Å [default: 0]
        "radius-offset": Given("Å"),
        /// Value at which the gaussian is cut off, relative to its value at the radius [default: 0.01]
        "cutoff-tolerance": Given("FRACTION"),
        /// Raw parameter a of the 2010 paper (gaussian: decay in Å⁻²; soft object: height)
        "paper-a": Given("A"),
        /// Raw parameter b of the 2010 paper (gaussian: height; otherwise a radius in Å)
        "paper-b": Given("B"),
        /// Raw parameter c of the 2010 paper (inverse square: strength in Å²)
        "paper-c": Given("C"),
        /// Find cavities, closed regions that hold a probe: keep (list them in the report), drop (also remove their
        /// walls from the mesh) or only (keep nothing else)
        "cavities": Given("MODE"),
        /// Find pockets, regions outside the molecule that the probe can enter and a large probe cannot, and list them
        /// in the report
        "pockets": Fixed("true"),
        /// Radius of the large probe of the search for pockets, in Å [default: 4]
        "pocket-probe": Given("Å"),
        /// Simplify the mesh: fewer, larger triangles, with this error in Å
        "simplify": Given("Å"),
        /// Quality of the triangles: standard, or high (few small angles; takes 10 to 50 times as long as meshing)
        "quality": Given("NAME"),
        /// Store the nearest atom of every vertex (`_ATOM` in glTF, `atom` in PLY)
        "atom-ids": Fixed("true"),
        /// Add exact areas and volume to the report, in total and by chain; `--surface vdw`, `sas` and `ses` only
        "exact": Fixed("true"),
        /// Add the surface area buried between two sets of chains, half the sum over both sides, with `--exact`; a
        /// slash joins chains of a side: H/L,A
        "interface": Given("A,B"),
    }

    /// Colours.
    ColorArgs("Colours") {
        /// Colours of vertices: uniform:#RRGGBB, element, chain, entity, residue, secondary-structure, bfactor,
        /// occupancy, plddt, hydrophobicity (Kyte-Doolittle), hydrophobicity:wimley-white, charge, curvature, radial,
        /// depth, pocket, map or none [default: none]
        "color": Given("SCHEME"),
        /// Palette of a numeric scheme: viridis, cividis, blue-white-red or red-white-blue [default: depends on the
        /// scheme]
        "palette": Given("PALETTE"),
        /// Values at the ends of the palette [default: depends on the scheme]
        "color-range": Given("MIN,MAX"),
        /// Transition between colours: nearest (sharp borders) or smooth (averaged over about 1 Å) [default: nearest]
        "color-blend": Given("BLEND"),
        /// Distance from the surface at which the map is sampled, in Å [default: 1.4]
        "color-offset": Given("Å"),
    }

    /// Chains, by which atoms are selected.
    ChainArgs("Atoms") {
        /// Comma-separated chains, by author name [default: all]
        "chains": Given("A,B"),
        /// Alternative location [default: the one with the highest occupancy in each residue]
        "altloc": Given("X"),
        /// Id of the biological assembly to build [default: asymmetric-unit, the atoms as they are in the file]
        "assembly": Given("ID"),
    }

    /// Model, instances and parts.
    PartArgs("Atoms") {
        /// Model number, or all: one part of the mesh per model [default: the first]
        "model": Given("N"),
        /// Mesh each distinct set of chains of the assembly once and repeat the mesh (glb and gltf only); surfaces of
        /// neighbouring instances are not joined
        "instances": Fixed("true"),
        /// Mesh one unit of the assembly, where it is in the file; NUMBER counts the parts of a report with --instances
        "unit": Given("NUMBER"),
        /// Atoms whose surface is made: selection (the selected atoms alone), or whole (all polymer chains and the
        /// selected atoms; only the triangles nearest to selected atoms are kept, and the mesh is open) [default:
        /// selection]
        "context": Given("CONTEXT"),
        /// Divide the mesh into parts: chain (per copy in an assembly), entity, residue-group (polymer, ligand, glycan,
        /// ion, water), pocket or none [default: none]
        "split": Given("RULE"),
    }

    /// Picture.
    PictureArgs("Picture") {
        /// Width in pixels [default: 512]
        "width": Given("PIXELS"),
        /// Height in pixels [default: 512]
        "height": Given("PIXELS"),
        /// View: principal (the longest axis is horizontal, the shortest points at the viewer), or front, back, left,
        /// right, top, bottom along the axes of the file [default: principal]
        "view": Given("VIEW"),
        /// Rotation of the viewer to the right, in degrees [default: 0]
        "azimuth": Given("DEGREES"),
        /// Rotation of the viewer upwards after that, in degrees [default: 0]
        "elevation": Given("DEGREES"),
        /// Background: transparent, white, black, RRGGBB or RRGGBBAA [default: transparent]
        "background": Given("COLOR"),
        /// Shading: surface (with ambient occlusion and a soft outline), or gouraud [default: surface]
        "style": Given("STYLE"),
    }

    /// Rows and surface of a table of areas.
    AreaArgs {
        /// Rows of the table: atom, residue or chain [default: residue]
        "by": Given("LEVEL"),
        /// Radius of the probe in Å, for `--surface sas` and `ses` [default: 1.4]
        "probe": Given("Å"),
        /// Factor of all radii [default: 1]
        "radius-scale": Given("FACTOR"),
        /// Length added to all scaled radii, in Å [default: 0]
        "radius-offset": Given("Å"),
        /// Surface area buried between two sets of chains, half the sum over both sides; a slash joins chains of a
        /// side: H/L,A
        "interface": Given("A,B"),
    }

    /// Model of a table of areas.
    AreaModelArgs("Atoms") {
        /// Model number [default: the first]
        "model": Given("N"),
    }
}
