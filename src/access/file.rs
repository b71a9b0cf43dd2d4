//! Key file: TOML with one `[[key]]` table per key. Errors name the line but do not quote values, because the text of a
//! key may have been written in place of its hash.

use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;

use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::account::{Quota, WINDOW_S};
use super::error::KeyFileError;
use super::keys::{Key, KeyRing, Scope};
use super::token;
use crate::pipeline::nearest::nearest;

/// Fields of a key.
const NAMES: [&str; 10] =
    ["id", "group", "hash", "scopes", "requests", "work_s", "concurrent", "window_s", "expires", "note"];

type Field<'a> = (Range<usize>, &'a DeValue<'a>);

/// Parses a key file.
pub(crate) fn parse(text: &str) -> Result<KeyRing, KeyFileError> {
    let wrong = |span: Range<usize>, reason: String| KeyFileError { line: line_of(text, span.start), reason };
    let table = DeTable::parse(text).map_err(|e| wrong(e.span().unwrap_or_default(), e.message().to_owned()))?;
    let mut keys = BTreeMap::new();
    for (name, value) in table.get_ref() {
        if name.get_ref() != "key" {
            return Err(wrong(name.span(), unknown(name.get_ref(), ["key"])));
        }
        let entries = value.get_ref().as_array().ok_or_else(|| wrong(name.span(), "expected [[key]]".to_owned()))?;
        for entry in entries {
            let fields =
                entry.get_ref().as_table().ok_or_else(|| wrong(entry.span(), "expected [[key]]".to_owned()))?;
            let key = key(fields, entry.span()).map_err(|(span, reason)| wrong(span, reason))?;
            let (span, id) = (entry.span(), key.id.clone());
            if keys.insert(id.clone(), Arc::new(key)).is_some() {
                return Err(wrong(span, format!("duplicate key `{id}`")));
            }
        }
    }
    Ok(KeyRing(keys))
}

/// Span and cause of an error.
type SpannedError = (Range<usize>, String);

fn key(fields: &DeTable<'_>, span_of_key: Range<usize>) -> Result<Key, SpannedError> {
    for name in fields.keys() {
        if !NAMES.contains(&&**name.get_ref()) {
            return Err((name.span(), unknown(name.get_ref(), NAMES)));
        }
    }
    let get = |name: &str| -> Option<Field<'_>> {
        fields.iter().find(|(n, _)| n.get_ref() == name).map(|(_, value)| (value.span(), value.get_ref()))
    };
    let text = |name: &str| text(name, get(name));
    let required = |name: &str| -> Result<(Range<usize>, &str), SpannedError> {
        text(name)?.ok_or_else(|| (span_of_key.clone(), format!("the key has no `{name}`")))
    };
    let count = |name: &str| count(name, get(name));
    let (span, id) = required("id")?;
    if !token::is_id(id) {
        return Err((span, "`id`: expected 1 to 32 lower-case letters, digits and hyphens".to_owned()));
    }
    let group = match text("group")? {
        Some((span, group)) if !token::is_id(group) => {
            return Err((span, "`group`: expected 1 to 32 lower-case letters, digits and hyphens".to_owned()));
        }
        Some((_, group)) => group,
        None => id,
    };
    let (span, hash) = required("hash")?;
    let hash = hash.parse().map_err(|expected| (span, format!("`hash`: expected {expected}")))?;
    let scopes = get("scopes").ok_or_else(|| (span_of_key.clone(), "the key has no `scopes`".to_owned()))?;
    let expires = text("expires")?.map(|(span, time)| {
        let expected = "`expires`: expected a time such as \"2030-01-31T00:00:00Z\"";
        humantime::parse_rfc3339(time).map_err(|_other| (span, expected.to_owned()))
    });
    let quota = Quota {
        requests: count("requests")?,
        work_s: count("work_s")?,
        concurrent: count("concurrent")?,
        window_s: count("window_s")?.unwrap_or(WINDOW_S),
    };
    Ok(Key {
        id: id.to_owned(),
        group: group.to_owned(),
        hash,
        scopes: self::scopes(scopes)?,
        quota: Arc::new(quota),
        expires: expires.transpose()?,
        note: text("note")?.map(|(_, note)| note.to_owned()),
    })
}

