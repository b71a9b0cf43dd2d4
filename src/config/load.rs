//! Loading of the configuration in layers. Each layer sets single keys; the defaults define which keys exist.

use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};

use serde::Serialize;
use serde_json::Value;

use super::secrets;
use super::store::HIDDEN;
use super::{AvailableMemory, Config, ConfigError, OwnedMemory};
use crate::pipeline::integer::{parse_integer, whole_number};
use crate::pipeline::nearest::nearest;

/// Prefix of environment variables; sections and keys follow, separated by two underscores.
const PREFIX: &str = "MOLMESH__";

/// Layer that set a value.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[serde(tag = "source", rename_all = "lowercase")]
pub enum ConfigSource {
    /// No layer set the value.
    Default,
    /// No layer set the value, and the default exceeds half of the memory.
    Memory {
        /// Memory, bytes.
        bytes: u64,
        /// Name of its owner, such as `this machine`.
        owner: &'static str,
    },
    /// TOML file.
    File {
        /// Path of the file.
        path: PathBuf,
    },
    /// Environment variable.
    Environment {
        /// Name of the variable.
        variable: String,
    },
    /// Flag of the command line.
    #[serde(rename = "command line")]
    Flag,
}

impl fmt::Display for ConfigSource {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Default => f.write_str("default"),
            Self::Memory { bytes, owner } => write!(f, "half of the {} MiB of {owner}", bytes >> 20),
            Self::File { path } => write!(f, "{}", path.display()),
            Self::Environment { variable } => f.write_str(variable),
            Self::Flag => f.write_str("command line"),
        }
    }
}

/// Configuration with the sources of its values.
#[derive(Debug, Clone)]
pub struct Loaded {
    /// Configuration, including the secrets read from files.
    pub config: Config,
    /// Warnings for the operator, one sentence each.
    pub warnings: Vec<String>,
    sources: BTreeMap<String, ConfigSource>,
}

impl Loaded {
    /// Returns the source of the value of `section.key`.
    #[must_use]
    pub fn source(&self, key: &str) -> ConfigSource {
        self.sources.get(key).cloned().unwrap_or(ConfigSource::Default)
    }

    /// Returns all keys that do not have their defaults, with their sources.
    pub fn sources(&self) -> impl Iterator<Item = (&str, &ConfigSource)> {
        self.sources.iter().map(|(key, source)| (key.as_str(), source))
    }

    /// Reduces `limits.memory_bytes` to half of `memory` if no layer sets it. The other half is for the caches of the
    /// store, the files that the system keeps in memory, threads, and memory that the allocator has not returned yet.
    fn fit_memory(&mut self, memory: AvailableMemory) {
        const KEY: &str = "limits.memory_bytes";
        let Some(OwnedMemory { bytes, owner }) = memory.least() else { return };
        let half = (bytes / 2) >> 20 << 20;
        if self.source(KEY) == ConfigSource::Default && (1..self.config.limits.memory_bytes).contains(&half) {
            self.config.limits.memory_bytes = half;
            self.sources.insert(KEY.to_owned(), ConfigSource::Memory { bytes, owner });
        }
    }
}

/// Loads the configuration of this process: `file`, then the environment, then `flags`. Reduces `limits.memory_bytes`
/// to half of the memory of the machine or control group if the default is larger.
///
/// # Errors
/// Returns the errors of [`load`].
pub fn load_process(file: Option<&Path>, flags: &[(String, String)]) -> Result<Loaded, ConfigError> {
    let env = std::env::vars_os().filter_map(|(k, v)| Some((k.into_string().ok()?, v.to_string_lossy().into_owned())));
    let mut loaded = load(file, env, flags)?;
    loaded.fit_memory(AvailableMemory::detect());
    Ok(loaded)
}

