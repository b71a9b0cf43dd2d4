//! Conversion of the errors of structures, colour schemes and maps into problems.

use std::time::Duration;

use super::with_key;
use crate::http::problem::Problem;
use crate::http::problem_types::ProblemType;
use crate::jobs::Failure;
use crate::pipeline::color::{self, ColorError};
use crate::structure::map::MapError;
use crate::structure::{Split, StructureError};
use crate::surface::Limit;

impl From<StructureError> for Problem {
    fn from(error: StructureError) -> Self {
        use StructureError as E;
        let detail = error.to_string();
        match error {
            E::Scratch { .. } => Self::internal(detail),
            E::DiskFull => Self::new(ProblemType::StoreFull, detail).retry_after(Duration::from_secs(5)),
            E::DiskSpace(error) => Self::from(error).detailed(with_key(&detail, Limit::ScratchBytes)),
            E::Input { .. } | E::NotAStream { .. } => Self::new(ProblemType::UnreadableStructure, detail),
            E::UnknownFormat { found } => Self::new(ProblemType::UnreadableStructure, detail).with("found", found),
            E::Syntax { line, column, found, expected } => Self::new(ProblemType::UnreadableStructure, detail)
                .with("line", line)
                .with("column", column)
                .with("found", found)
                .with("expected", expected),
            E::Malformed { location, found, expected } => Self::new(ProblemType::UnreadableStructure, detail)
                .with("location", location)
                .with("found", found)
                .with("expected", expected),
            E::Decompress { encoding, .. } => {
                Self::new(ProblemType::UnreadableStructure, detail).with("encoding", encoding)
            }
            E::Limit(error) => Self::from(&*error),
            E::BadAssembly { id, found, expected } => Self::new(ProblemType::UnreadableStructure, detail)
                .with("location", format!("assembly {id}"))
                .with("found", found)
                .with("expected", expected),
            E::NoEntities => Self::new(ProblemType::BadParameter, detail)
                .with("parameter", "split")
                .with("value", Split::Entity.name())
                .with("expected", "none, chain or residue-group"),
            E::Memory(error) => error.into(),
            E::Cancelled => Self::from(Failure::Stopped),
            E::NoAtoms { found } => Self::new(ProblemType::NoAtoms, detail).with("found", found),
            E::EmptySelection { holds } => Self::new(ProblemType::EmptySelection, detail).with("found", holds),
            E::NotFound { what, requested, available } => {
                let parameter = match what {
                    "chain" => "chains",
                    "selected chain" => "select",
                    "interface chain" => "interface",
                    "alternative location" => "altloc",
                    other => other,
                };
                Self::new(ProblemType::EmptySelection, detail)
                    .with("parameter", parameter)
                    .with("value", requested.trim_matches('`'))
                    .with("expected", available)
            }
        }
    }
}

impl From<ColorError> for Problem {
    fn from(error: ColorError) -> Self {
        Self::new(ProblemType::BadParameter, error.to_string())
            .with("parameter", "color")
            .with("value", error.scheme)
            .with("expected", color::EXPECTED)
    }
}

impl From<MapError> for Problem {
    fn from(error: MapError) -> Self {
        use MapError as E;
        let problem = |problem_type| Self::new(problem_type, error.to_string()).with("parameter", "map");
        match &error {
            E::UnknownFormat { found } => problem(ProblemType::UnreadableMap).with("found", found.as_str()),
            E::Malformed { location, found, expected } => problem(ProblemType::UnreadableMap)
                .with("location", location.as_str())
                .with("found", found.as_str())
                .with("expected", expected.as_str()),
            E::Decompress { encoding, .. } => problem(ProblemType::UnreadableMap).with("encoding", *encoding),
            E::Limit(error) => Self::from(&**error),
            E::Memory(error) => (*error).into(),
            E::Cancelled => Self::from(Failure::Stopped),
        }
    }
}
