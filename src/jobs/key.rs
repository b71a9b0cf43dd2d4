//! Content keys: names of results that follow from input, parameters, format, arithmetic and versions of algorithms.

use std::fmt;

use crate::formats::Format;
use crate::pipeline::{Options, algorithm_versions, params};
use crate::store::{BadDigest, Digest, Name, Namespace, StoreError};

/// Name of a mesh file, with the namespace in which it is stored. Equal names mean equal bytes in every namespace.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) struct ContentKey {
    digest: Digest,
    namespace: Namespace,
}

impl ContentKey {
    /// Returns the key of a result. `arithmetic` names the arithmetic of the backend, followed by that of a picture's
    /// renderer. Releases with the same algorithms give the same keys.
    pub(crate) fn new(
        input: &Digest,
        options: &Options,
        format: Format,
        arithmetic: &str,
        namespace: Namespace,
    ) -> Self {
        let (canonical, versions) = (params::canonical(options), algorithm_versions::file_versions(options));
        let text = format!("molmesh {versions}\n{arithmetic}\n{}\n{canonical}\n{input}\n", format.name());
        Self { digest: Digest::of(text.as_bytes()), namespace }
    }

    /// Parses the name of a result in a namespace.
    pub(crate) fn parse(text: &str, namespace: Namespace) -> Result<Self, BadDigest> {
        Ok(Self { digest: text.parse()?, namespace })
    }

    /// Returns the name in the store, of the file or of its report.
    pub(crate) fn name(&self, extension: &str) -> Result<Name, StoreError> {
        Ok(Name::result(&self.digest.to_string(), extension)?.within(self.namespace))
    }
}

impl fmt::Display for ContentKey {
    /// Writes the name, which is the same in every namespace.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.digest.fmt(f)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn different_results_have_different_keys() {
        let plain = Options::default();
        let fine = params::parse([("resolution", "0.4")]).unwrap().options;
        let chain = params::parse([("chains", "A")]).unwrap().options;
        let png = params::parse([("format", "png")]).unwrap().options;
        let wide = params::parse([("format", "png"), ("width", "600")]).unwrap().options;
        let (a, b) = (Digest::of(b"a"), Digest::of(b"b"));
        let key = |input, options, format, arithmetic| {
            ContentKey::new(input, options, format, arithmetic, Namespace::default())
        };
        let mut keys = vec![
            key(&a, &plain, Format::Glb, "cpu"),
            key(&b, &plain, Format::Glb, "cpu"),
            key(&a, &fine, Format::Glb, "cpu"),
            key(&a, &chain, Format::Glb, "cpu"),
            key(&a, &plain, Format::Ply, "cpu"),
            key(&a, &plain, Format::Glb, "gpu"),
            key(&a, &png, Format::Png, "cpu+cpu"),
            key(&a, &png, Format::Png, "cpu+gpu"),
            key(&a, &wide, Format::Png, "cpu+cpu"),
        ];
        assert_eq!(keys[0], key(&a, &Options::default(), Format::Glb, "cpu"));
        keys.sort_by_key(ToString::to_string);
        keys.dedup();
        assert_eq!(keys.len(), 9);
    }
}
