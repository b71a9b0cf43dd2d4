//! What a `Content-Type` says a structure is, and whether the bytes agree. The bytes decide what is read; a type that
//! contradicts them is refused, as one of the two is not what the client thinks.

use super::kinds::Kind;
use super::problem::Problem;
use crate::jobs::Failure;
use crate::pipeline::JobError;
use crate::structure::StructureError;
use crate::structure::atoms::SourceFormat;

/// What was declared.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Declared {
    /// Nothing that could contradict a structure file: nothing, text, octets, curl's form type.
    Neutral,
    /// A structure format.
    Structure(SourceFormat, String),
    /// A compressed file, with its first bytes.
    Compressed(&'static [u8], String),
    /// Something else altogether.
    Foreign(String),
}

impl Declared {
    /// Reads a media type; parameters such as `charset` are ignored.
    pub(super) fn new(content_type: &str) -> Self {
        let essence = content_type.split(';').next().unwrap_or_default().trim().to_ascii_lowercase();
        let (kind, subtype) = essence.split_once('/').unwrap_or_default();
        match (kind, subtype) {
            ("chemical", "x-pdb" | "pdb") => Self::Structure(SourceFormat::Pdb, essence),
            ("chemical", "x-mmcif" | "mmcif" | "x-cif" | "cif") => Self::Structure(SourceFormat::Mmcif, essence),
            // BinaryCIF has no registered type; that of its container is.
            ("chemical", "x-bcif" | "bcif" | "x-binarycif")
            | ("application", "vnd.binarycif" | "x-bcif" | "vnd.msgpack" | "msgpack" | "x-msgpack") => {
                Self::Structure(SourceFormat::BinaryCif, essence)
            }
            ("application", "gzip" | "x-gzip") => Self::Compressed(&[0x1f, 0x8b], essence),
            ("application", "zstd") => Self::Compressed(&[0x28, 0xb5, 0x2f, 0xfd], essence),
            ("image" | "audio" | "video" | "font" | "model", _)
            | ("application", "json" | "pdf" | "xml" | "zip")
            | ("text", "html" | "xml" | "css" | "javascript") => Self::Foreign(essence),
            _ => Self::Neutral,
        }
    }

    /// Whether it names a structure format, which the bytes must then have.
    pub(super) const fn is_structure(&self) -> bool {
        matches!(self, Self::Structure(..))
    }

    /// Checks what the first bytes can tell.
    pub(super) fn check_bytes(&self, bytes: &[u8]) -> Result<(), Problem> {
        match self {
            Self::Compressed(magic, essence) if !bytes.starts_with(magic) => {
                Err(contradiction(essence, "no such compressed data"))
            }
            _ => Ok(()),
        }
    }

    /// Checks the format that was read.
    pub(super) fn check_format(&self, found: &str) -> Result<(), Problem> {
        match self {
            Self::Structure(format, essence) if format.name() != found => Err(contradiction(essence, found)),
            _ => Ok(()),
        }
    }

    /// The problem of a job that failed: bytes that are no structure are what a foreign type said all along.
    pub(super) fn explain(&self, failure: Failure) -> Problem {
        match (self, failure) {
            (
                Self::Foreign(essence) | Self::Structure(_, essence),
                Failure::Job { error: JobError::Structure(StructureError::UnknownFormat { found }), .. },
            ) => contradiction(essence, &found),
            (_, failure) => failure.into(),
        }
    }
}

fn contradiction(declared: &str, found: &str) -> Problem {
    Problem::new(
        Kind::UnsupportedMediaType,
        format!("the body is declared as {declared}, but its bytes are {found}; leave the type out, or say what it is"),
    )
    .with("declared", declared)
    .with("found", found)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn curl_and_browsers_are_neutral() {
        for neutral in
            ["", "application/x-www-form-urlencoded", "text/plain; charset=utf-8", "application/octet-stream", "x"]
        {
            assert_eq!(Declared::new(neutral), Declared::Neutral, "{neutral}");
        }
        assert!(matches!(Declared::new("Image/PNG"), Declared::Foreign(e) if e == "image/png"));
    }

    #[test]
    fn contradictions_are_seen() {
        assert!(Declared::new("chemical/x-pdb").check_format("mmcif").is_err());
        assert!(Declared::new("chemical/x-pdb").check_format("pdb").is_ok());
        for binary in ["chemical/x-bcif", "application/vnd.binarycif", "application/vnd.msgpack; charset=binary"] {
            assert!(Declared::new(binary).check_format("bcif").is_ok(), "{binary}");
            assert!(Declared::new(binary).check_format("mmcif").is_err(), "{binary}");
        }
        assert!(Declared::new("chemical/x-mmcif").check_format("bcif").is_err());
        assert!(Declared::new("application/gzip").check_bytes(b"ATOM").is_err());
        assert!(Declared::new("application/gzip").check_bytes(&[0x1f, 0x8b, 8]).is_ok());
    }
}
