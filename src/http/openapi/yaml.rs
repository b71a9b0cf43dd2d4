//! OpenAPI document as YAML. A list or mapping is on one line if it fits, so that a property, a parameter or a response
//! takes one line and the document has little indentation.

use serde_json::Value;
use yaml_serde::Error;

/// Maximum width of a line with a list or mapping. Texts are not wrapped.
const WIDTH: usize = 160;

/// Serializes a document as YAML that version 1.1 reads as 1.2 does.
pub(super) fn to_yaml(document: &Value) -> Result<String, Error> {
    let mut out = String::new();
    write_block(document, 0, &mut out)?;
    Ok(out)
}

/// Writes each member of a list or mapping on lines of its own.
fn write_block(value: &Value, indent: usize, out: &mut String) -> Result<(), Error> {
    let margin = " ".repeat(indent);
    match value {
        Value::Object(members) => {
            for (name, value) in members {
                let name = format!("{margin}{}:", scalar(&name.as_str().into())?);
                let n_columns = name.chars().count();
                out.push_str(&name);
                // Items are as far to the right as the name of their list.
                let nested = if value.is_array() { indent } else { indent + 2 };
                write_member(value, nested, n_columns, out)?;
            }
        }
        Value::Array(items) => {
            for item in items {
                out.push_str(&margin);
                out.push('-');
                write_member(item, indent + 2, indent + 1, out)?;
            }
        }
        _ => {}
    }
    Ok(())
}

/// Writes a value after a name or dash that ends in column `n_columns`.
fn write_member(value: &Value, indent: usize, n_columns: usize, out: &mut String) -> Result<(), Error> {
    let is_nested = value.is_object() || value.is_array();
    if !is_nested {
        // The lines of a text are indented by two columns.
        let text = scalar(value)?.replace('\n', &format!("\n{}", " ".repeat(indent - 2)));
        out.extend([" ", &text.lines().map(str::trim_end).collect::<Vec<_>>().join("\n"), "\n"]);
    } else if let Some(line) = one_line(value)?.filter(|line| n_columns + 1 + line.chars().count() <= WIDTH) {
        out.extend([" ", &line, "\n"]);
    } else {
        out.push('\n');
        write_block(value, indent, out)?;
    }
    Ok(())
}

/// Returns a value on one line, or `None` if it has a text of several lines.
fn one_line(value: &Value) -> Result<Option<String>, Error> {
    let join = |all: Option<Result<Vec<String>, Error>>, [open, close]: [&str; 2]| {
        Ok(all.transpose()?.map(|all| format!("{open}{}{close}", all.join(", "))))
    };
    match value {
        Value::Object(members) => {
            let member = |(name, value): (&String, &Value)| {
                let name = one_line(&name.as_str().into())?;
                Ok::<_, Error>(name.zip(one_line(value)?).map(|(name, value)| format!("{name}: {value}")))
            };
            join(members.iter().map(member).map(Result::transpose).collect(), ["{", "}"])
        }
        Value::Array(items) => join(items.iter().map(one_line).map(Result::transpose).collect(), ["[", "]"]),
        _ => {
            let text = scalar(value)?;
            let is_quoted = text.starts_with(['\'', '"']);
            let has_indicator = text.contains([',', '[', ']', '{', '}', '?']);
            Ok((!text.contains('\n')).then(|| if has_indicator && !is_quoted { value.to_string() } else { text }))
        }
    }
}

/// Returns a scalar. Floats in exponent notation get a point and a sign (`1.0e-6`; version 1.1 reads `1e-6` as a text),
/// and times get quotes.
fn scalar(value: &Value) -> Result<String, Error> {
    let text = yaml_serde::to_string(value)?.trim_end().to_owned();
    if value.is_string() {
        let is_time = text.len() >= 20 && text.starts_with(|c: char| c.is_ascii_digit()) && text.ends_with('Z');
        return Ok(if is_time { format!("'{text}'") } else { text });
    }
    let Some((digits, exponent)) = text.split_once('e').filter(|_| value.is_number()) else { return Ok(text) };
    let point = if digits.contains('.') { "" } else { ".0" };
    let sign = if exponent.starts_with(['-', '+']) { "" } else { "+" };
    Ok(format!("{digits}{point}e{sign}{exponent}"))
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn yaml_1_1_reads_floats_and_times() {
        let document = json!({ "a": 1e-6, "b": [1e20, 1.5e-7, 0.5, 3], "c": "at 1e-6", "d": "2030-01-01T12:00:00Z" });
        let expected = "a: 1.0e-6\nb: [1.0e+20, 1.5e-7, 0.5, 3]\nc: at 1e-6\nd: '2030-01-01T12:00:00Z'\n";
        assert_eq!(to_yaml(&document).unwrap(), expected);
    }

    #[test]
    fn lists_and_mappings_are_on_one_line_if_they_fit() {
        let long = "word ".repeat(40).trim_end().to_owned();
        let document = json!({
            "short": { "type": ["string", "null"], "200": { "$ref": "#/a" } },
            "text": { "doc": "first\n\nsecond", "enum": ["a, b", "c: d", "why?"] },
            "long": [{ "doc": long, "list": [] }, { "$ref": "#/b" }],
        });
        let expected = format!(
            "short: {{type: [string, 'null'], '200': {{$ref: '#/a'}}}}\ntext:\n  doc: |-\n    first\n\n    second\n  \
             enum: [\"a, b\", 'c: d', \"why?\"]\nlong:\n-\n  doc: {long}\n  list: []\n- {{$ref: '#/b'}}\n"
        );
        let yaml = to_yaml(&document).unwrap();
        assert_eq!(yaml, expected);
        assert_eq!(yaml_serde::from_str::<Value>(&yaml).unwrap(), document);
    }
}
