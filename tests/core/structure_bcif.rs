//! BinaryCIF: encodings compared with arrays computed by hand, columns compared with the same values in text, and
//! inconsistent files.
#![allow(clippy::pedantic, reason = "tests fail by panicking")]

use crate::bcif_support;

use bcif_support::Pack::{Array, Bytes, Int, Map, Nil, Real};
use bcif_support::*;
use molmesh::structure::{Kind, ReadLimits, Structure, read, strict_validator};
use molmesh::surface::{Control, Exceeded, Limit};

fn bcif(bytes: &[u8]) -> Structure {
    read(bytes, &ReadLimits::default()).unwrap_or_else(|e| panic!("{e}"))
}

fn refusal(bytes: &[u8]) -> String {
    read(bytes, &ReadLimits::default()).expect_err("a refusal").to_string()
}

// ---- encodings ----

/// Description, data, encodings, and expected values.
type Case<T> = (&'static str, Vec<u8>, Vec<Pack>, Vec<T>);

#[test]
fn decodes_integers_of_every_encoding() {
    let cases: Vec<Case<i32>> = vec![
        ("Int8", vec![0xFF, 0x80, 0x7F], vec![byte_array(1)], vec![-1, -128, 127]),
        ("Int16", i16s(&[-2, 300, -32768]), vec![byte_array(2)], vec![-2, 300, -32768]),
        ("Int32", i32s(&[-3, 70_000, i32::MIN]), vec![byte_array(3)], vec![-3, 70_000, i32::MIN]),
        ("Uint8", vec![0xFF, 0x80, 0], vec![byte_array(4)], vec![255, 128, 0]),
        ("Uint16", i16s(&[-1, 1, 256]), vec![byte_array(5)], vec![65_535, 1, 256]),
        ("Uint32", i32s(&[i32::MAX, 0, 9]), vec![byte_array(6)], vec![i32::MAX, 0, 9]),
        // Examples of the specification.
        ("Delta", i32s(&[0, 3, 2, 1]), vec![delta(1000), byte_array(3)], vec![1000, 1003, 1005, 1006]),
        ("RunLength", i32s(&[1, 3, 2, 1, 3, 2]), vec![run_length(6), byte_array(3)], vec![1, 1, 1, 2, 3, 3]),
        (
            "IntegerPacking, signed",
            vec![1, 2, 0xFD, 127, 1],
            vec![packing(1, false, 4), byte_array(1)],
            vec![1, 2, -3, 128],
        ),
        // A limit value is always followed by the remainder, even if that is 0.
        (
            "IntegerPacking, limits",
            vec![127, 0, 0x80, 0, 0x80, 0xFF, 127, 127, 5, 0x80, 0x80, 0x80, 0xFE],
            vec![packing(1, false, 5), byte_array(1)],
            vec![127, -128, -129, 259, -386],
        ),
        (
            "IntegerPacking, unsigned",
            vec![255, 0, 254, 255, 255, 1, 0],
            vec![packing(1, true, 4), byte_array(4)],
            vec![255, 254, 511, 0],
        ),
        (
            "IntegerPacking, two bytes",
            i16s(&[32767, 1, -32768, -1, -5]),
            vec![packing(2, false, 3), byte_array(2)],
            vec![32768, -32769, -5],
        ),
        (
            "IntegerPacking, two bytes unsigned",
            i16s(&[-1, -1, 1, 7]),
            vec![packing(2, true, 2), byte_array(5)],
            vec![131_071, 7],
        ),
        (
            "Delta, RunLength, IntegerPacking",
            vec![1, 4, 0, 2, 127, 73, 1],
            vec![delta(9), run_length(7), packing(1, false, 6), byte_array(1)],
            vec![10, 11, 12, 13, 13, 13, 213],
        ),
    ];
    for (name, data, chain, expected) in cases {
        let n = expected.len();
        let s = bcif(&atoms(n, vec![column("auth_seq_id", data.clone(), chain.clone())]));
        assert_eq!(s.residue_number, expected, "{name}");
        // Control: one byte more or less yields another array or an error.
        for changed in [&data[..data.len() - 1], &[&data[..], &[1]].concat()] {
            let other =
                read(&atoms(n, vec![column("auth_seq_id", changed.to_vec(), chain.clone())]), &ReadLimits::default());
            assert!(other.is_err(), "{name}: {} bytes", changed.len());
        }
    }
}

#[test]
fn decodes_real_numbers_of_every_encoding() {
    let floats = |values: &[f32]| values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
    let doubles = |values: &[f64]| values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
    let cases: Vec<Case<f64>> = vec![
        ("Float32", floats(&[0.1, -2.5]), vec![byte_array(32)], vec![f64::from(0.1_f32), -2.5]),
        ("Float64", doubles(&[0.1, 1e-300]), vec![byte_array(33)], vec![0.1, 1e-300]),
        // Bit-identical to the text.
        (
            "FixedPoint",
            i32s(&[120, 123, -99_999_999]),
            vec![fixed_point(100.0), byte_array(3)],
            vec![1.2, 1.23, -999_999.99],
        ),
        (
            "FixedPoint, Delta, IntegerPacking",
            i16s(&[11_104, -4_970, 0]),
            vec![fixed_point(1000.0), delta(0), packing(2, false, 3), byte_array(2)],
            vec![11.104, 6.134, 6.134],
        ),
        // The specification's own example.
        (
            "IntervalQuantization",
            i32s(&[0, 0, 1, 2, 1, 0]),
            vec![interval(1.0, 2.0, 3), byte_array(3)],
            vec![1.0, 1.0, 1.5, 2.0, 1.5, 1.0],
        ),
        ("whole numbers", i32s(&[3, -4]), vec![byte_array(3)], vec![3.0, -4.0]),
    ];
    for (name, data, chain, expected) in cases {
        if name == "FixedPoint" {
            // Outside the range of coordinates.
            let s = bcif(&atoms(3, vec![column("B_iso_or_equiv", data, chain)]));
            assert_eq!(s.b_factor, expected.iter().map(|&v| v as f32).collect::<Vec<_>>(), "{name}");
        } else {
            let s = bcif(&atoms(expected.len(), vec![column("Cartn_x", data, chain)]));
            assert_eq!(s.x, expected, "{name}");
        }
    }
    // Binary files may store numbers as text.
    let s = bcif(&atoms(2, vec![texts("Cartn_x", &["1.234(5)", "-7"]), texts("auth_seq_id", &["-3", "12"])]));
    assert_eq!((s.x, s.residue_number), (vec![1.234, -7.0], vec![-3, 12]));
}

#[test]
fn decodes_texts() {
    // Example of the specification: a, AB, a.
    let chain = vec![string_array("aAB", &[0, 1, 3], vec![byte_array(4)])];
    let s = bcif(&atoms(3, vec![column("auth_asym_id", vec![0, 1, 0], chain)]));
    assert_eq!((0..3).map(|i| s.chain.get(i)).collect::<Vec<_>>(), ["a", "AB", "a"]);
    // Text ids are encoded too. -1 means no value. Unused texts are allowed.
    let chain = vec![string_array("XYZ", &[0, 1, 2, 3], vec![run_length(5), byte_array(3)])];
    let s = bcif(&atoms(5, vec![column("label_atom_id", i32s(&[2, 2, -1, 1, 0, 2]), chain)]));
    assert_eq!((0..5).map(|i| s.name.get(i)).collect::<Vec<_>>(), ["Z", "Z", "", "X", "X"]);
    // Offsets count UTF-16 code units, not bytes.
    let s = bcif(&atoms(3, vec![texts("auth_asym_id", &["é€", "𝄞A", "B"])]));
    assert_eq!((0..3).map(|i| s.chain.get(i)).collect::<Vec<_>>(), ["é€", "𝄞A", "B"]);
    // Integers in text columns are converted to text.
    let s = bcif(&atoms(4, vec![ints("auth_asym_id", &[7, 7, -12, 7])]));
    assert_eq!((0..4).map(|i| s.chain.get(i)).collect::<Vec<_>>(), ["7", "7", "-12", "7"]);
}

// ---- meaning ----

/// Writes a table of `atom_site` as text and as BinaryCIF. `?` and `.` become masks.
fn both(items: &[&str], rows: &[&[&str]]) -> (String, Vec<u8>) {
    let tags: String = items.iter().map(|item| format!("_atom_site.{item}\n")).collect();
    let lines: String = rows.iter().map(|row| row.join(" ") + "\n").collect();
    let columns = items.iter().enumerate().map(|(c, item)| {
        let values: Vec<&str> = rows.iter().map(|row| row[c]).collect();
        let mask: Vec<u8> = values.iter().map(|v| u8::from(*v == ".") + 2 * u8::from(*v == "?")).collect();
        let bare: Vec<&str> =
            values.iter().map(|v| v.strip_prefix('\'').map_or(*v, |v| v.trim_end_matches('\''))).collect();
        let column = match *item {
            "Cartn_x" | "Cartn_y" | "Cartn_z" | "occupancy" | "B_iso_or_equiv" => {
                reals(item, &bare.iter().map(|v| v.parse().unwrap_or(f64::NAN)).collect::<Vec<_>>())
            }
            "auth_seq_id" | "label_seq_id" | "pdbx_PDB_model_num" => {
                ints(item, &bare.iter().map(|v| v.parse().unwrap_or(-7)).collect::<Vec<_>>())
            }
            _ => texts(item, &bare),
        };
        if mask.iter().any(|&m| m != 0) { masked(column, &mask) } else { column }
    });
    let site = category("_atom_site", rows.len() as i64, columns.collect());
    let entry = category("_entry", 1, vec![texts("id", &["1abc"])]);
    let title = category("_struct", 1, vec![texts("title", &["A  title"])]);
    let text = format!("data_1ABC\n_entry.id 1abc\n_struct.title 'A  title'\nloop_\n{tags}{lines}");
    (text, file(vec![block("1ABC", vec![entry, site, title])]))
}

const ITEMS: [&str; 19] = [
    "group_PDB",
    "type_symbol",
    "label_atom_id",
    "auth_atom_id",
    "label_alt_id",
    "label_comp_id",
    "auth_comp_id",
    "label_asym_id",
    "auth_asym_id",
    "label_seq_id",
    "auth_seq_id",
    "pdbx_PDB_ins_code",
    "Cartn_x",
    "Cartn_y",
    "Cartn_z",
    "occupancy",
    "B_iso_or_equiv",
    "pdbx_PDB_model_num",
    "pdbx_formal_charge",
];

#[test]
fn columns_have_the_same_meaning_as_in_text() {
    let rows: [&[&str]; 6] = [
        &[
            "HETATM", "C", "C1", "C1'", "A", "LIG", "LIG", "AA", "Bb", "12", "-3", "C", "11.104", "-6.134", "0.5",
            "0.5", "20.25", "2", "?",
        ],
        &["ATOM", "?", "CA", "?", ".", "ALA", "?", "B", "?", "7", "?", "?", "1.0", "2.0", "3.0", "?", ".", "2", "1"],
        &[
            "ATOM", "ZN2+", "ZN", "ZN", ".", "ZN", "ZN", "C", "Z", ".", "401", ".", "4.0", "5.0", "6.0", "1.0", "0.0",
            "?", "?",
        ],
        &[
            "?", "D", "D1", "D1", "B", "DOD", "DOD", "?", "W", "?", "?", "'   '", "-1.0", "-2.0", "-3.0", "0.25",
            "-1.0", "1", "?",
        ],
        &[
            "HETATM", "Xx", "CA", "CA", "?", "CA", "CA", "D", ".", "?", "9", "A", "7.0", "8.0", "9.0", "1.0", "3.5",
            "1", ".",
        ],
        &[
            "ATOM",
            "SE",
            "SE",
            "SE",
            "?",
            "MSE",
            "?",
            "E",
            "?",
            "3",
            "2147483647",
            "?",
            "99999.0",
            "-99999.0",
            "0.0",
            "1.0",
            "3.5",
            "-1",
            ".",
        ],
    ];
    // Whole tables, and tables without some of their columns.
    for left_out in [
        &[][..],
        &["auth_atom_id", "auth_seq_id", "type_symbol"],
        &["label_asym_id", "label_seq_id", "group_PDB"],
        &["auth_asym_id", "auth_comp_id", "occupancy", "label_alt_id"],
        &["pdbx_PDB_model_num", "pdbx_PDB_ins_code", "B_iso_or_equiv"],
    ] {
        let kept: Vec<usize> = (0..ITEMS.len()).filter(|&i| !left_out.contains(&ITEMS[i])).collect();
        let items: Vec<&str> = kept.iter().map(|&i| ITEMS[i]).collect();
        let rows: Vec<Vec<&str>> = rows.iter().map(|row| kept.iter().map(|&i| row[i]).collect()).collect();
        let (text, binary) = both(&items, &rows.iter().map(Vec::as_slice).collect::<Vec<_>>());
        let (from_text, from_binary) = (bcif(text.as_bytes()), bcif(&binary));
        assert_eq!((from_text.format.name(), from_binary.format.name()), ("mmcif", "bcif"));
        assert_eq!(anonymous(&from_text), anonymous(&from_binary), "without {left_out:?}");
        // Control: a changed value is detected.
        let (other, _) = both(&items, &rows[1..].iter().map(Vec::as_slice).collect::<Vec<_>>());
        assert_ne!(anonymous(&from_text), anonymous(&bcif(other.as_bytes())));
    }
}

#[test]
fn rejects_the_same_values_as_text_with_the_same_message() {
    let good = [
        "HETATM", "C", "C1", "C1'", "A", "LIG", "LIG", "AA", "Bb", "12", "-3", "C", "11.104", "-6.134", "0.5", "0.5",
        "20.25", "2", "?",
    ];
    let bad = [("Cartn_y", "?", "Cartn_y in Å, within ±100000"), ("Cartn_z", "1e30", "Cartn_z in Å, within ±100000")];
    for (item, value, expected) in bad {
        let mut row = good;
        row[ITEMS.iter().position(|i| *i == item).unwrap()] = value;
        let (text, binary) = both(&ITEMS, &[&good, &row]);
        assert!(refusal(text.as_bytes()).ends_with(&format!("expected {expected}")), "{}", refusal(text.as_bytes()));
        let said = refusal(&binary);
        assert!(said.starts_with(&format!("BinaryCIF, atom_site, {item}, row 2: found ")), "{said}");
        assert!(said.ends_with(&format!("expected {expected}")), "{said}");
    }
    let long = "X".repeat(256);
    for (column, place) in [
        (texts("auth_asym_id", &["A", &long]), "auth_asym_id, row 2: found `XXX"),
        (texts("pdbx_PDB_model_num", &["1", "1e400"]), "pdbx_PDB_model_num, row 2: found `1e400`, expected a model"),
        (texts("pdbx_PDB_model_num", &["1", ""]), "pdbx_PDB_model_num, row 2: found nothing, expected a model number"),
        (reals("Cartn_x", &[0.0, f64::NAN]), "Cartn_x, row 2: found NaN, expected Cartn_x in Å"),
        (reals("Cartn_x", &[f64::INFINITY, f64::NAN]), "Cartn_x, row 1: found inf, expected Cartn_x in Å"),
    ] {
        let said = refusal(&atoms(2, vec![column]));
        assert!(said.starts_with(&format!("BinaryCIF, atom_site, {place}")), "{place}: {said}");
    }
}

#[test]
fn unreadable_optional_values_are_warnings() {
    let elements = || texts("type_symbol", &["C", "C"]);
    let warnings = |column: Pack| bcif(&atoms(2, vec![column, elements()])).warnings.join("\n");
    for (column, said) in [
        (reals("occupancy", &[1.0, f64::NAN]), "occupancy, row 2: found NaN, expected an occupancy, ? or .; read as 1"),
        (
            column("B_iso_or_equiv", i32s(&[0, 2]), vec![fixed_point(1e-320), byte_array(3)]),
            "B_iso_or_equiv, row 2: found inf, expected a B-factor, ? or .; read as 0",
        ),
        (
            reals("auth_seq_id", &[1.0, 2.5]),
            "auth_seq_id, row 2: found 2.5, expected a residue number (a whole number), ? or .; read as 0",
        ),
        (texts("group_PDB", &["ATM", "ATOM"]), "group_PDB, row 1: found `ATM`, expected ATOM or HETATM; read as ATOM"),
    ] {
        assert_eq!(warnings(column), format!("BinaryCIF, atom_site, {said}"));
    }
    assert_eq!(warnings(texts("group_PDB", &["ATOM", "HETATM"])), "");
}

#[test]
fn entities_or_sequence_numbers_decide_which_hetatm_records_are_polymer() {
    let site = |numbers: Pack| {
        let group = texts("group_PDB", &["HETATM", "HETATM"]);
        let names = texts("auth_comp_id", &["MSE", "LIG"]);
        let chains = texts("label_asym_id", &["A", "B"]);
        let elements = texts("type_symbol", &["C", "C"]);
        category("_atom_site", 2, [places(2), vec![group, names, chains, numbers, elements]].concat())
    };
    let numbered = || masked(ints("label_seq_id", &[7, 0]), &[0, 1]);
    let entity = |types: &[&str]| category("_entity", 2, vec![ints("id", &[1, 2]), texts("type", types)]);
    let asym = |n| category("_struct_asym", n, vec![texts("id", &["A", "B"]), texts("entity_id", &["1", "2"])]);
    let kinds = |categories: Vec<Pack>| {
        let s = bcif(&file(vec![block("a", categories)]));
        (s.kind, s.warnings.join("\n"))
    };
    let (first, second) = (vec![Kind::Protein, Kind::Ligand], vec![Kind::Ligand, Kind::Polymer]);
    let none = String::new();
    assert_eq!(kinds(vec![site(numbered())]), (first.clone(), none.clone()));
    assert_eq!(
        kinds(vec![site(ints("label_seq_id", &[7, 8]))]),
        (vec![Kind::Ligand; 2], none.clone()),
        "all are numbered"
    );
    // The entities decide, at any place in the file.
    let known = [site(numbered()), entity(&["water", "polymer"]), asym(2)];
    assert_eq!(kinds(known.to_vec()), (second.clone(), none.clone()));
    assert_eq!(kinds(known.into_iter().rev().collect()), (second, none));
    // Unreadable entities do not affect the atoms.
    let (found, warning) = kinds(vec![site(numbered()), entity(&["water", "polymer"]), asym(3)]);
    assert_eq!(found, first);
    assert!(
        warning.starts_with("BinaryCIF, struct_asym, id") && warning.ends_with("entities are unknown"),
        "{warning}"
    );
}

#[test]
fn blocks_categories_and_names() {
    let site = |n: usize| category("_atom_site", n as i64, places(n));
    let entry = |id: &str| category("_entry", 1, vec![texts("id", &[id])]);
    // The first block with atoms; the block name if there is no entry.
    let empty = category("_atom_site", 0, vec![]);
    let two =
        file(vec![block("a", vec![entry("X"), empty.clone()]), block("b", vec![site(3)]), block("c", vec![site(4)])]);
    let s = bcif(&two);
    assert_eq!((s.len(), s.id.as_deref(), s.title), (3, Some("b"), None));
    assert_eq!((s.unread.blocks, s.unread.spheres), (4, 0));
    assert_eq!(s.warnings.last().unwrap(), "only the first data block with atoms is read; left out: `c` (4 atoms)");
    let spheres = category("_ihm_sphere_obj_site", 7, vec![]);
    let s = bcif(&file(vec![block("a", vec![site(3), spheres])]));
    assert_eq!((s.len(), s.unread.blocks, s.unread.spheres), (3, 0, 7));
    // Names in any case, with or without underscore. A masked id counts as missing.
    let lower: Vec<Pack> =
        places(2).into_iter().zip(["CARTN_X", "cartn_y", "Cartn_Z"]).map(|(c, n)| c.with("name", text(n))).collect();
    let hidden = category("_entry", 1, vec![masked(texts("id", &["X"]), &[2])]);
    let s = bcif(&file(vec![block("d", vec![category("Atom_Site", 2, lower), hidden])]));
    assert_eq!((s.len(), s.id.as_deref()), (2, Some("d")));

    let no_z = category("_atom_site", 1, places(1)[..2].to_vec());
    for (blocks, said) in [
        (vec![], "no atoms: BinaryCIF with no named data block and nothing in it"),
        (vec![block("a", vec![])], "no atoms: BinaryCIF with data block a and nothing in it"),
        (
            vec![block("a", vec![entry("X"), category("_cell", 0, vec![])]), block("b", vec![no_z])],
            "no atoms: BinaryCIF with data block b (the last of 2), categories entry, cell, atom_site, atom_site without Cartn_z",
        ),
        (vec![block("a", vec![empty])], "no atoms: BinaryCIF with data block a, categories atom_site"),
    ] {
        assert_eq!(refusal(&file(blocks)), said);
    }
}

#[test]
fn decodes_only_required_columns() {
    // Unused columns, unused fallback columns and other categories may contain anything.
    let broken = |name: &str| column(name, vec![1, 2, 3], vec![text("nonsense")]);
    let site = atoms(2, vec![texts("auth_atom_id", &["A", "B"]), broken("label_atom_id"), broken("Cartn_x_esd")]);
    assert_eq!(bcif(&site).len(), 2);
    // Control: a required fallback is read.
    let hole = masked(texts("auth_atom_id", &["A", "B"]), &[0, 2]);
    let said = refusal(&atoms(2, vec![hole, broken("label_atom_id")]));
    assert_eq!(said, "BinaryCIF, atom_site, label_atom_id, encoding 1: found the text `nonsense`, expected a map");
}

// ---- inconsistent files ----

/// Returns the error for a column of two values, without the category.
fn of_column(column: Pack) -> String {
    let said = refusal(&atoms(2, vec![column]));
    let behind = said.strip_prefix("BinaryCIF, atom_site").unwrap_or_else(|| panic!("{said}"));
    behind.trim_start_matches([',', ':', ' ']).to_owned()
}

#[test]
fn rejects_inconsistent_encodings() {
    let number = |data: &[u8], chain: Vec<Pack>| column("auth_seq_id", data.to_vec(), chain);
    let two = i32s(&[1, 2]);
    let strings = |ids: &[i32], offsets: &[i32]| {
        column("auth_asym_id", i32s(ids), vec![string_array("AB", offsets, vec![byte_array(3)])])
    };
    let nest = string_array("AB", &[0, 1, 2], vec![string_array("AB", &[0, 1, 2], vec![byte_array(3)])]);
    let cases: Vec<(Pack, &str)> = vec![
        (number(&two, vec![]), "auth_seq_id: found no encoding, expected at least ByteArray"),
        (
            number(&two, vec![delta(0)]),
            "auth_seq_id, Delta (encoding 1 of 1): found this encoding at the end of its chain",
        ),
        (
            number(&two, vec![byte_array(3), byte_array(3)]),
            "auth_seq_id, ByteArray (encoding 1 of 2): found this encoding in the middle",
        ),
        (number(&two, vec![byte_array(7)]), "auth_seq_id, encoding 1, ByteArray: found type 7"),
        (number(&two, vec![byte_array(-1)]), "auth_seq_id, encoding 1, `type`: found -1"),
        (number(&two, vec![byte_array(3).without("type")]), "auth_seq_id, encoding 1: found nothing, expected `type`"),
        (number(&two, vec![byte_array(3).without("kind")]), "auth_seq_id, encoding 1: found nothing, expected `kind`"),
        (
            number(&two, vec![byte_array(3).with("kind", text("Huffman"))]),
            "auth_seq_id, encoding 1: found the encoding `Huffman`",
        ),
        (number(&two, vec![byte_array(3); 9]), "auth_seq_id: found more encodings, expected at most 8 in a row"),
        (number(&two[..7], vec![byte_array(3)]), "auth_seq_id, ByteArray (encoding 1 of 1): found 7 bytes"),
        (number(&i32s(&[-1, 2]), vec![byte_array(6)]), "auth_seq_id: found a number of 2³¹ or more"),
        (number(&i32s(&[1, 2, 3]), vec![byte_array(3)]), "auth_seq_id: found 3 values, expected 2, as rowCount says"),
        (number(&i32s(&[1]), vec![byte_array(3)]), "auth_seq_id: found 1 values, expected 2, as rowCount says"),
        (number(&[0; 4000], vec![byte_array(3)]), "auth_seq_id: found 1000 values, expected at most 6"),
        (
            number(&i32s(&[i32::MAX, 1]), vec![delta(1), byte_array(3)]),
            "auth_seq_id, Delta (encoding 1 of 2): found 2147483648",
        ),
        (number(&two, vec![delta(1 << 40), byte_array(3)]), "auth_seq_id, encoding 1, `origin`: found 1099511627776"),
        (number(&two, vec![delta(0), byte_array(32)]), "auth_seq_id, Delta (encoding 1 of 2): found real numbers"),
        (
            number(&two, vec![fixed_point(0.0), byte_array(3)]),
            "auth_seq_id, encoding 1, FixedPoint: found a factor of 0",
        ),
        (number(&two, vec![fixed_point(f64::NAN), byte_array(3)]), "auth_seq_id, encoding 1, `factor`: found NaN"),
        (
            number(&two, vec![fixed_point(10.0), fixed_point(10.0), byte_array(3)]),
            "auth_seq_id, FixedPoint (encoding 1 of 3): found real numbers",
        ),
        (
            number(&two, vec![interval(0.0, 1.0, 1), byte_array(3)]),
            "auth_seq_id, encoding 1, IntervalQuantization: found 1 steps",
        ),
        (
            number(&two, vec![interval(0.0, 1.0, 2), byte_array(3)]),
            "auth_seq_id, IntervalQuantization (encoding 1 of 2): found step 2",
        ),
        (
            number(&two, vec![interval(0.0, f64::INFINITY, 9), byte_array(3)]),
            "auth_seq_id, encoding 1, `max`: found inf",
        ),
        (
            number(&i32s(&[5, 2, 7]), vec![run_length(2), byte_array(3)]),
            "auth_seq_id, RunLength (encoding 1 of 2): found 3 numbers",
        ),
        (
            number(&i32s(&[5, -2]), vec![run_length(2), byte_array(3)]),
            "auth_seq_id, RunLength (encoding 1 of 2): found a run of -2",
        ),
        (
            number(&i32s(&[5, 2]), vec![run_length(3), byte_array(3)]),
            "auth_seq_id, RunLength (encoding 1 of 2): found 2 values, expected 3, as srcSize says",
        ),
        (number(&i32s(&[5, 3]), vec![run_length(3), byte_array(3)]), "auth_seq_id: found 3 values, expected 2"),
        (
            number(&i32s(&[5, i32::MAX]), vec![run_length(i64::from(i32::MAX)), byte_array(3)]),
            "auth_seq_id, RunLength (encoding 1 of 2): found 2147483647 values, expected at most 6",
        ),
        (
            number(&i32s(&[5, i32::MAX].repeat(3)), vec![run_length(2).without("srcSize"), byte_array(3)]),
            "auth_seq_id, RunLength (encoding 1 of 2): found 6442450941 values, expected at most 6",
        ),
        (
            number(&[1, 127], vec![packing(1, false, 2), byte_array(1)]),
            "auth_seq_id, IntegerPacking (encoding 1 of 2): found the end of the data within a value",
        ),
        (
            number(&[1, 2], vec![packing(1, false, 3), byte_array(1)]),
            "auth_seq_id, IntegerPacking (encoding 1 of 2): found 2 values, expected 3",
        ),
        (
            number(&[1, 2], vec![packing(1, true, 2), byte_array(1)]),
            "auth_seq_id, IntegerPacking (encoding 1 of 2): found Int8 in the ByteArray, expected Uint8",
        ),
        (
            number(&[1; 8], vec![packing(4, false, 2), byte_array(3)]),
            "auth_seq_id, encoding 1, IntegerPacking: found a byteCount of 4",
        ),
        (
            number(&[1; 8], vec![packing(1, false, 2).with("isUnsigned", text("no")), byte_array(1)]),
            "auth_seq_id, encoding 1, `isUnsigned`: found the text `no`",
        ),
        (
            number(&i32s(&[1, 2]), vec![packing(1, false, 2), delta(0), byte_array(3)]),
            "auth_seq_id, IntegerPacking (encoding 1 of 3): found another encoding after it",
        ),
        (
            number(&[[0xFF; 4].repeat(40_000), vec![0, 0]].concat(), vec![packing(2, true, 1), byte_array(5)]),
            "auth_seq_id, IntegerPacking (encoding 1 of 2): found 5242800000",
        ),
        (strings(&[0, 2], &[0, 1, 2]), "auth_asym_id, StringArray: found text 2, expected -1 (none) or one of the 2"),
        (strings(&[0, -2], &[0, 1, 2]), "auth_asym_id, StringArray: found text -2"),
        (strings(&[0, 0], &[]), "auth_asym_id, StringArray: found text 0, expected -1 (none) or one of the 0"),
        (
            strings(&[0, 0], &[0, 3]),
            "auth_asym_id, StringArray, offsets: found offset 3, expected one from 0 to the end of 2 bytes",
        ),
        (strings(&[0, 0], &[2, 1]), "auth_asym_id, StringArray, offsets: found offset 1, expected one from 2"),
        (strings(&[0, 0], &[-1, 1]), "auth_asym_id, StringArray, offsets: found offset -1"),
        (strings(&[0, 0, 0], &[0, 1]), "auth_asym_id, StringArray: found 3 values, expected 2"),
        (
            column("auth_asym_id", i32s(&[0, 0]), vec![nest]),
            "auth_asym_id, StringArray, data, StringArray (encoding 1 of 1): found this encoding at the end",
        ),
        (
            column("auth_asym_id", i32s(&[0, 0]), vec![string_array("A", &[0, 1], vec![]), byte_array(3)]),
            "auth_asym_id, StringArray (encoding 1 of 2): found this encoding among others",
        ),
        (reals("auth_asym_id", &[1.0, 2.0]), "auth_asym_id: found real numbers, expected texts"),
        (
            masked(ints("auth_seq_id", &[1, 2]), &[0, 3]),
            "auth_seq_id, mask: found 3, expected 0 (a value), 1 (.) or 2 (?)",
        ),
        (masked(ints("auth_seq_id", &[1, 2]), &[0]), "auth_seq_id, mask: found 1 values, expected 2"),
        (ints("auth_seq_id", &[1, 2]).with("mask", Int(1)), "auth_seq_id, mask: found 1, expected a map"),
        (ints("auth_seq_id", &[1, 2]).with("data", Nil), "auth_seq_id: found nil, expected a map"),
        (ints("auth_seq_id", &[1, 2]).without("data"), "auth_seq_id: found nothing, expected `data`"),
        (
            ints("auth_seq_id", &[1, 2]).with("data", Map(vec![("data", Array(vec![]))])),
            "auth_seq_id, `data`: found an array of 0, expected bytes",
        ),
        (
            ints("auth_seq_id", &[1, 2]).with("data", Map(vec![("data", Bytes(vec![]))])),
            "auth_seq_id: found nothing, expected `encoding`",
        ),
        (ints("auth_seq_id", &[1, 2]).without("name"), "found a column without a name"),
        (ints("CARTN_X", &[1, 2]), "found two columns CARTN_X, expected every column once"),
    ];
    for (column, expected) in cases {
        // Names are case-insensitive, so `atoms` leaves both.
        let said = of_column(column).replace("BinaryCIF, ", "");
        assert!(said.starts_with(expected), "`{said}` is not `{expected}`");
    }
}

#[test]
fn rejects_inconsistent_frames() {
    let site = |rows: Pack| category("_atom_site", 0, places(2)).with("rowCount", rows);
    let one = |category: Pack| file(vec![block("x", vec![category])]);
    let top = |entries: Vec<(&'static str, Pack)>| {
        let mut out = Vec::new();
        Map(entries).write(&mut out);
        out
    };
    for (bytes, expected) in [
        (one(site(Int(-1))), "BinaryCIF, atom_site, rowCount: found -1, expected a number of rows"),
        (one(site(Real(2.5))), "BinaryCIF, atom_site, rowCount: found 2.5"),
        (one(site(text("2"))), "BinaryCIF, atom_site, rowCount: found the text `2`"),
        (one(site(Int(3))), "BinaryCIF, atom_site, Cartn_x: found 2 values, expected 3"),
        (one(site(Int(2)).without("rowCount")), "BinaryCIF, atom_site: found nothing, expected `rowCount`"),
        (one(site(Int(2)).without("columns")), "BinaryCIF, atom_site: found nothing, expected `columns`"),
        (one(site(Int(2)).with("columns", Int(1))), "BinaryCIF, atom_site: found 1, expected an array"),
        (one(Nil), "BinaryCIF: found nil, expected a map"),
        (top(vec![("encoder", text("x"))]), "BinaryCIF: found nothing, expected `dataBlocks`"),
        (top(vec![("dataBlocks", Int(1))]), "BinaryCIF: found 1, expected an array"),
        (top(vec![("dataBlocks", Array(vec![Map(vec![])]))]), "BinaryCIF: found nothing, expected `categories`"),
        (
            file(vec![block(
                "x",
                vec![category("_atom_site", 2, places(2)), category("_entry", 1, vec![ints("id", &[1, 2])])],
            )]),
            "BinaryCIF, entry, id: found 2 values, expected 1",
        ),
    ] {
        let said = refusal(&bytes);
        assert!(said.starts_with(expected), "`{said}` is not `{expected}`");
    }
    // An integral row count may be written as a real number.
    assert_eq!(bcif(&one(site(Real(2.0)))).len(), 2);
}

#[test]
fn checks_limits_before_allocation() {
    // A few hundred bytes that declare 2³¹ atoms.
    let n = i64::from(i32::MAX);
    let runs = |name| column(name, i32s(&[0, i32::MAX]), vec![run_length(n), byte_array(3)]);
    let bomb = |rows: i64| {
        let all = ["Cartn_x", "Cartn_y", "Cartn_z", "auth_seq_id"].map(runs).to_vec();
        file(vec![block("x", vec![category("_atom_site", rows, all)])])
    };
    let limits = ReadLimits {
        max_inflated_bytes: 1 << 20,
        max_atoms: 10_000,
        max_duplicates: 10_000,
        max_copies: 1000,
        max_parts: 100,
        max_distances: u64::MAX,
    };
    assert!(bomb(n).len() < 1500);
    assert_eq!(read(&bomb(n), &limits), Err(Exceeded::new(Limit::Atoms, 10_000).error()));
    assert_eq!(read(&bomb(i64::MAX), &limits), Err(Exceeded::new(Limit::Atoms, 10_000).error()));
    assert_eq!(read(&bomb(i64::MAX), &ReadLimits::default()), Err(Exceeded::new(Limit::Atoms, 20_000_000).error()));
    // The number of rows is allowed, the number of runs is not.
    let said = read(&bomb(10_000), &limits).unwrap_err().to_string();
    assert_eq!(
        said,
        "BinaryCIF, atom_site, auth_seq_id, RunLength (encoding 1 of 2): found 2147483647 values, expected at most 20002"
    );
    // Decoded data counts as decompressed data: 32 bytes per row here.
    let whole = |name| column(name, i32s(&[0, 10_000]), vec![run_length(10_000), byte_array(3)]);
    let all = ["Cartn_x", "Cartn_y", "Cartn_z", "auth_seq_id"].map(whole).to_vec();
    let good = file(vec![block("x", vec![category("_atom_site", 10_000, all)])]);
    assert_eq!(read(&good, &limits).unwrap().len(), 10_000);
    let tight = |bytes| ReadLimits { max_inflated_bytes: bytes, ..limits };
    assert_eq!(read(&good, &tight(320_000)).unwrap().len(), 10_000);
    assert_eq!(read(&good, &tight(319_999)), Err(Exceeded::new(Limit::InflatedBytes, 319_999).error()));
    // More unused texts than allowed atoms.
    let offsets = column(
        "auth_asym_id",
        i32s(&[0, 1]),
        vec![
            string_array("", &[0, i32::MAX], vec![run_length(1), byte_array(3)])
                .with("offsetEncoding", Array(vec![run_length(n), byte_array(3)])),
        ],
    );
    let said = read(&atoms(1, vec![offsets]), &limits).unwrap_err().to_string();
    assert!(
        said.contains("auth_asym_id, StringArray, offsets, RunLength (encoding 1 of 2): found 2147483647 values"),
        "{said}"
    );
    // Too many columns.
    let said = read(&atoms(1, vec![ints("x", &[1]); 1000]), &limits).unwrap_err().to_string();
    assert_eq!(said, "BinaryCIF, atom_site: found more columns, expected at most 1000");
    // An entry with more rows than allowed atoms.
    let long = category("_entry", 10_001, vec![texts("id", &["x"])]);
    let said = read(&file(vec![block("x", vec![category("_atom_site", 2, places(2)), long])]), &limits).unwrap_err();
    assert_eq!(said.to_string(), "BinaryCIF, entry, rowCount: found 10001 rows, expected at most 10000");
}

#[test]
fn never_panics_on_truncated_or_changed_files() {
    let limits = ReadLimits { max_inflated_bytes: 1 << 20, max_atoms: 1_000, ..ReadLimits::default() };
    let whole = CRAMBIN;
    assert_eq!(read(whole, &limits).unwrap().len(), 327);
    for cut in (0..whole.len()).step_by(7).chain(whole.len() - 50..whole.len()) {
        let error = read(&whole[..cut], &limits).expect_err("a part of a file");
        assert!(error.to_string().len() < 1000, "{cut}: {error}");
    }
    // Changes every byte in one of five ways. The result is a structure or an error, never a panic.
    let mut read_still = 0;
    let mut changed = whole.to_vec();
    for at in 0..whole.len() {
        changed[at] = [whole[at] ^ 0x01, whole[at] ^ 0x80, whole[at] ^ 0xFF, 0xDD, 0xC1][at % 5];
        match read(&changed, &limits) {
            Ok(s) => read_still += usize::from(s.len() <= 1_000),
            Err(error) => assert!(error.to_string().len() < 1000, "{at}: {error}"),
        }
        changed[at] = whole[at];
    }
    assert!(read_still > 1000, "{read_still}");
    // Nested map and array heads, two million deep.
    let deep = [b"\x81\xaadataBlocks".as_slice(), &[0x91; 2_000_000], &[0xC0]].concat();
    assert_eq!(refusal(&deep), "BinaryCIF: found an array of 1, expected a map");
}

#[test]
fn strict_validator_reports_that_it_does_not_read_binary_cif() {
    let findings = strict_validator::check(CRAMBIN, &ReadLimits::default(), &Control::default()).unwrap();
    assert_eq!(findings.len(), 1);
    assert_eq!((findings[0].level, findings[0].line), (strict_validator::Level::Note, None));
    assert!(findings[0].message.contains("BinaryCIF"), "{}", findings[0].message);
}

#[test]
fn results_do_not_depend_on_the_number_of_threads() {
    // More rows than one task reads. Names appear in a different order in every part.
    let n = 200_000;
    let ids: Vec<i32> = (0..n).map(|i| (i * 7919) % 31).collect();
    let letters: String = (0..31).map(|i| char::from(b'A' + i as u8 % 26)).collect();
    let offsets: Vec<i32> = (0..32).collect();
    let chain = column("auth_asym_id", i32s(&ids), vec![string_array(&letters, &offsets, vec![byte_array(3)])]);
    let numbers: Vec<i32> = (0..n).collect();
    let bytes = atoms(n as usize, vec![chain, ints("auth_seq_id", &numbers)]);
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| bcif(&bytes))
    };
    let one = with(1);
    assert_eq!(one.residue_number, numbers);
    for i in [0, 1, 65_535, 65_536, 199_999] {
        let id = ids[i] as usize;
        assert_eq!(one.chain.get(i), &letters[id..=id]);
    }
    assert!(one == with(2) && one == with(7));
    // The first fault in file order, independent of the threads.
    let mut x = vec![0.0; n as usize];
    (x[70_000], x[190_000]) = (f64::NAN, f64::NAN);
    let said = refusal(&atoms(n as usize, vec![reals("Cartn_x", &x)]));
    assert!(said.starts_with("BinaryCIF, atom_site, Cartn_x, row 70001: found NaN"), "{said}");
}
