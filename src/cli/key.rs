//! `molmesh key`: creates and prints keys. Nothing is stored; a lost key must be replaced.

use std::io::{self, Write as _};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use molmesh::access::{self, Hash, Key, Quota, Scope};
use molmesh::pipeline::params::ParamError;

use super::args::{KeyCommand, NewKeyArgs, SigningKeyArgs};
use super::error::CliError;

/// Runs the command.
pub(super) fn run(command: &KeyCommand) -> Result<(), CliError> {
    match command {
        KeyCommand::New(args) => new(args),
        KeyCommand::Signing(args) => signing(args),
    }
}

/// Prints the key to stderr and its entry to stdout, so that `>> keys.toml` stores the entry only.
fn new(args: &NewKeyArgs) -> Result<(), CliError> {
    let id = name("id", &args.id)?;
    let group = args.group.as_deref().map(|group| name("group", group)).transpose()?;
    let scope = |name: &str| {
        let known = || Scope::ALL.map(Scope::name).join(", ");
        Scope::named(name.trim()).ok_or_else(|| ParamError::bad_value("scopes", name, known()))
    };
    let mut scopes = args.scopes.split(',').map(scope).collect::<Result<Vec<_>, _>>()?;
    scopes.sort_unstable();
    scopes.dedup();
    let quota = Quota {
        requests: args.requests,
        work_s: args.work.as_deref().map(|text| seconds("work", text)).transpose()?,
        concurrent: args.concurrent,
        window_s: seconds("window", args.window.as_deref().unwrap_or("1m"))?,
    };
    if let Some(window) = args.window.as_ref().filter(|_| quota.requests.is_none() && quota.work_s.is_none()) {
        return Err(ParamError::bad_value("window", window, "a quota per window as well, --requests or --work").into());
    }
    let key_text = access::new_key(id).map_err(|error| CliError::Internal(error.to_string()))?;
    let expires = args.expires.as_deref().map(end).transpose()?;
    let key = Key {
        id: id.to_owned(),
        group: group.unwrap_or(id).to_owned(),
        hash: Hash::of(&key_text),
        scopes,
        quota: Arc::new(quota),
        expires,
        note: args.note.clone(),
    };
    super::print(&access::format_key(&key))?;
    let text = format!("\nThe key (shown only once):\n{key_text}\n");
    io::stderr().write_all(text.as_bytes()).map_err(|source| CliError::Output { name: "stderr".to_owned(), source })
}

fn signing(args: &SigningKeyArgs) -> Result<(), CliError> {
    let mut id = name("id", &args.id)?.to_owned();
    if let Some(group) = &args.group {
        id = format!("{id}@{}", name("group", group)?);
    }
    let secret = access::new_secret().map_err(|error| CliError::Internal(error.to_string()))?;
    super::print(&format!("{id}:{secret}\n"))
}

/// Checks the name of a key or group.
fn name<'a>(parameter: &'static str, text: &'a str) -> Result<&'a str, ParamError> {
    let bad = || ParamError::bad_value(parameter, text, "1 to 32 lower-case letters, digits and hyphens");
    Some(text).filter(|text| access::is_id(text)).ok_or_else(bad)
}

/// Parses a time such as `1h` into whole seconds, at least one.
fn seconds(parameter: &'static str, text: &str) -> Result<u64, ParamError> {
    let seconds = humantime::parse_duration(text).map(|time| time.as_secs()).ok().filter(|seconds| *seconds >= 1);
    seconds.ok_or_else(|| ParamError::bad_value(parameter, text, "a time such as 90s, 1h or 30d"))
}

/// Parses an expiry: a time from now, or a date.
pub(super) fn end(text: &str) -> Result<SystemTime, CliError> {
    let expected = "a time from now such as 1h or 90d, or a date such as 2030-01-31T00:00:00Z";
    let bad = || ParamError::bad_value("expires", text, expected);
    if let Ok(date) = humantime::parse_rfc3339(text) {
        let past = || CliError::usage(format!("parameter `expires`: `{text}` is in the past"));
        return Some(date).filter(|date| *date > SystemTime::now()).ok_or_else(past);
    }
    let from_now = seconds("expires", text).map_err(|_other| bad())?;
    let end = SystemTime::now().checked_add(Duration::from_secs(from_now)).filter(is_a_date);
    Ok(end.ok_or_else(bad)?)
}

/// Returns true if the year of a time has at most four digits.
fn is_a_date(time: &SystemTime) -> bool {
    const YEAR_10000_S: u64 = 253_402_300_800;
    time.duration_since(SystemTime::UNIX_EPOCH).is_ok_and(|since| since.as_secs() < YEAR_10000_S)
}