/// Loads a configuration: defaults, then `file`, then the variables of `env` that begin with `MOLMESH__`, then
/// `flags` as pairs of a path such as `server.listen` and a value.
///
/// Values from the environment and flags are text: `none` clears a key, sizes may have the form `64MiB`. For each
/// secret there is a key with the suffix `_file` that names a file with its value.
///
/// # Errors
/// Returns [`ConfigError`] for the first unknown key or invalid value, or if a file cannot be read.
pub fn load(
    file: Option<&Path>,
    env: impl IntoIterator<Item = (String, String)>,
    flags: &[(String, String)],
) -> Result<Loaded, ConfigError> {
    let mut tree = Tree::new();
    if let Some(path) = file {
        let text = std::fs::read_to_string(path).map_err(|error| ConfigError::Read { path: path.to_owned(), error })?;
        let table: Value = toml::from_str(&text)
            .map_err(|e| ConfigError::Syntax { path: path.to_owned(), reason: tree.syntax(&text, &e) })?;
        let source = ConfigSource::File { path: path.to_owned() };
        for (section, entries) in table.as_object().into_iter().flatten() {
            let Some(entries) = entries.as_object() else {
                return Err(tree.unknown(section, source));
            };
            for (key, value) in entries {
                tree.set(&format!("{section}.{key}"), value, &source)?;
            }
        }
    }
    let (mut env, others): (Vec<_>, Vec<_>) = env.into_iter().partition(|(name, _)| name.starts_with(PREFIX));
    env.sort();
    for (name, value) in env {
        let key = name[PREFIX.len()..].to_ascii_lowercase().replace("__", ".");
        tree.set(&key, &Value::String(value), &ConfigSource::Environment { variable: name })?;
    }
    for (key, value) in flags {
        tree.set(key, &Value::String(value.clone()), &ConfigSource::Flag)?;
    }
    let mut warnings = tree.read_secrets()?;
    tree.config.check_cluster().map_err(ConfigError::Contradiction)?;
    warnings.extend(others.iter().filter_map(|(name, _)| tree.misspelt(name)));
    Ok(Loaded { config: tree.config, warnings, sources: tree.sources })
}

/// Configuration of the layers applied so far, typed and as a JSON tree.
struct Tree {
    defaults: Value,
    values: Value,
    config: Config,
    sources: BTreeMap<String, ConfigSource>,
}

impl Tree {
    fn new() -> Self {
        let config = Config::default();
        let defaults = serde_json::to_value(&config).unwrap_or(Value::Null);
        Self { values: defaults.clone(), defaults, config, sources: BTreeMap::new() }
    }

    /// Returns the position, the key if it is known, and the message of a syntax error. The line may hold a secret.
    fn syntax(&self, text: &str, error: &toml::de::Error) -> String {
        let before = error.span().and_then(|span| text.get(..span.start)).unwrap_or_default();
        let line = before.split('\n').count();
        let column = before.rsplit('\n').next().unwrap_or_default().chars().count() + 1;
        let key = text.split('\n').nth(line - 1).and_then(|line| line.split('=').next()).unwrap_or_default().trim();
        let is_known = self.keys().iter().any(|known| known.split('.').next_back() == Some(key));
        let key = if is_known { format!(", key `{key}`") } else { String::new() };
        format!("line {line}, column {column}{key}: {}", error.message())
    }

    /// Returns a warning for a variable such as `MOLMESH_LIMITS_ATOMS`, which lacks an underscore and is ignored.
    fn misspelt(&self, variable: &str) -> Option<String> {
        let plain = |text: &str| text.to_ascii_lowercase().replace("__", "_");
        let name = plain(variable.strip_prefix("MOLMESH_")?);
        let key = self.keys().into_iter().find(|key| key.replace('.', "_") == name)?;
        let meant = format!("{PREFIX}{}", key.replace('.', "__").to_ascii_uppercase());
        Some(format!("the variable {variable} is ignored: {key} is set by {meant}, with two underscores"))
    }

    /// Returns the paths of all keys.
    fn keys(&self) -> Vec<String> {
        let mut keys = Vec::new();
        for (section, entries) in self.defaults.as_object().into_iter().flatten() {
            keys.extend(entries.as_object().into_iter().flatten().map(|(key, _)| format!("{section}.{key}")));
        }
        keys
    }

    fn unknown(&self, key: &str, source_layer: ConfigSource) -> ConfigError {
        let known = self.keys();
        // A key in the wrong section or in none: suggest the key of the same name.
        let last = key.rsplit('.').next().unwrap_or(key);
        let namesake = known.iter().find(|k| k.rsplit('.').next() == Some(last)).cloned();
        let nearest = namesake.or_else(|| nearest(key, known.iter().map(String::as_str)).map(str::to_owned));
        ConfigError::UnknownKey { key: key.to_owned(), nearest, source_layer }
    }

