//! Printing of the effective configuration: every value with its source, without secrets.

use serde_json::{Map, Value, json};

use super::load::{Loaded, Source};
use super::secrets::{SECRETS, file_key, is_hidden};

/// Printed form of a value.
enum Shown {
    Value(Value),
    /// Set, but secret.
    Hidden,
    /// Secret read from the file that the `_file` key names.
    FromFile,
}

/// Key, printed value and source.
type Row = (String, Shown, Source);

impl Loaded {
    /// Returns the sections with their rows.
    fn rows(&self) -> Vec<(String, Vec<Row>)> {
        let tree = serde_json::to_value(&self.config).unwrap_or_default();
        let keys = |section: &str, keys: &Map<String, Value>| {
            let row = |(key, value): (&String, &Value)| {
                let path = format!("{section}.{key}");
                let source = self.source(&path);
                (key.clone(), self.shown(&path, value), source)
            };
            keys.iter().map(row).collect()
        };
        let sections = tree.as_object().into_iter().flatten();
        sections.filter_map(|(name, of)| Some((name.clone(), keys(name, of.as_object()?)))).collect()
    }

    fn shown(&self, path: &str, value: &Value) -> Shown {
        match value {
            Value::Null => Shown::Value("none".into()),
            // No layer set the secret itself.
            _ if SECRETS.contains(&path) && self.source(&file_key(path)) != Source::Default => Shown::FromFile,
            Value::String(text) if is_hidden(path, text) => Shown::Hidden,
            other => Shown::Value(other.clone()),
        }
    }

    /// Returns the effective configuration as a TOML file that loads to the same configuration, except for secrets. A
    /// comment after each value names its source.
    #[must_use]
    pub fn to_toml(&self) -> String {
        let row = |(key, shown, source): &(String, Shown, Source)| match shown {
            Shown::Value(value) => format!("{key} = {} # {}\n", toml(value), one_line(source)),
            Shown::Hidden => format!("# {key} is set and not shown # {}\n", one_line(source)),
            Shown::FromFile => format!("# {key} is set and not shown # the file that {} names\n", file_key(key)),
        };
        let section = |(section, keys): (String, Vec<_>)| {
            let rows: String = keys.iter().map(row).collect();
            format!("[{section}]\n{rows}")
        };
        self.rows().into_iter().map(section).collect::<Vec<_>>().join("\n")
    }

    /// Returns the effective configuration as JSON: `config` has the form of the file, `sources` has the source of
    /// every key.
    #[must_use]
    pub fn to_json(&self) -> Value {
        let (mut config, mut sources) = (Map::new(), Map::new());
        for (section, keys) in self.rows() {
            let (mut values, mut from) = (Map::new(), Map::new());
            for (key, shown, source) in keys {
                let mut of = source.document();
                match shown {
                    Shown::Value(value) => drop(values.insert(key.clone(), value)),
                    Shown::Hidden => of["hidden"] = true.into(),
                    Shown::FromFile => {
                        of = self.source(&file_key(&format!("{section}.{key}"))).document();
                        (of["hidden"], of["key"]) = (true.into(), file_key(&key).into());
                    }
                }
                from.insert(key, of);
            }
            config.insert(section.clone(), values.into());
            sources.insert(section, from.into());
        }
        json!({ "config": config, "sources": sources })
    }
}

impl Source {
    /// Returns the source as JSON.
    fn document(&self) -> Value {
        match self {
            Self::Default => json!({ "source": "default" }),
            Self::File(path) => json!({ "source": "file", "path": path.to_string_lossy() }),
            Self::Environment(name) => json!({ "source": "environment", "variable": name }),
            Self::Flag => json!({ "source": "command line" }),
        }
    }
}

/// Formats a source for a comment, without control characters, which would end it.
fn one_line(source: &Source) -> String {
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
