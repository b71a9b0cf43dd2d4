//! Value of the parameter `context`.

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

impl Context {
    /// All values.
    pub const ALL: [Self; 2] = [Self::Selection, Self::Whole];

    /// Returns the value of the parameter `context`.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Selection => "selection",
            Self::Whole => "whole",
        }
    }
}
