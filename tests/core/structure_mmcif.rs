//! mmCIF: grammar, order of columns and categories, fallback items.
#![allow(
    clippy::pedantic,
    clippy::unwrap_used,
    clippy::panic,
    clippy::print_stderr,
    reason = "tests fail by panicking and print what they skip"
)]

use molmesh::structure::{ReadLimits, Structure, read};
use molmesh::surface::{Exceeded, Limit};

/// Limits of files that repeat one row.
const REPEATED: ReadLimits = ReadLimits {
    max_inflated_bytes: 1 << 30,
    max_atoms: 1_000_000,
    max_duplicates: u64::MAX,
    max_copies: 1000,
    max_parts: 100,
    max_distances: u64::MAX,
};

fn cif(text: impl AsRef<[u8]>) -> Structure {
    read(text.as_ref(), &REPEATED).unwrap_or_else(|e| panic!("{e}"))
}

fn refusal(text: impl AsRef<[u8]>) -> String {
    read(text.as_ref(), &ReadLimits::default()).expect_err("a refusal").to_string()
}

const TAGS: &str = "loop_
_atom_site.group_PDB
_atom_site.id
_atom_site.type_symbol
_atom_site.label_atom_id
_atom_site.label_alt_id
_atom_site.label_comp_id
_atom_site.label_asym_id
_atom_site.label_seq_id
_atom_site.pdbx_PDB_ins_code
_atom_site.Cartn_x
_atom_site.Cartn_y
_atom_site.Cartn_z
_atom_site.occupancy
_atom_site.B_iso_or_equiv
_atom_site.auth_seq_id
_atom_site.auth_asym_id
_atom_site.pdbx_PDB_model_num
";
const ROW: &str = "HETATM 1 C \"C1'\" A LIG AA 12 C 11.104 -6.134 0.500 0.50 20.25 -3 Bb 2\n";

fn file(rows: &str) -> String {
    format!("data_1ABC\n#\n_entry.id 1abc\n_struct.title 'A title'\n{TAGS}{rows}#\n")
}

#[test]
fn reads_every_item() {
    let s = cif(file(ROW));
    assert_eq!((s.id.as_deref(), s.title.as_deref()), (Some("1abc"), Some("A title")));
    assert_eq!((s.x[0], s.y[0], s.z[0]), (11.104, -6.134, 0.5));
    assert_eq!((s.name.get(0), s.residue.get(0), s.chain.get(0), s.label_chain.get(0)), ("C1'", "LIG", "Bb", "AA"));
    assert_eq!((s.residue_number[0], s.insertion_code[0], s.altloc[0]), (-3, b'C', b'A'));
    assert_eq!((s.occupancy[0], s.b_factor[0], s.model[0], s.hetero[0], s.element[0]), (0.5, 20.25, 2, true, 6));
}

#[test]
fn plain_and_special_rows_have_the_same_result() {
    let plain = cif(file(&ROW.repeat(3)));
    let row = ROW.trim_end();
    let forms = [
        format!("{row}\n\n# a comment in between\n{row}\n{row}\n"),
        format!("{}\n", [row; 3].join(" # a comment\n")),
        [row; 3].join("\t\t") + "\n",
        format!("{row}\n{row}\n{}\n", row.replace(' ', "\n")),
        format!("{row}\n{row}\n{}\n", row.replace("LIG", "'LIG'").replace("\"C1'\"", "\n;C1'\n;\n")),
        format!("{row}\n{row}\n{}\n", row.replace("\"C1'\"", "C1'").replace("Bb", "'Bb'")),
        [row; 3].join("\r\n") + "\r\n",
        [row; 3].join("\r") + "\r",
    ];
    for form in forms {
        assert_eq!(cif(file(&form)), plain, "{form}");
    }
    assert_eq!(cif(file(&ROW.repeat(3)).replace('\n', "\r\n")), plain);
    assert_eq!(cif(file(&ROW.repeat(3)).replace('\n', "\r")), plain);
    assert_eq!(cif(file(&ROW.repeat(3)).trim_end_matches(['#', '\n'])), plain, "at the end of the file");
}

