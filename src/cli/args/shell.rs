//! Flags of the commands that print texts for shells.

use clap::Args as ClapArgs;
use clap_complete::Shell;

const COMPLETIONS_EXAMPLES: &str = "\
Examples:
  molmesh completions bash > ~/.local/share/bash-completion/completions/molmesh
  molmesh completions zsh > \"${fpath[1]}/_molmesh\"
  molmesh completions fish > ~/.config/fish/completions/molmesh.fish";

// `molmesh completions`.
#[derive(Debug, ClapArgs)]
#[command(after_help = COMPLETIONS_EXAMPLES)]
pub(crate) struct CompletionsArgs {
    /// Shell
    pub(crate) shell: Shell,
}

// `molmesh man`.
#[derive(Debug, ClapArgs)]
pub(crate) struct ManArgs {
    /// Command, such as `mesh` or `key new`; without it, the page of all commands
    pub(crate) command: Vec<String>,
}
