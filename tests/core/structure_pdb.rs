//! PDB files and common deviations from the format.
#![allow(
    clippy::pedantic,
    clippy::unwrap_used,
    clippy::panic,
    clippy::print_stderr,
    reason = "tests fail by panicking and print what they skip"
)]

use molmesh::structure::{ReadLimits, Structure, read};
use molmesh::surface::{Exceeded, Limit};

fn pdb(text: impl AsRef<[u8]>) -> Structure {
    read(text.as_ref(), &ReadLimits::default()).unwrap_or_else(|e| panic!("{e}"))
}

fn refusal(text: impl AsRef<[u8]>) -> String {
    read(text.as_ref(), &ReadLimits::default()).expect_err("a refusal").to_string()
}

/// Pads a line to 80 columns.
const CA: &str = "ATOM      2  CA AALA B -12C     11.104  -6.134   0.500  0.50 20.25           C  \n";

fn symbols(s: &Structure) -> Vec<u8> {
    s.element.clone()
}

#[test]
fn reads_every_column() {
    let s = pdb([
        "HEADER    HYDROLASE                               02-MAR-00   1ABC              \n",
        "TITLE     A TITLE  OF\nTITLE    2 TWO LINES \n",
        CA,
    ]
    .concat());
    assert_eq!((s.id.as_deref(), s.title.as_deref()), (Some("1ABC"), Some("A TITLE OF TWO LINES")));
    assert_eq!((s.x[0], s.y[0], s.z[0]), (11.104, -6.134, 0.5));
    assert_eq!((s.name.get(0), s.residue.get(0), s.chain.get(0)), ("CA", "ALA", "B"));
    assert_eq!((s.residue_number[0], s.insertion_code[0], s.altloc[0]), (-12, b'C', b'A'));
    assert_eq!((s.occupancy[0], s.b_factor[0], s.model[0], s.hetero[0], s.element[0]), (0.5, 20.25, 1, false, 6));
    assert_eq!((s.len(), s.label_chain.len()), (1, 0));
}

#[test]
fn accepts_any_line_ending() {
    let text = format!("\n\nREMARK   1\n{CA}{CA}TER\nEND\n");
    let plain = pdb(&text);
    assert_eq!(plain.len(), 2);
    for ending in ["\r\n", "\r"] {
        assert_eq!(pdb(text.replace('\n', ending)), plain, "{ending:?}");
    }
    assert_eq!(pdb(text.trim_end()), plain);
    assert_eq!(pdb([b"\xef\xbb\xbf", text.as_bytes()].concat()), plain, "byte order mark");
}

#[test]
fn accepts_lines_that_end_after_the_coordinates() {
    let full = pdb(CA);
    for columns in [79, 78, 66, 60, 54] {
        let s = pdb(format!("{}\n", &CA[..columns]));
        assert_eq!((s.x[0], s.z[0], s.element[0]), (full.x[0], full.z[0], 6), "{columns}");
        assert_eq!(s.occupancy[0], if columns >= 60 { 0.5 } else { 1.0 });
        assert_eq!(s.b_factor[0], if columns >= 66 { 20.25 } else { 0.0 });
    }
    let error = refusal(format!("REMARK\n{}\n", &CA[..53]));
    assert_eq!(error, "line 2, column 54: found a line of 53 columns, expected coordinates in columns 31 to 54");
    assert_eq!(
        refusal("REMARK   1\r\nATOM"),
        "line 2, column 5: found a line of 4 columns, expected coordinates in columns 31 to 54"
    );
}

#[test]
fn serial_numbers_may_overflow() {
    for serial in
        ["ATOM  99999", "ATOM  A0000", "ATOM  *****", "ATOM 100000", "ATOM      0", "ATOM       ", "ATOM  186a0"]
    {
        assert_eq!(pdb(CA.replace("ATOM      2", serial)).name.get(0), "CA", "{serial}");
    }
    assert!(pdb(CA.replace("ATOM      2 ", "HETATM100000")[..54].to_owned() + "\n").hetero[0]);
}

