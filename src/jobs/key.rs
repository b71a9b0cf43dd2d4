//! Content keys: names of results that follow from input, parameters, format, arithmetic and version.

use std::fmt;
use std::str::FromStr;

use crate::formats::Format;
use crate::pipeline::{Job, params};
use crate::store::{BadDigest, Digest, Name, StoreError};

/// Name of a mesh file. Equal keys mean equal bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) struct ContentKey(Digest);

impl ContentKey {
    /// Returns the key of a result. `maker` names the arithmetic of the backend, followed by that of a picture's
    /// renderer. The version is part of the key, since a release may change the last bits.
    pub(crate) fn new(input: &Digest, job: &Job, format: Format, maker: &str) -> Self {
        let (canonical, version) = (params::canonical(job), env!("CARGO_PKG_VERSION"));
        let text = format!("molmesh {version}\n{maker}\n{}\n{canonical}\n{input}\n", format.extension());
        Self(Digest::of(text.as_bytes()))
    }
}

impl ContentKey {
    /// Returns the name in the store, of the file or of its report.
    pub(crate) fn name(&self, extension: &str) -> Result<Name, StoreError> {
        Ok(Name::result(&self.0.to_string(), extension)?)
    }
}

impl FromStr for ContentKey {
    type Err = BadDigest;

    fn from_str(text: &str) -> Result<Self, BadDigest> {
        text.parse().map(Self)
    }
}

impl fmt::Display for ContentKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_tell_everything_apart() {
        let plain = Job::default();
        let fine = params::parse([("resolution", "0.4")]).unwrap().job;
        let chain = params::parse([("chains", "A")]).unwrap().job;
        let png = params::parse([("format", "png")]).unwrap().job;
        let wide = params::parse([("format", "png"), ("width", "600")]).unwrap().job;
        let (a, b) = (Digest::of(b"a"), Digest::of(b"b"));
        let mut keys = vec![
            ContentKey::new(&a, &plain, Format::Glb, "cpu"),
            ContentKey::new(&b, &plain, Format::Glb, "cpu"),
            ContentKey::new(&a, &fine, Format::Glb, "cpu"),
            ContentKey::new(&a, &chain, Format::Glb, "cpu"),
            ContentKey::new(&a, &plain, Format::Ply, "cpu"),
            ContentKey::new(&a, &plain, Format::Glb, "gpu"),
            ContentKey::new(&a, &png, Format::Png, "cpu+cpu"),
            ContentKey::new(&a, &png, Format::Png, "cpu+gpu"),
            ContentKey::new(&a, &wide, Format::Png, "cpu+cpu"),
        ];
        assert_eq!(keys[0], ContentKey::new(&a, &Job::default(), Format::Glb, "cpu"));
        keys.sort_by_key(ToString::to_string);
        keys.dedup();
        assert_eq!(keys.len(), 9);
    }
}
