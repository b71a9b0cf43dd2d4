//! Content keys: names of results that follow from input, parameters, format, arithmetic and versions of algorithms.

use std::fmt;

use crate::pipeline::algorithm_versions;
use crate::pipeline::params::{self, Request};
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
    pub(crate) fn new(input: &Digest, request: &Request, arithmetic: &str, namespace: Namespace) -> Self {
        let Request { options, format, .. } = request;
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
        let parse = |pairs: &[(&str, &str)]| params::parse(pairs.iter().copied()).unwrap();
        let plain = parse(&[]);
        let ply = parse(&[("format", "ply")]);
        let fine = parse(&[("resolution", "0.4")]);
        let chain = parse(&[("chains", "A")]);
        let png = parse(&[("format", "png")]);
        let wide = parse(&[("format", "png"), ("width", "600")]);
        let (a, b) = (Digest::of(b"a"), Digest::of(b"b"));
        let key = |input, request, arithmetic| ContentKey::new(input, request, arithmetic, Namespace::default());
        let mut keys = vec![
            key(&a, &plain, "cpu"),
            key(&b, &plain, "cpu"),
            key(&a, &fine, "cpu"),
            key(&a, &chain, "cpu"),
            key(&a, &ply, "cpu"),
            key(&a, &plain, "gpu"),
            key(&a, &png, "cpu+cpu"),
            key(&a, &png, "cpu+gpu"),
            key(&a, &wide, "cpu+cpu"),
        ];
        assert_eq!(keys[0], key(&a, &parse(&[("format", "glb")]), "cpu"));
        keys.sort_by_key(ToString::to_string);
        keys.dedup();
        assert_eq!(keys.len(), 9);
    }
}