#[test]
fn residue_numbers_wrap_in_three_ways() {
    let number = |columns: &str| {
        let s = pdb(CA.replace(" -12C", columns));
        (s.residue_number[0], s.insertion_code[0])
    };
    assert_eq!(number("9999 "), (9999, 0));
    assert_eq!(number("A000 "), (10_000, 0));
    assert_eq!(number("a000B"), (10_000 + 26 * 46_656, b'B'));
    assert_eq!(number("12345"), (12_345, 0));
    assert_eq!(number("-1234"), (-1234, 0));
    assert_eq!(number("   1A"), (1, b'A'));
    assert_eq!(number("     "), (0, 0));
    assert_eq!(number("271a "), (10_010, 0));
    let s = pdb(CA.replace(" -12C", "**** "));
    let warning = "line 1, column 23: found `****`, expected a residue number, decimal or hybrid-36; read as 0";
    assert_eq!((s.residue_number[0], s.warnings), (0, vec![warning.to_owned()]));
}

#[test]
fn four_letter_residues_and_two_letter_chains() {
    let names = |columns: &str| {
        let s = pdb(CA.replace("ALA B", columns));
        (s.residue.get(0).to_owned(), s.chain.get(0).to_owned())
    };
    let cases = [
        ("ALA B", "ALA", "B"),
        ("TIP3 ", "TIP3", ""),
        ("TIP3W", "TIP3", "W"),
        ("POPCM", "POPC", "M"),
        ("ALAAA", "ALA", "AA"),
        ("HOHXY", "HOH", "XY"),
        (" DCAB", "DC", "AB"),
        (" DC B", "DC", "B"),
        ("  C B", "C", "B"),
        ("  CL5", "C", "L5"),
        ("  CA ", "CA", ""),
        ("NALAB", "NALA", "B"),
        ("CYSH ", "CYSH", ""),
        ("     ", "", ""),
    ];
    for (columns, residue, chain) in cases {
        assert_eq!(names(columns), (residue.to_owned(), chain.to_owned()), "{columns}");
    }
}

#[test]
fn guesses_blank_elements_from_name_and_residue() {
    let element = |name: &str, residue: &str| {
        let line = format!("HETATM    1 {name} {residue:<3} A   1      11.104   6.134  -6.504\n");
        pdb(line).element[0]
    };
    let cases = [
        (" CA ", "ALA", 6),
        ("CA  ", " CA", 20),
        ("CA  ", "ALA", 6),
        ("HG  ", " HG", 80),
        ("HG11", "VAL", 1),
        (" HG ", "CYS", 1),
        ("FE  ", "HEM", 26),
        (" NA ", "HEM", 7),
        ("NA  ", " NA", 11),
        ("1HB ", "ALA", 1),
        (" D  ", "ALA", 1),
        ("SE  ", "MSE", 34),
        ("CL1 ", "LIG", 17),
        ("ZN  ", " ZN", 30),
        (" O5*", "  C", 8),
        (" OW ", "SOL", 8),
        ("SOD ", "SOD", 11),
        (" P  ", " DA", 15),
    ];
    for (name, residue, z) in cases {
        assert_eq!(element(name, residue), z, "{name} in {residue}");
    }
    // If all names are left-justified, the alignment is meaningless. N and C in the first column reveal it.
    let lines = ["N    ALA", "CA   ALA", "C    LIG", "CD   LIG", "CD    CD"]
        .map(|n| format!("ATOM      1 {n} A   1      11.104   6.134  -6.504\n"));
    assert_eq!(symbols(&pdb(lines.concat())), [7, 6, 6, 6, 48]);
}

#[test]
fn uses_element_columns_that_contain_an_element() {
    let element = |columns: &str| {
        assert_eq!(columns.len(), 8);
        pdb(format!("{}{columns}\n", &CA[..72])).element[0]
    };
    assert_eq!(element("     C  "), 6);
    assert_eq!(element("    CA2+"), 20);
    assert_eq!(element("    zn  "), 30);
    assert_eq!(element("    D   "), 1);
    assert_eq!(element("     D1+"), 1);
    // Not element symbols: the name decides.
    assert_eq!(element("    XX  "), 6);
    assert_eq!(element("    12  "), 6);
    assert_eq!(element("PROA    "), 6);
    // Entry id and line number, as before 1996. The revision letter of such a line is not nitrogen.
    assert_eq!(element("4PTI 104"), 6);
    assert_eq!(element("4PTIN104"), 6);
    assert_eq!(element("4PTIE  1"), 6);
    assert_eq!(element("4PTI1104"), 6);
}

