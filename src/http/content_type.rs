//! Declared type of a structure file. The format is detected from the bytes; a `Content-Type` that contradicts them is
//! rejected, since one of the two is a mistake.

use super::problem::Problem;
use super::problem_types::ProblemType;
use crate::jobs::Failure;
use crate::pipeline::JobError;
use crate::structure::{GZIP_MAGIC, SourceFormat, StructureError, ZSTD_MAGIC};

/// Declared type of a body.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum DeclaredType {
    /// No type, or one that contradicts no structure file: text, octets, curl's default form type.
    Neutral,
    /// Structure format, with the type.
    Structure(SourceFormat, String),
    /// Compressed file, with its first bytes and the type.
    Compressed(&'static [u8], String),
    /// Type of another kind of file.
    Foreign(String),
}

impl DeclaredType {
    /// Parses a media type; parameters such as `charset` are ignored.
    pub(super) fn new(content_type: &str) -> Self {
        let essence = content_type.split(';').next().unwrap_or_default().trim().to_ascii_lowercase();
        let (kind, subtype) = essence.split_once('/').unwrap_or_default();
        match (kind, subtype) {
            ("chemical", "x-pdb" | "pdb") => Self::Structure(SourceFormat::Pdb, essence),
            ("chemical", "x-mmcif" | "mmcif" | "x-cif" | "cif") => Self::Structure(SourceFormat::Mmcif, essence),
            ("chemical", "x-pqr" | "pqr") => Self::Structure(SourceFormat::Pqr, essence),
            ("chemical", "x-xyz" | "xyz") => Self::Structure(SourceFormat::Xyz, essence),
            // BinaryCIF has no registered type; that of its container is.
            ("chemical", "x-bcif" | "bcif" | "x-binarycif")
            | ("application", "vnd.binarycif" | "x-bcif" | "vnd.msgpack" | "msgpack" | "x-msgpack") => {
                Self::Structure(SourceFormat::BinaryCif, essence)
            }
            ("application", "gzip" | "x-gzip") => Self::Compressed(GZIP_MAGIC, essence),
            ("application", "zstd") => Self::Compressed(ZSTD_MAGIC, essence),
            ("image" | "audio" | "video" | "font" | "model", _)
            | ("application", "json" | "pdf" | "xml" | "zip")
            | ("text", "html" | "xml" | "css" | "javascript") => Self::Foreign(essence),
            _ => Self::Neutral,
        }
    }

    /// Returns true if a structure format is declared, which the bytes must have.
    pub(super) const fn is_structure(&self) -> bool {
        matches!(self, Self::Structure(..))
    }

    /// Checks the first bytes.
    pub(super) fn check_bytes(&self, bytes: &[u8]) -> Result<(), Problem> {
        match self {
            Self::Compressed(magic, essence) if !bytes.starts_with(magic) => {
                Err(contradiction(essence, "not compressed that way"))
            }
            _ => Ok(()),
        }
    }

    /// Checks the detected format.
    pub(super) fn check_format(&self, found: &str) -> Result<(), Problem> {
        match self {
            Self::Structure(format, essence) if format.name() != found => Err(contradiction(essence, found)),
            _ => Ok(()),
        }
    }

    /// Converts a failure. Bytes of unknown format under a foreign type are a contradiction of that type.
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

/// Returns the problem of a body whose bytes are not of the declared type.
pub(super) fn contradiction(declared: &str, found: &str) -> Problem {
    Problem::new(
        ProblemType::UnsupportedMediaType,
        format!("the body is declared as {declared}, but its bytes are {found}; omit `Content-Type` or correct it"),
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
            assert_eq!(DeclaredType::new(neutral), DeclaredType::Neutral, "{neutral}");
        }
        assert!(matches!(DeclaredType::new("Image/PNG"), DeclaredType::Foreign(e) if e == "image/png"));
    }

    #[test]
    fn contradictions_are_seen() {
        assert!(DeclaredType::new("chemical/x-pdb").check_format("mmcif").is_err());
        assert!(DeclaredType::new("chemical/x-pdb").check_format("pdb").is_ok());
        for binary in ["chemical/x-bcif", "application/vnd.binarycif", "application/vnd.msgpack; charset=binary"] {
            assert!(DeclaredType::new(binary).check_format("bcif").is_ok(), "{binary}");
            assert!(DeclaredType::new(binary).check_format("mmcif").is_err(), "{binary}");
        }
        assert!(DeclaredType::new("chemical/x-mmcif").check_format("bcif").is_err());
        assert!(DeclaredType::new("chemical/x-xyz").check_format("xyz").is_ok());
        assert!(DeclaredType::new("chemical/x-pqr").check_format("pdb").is_err());
        assert!(DeclaredType::new("application/gzip").check_bytes(b"ATOM").is_err());
        assert!(DeclaredType::new("application/gzip").check_bytes(&[0x1f, 0x8b, 8]).is_ok());
    }
}
