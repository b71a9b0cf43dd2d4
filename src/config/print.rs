//! The effective configuration as it is shown: every value with its source, no secret.

use serde_json::{Map, Value, json};

use super::load::{Loaded, Source};
use super::secrets::{SECRETS, file_key, is_hidden};

/// What is shown of a value.
enum Shown {
    Value(Value),
    /// It is set, and not for other eyes.
    Hidden,
    /// It came from the file that its namesake names.
    FromFile,
}

/// A key, what is shown of its value, and where that is from.
type Row = (String, Shown, Source);

impl Loaded {
    /// The sections with their keys, what is shown of each value, and its source.
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
            // The secret itself was set by nobody.
            _ if SECRETS.contains(&path) && self.source(&file_key(path)) != Source::Default => Shown::FromFile,
            Value::String(text) if is_hidden(path, text) => Shown::Hidden,
            other => Shown::Value(other.clone()),
        }
    }

    /// The effective configuration as a file that gives the same configuration again, secrets aside; a comment behind
    /// each value says where it is from.
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

    /// The effective configuration: `config` as the file would have it, `sources` the same keys with where each value is
    /// from.
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
    /// The source for programs.
    fn document(&self) -> Value {
        match self {
            Self::Default => json!({ "source": "default" }),
            Self::File(path) => json!({ "source": "file", "path": path.to_string_lossy() }),
            Self::Environment(name) => json!({ "source": "environment", "variable": name }),
            Self::Flag => json!({ "source": "command line" }),
        }
    }
}

/// A source in a comment, which a line break would end.
fn one_line(source: &Source) -> String {
    source.to_string().replace(|c: char| c.is_control(), " ")
}

/// A value as TOML writes it. Its strings are those of JSON, but for one character that TOML wants escaped; numbers beyond its
/// own are read from text.
fn toml(value: &Value) -> String {
    match value {
        Value::String(text) => Value::from(text.as_str()).to_string().replace('\u{7f}', "\\u007f"),
        Value::Number(number) if number.as_u64().is_some_and(|n| i64::try_from(n).is_err()) => format!("\"{number}\""),
        other => other.to_string(),
    }
}