#[test]
fn models_begin_and_end() {
    let models = |text: &str| pdb(text.replace("CA", CA)).model;
    assert_eq!(models("MODEL        3\nCAENDMDL\nMODEL        7\nCACAENDMDL\n"), [3, 7, 7]);
    assert_eq!(models("MODEL\nCAENDMDL\nCACAENDMDL\nCA"), [1, 2, 2, 3], "frames without MODEL");
    assert_eq!(models("CAEND\nCAEND\n"), [1, 2], "frames between END");
    assert_eq!(models("MODEL 1\nCAENDMDL\nMODEL 1\nCA"), [1, 2], "a number that comes back");
    assert_eq!(models("MODEL     2147483647\nCAENDMDL\nCA"), [i32::MAX, i32::MAX]);
    assert_eq!(models("CATER\nCA"), [1, 1]);
    assert_eq!(refusal(format!("MODEL   x1\n{CA}")), "line 1, column 9: found `x1`, expected a model number");
}

#[test]
fn tabs_are_eight_columns() {
    let tabbed = CA.replace("ATOM      2  CA AALA B", "ATOM\t  2  CA AALA B");
    assert_eq!(tabbed.len(), CA.len() - 3, "four columns by one tab");
    assert_eq!(pdb(&tabbed), pdb(CA));
    let error = refusal(tabbed.replace("11.104", "11.1x4"));
    assert_eq!(error, "line 1, column 28: found `  11.1x4`, expected the x coordinate in Å, within ±100000");
}

#[test]
fn latin_1_reads() {
    let text = [b"REMARK   1 AUTHOR: M\xdcLLER\n", CA.replace("CA A", "C\u{1}BA").as_bytes()].concat();
    assert_eq!(pdb(&text).name.get(0), "C\u{fffd}B");
    let mut line = CA.as_bytes().to_vec();
    line[14] = 0xe9;
    assert_eq!(pdb(&line).name.get(0), "Cé");
}

#[test]
fn errors_name_line_and_column() {
    let bad = |from: &str, to: &str| refusal(format!("REMARK\n{}", CA.replace(from, to)));
    let x = "expected the x coordinate in Å, within ±100000";
    assert_eq!(bad("  11.104", "     NaN"), format!("line 2, column 31: found `     NaN`, {x}"));
    assert_eq!(bad("  11.104", "     inf"), format!("line 2, column 31: found `     inf`, {x}"));
    assert_eq!(bad("  11.104", "********"), format!("line 2, column 31: found `********`, {x}"));
    assert_eq!(bad("  11.104", "    1e30"), format!("line 2, column 31: found `    1e30`, {x}"));
    assert_eq!(bad("  11.104", "100000.1"), format!("line 2, column 31: found `100000.1`, {x}"));
    assert_eq!(bad("  11.104", "        "), format!("line 2, column 31: found blanks, {x}"));
    assert!(bad("  -6.134", "  -6.13x").starts_with("line 2, column 39: found `  -6.13x`, expected the y"));
    assert!(bad("   0.500", " 0 . 500").starts_with("line 2, column 47: found ` 0 . 500`, expected the z"));
    assert_eq!(pdb(CA.replace("  11.104", "1.104   ")).x[0], 1.104);
    assert_eq!(pdb(CA.replace("  11.104", "  -1e2  ")).x[0], -100.0);
    assert_eq!(pdb(CA.replace("  11.104", "100000.0")).x[0], 100_000.0);
}

