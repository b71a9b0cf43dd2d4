//! Map file of a job.

use std::fmt;
use std::sync::Arc;

use molmesh_structure::map::{self, Map, MapLimits};
use molmesh_surface::Control;

use super::JobError;

/// Shared bytes of a file.
type SharedBytes = Arc<dyn AsRef<[u8]> + Send + Sync>;

/// Map file, whose values colour the vertices. Clones share the bytes.
#[derive(Clone)]
pub struct MapFile {
    /// Digest of the content, part of the content key. Empty where no keys are made.
    digest: String,
    /// Content; `None` if it is not loaded yet.
    bytes: Option<SharedBytes>,
}

impl fmt::Debug for MapFile {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("MapFile").field("digest", &self.digest).field("bytes", &self.as_ref().len()).finish()
    }
}

impl AsRef<[u8]> for MapFile {
    /// Returns the content; nothing if it is not loaded.
    fn as_ref(&self) -> &[u8] {
        self.bytes.as_ref().map_or(&[], |bytes| (**bytes).as_ref())
    }
}

impl MapFile {
    /// Creates a map file. `digest` identifies the content in content keys.
    #[must_use]
    pub fn new(digest: String, bytes: impl AsRef<[u8]> + Send + Sync + 'static) -> Self {
        Self { digest, bytes: Some(Arc::new(bytes)) }
    }

    /// Creates a map file whose content is loaded before the job runs.
    #[must_use]
    pub const fn not_loaded(digest: String) -> Self {
        Self { digest, bytes: None }
    }

    /// Returns the digest of the content.
    #[must_use]
    pub fn digest(&self) -> &str {
        &self.digest
    }

    /// Reads the map.
    pub(super) fn read(&self, limits: &MapLimits, control: &Control<'_>) -> Result<Map, JobError> {
        Ok(map::read(self.as_ref(), limits, control)?)
    }
}