fn text<'a>(name: &str, field: Option<Field<'a>>) -> Result<Option<(Range<usize>, &'a str)>, SpannedError> {
    let Some((span, value)) = field else { return Ok(None) };
    match value.as_str() {
        Some(text) => Ok(Some((span, text))),
        None => Err((span, format!("`{name}`: expected a string"))),
    }
}

fn count(name: &str, field: Option<Field<'_>>) -> Result<Option<u64>, SpannedError> {
    let Some((span, value)) = field else { return Ok(None) };
    let number = value.as_integer().and_then(|n| u64::from_str_radix(&n.as_str().replace('_', ""), n.radix()).ok());
    match number.filter(|number| *number >= 1) {
        Some(number) => Ok(Some(number)),
        None => Err((span, format!("`{name}`: expected a positive integer"))),
    }
}

fn scopes((span, value): Field<'_>) -> Result<Vec<Scope>, SpannedError> {
    let expected = || format!("`scopes`: expected a list of {}", quoted(Scope::ALL.map(Scope::name)));
    let items = value.as_array().filter(|items| items.iter().next().is_some());
    let items = items.ok_or_else(|| (span.clone(), expected()))?;
    let scope = |item: &Spanned<DeValue<'_>>| {
        let name = item.get_ref().as_str().ok_or_else(|| (item.span(), expected()))?;
        Scope::named(name).ok_or_else(|| (item.span(), unknown(name, Scope::ALL.map(Scope::name))))
    };
    items.iter().map(scope).collect()
}

/// Formats names for a message.
fn quoted<const N: usize>(names: [&str; N]) -> String {
    names.map(|name| format!("`{name}`")).join(", ")
}

fn unknown<const N: usize>(name: &str, known: [&str; N]) -> String {
    let shown: String = name.chars().take(MAX_SHOWN).collect();
    let nearest = nearest(name, known).map(|nearest| format!("; did you mean `{nearest}`?"));
    format!("unknown name `{shown}`{}", nearest.unwrap_or_else(|| format!("; expected one of {}", quoted(known))))
}

/// Maximum number of characters of an unknown name in a message.
const MAX_SHOWN: usize = 32;

/// Returns the line number of a byte offset, from 1.
fn line_of(text: &str, offset: usize) -> usize {
    text.bytes().take(offset).filter(|b| *b == b'\n').count() + 1
}

/// Formats a key as a `[[key]]` table.
#[must_use]
pub fn format_key(key: &Key) -> String {
    // TOML accepts all escapes of JSON. DEL, which only JSON allows unescaped, is removed.
    let quote = |text: &str| serde_json::Value::from(text.replace('\u{7f}', "")).to_string();
    let scopes: Vec<String> = key.scopes.iter().map(|scope| quote(scope.name())).collect();
    let group = if key.group == key.id { String::new() } else { format!("group = {}\n", quote(&key.group)) };
    let (id, hash, scopes) = (quote(&key.id), &key.hash, scopes.join(", "));
    let mut lines = format!("[[key]]\nid = {id}\n{group}hash = \"{hash}\"\nscopes = [{scopes}]\n");
    let counts = [
        ("requests", key.quota.requests),
        ("work_s", key.quota.work_s),
        ("concurrent", key.quota.concurrent),
        ("window_s", Some(key.quota.window_s).filter(|_| !key.quota.is_unlimited())),
    ];
    let counts = counts.into_iter().filter_map(|(name, count)| Some((name, count?.to_string())));
    let expires = key.expires.map(|time| ("expires", quote(&humantime::format_rfc3339_seconds(time).to_string())));
    let note = key.note.as_deref().map(|note| ("note", quote(note)));
    for (name, value) in counts.chain(expires).chain(note) {
        lines.extend([name, " = ", &value, "\n"]);
    }
    lines
}

#[cfg(test)]
mod tests {
    use std::time::{Duration, SystemTime};

    use super::*;

