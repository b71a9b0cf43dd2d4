//! `molmesh serve`.
use super::args::ServeArgs;
use super::error::CliError;
pub(super) fn run(_: &ServeArgs) -> Result<(), CliError> {
    Ok(())
}
