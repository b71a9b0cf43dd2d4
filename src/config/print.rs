//! Printing of the effective configuration: every value with its source, without secrets.

use serde_json::{Map, Value, json};

use super::load::{ConfigSource, Loaded};
use super::secrets::{SECRETS, file_key, is_hidden};

/// Printed key.
struct ConfigLine {
    key: String,
    /// Value; `None` for a secret.
    value: Option<Value>,
    /// Source of the value. For a secret from a file, source of the key that names the file.
    source: ConfigSource,
    /// True if the value is a secret from the file that the `_file` key names.
    is_from_file: bool,
}

impl Loaded {
    /// Returns the sections with their rows.
    fn rows(&self) -> Vec<(String, Vec<ConfigLine>)> {
        let tree = serde_json::to_value(&self.config).unwrap_or_default();
        let section = |(section, keys): (&String, &Value)| {
            let row = |(key, value): (&String, &Value)| self.row(section, key, value);
            Some((section.clone(), keys.as_object()?.iter().map(row).collect()))
        };
        tree.as_object().into_iter().flatten().filter_map(section).collect()
    }

    fn row(&self, section: &str, key: &str, value: &Value) -> ConfigLine {
        let path = format!("{section}.{key}");
        let file_source = self.source(&file_key(&path));
        let is_from_file = SECRETS.contains(&path.as_str()) && !value.is_null() && file_source != ConfigSource::Default;
        let source = if is_from_file { file_source } else { self.source(&path) };
        let value = match value {
            Value::Null => Some("none".into()),
            Value::String(text) if is_hidden(&path, text) => None,
            other => Some(other.clone()),
        };
        ConfigLine { key: key.to_owned(), value, source, is_from_file }
    }

    /// Returns the effective configuration as a TOML file that loads to the same configuration, except for secrets. A
    /// comment after each value names its source.
    #[must_use]
    pub fn to_toml(&self) -> String {
        let row = |ConfigLine { key, value, source, is_from_file }: &ConfigLine| match value {
            Some(value) => format!("{key} = {} # {}\n", toml(value), one_line(source)),
            None if *is_from_file => format!("# {key} is set and not shown # the file that {} names\n", file_key(key)),
            None => format!("# {key} is set and not shown # {}\n", one_line(source)),
        };
        let section = |(section, rows): (String, Vec<ConfigLine>)| {
            let rows: String = rows.iter().map(row).collect();
            format!("[{section}]\n{rows}")
        };
        self.rows().into_iter().map(section).collect::<Vec<_>>().join("\n")
    }

    /// Returns the effective configuration as JSON: `config` has the form of the file, `sources` has the source of
    /// every key.
    #[must_use]
    pub fn to_json(&self) -> Value {
        let (mut config, mut sources) = (Map::new(), Map::new());
        for (section, rows) in self.rows() {
            let (mut values, mut from) = (Map::new(), Map::new());
            for ConfigLine { key, value, source, is_from_file } in rows {
                let mut of = serde_json::to_value(source).unwrap_or_default();
                if value.is_none() {
                    of["hidden"] = true.into();
                }
                if is_from_file {
                    of["key"] = file_key(&key).into();
                }
                values.extend(value.map(|value| (key.clone(), value)));
                from.insert(key, of);
            }
            config.insert(section.clone(), values.into());
            sources.insert(section, from.into());
        }
        json!({ "config": config, "sources": sources })
    }
}

/// Formats a source for a comment, without control characters, which would end it.
fn one_line(source: &ConfigSource) -> String {
    source.to_string().replace(|c: char| c.is_control(), " ")
}

/// Formats a value as TOML. Strings are as in JSON, except that TOML requires DEL to be escaped. Numbers beyond the
/// range of TOML are written as strings.
fn toml(value: &Value) -> String {
    match value {
        Value::String(text) => Value::from(text.as_str()).to_string().replace('\u{7f}', "\\u007f"),
        Value::Number(number) if number.as_u64().is_some_and(|n| i64::try_from(n).is_err()) => format!("\"{number}\""),
        other => other.to_string(),
    }
}
