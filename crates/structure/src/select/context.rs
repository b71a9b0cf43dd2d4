//! Value of the parameter `context`.

use molmesh_surface::named;

/// Atoms whose surface is made.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Context {
    /// The selected atoms alone.
    #[default]
    Selection,
    /// The atoms of the default selection in all chains, and the selected ones. The surface is then cut: only the
    /// triangles of the selected atoms remain.
    Whole,
}

named!(Context, Selection => "selection", Whole => "whole");
