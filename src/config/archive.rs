//! Where structures are looked up by PDB id.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

/// The folder of structures.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ArchiveConfig {
    /// The folder, flat or in wwPDB's `divided` layout. None: `archive` in the data folder, so that one folder is
    /// all that an operator has to mount.
    pub dir: Option<PathBuf>,
}