    /// Sets one key and validates the whole configuration, so that an error names the layer that set the value.
    fn set(&mut self, key: &str, value: &Value, source: &ConfigSource) -> Result<(), ConfigError> {
        let pointer = format!("/{}", key.replace('.', "/"));
        let default = self.defaults.pointer(&pointer).filter(|d| !d.is_object());
        let Some(default) = default else { return Err(self.unknown(key, source.clone())) };
        let hidden = secrets::is_hidden(key, value.as_str().unwrap_or_default());
        let bad = |expected: String| ConfigError::BadValue {
            key: key.to_owned(),
            value: if hidden { HIDDEN.to_owned() } else { value.to_string() },
            expected,
            source_layer: source.clone(),
        };
        let clears = matches!(value, Value::String(text) if text == "none");
        let typed = match (value, default) {
            _ if clears => Value::Null,
            (Value::String(text), Value::Number(number)) if number.is_f64() => {
                Value::from(text.trim().parse::<f64>().map_err(|_none| bad("a number".to_owned()))?)
            }
            (Value::String(text), Value::Number(_)) => {
                let size = key.ends_with("_bytes");
                Value::from(parse_integer(text, size).ok_or_else(|| bad(whole_number(size)))?)
            }
            (Value::String(text), Value::Bool(_)) => {
                Value::Bool(text.trim().parse().map_err(|_neither| bad("true or false".to_owned()))?)
            }
            _ => value.clone(),
        };
        // The types of fractions check their own range.
        let minimum = minimum(key);
        if !default.is_f64() && typed.as_f64().is_some_and(|v| v < minimum as f64) {
            return Err(bad(format!("{minimum} or more")));
        }
        if let Some(slot) = self.values.pointer_mut(&pointer) {
            *slot = typed;
        }
        let why = |e: serde_json::Error| match default {
            Value::Number(_) if clears => bad(whole_number(key.ends_with("_bytes"))),
            _ if key.ends_with("listen") => {
                let none = if default.is_null() { ", or none" } else { "" };
                bad(format!("an address such as 127.0.0.1:8080{none}"))
            }
            _ => bad(format!("another value: {e}")),
        };
        self.config = serde_json::from_value(self.values.clone()).map_err(why)?;
        self.sources.insert(key.to_owned(), source.clone());
        Ok(())
    }

    /// Reads secrets from their files. Returns warnings about the files.
    fn read_secrets(&mut self) -> Result<Vec<String>, ConfigError> {
        let mut warnings = Vec::new();
        for key in secrets::SECRETS {
            let file_key = secrets::file_key(key);
            let at = |key: &str| format!("/{}", key.replace('.', "/"));
            let path = self.values.pointer(&at(&file_key)).and_then(Value::as_str);
            let Some(path) = path.map(PathBuf::from) else { continue };
            let source = |key: &str| self.sources.get(key).cloned().unwrap_or(ConfigSource::Default);
            if self.values.pointer(&at(key)).is_some_and(|value| !value.is_null()) {
                let [one, other] = [key, &file_key].map(|key| (key.to_owned(), source(key)));
                return Err(ConfigError::Both { one, other });
            }
            let source_layer = source(&file_key);
            let read = secrets::read(&path).map_err(|reason| ConfigError::SecretFile {
                key: file_key.clone(),
                path: path.clone(),
                reason,
                source_layer,
            })?;
            warnings.extend(read.warning.map(|warning| format!("{file_key}: {warning}")));
            if let Some(slot) = self.values.pointer_mut(&at(key)) {
                *slot = Value::String(read.text);
            }
            self.config = serde_json::from_value(self.values.clone()).map_err(|e| ConfigError::BadValue {
                key: key.to_owned(),
                value: HIDDEN.to_owned(),
                expected: e.to_string(),
                source_layer: ConfigSource::File { path },
            })?;
        }
        Ok(warnings)
    }
}

/// Returns the minimum of a number. A limit or timeout of zero would prevent all service.
pub(super) fn minimum(key: &str) -> u64 {
    match key {
        // Keeps no structures, indexes on disk or readback buffers.
        "limits.structure_cache_bytes" | "limits.scratch_bytes" | "devices.readback_bytes" => 0,
        _ => 1,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::limit::LIMITS;

    #[test]
    fn every_key_of_a_limit_exists() {
        let keys = Tree::new().keys();
        for key in LIMITS.iter().filter_map(|row| row.key) {
            assert!(keys.iter().any(|known| known == key), "{key}");
        }
    }

    #[test]
    fn requests_use_half_of_a_small_memory_unless_configured() {
        let fitted = |limit: Option<u64>, flags: &[(String, String)]| {
            let mut loaded = load(None, [], flags).unwrap();
            loaded.fit_memory(AvailableMemory { machine: Some(64 << 30), limit });
            (loaded.config.limits.memory_bytes, loaded.source("limits.memory_bytes"))
        };
        let owner = "this control group";
        let small = ConfigSource::Memory { bytes: 2 << 30, owner };
        assert_eq!(fitted(Some(2 << 30), &[]), (1 << 30, small.clone()));
        assert_eq!(small.to_string(), "half of the 2048 MiB of this control group");
        assert_eq!(fitted(Some((3 << 20) + 5), &[]).0, 1 << 20, "whole MiB");
        for large in [None, Some(16 << 30), Some(1)] {
            assert_eq!(fitted(large, &[]), (8 << 30, ConfigSource::Default), "{large:?}");
        }
        let flags = [("limits.memory_bytes".to_owned(), "8GiB".to_owned())];
        assert_eq!(fitted(Some(2 << 30), &flags), (8 << 30, ConfigSource::Flag));
    }
}
