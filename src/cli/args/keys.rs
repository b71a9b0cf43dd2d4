//! Flags of the commands that create keys and sign URLs.

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
    /// Create a key: prints its entry for the key file to stdout, and the key itself, only once, to stderr
    New(Box<NewKeyArgs>),
    /// Create a key that signs URLs, for `access.signing_secret`
    Signing(SigningKeyArgs),
}

/// `molmesh key new`.
#[derive(Debug, ClapArgs)]
#[command(after_help = KEY_EXAMPLES)]
pub(crate) struct NewKeyArgs {
    /// Name of the key in logs: lower-case letters, digits and hyphens
    #[arg(long, value_name = "NAME")]
    pub(crate) id: String,
    /// Group whose keys share structures, results and jobs [default: the name of the key]
    #[arg(long, value_name = "NAME")]
    pub(crate) group: Option<String>,
    /// Permissions: mesh (compute meshes), read (read existing objects), or both
    #[arg(long, value_name = "A,B", default_value = "mesh,read")]
    pub(crate) scopes: String,
    /// Expiry: a time from now such as 90d, or a date [default: never]
    #[arg(long, value_name = "TIME", allow_hyphen_values = true)]
    pub(crate) expires: Option<String>,
    /// Comment in the key file
    #[arg(long, value_name = "TEXT")]
    pub(crate) note: Option<String>,
    /// Requests per window [default: unlimited]
    #[arg(long, value_name = "N", help_heading = "Quota", value_parser = clap::value_parser!(u64).range(1..))]
    pub(crate) requests: Option<u64>,
    /// Computing time per window, such as 10m [default: unlimited]
    #[arg(long, value_name = "TIME", help_heading = "Quota", allow_hyphen_values = true)]
    pub(crate) work: Option<String>,
    /// Concurrent requests [default: unlimited]
    #[arg(long, value_name = "N", help_heading = "Quota", value_parser = clap::value_parser!(u64).range(1..))]
    pub(crate) concurrent: Option<u64>,
    /// Length of a window; needs --requests or --work [default: 1m]
    #[arg(long, value_name = "TIME", help_heading = "Quota", allow_hyphen_values = true)]
    pub(crate) window: Option<String>,
}

/// `molmesh key signing`.
#[derive(Debug, ClapArgs)]
pub(crate) struct SigningKeyArgs {
    /// Name of the key in URLs: lower-case letters, digits and hyphens
    #[arg(long, value_name = "NAME")]
    pub(crate) id: String,
    /// Group of keys whose structures, results and jobs the signed URLs open [default: the name of the key]
    #[arg(long, value_name = "NAME")]
    pub(crate) group: Option<String>,
}

// `molmesh sign`.
#[derive(Debug, ClapArgs)]
#[command(after_help = SIGN_EXAMPLES)]
pub(crate) struct SignArgs {
    /// URL, or its path and query; behind a proxy that changes paths, the one that the service receives
    pub(crate) url: String,
    /// Expiry: a time from now such as 1h, or a date such as 2030-01-31T00:00:00Z
    #[arg(long, value_name = "TIME", default_value = "1h", allow_hyphen_values = true)]
    pub(crate) expires: String,
    /// Name of the signing key [default: the first in `access.signing_secret`]
    #[arg(long, value_name = "NAME")]
    pub(crate) key_id: Option<String>,
    /// Configuration file (TOML) of the service
    #[arg(long, value_name = "FILE", env = "MOLMESH_CONFIG", hide_env_values = true)]
    pub(crate) config: Option<PathBuf>,
    /// Set one value of the configuration; may be repeated
    #[arg(long, value_name = "SECTION.KEY=VALUE")]
    pub(crate) set: Vec<String>,
}