    #[test]
    fn formatted_keys_parse_back() {
        let hash = token::Hash::of("x");
        let quota = Quota { requests: Some(1000), work_s: Some(60), concurrent: Some(4), window_s: 3600 };
        let expires = Some(SystemTime::UNIX_EPOCH + Duration::from_secs(1_900_000_000));
        let note = Some("the \"viewer\" of\nlab 3".to_owned());
        let full = Key {
            id: "a-1".into(),
            group: "lab".into(),
            hash,
            scopes: Scope::ALL.into(),
            quota: Arc::new(quota),
            expires,
            note,
        };
        let plain = Key {
            id: "b".into(),
            group: "b".into(),
            scopes: vec![Scope::Read],
            quota: Arc::new(Quota { window_s: WINDOW_S, ..Quota::default() }),
            expires: None,
            note: None,
            ..full.clone()
        };
        let text = format!("# keys\n{}\n{}", format_key(&full), format_key(&plain));
        let ring = parse(&text).unwrap_or_else(|e| panic!("{e}\n{text}"));
        assert_eq!(ring.0.len(), 2);
        for key in [&full, &plain] {
            let read = &ring.0[&key.id];
            assert!(read.hash.same(&key.hash) && read.group == key.group);
            assert_eq!(
                (&read.scopes, &read.quota, &read.expires, &read.note),
                (&key.scopes, &key.quota, &key.expires, &key.note)
            );
        }
        assert!(
            !format_key(&plain).contains("group")
                && !format_key(&plain).contains("window_s")
                && parse("").unwrap().0.is_empty()
        );
    }

    #[test]
    fn errors_name_the_line_and_a_similar_name() {
        let hash = token::Hash::of("x");
        let good = format!("[[key]]\nid = \"a\"\nhash = \"{hash}\"\nscopes = [\"read\"]\n");
        for (change, line, reason) in [
            (("scopes = ", "scope = "), 4, "did you mean `scopes`?"),
            (("[[key]]", "[[keys]]"), 1, "did you mean `key`?"),
            (("[[key]]", "[key]"), 1, "expected [[key]]"),
            (("\"read\"", "\"raed\""), 4, "did you mean `read`?"),
            (("\"read\"", "\"admin\""), 4, "expected one of `mesh`, `read`"),
            (("[\"read\"]", "\"read\""), 4, "expected a list of"),
            (("[\"read\"]", "[]"), 4, "expected a list of"),
            (("[\"read\"]", "[1]"), 4, "expected a list of"),
            (("scopes = [\"read\"]", ""), 1, "has no `scopes`"),
            (("id = \"a\"", "id = \"A B\""), 2, "`id`: expected"),
            (("id = \"a\"", "id = \"a\"\ngroup = \"A B\""), 3, "`group`: expected"),
            (("id = \"a\"", "id = 3"), 2, "`id`: expected a string"),
            (("sha256:", "mm_a_"), 3, "`hash`: expected"),
            (("id = \"a\"", "id = \"a\"\nrequests = 0"), 3, "`requests`: expected a positive integer"),
            (("id = \"a\"", "id = \"a\"\nwork_s = 1.5"), 3, "`work_s`: expected a positive integer"),
            (("id = \"a\"", "id = \"a\"\nexpires = \"soon\""), 3, "`expires`: expected a time"),
            (("id = \"a\"", "id = \"a\"\nexpires = 2030-01-01"), 3, "`expires`: expected a string"),
            (("id = \"a\"", "id = \"a\"\nid = \"b\""), 3, "duplicate"),
            (("id = \"a\"", "id = "), 2, ""),
        ] {
            let text = good.replace(change.0, change.1);
            assert_ne!(text, good, "{change:?}");
            let error = parse(&text).map(|ring| ring.0.len()).unwrap_err();
            assert_eq!(error.line, line, "{error}\n{text}");
            assert!(error.reason.contains(reason), "{error}\n{text}");
            assert!(!error.reason.contains(&hash.to_string()[20..]), "{error}");
        }
        assert_eq!(
            parse(&format!("{good}{good}")).unwrap_err(),
            KeyFileError { line: 5, reason: "duplicate key `a`".into() }
        );
        assert!(parse(&good).is_ok());
    }
}
