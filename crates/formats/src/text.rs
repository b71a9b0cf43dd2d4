//! Text headers of PLY, STL and OBJ: one short ASCII line per property of the mesh.

use std::fmt::Write;

use molmesh_surface::Mesh;
use serde_json::Value;

use super::{GENERATOR, Meta, Units};

/// Maximum length of a line, characters: PLY readers have line buffers of 256 or more.
const MAX_CHARS: usize = 200;

/// Name in the header of a mesh without a name.
const NAMELESS: &str = "surface";

/// Returns `text` as one line of printable ASCII: control characters become spaces, other characters JSON's `\u`
/// escapes.
pub(super) fn one_line(text: &str) -> String {
    let mut line = String::with_capacity(text.len());
    for c in text.trim().chars() {
        match c {
            ' '..='~' => line.push(c),
            _ if c.is_control() => line.push(' '),
            _ => c.encode_utf16(&mut [0; 2]).iter().for_each(|unit| {
                // Writing to a string cannot fail.
                write!(line, "\\u{unit:04x}").unwrap_or_default();
            }),
        }
        if line.len() >= MAX_CHARS {
            line.truncate(MAX_CHARS);
            break;
        }
    }
    line
}

/// Returns the name of a mesh or of a part as one word.
pub(super) fn word(name: Option<&str>) -> String {
    let name = one_line(name.unwrap_or_default()).replace(' ', "_");
    if name.is_empty() { NAMELESS.to_owned() } else { name }
}

/// Returns the lines: generator, name, units, centre in these units, and every scalar of `meta.extras`. `precision`
/// describes the rounding of the numbers in the file, if any.
pub(super) fn facts(mesh: &Mesh, meta: &Meta, units: Units, precision: Option<&str>) -> Vec<String> {
    let [x, y, z] = mesh.centre.map(|v| v * units.scale());
    let mut facts = vec![format!("generator {GENERATOR}")];
    if let Some(name) = &meta.name {
        facts.push(one_line(&format!("name {name}")));
    }
    facts.push(format!("units {}", units.name()));
    facts.extend(precision.map(|p| format!("precision {p}")));
    facts.push(format!("centre {x} {y} {z} (already in the coordinates)"));
    for (key, value) in &meta.extras {
        match value {
            Value::String(text) => facts.push(one_line(&format!("{key} {}", text.replace('Å', "angstrom")))),
            Value::Bool(_) | Value::Number(_) => facts.push(one_line(&format!("{key} {value}"))),
            // Lists and maps are written to glTF only.
            Value::Null | Value::Array(_) | Value::Object(_) => {}
        }
    }
    facts
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_from_a_file_cannot_break_out_of_its_line() {
        assert_eq!(one_line(" a\r\nend_header\u{7f}b "), "a  end_header b");
        assert_eq!(one_line("2.0 Å"), "2.0 \\u00c5");
        assert_eq!(one_line("🧬"), "\\ud83e\\uddec");
        assert_eq!(one_line(&"Å".repeat(1000)).len(), MAX_CHARS);
    }

    #[test]
    fn names_are_one_word() {
        let named = |name: &str| word(Some(name));
        assert_eq!(named("my\tprotein 1"), "my_protein_1");
        assert_eq!(named(" \n"), "surface");
        assert_eq!(word(None), "surface");
    }

    #[test]
    fn facts_hold_plain_extras_only() {
        let Value::Object(extras) =
            serde_json::json!({"radii": "2.0 Å", "atoms": 3, "closed": true, "list": [1], "none": null})
        else {
            unreachable!()
        };
        let mesh = Mesh { centre: [1.5, -2.0, 0.0], ..Mesh::default() };
        let facts = facts(&mesh, &Meta { name: Some("4PTI".into()), extras }, Units::Angstrom, None);
        assert_eq!(
            facts[1..],
            [
                "name 4PTI",
                "units angstrom",
                "centre 1.5 -2 0 (already in the coordinates)",
                "radii 2.0 angstrom",
                "atoms 3",
                "closed true"
            ]
        );
    }
}