#[test]
fn quotes_end_only_before_white_space() {
    let name = |value: &str| cif(file(&ROW.replace("\"C1'\"", value))).name.get(0).to_owned();
    assert_eq!(name("'a dog's name'"), "a dog's name");
    assert_eq!(name("\"O5\"'\""), "O5\"'");
    assert_eq!(name("'?'"), "?");
    assert_eq!(name("?"), "");
    assert_eq!(name("a#b"), "a#b");
    assert_eq!(name("x;y"), "x;y");
    assert_eq!(name("[C]"), "[C]");
    assert_eq!(name("'_atom_site.id'"), "_atom_site.id");
    assert_eq!(name("'loop_'"), "loop_");
    assert_eq!(name("C_1"), "C_1");
    assert_eq!(name("datax_"), "datax_");
    assert_eq!(name("\n;two\nlines\n;"), "two\u{fffd}lines");
    let error = refusal(file(&ROW.replace("\"C1'\"", "'C1")));
    assert!(
        error.starts_with("line 23, column 12: found `'C1 A LIG")
            && error.ends_with("expected a closing ' on the same line")
    );
    let error = refusal(file(&ROW.replace("\"C1'\"", "\n;C1")));
    assert_eq!(error, "line 24, column 1: found a text field without end, expected a line that begins with ;");
}

#[test]
fn columns_and_categories_in_any_order() {
    let text = "data_x\nloop_\n_other.a\n_other.b\n1 'two _atom_site.id'\n3\n;loop_\n_atom_site.id\n;\n
        loop_ _atom_site.Cartn_z _atom_site.unknown _ATOM_SITE.CARTN_X _atom_site.cartn_y 3.0 ? 1.0(12) 2.0 6 'q r' 4 5\n
        loop_ _later.a 1 2 3\n_struct.title\n;A title\n of two lines\n;\n_entry.id ?\n";
    let s = cif(text);
    assert_eq!((s.x.as_slice(), s.y.as_slice(), s.z.as_slice()), (&[1.0, 4.0][..], &[2.0, 5.0][..], &[3.0, 6.0][..]));
    assert_eq!((s.id.as_deref(), s.title.as_deref()), (Some("x"), Some("A title of two lines")));
    assert_eq!((s.hetero[0], s.model[0], s.occupancy[0], s.b_factor[0]), (false, 1, 1.0, 0.0));
    assert_eq!((s.chain.get(0), s.label_chain.len()), ("", 0));
}

#[test]
fn author_items_take_precedence_over_dictionary_items() {
    let text = |auth: &str| {
        format!(
            "data_x loop_ _atom_site.Cartn_x _atom_site.Cartn_y _atom_site.Cartn_z
_atom_site.label_atom_id _atom_site.auth_atom_id _atom_site.label_comp_id _atom_site.auth_comp_id
_atom_site.label_asym_id _atom_site.auth_asym_id _atom_site.label_seq_id _atom_site.auth_seq_id
1 2 3 N1 {auth} ALA {auth} A {auth} 7 {}",
            if auth == "X" { "8" } else { auth }
        )
    };
    let names = |s: &Structure| {
        (s.name.get(0).to_owned(), s.residue.get(0).to_owned(), s.chain.get(0).to_owned(), s.residue_number[0])
    };
    assert_eq!(names(&cif(text("X"))), ("X".into(), "X".into(), "X".into(), 8));
    for null in ["?", "."] {
        assert_eq!(names(&cif(text(null))), ("N1".into(), "ALA".into(), "A".into(), 7));
    }
    assert_eq!(cif(text("X")).label_chain.get(0), "A");
}

#[test]
fn reads_one_atom_without_a_loop() {
    let text = "data_x\n_atom_site.id 1\n_atom_site.Cartn_x 1\n_atom_site.Cartn_y 2\n_atom_site.Cartn_z 3\n_atom_site.label_atom_id \"O5'\"\n";
    let s = cif(text);
    assert_eq!((s.len(), s.x[0], s.y[0], s.z[0], s.name.get(0), s.element[0]), (1, 1.0, 2.0, 3.0, "O5'", 8));
    assert_eq!(cif(format!("{text}data_y\n")), s);
}

#[test]
fn reads_the_first_block_with_atoms() {
    let other = "data_first\n_entry.id WRONG\n_struct.title wrong\n_cell.length_a 1\n";
    let second = file(&ROW.repeat(2));
    let third = "data_third\nloop_ _atom_site.Cartn_x 1 2 3";
    let s = cif(format!("{other}{second}{third}"));
    assert_eq!((s.len(), s.id.as_deref(), s.title.as_deref()), (2, Some("1abc"), Some("A title")));
    // Items of save frames do not belong to the block.
    let framed = format!("data_x save_frame _entry.id y {TAGS}{ROW} save_ {TAGS}{ROW}{ROW}");
    assert_eq!(cif(framed).len(), 2);
}

