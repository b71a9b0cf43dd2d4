//! Named values of parameters: surfaces, kernels and presets.

/// The density that one atom contributes, as a function of the distance to its centre.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Kernel {
    /// Blinn 1982: exp(−a(d²/r² − 1)), with a C¹ cut-off.
    #[default]
    Gaussian,
    /// Wyvill, `McPheeters`, Wyvill 1986: a sextic with compact support.
    SoftObject,
    /// C/d², windowed.
    InverseSquare,
}

/// The surface that is triangulated.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum SurfaceKind {
    /// Isosurface of the densities of [`Kernel::Gaussian`].
    #[default]
    Gaussian,
    /// Isosurface of the densities of [`Kernel::SoftObject`].
    SoftObject,
    /// Isosurface of the densities of [`Kernel::InverseSquare`].
    InverseSquare,
    /// Van der Waals surface: boundary of the union of the spheres.
    Vdw,
    /// Solvent-accessible surface: the same with radii enlarged by the probe radius.
    Sas,
    /// Solvent-excluded surface: boundary of the points that no probe sphere outside the spheres can reach.
    Ses,
}

impl SurfaceKind {
    /// Returns the kernel of an isosurface; `None` for a surface of spheres.
    #[must_use]
    pub const fn kernel(self) -> Option<Kernel> {
        match self {
            Self::Gaussian => Some(Kernel::Gaussian),
            Self::SoftObject => Some(Kernel::SoftObject),
            Self::InverseSquare => Some(Kernel::InverseSquare),
            Self::Vdw | Self::Sas | Self::Ses => None,
        }
    }

    /// Returns true if the surface depends on the probe radius.
    #[must_use]
    pub const fn has_probe(self) -> bool {
        matches!(self, Self::Sas | Self::Ses)
    }
}

impl From<Kernel> for SurfaceKind {
    fn from(kernel: Kernel) -> Self {
        match kernel {
            Kernel::Gaussian => Self::Gaussian,
            Kernel::SoftObject => Self::SoftObject,
            Kernel::InverseSquare => Self::InverseSquare,
        }
    }
}

/// A named set of parameters.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Preset {
    /// Smoothness 1.25 at isovalue 1: close to the solvent-excluded surface in volume.
    #[default]
    Default,
    /// Smoothness 0.75 at isovalue 1.9: an approximation of the solvent-excluded surface (1.4 Å probe), without a
    /// probe. On 18 proteins its area was −6.2 to +11.9 % off and its volume −0.3 to +6.8 %. Small structures are
    /// worse: the volume of DNA helices was 9 to 15 % too large.
    SesLike,
    /// Smoothness 5 at isovalue 1.06: close to the union of van der Waals spheres.
    VdwLike,
    /// Smoothness 1.5.
    Molstar,
    /// Smoothness 2.5.
    Blinn,
    /// Smoothness 0.5 at isovalue 0.824: the density that VMD's `QuickSurf` draws by default.
    Quicksurf,
}

/// Implements `ALL`, `NAMES`, `name`, `named` and [`Display`](std::fmt::Display) for an enum of named values:
/// `named!(Type, Variant => "name", …)`. A variant after a semicolon has a name but is in neither list: no parameter
/// accepts it.
#[macro_export]
macro_rules! named {
    ($type:ident, $($variant:ident => $name:literal),+ $(; $implied:ident => $implied_name:literal)?) => {
        impl $type {
            /// Every value that a parameter accepts, in documentation order.
            pub const ALL: [Self; Self::NAMES.len()] = [$(Self::$variant),+];
            /// Names of [`Self::ALL`].
            pub const NAMES: &'static [&'static str] = &[$($name),+];

            /// Returns the name of the value in parameters, reports and files.
            #[must_use]
            pub const fn name(self) -> &'static str {
                match self { $(Self::$variant => $name,)+ $(Self::$implied => $implied_name)? }
            }

            /// Returns the value with this name.
            #[must_use]
            pub fn named(name: &str) -> Option<Self> {
                Self::ALL.into_iter().find(|value| value.name() == name)
            }
        }

        impl std::fmt::Display for $type {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str(self.name())
            }
        }
    };
}

named!(Kernel, Gaussian => "gaussian", SoftObject => "soft-object", InverseSquare => "inverse-square");
named!(SurfaceKind, Gaussian => "gaussian", SoftObject => "soft-object",
    InverseSquare => "inverse-square", Vdw => "vdw", Sas => "sas", Ses => "ses");
named!(Preset, Default => "default", SesLike => "ses-like", VdwLike => "vdw-like", Molstar => "molstar",
    Blinn => "blinn", Quicksurf => "quicksurf");
