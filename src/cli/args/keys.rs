//! The flags of the commands that make keys and sign addresses.

use std::path::PathBuf;

use clap::{Args as ClapArgs, Subcommand};

const KEY_EXAMPLES: &str = "\
Examples:
  molmesh key new --id viewer --scopes mesh,read --requests 1000 --window 1h >> keys.toml
  molmesh serve --set access.keys_file=keys.toml";

const SIGN_EXAMPLES: &str = "\
Examples:
  export MOLMESH__ACCESS__SIGNING_SECRET=$(molmesh key signing --id 2030a)
  molmesh sign 'https://meshes.example/v1/pdb/4pti/surface.glb?resolution=1' --expires 1h";

// `molmesh key`.
#[derive(Debug, Subcommand)]
pub(crate) enum KeyCommand {
    /// Make a key: the lines for the file of keys go to stdout, the key itself, once, to stderr
    New(Box<NewKeyArgs>),
    /// Make a key that signs addresses, as `access.signing_secret` takes it
    Signing(SigningKeyArgs),
}

/// `molmesh key new`.
#[derive(Debug, ClapArgs)]
#[command(after_help = KEY_EXAMPLES)]
pub(crate) struct NewKeyArgs {
    /// Its name, which stands in logs: lower-case letters, digits and hyphens
    #[arg(long, value_name = "NAME")]
    pub(crate) id: String,
    /// What it is for: mesh (to compute), read (to read what there is), or both
    #[arg(long, value_name = "A,B", default_value = "mesh,read")]
    pub(crate) scopes: String,
    /// When it ends: a time from now such as 90d, or a date; never by default
    #[arg(long, value_name = "WHEN")]
    pub(crate) expires: Option<String>,
    /// For whom reads the file
    #[arg(long, value_name = "TEXT")]
    pub(crate) note: Option<String>,
    /// Requests in a window; any number by default
    #[arg(long, value_name = "N", help_heading = "Quota", value_parser = clap::value_parser!(u64).range(1..))]
    pub(crate) requests: Option<u64>,
    /// Time in a window that workers spend on its jobs, such as 10m; any time by default
    #[arg(long, value_name = "TIME", help_heading = "Quota")]
    pub(crate) work: Option<String>,
    /// Requests at once; any number by default
    #[arg(long, value_name = "N", help_heading = "Quota", value_parser = clap::value_parser!(u64).range(1..))]
    pub(crate) concurrent: Option<u64>,
    /// Length of a window
    #[arg(long, value_name = "TIME", help_heading = "Quota", default_value = "1m")]
    pub(crate) window: String,
}

/// `molmesh key signing`.
#[derive(Debug, ClapArgs)]
pub(crate) struct SigningKeyArgs {
    /// Its name, which stands in addresses: lower-case letters, digits and hyphens
    #[arg(long, value_name = "NAME")]
    pub(crate) id: String,
}

// `molmesh sign`.
#[derive(Debug, ClapArgs)]
#[command(after_help = SIGN_EXAMPLES)]
pub(crate) struct SignArgs {
    /// What to sign: an address, or its path and query; as the service sees it, where a proxy changes paths
    pub(crate) url: String,
    /// When it ends: a time from now such as 1h, or a date such as 2030-01-31T00:00:00Z
    #[arg(long, value_name = "WHEN", default_value = "1h")]
    pub(crate) expires: String,
    /// Which key signs; the first one of `access.signing_secret` by default
    #[arg(long, value_name = "NAME")]
    pub(crate) key_id: Option<String>,
    /// Configuration file (TOML), the service's own
    #[arg(long, value_name = "FILE", env = "MOLMESH_CONFIG", hide_env_values = true)]
    pub(crate) config: Option<PathBuf>,
    /// Set one value of the configuration; may be repeated
    #[arg(long, value_name = "SECTION.KEY=VALUE")]
    pub(crate) set: Vec<String>,
}