#[test]
fn elements_are_read_or_guessed() {
    let element = |symbol: &str, name: &str, residue: &str| {
        let row = ROW.replace(" C \"C1'\" A LIG", &format!(" {symbol} {name} . {residue}"));
        cif(file(&row)).element[0]
    };
    assert_eq!(element("C", "CA", "ALA"), 6);
    assert_eq!(element("CA", "CA", "CA"), 20);
    assert_eq!(element("Fe3+", "FE", "HEM"), 26);
    assert_eq!(element("D", "D1", "DOD"), 1);
    assert_eq!(element("?", "CA", "ALA"), 6);
    assert_eq!(element(".", "CA", "CA"), 20);
    assert_eq!(element("?", "CL1", "LIG"), 17);
    assert_eq!(element("?", "N1", "LIG"), 7);
    assert_eq!(element("X", "N1", "LIG"), 0);
    assert_eq!(element("?", "?", "?"), 0);
}

#[test]
fn errors_name_line_and_column() {
    let bad = |from: &str, to: &str| refusal(file(&format!("{ROW}{}", ROW.replace(from, to))));
    assert_eq!(bad("11.104", "nan"), "line 24, column 32: found `nan`, expected Cartn_x in Å, within ±100000");
    assert_eq!(bad("11.104", "1e400"), "line 24, column 32: found `1e400`, expected Cartn_x in Å, within ±100000");
    assert_eq!(bad("-6.134", "?"), "line 24, column 39: found `?`, expected Cartn_y in Å, within ±100000");
    assert_eq!(
        bad("0.500 ", "-100000.5 "),
        "line 24, column 46: found `-100000.5`, expected Cartn_z in Å, within ±100000"
    );
    assert_eq!(
        bad("Bb 2", "Bb 99999999999"),
        "line 24, column 69: found `99999999999`, expected a model number (a whole number), ? or ."
    );
    assert_eq!(
        refusal(file(&format!("{ROW}{}", ROW.replace(" Bb 2", "")))),
        "line 26, column 1: found the end of the file, expected value 16 of the 17 in a row of atom_site"
    );
    assert_eq!(
        refusal(format!("{}loop_ _x.y 1", file(&ROW.replace(" Bb 2", "")))),
        "line 25, column 1: found `loop_`, expected value 16 of the 17 in a row of atom_site"
    );
    assert_eq!(
        refusal("data_x\n1 2\n"),
        "line 2, column 1: found `1`, expected a data block, loop_, or a tag that begins with _"
    );
    assert_eq!(refusal("data_x\n_a.b\n_a.c 1\n"), "line 3, column 1: found `_a.c`, expected a value of _a.b");
    assert_eq!(refusal("data_x\n_a.b"), "line 2, column 5: found the end of the file, expected a value of _a.b");
    assert_eq!(refusal("data_x\nloop_\n"), "line 3, column 1: found the end of the file, expected a tag after loop_");
    assert_eq!(refusal("data_x\nloop_ loop_ _a.b 1"), "line 2, column 7: found `loop_`, expected a tag after loop_");
    assert_eq!(
        refusal("data_x\nloop_ _atom_site.Cartn_x _atom_site.cartn_x 1 2"),
        "line 2, column 26: found `_atom_site.cartn_x`, expected every tag once in its category"
    );
}

#[test]
fn unreadable_optional_values_are_warnings() {
    let read = |from: &str, to: &str| cif(file(&format!("{ROW}{}", ROW.replace(from, to))));
    let s = read("HETATM", "ATOMS");
    assert_eq!((s.hetero.as_slice(), s.len()), (&[true, false][..], 2));
    assert_eq!(s.warnings, ["line 24, column 1: found `ATOMS`, expected ATOM or HETATM; read as ATOM"]);
    for bad in ["x", "inf", "NaN", "1e39", "-1e400"] {
        let s = read("0.50 ", &format!("{bad} "));
        assert_eq!(s.occupancy, [0.5, 1.0]);
        assert_eq!(
            s.warnings,
            [format!("line 24, column 52: found `{bad}`, expected an occupancy, ? or .; read as 1")]
        );
    }
    let s = read("20.25", "nan");
    assert_eq!(s.b_factor, [20.25, 0.0]);
    assert_eq!(s.warnings, ["line 24, column 57: found `nan`, expected a B-factor, ? or .; read as 0"]);
    assert_eq!(cif(file(ROW)).warnings, Vec::<String>::new());
}

