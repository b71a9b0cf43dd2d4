//! Flags of the parameters of a request. Each is declared once; the declaration gives the argument of clap, and the
//! name and value for the parser. The help is the text of the table of parameters, or the flag's own.

use clap::{Arg, ArgAction, ArgMatches, Command, Error, FromArgMatches};

use FlagValue::{Fixed, Given};
use molmesh::pipeline::params::{Domain, TABLE};

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
    /// Help if it is not the text of the table.
    own_help: &'static str,
}

impl ParameterFlag {
    fn argument(&self, heading: Option<&'static str>) -> Arg {
        let argument = Arg::new(self.name).long(self.name).help_heading(heading);
        let parameter = TABLE.iter().find(|parameter| parameter.name == self.parameter());
        let argument = match (parameter.filter(|_| self.own_help.is_empty()), &self.value) {
            (None, _) => argument.help(self.own_help.trim_start()),
            (Some(parameter), Fixed(_)) => argument.help(with_flags(parameter.doc.trim_end_matches('.'))),
            (Some(parameter), Given(_)) => {
                let first = parameter.doc.split_once(". ").map_or(parameter.doc, |(first, _)| first);
                let choices = match parameter.domain {
                    Domain::Choice(names) => format!(" Values: {}.", names.join(", ")),
                    _ => String::new(),
                };
                let long = with_flags(&parameter.describe()) + &choices;
                argument.help(with_flags(first.trim_end_matches('.'))).long_help(long)
            }
        };
        match self.value {
            // A range may begin with a minus sign, and is not a negative number.
            Given(name) => argument.value_name(name).allow_hyphen_values(name == "MIN,MAX"),
            Fixed(_) => argument.action(ArgAction::SetTrue),
        }
    }

    /// Returns the name of the parameter.
    fn parameter(&self) -> String {
        self.name.replace('-', "_")
    }

    /// Returns the name and the value of the parameter, if the flag is given.
    fn pair(&self, matches: &ArgMatches) -> Option<(String, String)> {
        let value = match self.value {
            Given(_) => matches.get_one::<String>(self.name)?.clone(),
            Fixed(value) => matches.get_flag(self.name).then(|| value.to_owned())?,
        };
        Some((self.parameter(), value))
    }
}

/// Writes the parameters that a text names as flags: `exact=true` as `--exact`, `max_triangles` as `max-triangles`.
fn with_flags(text: &str) -> String {
    // Each start of the program builds the help, so words that cannot change are not looked up.
    let may_change = |word: &str| memchr::memchr2(b'=', b'_', word.as_bytes()).is_some();
    if !may_change(text) {
        return text.to_owned();
    }
    let word = |word: &str| {
        if !may_change(word) {
            return word.to_owned();
        }
        let stem = word.trim_end_matches(['.', ',', ';', ':']);
        let (name, value) = stem.split_once('=').map_or((stem, None), |(name, value)| (name, Some(value)));
        if TABLE.iter().all(|parameter| parameter.name != name) {
            return word.to_owned();
        }
        let name = name.replace('_', "-");
        let flag = match value {
            None => name,
            Some("true") => format!("--{name}"),
            Some(value) => format!("--{name} {value}"),
        };
        flag + &word[stem.len()..]
    };
    text.split(' ').map(word).collect::<Vec<_>>().join(" ")
}

/// Declares groups of flags: the heading in the help, and for each flag its name, its value and, if it is not that of
/// the table, its help. A group contains the names and values of the parameters that are given, as in a query.
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
                &[$(ParameterFlag { name: $name, value: $value, own_help: concat!($($help),*) }),*];
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
        "tile": Given("LEVEL/X/Y/Z"),
        "compress": Given("METHOD"),
        "normals": Given("NORMALS"),
        "units": Given("UNIT"),
    }

    /// Checks of the structure and the mesh.
    CheckArgs {
        "check": Fixed("strict"),
        "validation": Given("METHOD"),
    }

    /// Surface.
    SurfaceArgs("Surface") {
        "surface": Given("SURFACE"),
        "probe": Given("Å"),
        "preset": Given("PRESET"),
        "resolution": Given("Å"),
        "detail": Given("LEVEL"),
        "max-triangles": Given("N"),
        "isovalue": Given("LEVEL"),
        "smoothness": Given("A"),
        "radius-scale": Given("FACTOR"),
        "radius-offset": Given("Å"),
        "cutoff-tolerance": Given("FRACTION"),
        "paper-a": Given("A"),
        "paper-b": Given("B"),
        "paper-c": Given("C"),
        "cavities": Given("MODE"),
        "pockets": Fixed("true"),
        "pocket-probe": Given("Å"),
        "simplify": Given("Å"),
        "quality": Given("NAME"),
        "atom-ids": Fixed("true"),
        "exact": Fixed("true"),
        "interface": Given("A,B"),
    }

    /// Colours.
    ColorArgs("Colours") {
        "color": Given("SCHEME"),
        "palette": Given("PALETTE"),
        "color-range": Given("MIN,MAX"),
        "color-blend": Given("BLEND"),
        "color-offset": Given("Å"),
    }

    /// Chains, by which atoms are selected.
    ChainArgs("Atoms") {
        "chains": Given("A,B"),
        "altloc": Given("X"),
        "assembly": Given("ID"),
    }

    /// Model, instances and parts.
    PartArgs("Atoms") {
        "model": Given("N"),
        "instances": Fixed("true"),
        "unit": Given("NUMBER"),
        "context": Given("CONTEXT"),
        "split": Given("RULE"),
    }

    /// Picture.
    PictureArgs("Picture") {
        "width": Given("PIXELS"),
        "height": Given("PIXELS"),
        "view": Given("VIEW"),
        "azimuth": Given("DEGREES"),
        "elevation": Given("DEGREES"),
        "background": Given("COLOR"),
        "style": Given("STYLE"),
    }

    /// Rows and surface of a table of areas.
    AreaArgs {
        /// Rows of the table: atom, residue or chain [default: residue]
        "by": Given("LEVEL"),
        "probe": Given("Å"),
        "radius-scale": Given("FACTOR"),
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