#[test]
fn unreadable_occupancies_and_b_factors_are_warnings() {
    let read = |from: &str, to: &str| {
        let s = pdb(format!("REMARK\n{}", CA.replace(from, to)));
        (s.occupancy[0], s.b_factor[0], s.warnings.join("\n"))
    };
    assert_eq!(read("", ""), (0.5, 20.25, String::new()));
    let occupancy = "expected an occupancy in columns 55 to 60, or blanks; read as 1";
    for bad in ["  x.50", "   inf", "   NaN", "******", " 1e39 "] {
        assert_eq!(
            read("  0.50 20", &format!("{bad} 20")),
            (1.0, 20.25, format!("line 2, column 55: found `{bad}`, {occupancy}"))
        );
    }
    let b_factor = "expected a B-factor in columns 61 to 66, or blanks; read as 0";
    for bad in ["   NaN", "******", "-  inf"] {
        assert_eq!(read(" 20.25", bad), (0.5, 0.0, format!("line 2, column 61: found `{bad}`, {b_factor}")));
    }
    // A tab replaces columns 49 to 56.
    let tabbed = pdb(CA.replace("   0.500  0.50", "  0.5\t  x0 "));
    assert_eq!(tabbed.warnings.len(), 1, "{:?}", tabbed.warnings);
    let many = pdb(CA.replace("  0.50 20", "  x.50 20").repeat(1000));
    assert_eq!((many.len(), many.warnings.len()), (1000, 12));
    assert_eq!(many.warnings[9], format!("line 10, column 55: found `  x.50`, {occupancy}"));
    assert_eq!(many.warnings[10], "990 more values that could not be read");
}

#[test]
fn limits_atoms() {
    let text = CA.repeat(10);
    let with = |max_atoms| read(text.as_bytes(), &ReadLimits { max_atoms, ..ReadLimits::default() });
    assert_eq!(with(9), Err(Exceeded::new(Limit::Atoms, 9).error()));
    assert_eq!(with(10).unwrap().len(), 10);
    assert_eq!(with(0), Err(Exceeded::new(Limit::Atoms, 0).error()));
}

#[test]
fn a_file_without_atoms_is_described() {
    let message = refusal("HEADER    X\nREMARK   2\nREMARK   2\nEND\n");
    assert_eq!(message, "no atoms: a PDB file of 4 lines without ATOM and HETATM; it has HEADER, REMARK, END");
}

proptest::proptest! {
    #[test]
    fn formatted_lines_come_back(
        name in "[CNOS][A-Z0-9]{0,2}",
        residue in "[A-Z]{3}",
        chain in "[A-Za-z0-9]",
        number in -999_i32..=9999,
        code in "[ A-Z]",
        altloc in "[ A-Z]",
        place in proptest::array::uniform3(-999_999_i32..=9_999_999),
        occupancy in 0_u16..=100,
        b in -9999_i32..=99_999,
        hetero: bool,
        z in 2_usize..=118,
    ) {
        let record = if hetero { "HETATM" } else { "ATOM  " };
        let symbol = molmesh::structure::element::SYMBOLS[z - 1].to_uppercase();
        let [x, y, zz] = place.map(|v| f64::from(v) / 1000.0);
        let line = format!(
            "{record}    1  {name:<3}{altloc}{residue} {chain}{number:>4}{code}   {x:8.3}{y:8.3}{zz:8.3}{:6.2}{:6.2}          {symbol:>2}\n",
            f64::from(occupancy) / 100.0, f64::from(b) / 100.0,
        );
        let s = pdb(&line);
        let letter = |text: &str| text.trim().bytes().next().unwrap_or(0);
        proptest::prop_assert_eq!((s.name.get(0), s.residue.get(0), s.chain.get(0)), (&*name, &*residue, &*chain));
        proptest::prop_assert_eq!((s.residue_number[0], s.insertion_code[0], s.altloc[0]), (number, letter(&code), letter(&altloc)));
        proptest::prop_assert_eq!([s.x[0], s.y[0], s.z[0]], [x, y, zz].map(|v| format!("{v:.3}").parse::<f64>().unwrap()));
        proptest::prop_assert_eq!(s.occupancy[0], f32::from(occupancy) / 100.0);
        proptest::prop_assert!((f64::from(s.b_factor[0]) - f64::from(b) / 100.0).abs() < 1e-4);
        proptest::prop_assert_eq!((s.hetero[0], usize::from(s.element[0])), (hetero, z));
    }
}