#[test]
fn unknown_elements_are_warnings_in_every_format() {
    let nameless = |n: usize| file(&format!("{ROW}{}", ROW.replace(" C \"C1'\" ", " ? \"1\" ").repeat(n)));
    let s = cif(nameless(1));
    assert_eq!(s.element, [6, 0]);
    assert_eq!(s.warnings, ["atom 2 (`1` of residue `LIG`) has no known element; its radius is 2 Å"]);
    let s = cif(nameless(3));
    assert_eq!(s.warnings, ["atom 2 (`1` of residue `LIG`) and 2 more have no known element; their radius is 2 Å"]);
    let pdb = "HETATM    1  1   LIG A   1      11.104  -6.134   0.500  1.00  0.00           X\n";
    let s = read(pdb.as_bytes(), &ReadLimits::default()).unwrap();
    assert_eq!(s.warnings, ["atom 1 (`1` of residue `LIG`) has no known element; its radius is 2 Å"]);
}

#[test]
fn warnings_are_the_same_on_any_number_of_threads() {
    let pool = |threads| rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    let bad = ROW.replace("0.50 20.25", "inf 20.25");
    let text = file(&format!("{}{bad}{}{}", ROW.repeat(30_000), ROW.repeat(30_000), bad.repeat(12)));
    let reads = [1, 3].map(|n| pool(n).install(|| cif(&text)));
    assert_eq!(reads[0], reads[1]);
    let warnings = &reads[0].warnings;
    assert!(warnings[0].starts_with("line 30023, column 52: found `inf`"), "{warnings:?}");
    assert!(warnings[1].starts_with("line 60024, column 52: found `inf`"), "{warnings:?}");
    assert_eq!((warnings.len(), warnings[10].as_str()), (12, "3 more values that could not be read"));
}

#[test]
fn a_file_without_coordinates_is_described() {
    assert_eq!(refusal("data_x\n"), "no atoms: mmCIF with data block x and nothing in it");
    assert_eq!(
        refusal("data_ligand\nloop_\n_chem_comp_atom.atom_id\n_chem_comp_atom.x\nC1 0\n_cell.length_a 1\n"),
        "no atoms: mmCIF with data block ligand, categories chem_comp_atom, cell"
    );
    assert_eq!(
        refusal("data_a _x.y 1 data_b loop_ _atom_site.id _atom_site.fract_x _atom_site.Cartn_y 1 2 3"),
        "no atoms: mmCIF with data block b (the last of 2), categories x, atom_site, atom_site without Cartn_x, Cartn_z"
    );
}

#[test]
fn limits_atoms() {
    // Large enough for several threads.
    for n in [10, 60_000] {
        let text = file(&ROW.repeat(n));
        let with = |max_atoms| read(text.as_bytes(), &ReadLimits { max_atoms, ..REPEATED });
        assert_eq!(with(n as u64 - 1), Err(Exceeded::new(Limit::Atoms, n as u64 - 1).error()));
        assert_eq!(with(n as u64).unwrap().len(), n);
    }
}

#[test]
fn large_files_have_the_same_result_on_every_path() {
    let pool = |threads| rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    let rows = |special: &str| format!("{}{special}{}", ROW.repeat(50_000), ROW.replace("Bb", "Q").repeat(20_000));
    let row = ROW.trim_end();
    for special in [
        String::new(),
        "\n".to_owned(),
        "# a comment\n".to_owned(),
        format!("{row} {row}\n"),
        format!("{}\n", row.replace(' ', "\n")),
        row.replace("\"C1'\"", "\n;C1'\n;\n") + "\n",
        row.replace("Bb", "B_b") + "\n",
        row.replace("Bb", "'B b'") + "\n",
        row.replace("11.104", "oops") + "\n",
        row.replace(" Bb", "") + "\n",
        "data_y\n".to_owned(),
    ] {
        let text = file(&rows(&special));
        let reads = [1, 3].map(|n| pool(n).install(|| read(text.as_bytes(), &REPEATED)));
        assert_eq!(reads[0], reads[1], "{special}");
        match &reads[0] {
            Ok(s) => assert!(s.len() >= 50_000, "{special}"),
            Err(e) => assert!(e.to_string().starts_with("line "), "{special}: {e}"),
        }
    }
}
