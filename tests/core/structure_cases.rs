//! Files as other programs write them (`tests/cases`): atoms, elements and warnings, and that every atom of a file is
//! meshed or counted.
#![allow(clippy::pedantic, clippy::unwrap_used, clippy::panic, reason = "tests fail by panicking")]

use crate::tools;

use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};

use molmesh::structure::annotations::SecondaryRanges;
use molmesh::structure::{ReadLimits, Selected, Selection, Structure, StructureError, element, read, select};
use proptest::prelude::*;

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/cases/atoms")
}

fn text(name: &str) -> String {
    std::fs::read_to_string(folder().join(name)).unwrap()
}

fn structure(text: impl AsRef<[u8]>) -> Structure {
    read(text.as_ref(), &ReadLimits::default()).unwrap_or_else(|error| panic!("{error}"))
}

fn selected(s: &Structure, atoms: &str) -> Result<Selected, StructureError> {
    select(s, &Selection { atoms: atoms.parse().unwrap(), ..Selection::default() })
}

/// Returns the number of atoms of a selection, 0 if there is none.
fn count(s: &Structure, atoms: &str) -> usize {
    match selected(s, atoms) {
        Ok(selected) => selected.atoms.len(),
        Err(StructureError::EmptySelection { .. }) => 0,
        Err(error) => panic!("{error}"),
    }
}

fn symbols(s: &Structure) -> String {
    s.element.iter().map(|&z| element::symbol(z)).collect::<Vec<_>>().join(" ")
}

/// Returns the names of the meshed atoms of a residue.
fn names_of(s: &Structure, number: i32) -> Vec<String> {
    let atoms = selected(s, &format!("resi {number}")).unwrap().atoms;
    atoms.iter().map(|&i| format!("{}{}", s.name.get(i as usize), char::from(s.altloc[i as usize]))).collect()
}

/// Expected content of a file.
struct Case {
    file: &'static str,
    /// Number of atoms of all models.
    atoms: usize,
    /// Numbers of atoms by selection.
    counts: &'static [(&'static str, usize)],
    /// A part of a warning.
    warning: Option<&'static str>,
}

const fn case(
    file: &'static str,
    atoms: usize,
    counts: &'static [(&'static str, usize)],
    warning: Option<&'static str>,
) -> Case {
    Case { file, atoms, counts, warning }
}

const CASES: [Case; 26] = [
    case("alt_incomplete.pdb", 28, &[("polymer", 26)], None),
    case("alt_segments.pdb", 29, &[("polymer", 26)], None),
    case("auth_seq_code.cif", 20, &[("resi 2A", 5), ("resi 2", 0)], Some("found `2A`, expected a residue number")),
    case(
        "charmm9999.pdb",
        31,
        &[("polymer", 31)],
        Some("1 of 31 atoms lie more than 1000 Å from the others, the first is atom 31 at (9999, 9999, 9999)"),
    ),
    case(
        "charmm_membrane.pdb",
        97,
        &[("polymer", 20), ("nucleic", 0), ("ligand", 69), ("ion", 2), ("water", 2)],
        Some("69 atoms in ATOM records belong to residues with unknown names"),
    ),
    case("cluspro.pdb", 60, &[("polymer", 60)], None),
    case("elem_shift.pdb", 6, &[("ligand", 6)], None),
    case("entity_no_asym.cif", 53, &[("polymer", 50), ("ligand", 3)], None),
    case("ext_id.xyz", 2, &[("polymer", 2)], None),
    case("fpocket.pqr", 3, &[("polymer", 3)], None),
    case("fpocket_joined.pqr", 3, &[("polymer", 3)], None),
    case("gold.xyz", 4, &[("polymer", 4), ("ion", 0)], None),
    case("helix_cross.pdb", 120, &[("polymer", 120)], Some("residue 2 of chain `A` to residue 9 of chain `B`")),
    case("ihm_mixed.cif", 15, &[("polymer", 15)], Some("2 spheres of `ihm_sphere_obj_site`")),
    case("joined_all.pqr", 2, &[("polymer", 2)], None),
    case("joined_first.pqr", 4, &[("polymer", 4)], None),
    case("ligand.pdbqt", 20, &[("ligand", 20)], None),
    case("ligand_atom.pdb", 24, &[("polymer", 20), ("ligand", 4)], Some("treated as ligands: `LIG` 4")),
    case("martini.pdb", 15, &[("polymer", 10), ("ligand", 5)], Some("atom 1 (`BB` of residue `LEU`) and 14 more")),
    case("noelem_vmd.pdb", 20, &[("polymer,hydrogen", 20)], None),
    case("numberless_alt.cif", 25, &[("polymer", 20), ("water", 3)], None),
    case("pymol_objects.cif", 20, &[("polymer", 20)], Some("left out: `lig` (20 atoms)")),
    case("resid_24_27.pdb", 20, &[("resi 1000", 5), ("resi 100", 0)], None),
    case("salt.xyz", 2, &[("polymer", 2)], None),
    case("sheet_reverse.pdb", 60, &[("polymer", 60)], None),
    case(
        "unx.pdb",
        26,
        &[("polymer", 21), ("ligand", 5), ("ion", 0)],
        Some("atom 21 (`UNK` of residue `UNX`) and 4 more"),
    ),
];

#[test]
fn every_case_has_its_atoms_and_warnings() {
    for Case { file: name, atoms, counts, warning } in CASES {
        let s = structure(text(name));
        assert_eq!(s.len(), atoms, "{name}");
        for (selection, n) in counts {
            assert_eq!(count(&s, selection), *n, "{name}: {selection}");
        }
        let has_warning = warning.is_none_or(|warning| s.warnings.iter().any(|w| w.contains(warning)));
        assert!(has_warning && s.warnings.is_empty() == warning.is_none(), "{name}: {:?}", s.warnings);
    }
    let water = structure(text("water_names.pdb"));
    assert_eq!((count(&water, "polymer"), count(&water, "water")), (15, 37));
    let listed = CASES.len() + 1;
    assert_eq!(std::fs::read_dir(folder()).unwrap().count(), listed, "every file has a row");
}

#[test]
fn elements_are_as_stated_or_unknown() {
    for (name, expected) in [
        ("elem_shift.pdb", "C Cl Br Fe N Zn"),
        ("ligand.pdbqt", "C C N N O S S F Cl Br I Fe Zn Mg Mn Ca P Si Cl Br"),
        ("noelem_vmd.pdb", "C C Br I F Fe Zn Mg Mn C N C S S H C N C S B"),
        ("martini.pdb", "? ? ? ? ? ? ? ? ? ? ? ? ? ? ?"),
        ("fpocket.pqr", "C O O"),
    ] {
        assert_eq!(symbols(&structure(text(name))), expected, "{name}");
    }
    let unx = structure(text("unx.pdb"));
    assert!(symbols(&unx).ends_with("? ? O ? ? ?"), "{}", symbols(&unx));
    // Controls: without a symbol, the element follows from the name; in columns 77 and 78, NA is sodium.
    let guessed = structure(text("unx.pdb").replace("           X", "            "));
    assert!(symbols(&guessed).ends_with("? ? O C H ?"), "{}", symbols(&guessed));
    let sodium = text("elem_shift.pdb").replace("           Zn", "          NA ");
    assert!(symbols(&structure(sodium)).ends_with("Na"));
}

// ---- alternative locations ----

/// Returns a residue as PDB: name, alternative location and occupancy of each atom, at different positions.
fn residue(name: &str, atoms: &[(&str, char, f64)]) -> String {
    let line = |(i, (atom, letter, occupancy)): (usize, &(&str, char, f64))| {
        let element = &atom[..1];
        format!(
            "ATOM  {i:>5}  {atom:<3}{letter}{name} A   1    {:>8.3}   0.000   0.000{occupancy:>6.2}  0.00          {element:>2}\n",
            1.5 * i as f64
        )
    };
    atoms.iter().enumerate().map(line).collect()
}

#[test]
fn each_atom_name_of_a_residue_is_meshed_once() {
    assert_eq!(names_of(&structure(text("alt_incomplete.pdb")), 3), ["NA", "CAA", "CA", "OA", "CBB", "OGB"]);
    assert_eq!(names_of(&structure(text("alt_segments.pdb")), 3), ["N\0", "CA\0", "C\0", "OC", "CBA", "OGA"]);
    type Atoms = [(&'static str, char, f64)];
    let cases: [(&Atoms, &[&str]); 5] = [
        // The first conformer has no letter.
        (
            &[("N", ' ', 1.0), ("CB", ' ', 0.6), ("CB", 'B', 0.4), ("OG", ' ', 0.6), ("OG", 'B', 0.4)],
            &["CB\0", "N\0", "OG\0"],
        ),
        (&[("N", ' ', 1.0), ("CB", ' ', 0.3), ("CB", 'B', 0.7), ("OG", 'B', 0.7)], &["CBB", "N\0", "OGB"]),
        // The lowest of equal letters.
        (&[("CB", 'B', 0.5), ("CB", 'A', 0.5)], &["CBA"]),
        // Fills in from the blank atom before other letters.
        (&[("CB", 'A', 0.7), ("CB", 'B', 0.2), ("OG", ' ', 0.1), ("OG", 'B', 0.2)], &["CBA", "OG\0"]),
        // Deuterium is an alternative of hydrogen.
        (&[("H1", 'A', 0.3), ("D1", 'B', 0.7), ("N", ' ', 1.0)], &["D1B", "N\0"]),
    ];
    for (atoms, expected) in cases {
        let s = structure(residue("SER", atoms));
        let mut found: Vec<String> = selected(&s, "all")
            .unwrap()
            .atoms
            .iter()
            .map(|&i| s.name.get(i as usize).to_owned() + &char::from(s.altloc[i as usize]).to_string())
            .collect();
        found.sort_unstable();
        assert_eq!(found, expected, "{atoms:?}");
    }
    // Atoms of another residue name are not mixed in, but common atoms stay.
    let two = residue("SER", &[("N", ' ', 1.0), ("CB", 'A', 0.4), ("OG", 'A', 0.4)])
        + &residue("THR", &[("CB", 'B', 0.6), ("CG2", 'B', 0.6)]);
    let s = structure(&two);
    assert_eq!(names_of(&s, 1), ["N\0", "CBB", "CG2B"]);
    let preferred = Selection { altloc: Some('A'), ..Selection::default() };
    assert_eq!(select(&s, &preferred).unwrap().atoms.len(), 3);
    assert_eq!(s.starts_residue.iter().filter(|starts| **starts).count(), 1);
}

/// Number of distinct atoms of each residue of the first model: chain, number, insertion code, name.
type Sizes = BTreeMap<(String, i32, String, String), usize>;

#[test]
fn agrees_with_biopython_on_the_atoms_of_residues() {
    let alone = tools::some_structures();
    let mut paths: Vec<PathBuf> = ["alt_incomplete.pdb", "alt_segments.pdb"].map(|name| folder().join(name)).into();
    paths.extend(["1ejg.pdb.gz", "1ubq.pdb.gz"].map(|name| alone.join(name)));
    let Some(reports) = tools::python::<Vec<(String, i32, String, String, usize)>>("biopython_residues.py", &paths)
    else {
        return;
    };
    let mut n_residues = 0;
    for (path, report) in paths.iter().zip(reports) {
        let s = structure(std::fs::read(path).unwrap());
        let mut ours = Sizes::new();
        let residue = |i: usize| {
            let code =
                Some(s.insertion_code[i]).filter(|code| *code != 0).map_or(String::new(), |c| char::from(c).into());
            (s.chain.get(i).to_owned(), s.residue_number[i], code, s.residue.get(i).to_owned())
        };
        for i in selected(&s, "all").unwrap().atoms {
            *ours.entry(residue(i as usize)).or_default() += 1;
        }
        // Biopython chooses another residue name where there are several.
        let names: HashMap<_, _> = report.iter().map(|(chain, n, code, name, _)| ((chain, n, code), name)).collect();
        ours.retain(|(chain, n, code, name), _| names.get(&(chain, n, code)) == Some(&name));
        let theirs: Sizes = report.iter().map(|(a, b, c, d, n)| ((a.clone(), *b, c.clone(), d.clone()), *n)).collect();
        for (residue, n) in &ours {
            assert_eq!(theirs.get(residue), Some(n), "{}: {residue:?}", path.display());
        }
        n_residues += ours.len();
    }
    assert!(n_residues > 150, "{n_residues}");
}

// ---- polymers, residues, frames ----

#[test]
fn unknown_residues_in_atom_records_are_polymer_only_if_joined_to_one() {
    let ligand = text("ligand_atom.pdb");
    let kinds = |text: &str| {
        let s = structure(text);
        (count(&s, "polymer"), count(&s, "ligand"), s.warnings.len())
    };
    assert_eq!(kinds(&ligand), (20, 4, 1));
    // Nothing else is in the file.
    let alone: String = ligand.lines().filter(|line| line.contains("LIG")).map(|line| line.to_owned() + "\n").collect();
    assert_eq!(kinds(&alone), (4, 0, 0));
    // Listed by SEQRES; bonded to the last residue; a trace of alpha carbons.
    assert_eq!(kinds(&format!("SEQRES   1 A    5  ALA ALA ALA ALA LIG\n{ligand}")), (24, 0, 0));
    let bonded =
        ligand.replace("  C1  LIG A 301       0.000   7.000   0.000", "  N   LIG A 301      14.400   0.000   0.000");
    assert_eq!(kinds(&bonded), (24, 0, 0));
    let trace: String =
        ligand.lines().filter(|line| line.contains(" CA ")).map(|line| line.to_owned() + "\n").collect();
    let trace = trace + "ATOM     61  CA  QQQ A   5      15.600   0.800   0.000  1.00  0.00           C\n";
    assert_eq!(kinds(&trace), (5, 0, 0));
    // A lipid with the phosphorus of a nucleotide, and one with its sugar.
    let nucleic = |atoms: &[&str]| {
        let atoms: String = atoms
            .iter()
            .enumerate()
            .map(|(i, atom)| {
                format!(
                    "HETATM{i:>5}  {atom:<4}QQQ B   1    {i:>8.3}   0.000   0.000  1.00  0.00           {}\n",
                    &atom[..1]
                )
            })
            .collect();
        let s = structure(format!("SEQRES   1 B    1  QQQ\n{atoms}"));
        count(&s, "nucleic")
    };
    assert_eq!([&["P"][..], &["P", "O1P"], &["P", "C1'"], &["C1'", "C4'"], &["C4*"]].map(nucleic), [0, 0, 2, 2, 0]);
}

/// Returns atoms of a residue as PDB lines: record, residue name, number, and names and x coordinates of atoms.
fn lines(record: &str, residue: &str, number: &str, atoms: &[(&str, f64)]) -> String {
    let line = |(atom, x): &(&str, f64)| {
        let element = &atom[..1];
        format!(
            "{record:<6}    1  {atom:<3} {residue:<4}A{number:>4}    {x:>8.3}   0.000   0.000  1.00  0.00           {element}\n"
        )
    };
    atoms.iter().map(line).collect()
}

#[test]
fn a_bond_or_a_shared_number_makes_a_residue_part_of_the_polymer() {
    let backbone = |x: f64| [("N", x), ("CA", x + 1.2), ("C", x + 2.4), ("O", x + 3.0)];
    let chain = |name: &str| {
        lines("ATOM", "ALA", "1", &backbone(0.0))
            + &lines("ATOM", name, "2", &backbone(3.6))
            + &lines("ATOM", "GLY", "3", &backbone(7.2))
    };
    // XYZ and CT3 are saccharides in the component dictionary.
    for name in ["QQQ", "XYZ", "CT3", "HEM"] {
        assert_eq!(count(&structure(chain(name)), "protein"), 12, "{name}");
        let apart = lines("ATOM", "ALA", "1", &backbone(0.0)) + &lines("ATOM", name, "2", &backbone(20.0));
        assert_eq!(count(&structure(apart), "polymer"), 4, "{name}");
    }
    // PDB2PQR gives patched atoms other residue names.
    let patched = lines("ATOM", "NTER", "1", &[("N", 0.0), ("CA", 1.2)])
        + &lines("ATOM", "ALA", "1", &[("C", 2.4), ("CB", 1.9)])
        + &lines("ATOM", "CTER", "1", &[("OT2", 3.6)]);
    let s = structure(patched);
    assert_eq!((count(&s, "polymer"), count(&s, "byres name CB"), s.warnings.len()), (5, 2, 0));
}

#[test]
fn alternatives_belong_to_one_residue() {
    let with_letters = |text: &str, letters: [char; 2]| -> String {
        let put = |line: &str, letter: char| format!("{}{letter}{}\n", &line[..16], &line[17..]);
        text.lines().flat_map(|line| letters.map(|letter| put(line, letter))).collect()
    };
    let phe = lines("ATOM", "PHE", "4", &[("N", 0.0), ("CA", 1.2), ("C", 2.4), ("O", 3.0)]);
    let other = lines("ATOM", "ALA", "5", &[("N", 3.6), ("CA", 4.8)]);
    // A ligand with letters has the number of a residue without.
    let ligand = with_letters(&lines("HETATM", "LIG", "4", &[("N", 50.0), ("CA", 51.0), ("O", 52.0)]), ['A', 'B']);
    let s = structure(format!("{phe}{other}{ligand}"));
    assert_eq!((count(&s, "polymer"), count(&s, "ligand")), (6, 3));
    // Letters of both, at the end of the file.
    let first: String = phe.lines().map(|line| format!("{}A{}\n", &line[..16], &line[17..])).collect();
    let second = first.replace("A PHE", "BPHE").replace("APHE", "BPHE");
    let s = structure(format!("{first}{other}{second}"));
    assert_eq!((s.len(), count(&s, "polymer")), (10, 6));
    // Conformers in segments of their own.
    let segment = |text: &str, name: &str| text.replace("          ", &format!("      {name} ")[..10]);
    let s = structure(segment(&first, "AC1") + &segment(&second, "AC2"));
    assert_eq!(count(&s, "polymer"), 4);
    // Residues without numbers.
    let blank = |text: String| text.replace("A   4", "A    ").replace("A   5", "A    ");
    let s = structure(blank(other.replace("ALA", "LEU") + &with_letters(&phe, ['A', 'B'])));
    assert_eq!(count(&s, "polymer"), 6);
}

#[test]
fn one_oxygen_is_water_unless_it_is_part_of_a_ligand() {
    let hetatm = |i: usize, name: &str, residue: &str, number: i32, x: f64| {
        format!(
            "HETATM{i:>5}  {name:<4}{residue} A{number:>4}    {x:>8.3}   0.000   0.000  1.00  0.00           {}\n",
            &name[..1]
        )
    };
    let waters = |atoms: &[(&str, &str, i32, f64)]| {
        let file: String = atoms.iter().enumerate().map(|(i, (a, r, n, x))| hetatm(i, a, r, *n, *x)).collect();
        count(&structure(file), "water and not hydrogen")
    };
    assert_eq!(waters(&[("O", "QQQ", 1, 0.0), ("H1", "QQQ", 1, 1.0), ("H2", "QQQ", 1, 2.0)]), 1);
    assert_eq!(waters(&[("O", "QQQ", 1, 0.0), ("H1", "QQQ", 1, 1.0), ("H2", "QQQ", 1, 2.0), ("H3", "QQQ", 1, 3.0)]), 0);
    assert_eq!(waters(&[("O", "QQQ", 1, 0.0), ("C", "QQQ", 1, 1.4)]), 0);
    assert_eq!(waters(&[("O", "QQQ", 1, 0.0), ("O", "QQQ", 1, 9.0)]), 2);
    // A ligand whose atoms have the names of their elements, bonded or not.
    assert_eq!(waters(&[("C", "QQQ", 1, 0.0), ("C", "QQQ", 1, 1.4), ("O", "QQQ", 1, 2.8), ("O", "QQQ", 1, 4.2)]), 0);
    assert_eq!(waters(&[("C", "QQQ", 1, 0.0), ("C", "QQQ", 1, 9.0), ("O", "QQQ", 1, 19.0), ("O", "QQQ", 1, 29.0)]), 0);
}

#[test]
fn repeated_names_and_segments_begin_residues() {
    let n_residues = |text: &str| structure(text).starts_residue.iter().filter(|starts| **starts).count();
    let ala = |segment: &str| {
        let atoms = ["N ", "CA", "C ", "O "].iter().zip([0.0, 1.2, 2.4, 2.4]);
        let line = |(atom, x): (&&str, f64)| {
            format!("ATOM      1  {atom}  ALA A   1    {x:>8.3}   0.000   0.000  1.00  0.00      {segment:<4}\n")
        };
        atoms.map(line).collect::<String>()
    };
    assert_eq!(n_residues(&ala("PROA")), 1);
    assert_eq!(n_residues(&(ala("PROA") + &ala("PROA"))), 2);
    let halves = ala("PROA").lines().take(2).map(|l| l.to_owned() + "\n").collect::<String>()
        + &ala("PROB").lines().skip(2).map(|l| l.to_owned() + "\n").collect::<String>();
    assert_eq!(n_residues(&halves), 2);
    assert_eq!(n_residues(&text("numberless_alt.cif")), 4 + 3);
    let byres = count(&structure(text("charmm_membrane.pdb")), "byres (resn POPC and resi 2)");
    assert_eq!(byres, 23);
}

#[test]
fn end_records_separate_frames_of_the_same_atoms_only() {
    let part = |chain: char, n: usize| -> String {
        (1..=n)
            .map(|i| {
                format!("ATOM  {i:>5}  CA  ALA {chain}{i:>4}    {i:>8.3}   0.000   0.000  1.00  0.00           C\n")
            })
            .collect()
    };
    let models = |text: &str| structure(text).model;
    let (a, b) = (part('A', 2), part('B', 1));
    assert_eq!(models(&format!("{a}END\n{b}END\n")), [1, 1, 1]);
    assert_eq!(models(&format!("{a}END\n{a}END\n{a}END\n")), [1, 1, 2, 2, 3, 3]);
    assert_eq!(models(&format!("{a}END\nEND\n{b}END\n{b}")), [1, 1, 1, 2]);
    assert_eq!(models(&format!("{a}ENDMDL\n{b}ENDMDL\n")), [1, 1, 2]);
    assert_eq!(models(&format!("MODEL 1\n{a}END\n{b}END\n")), [1, 1, 2]);
}

#[test]
fn helices_and_strands_follow_the_order_of_the_file() {
    let strand = |text: &str| {
        let s = structure(text);
        let ranges = SecondaryRanges::of(&s);
        let has = |i: &usize| ranges.as_ref().is_some_and(|ranges| ranges.get(&s, *i).is_some());
        (0..s.len())
            .filter(|i| s.name.get(*i) == "CA")
            .filter(has)
            .map(|i| char::from(s.insertion_code[i]))
            .collect::<String>()
    };
    let file = text("sheet_reverse.pdb");
    assert_eq!(strand(&file), "FEDC");
    // By number, if an end is missing; nothing, if the ends name different chains.
    assert_eq!(strand(&file.replace("ALA L   1C 0", "ALA L   1Z 0")), "HGF");
    assert_eq!(strand(&file.replace("ALA L   1C 0", "ALA M   1C 0")), "");
    let helix = structure(text("helix_cross.pdb"));
    let ranges = SecondaryRanges::of(&helix).unwrap();
    let n = (0..helix.len()).filter(|&i| helix.name.get(i) == "CA" && ranges.get(&helix, i).is_some()).count();
    assert_eq!(n, 3);
}

#[test]
fn charges_and_radii_are_those_of_pqr() {
    let s = structure(text("fpocket.pqr"));
    assert_eq!(s.radius, [3.3, 3.08, 3.32]);
    assert_eq!((s.z[2], s.residue.get(2), s.residue_number[2]), (-124.1, "STP", 1));
    let s = structure(text("joined_first.pqr"));
    assert_eq!((s.radius[0], s.x[0], s.y[0], s.z[0]), (1.908, -26.0, -132.669, -122.669));
    let s = structure("ATOM     12  OE1GLUP A  12     -26.000-132.669-122.669 -0.8188 1.6612\n");
    assert_eq!((s.name.get(0), s.residue.get(0), s.chain.get(0), s.residue_number[0]), ("OE1", "GLUP", "A", 12));
    // An element after the radius.
    let s = structure("ATOM      1  N   ALA A   1      10.000  10.000  10.000 -0.12312092   1.550  S\n");
    assert_eq!((s.radius[0], s.element[0]), (1.55, 16));
    // Two decimals in the columns of PDB: occupancies and B-factors, with a warning.
    let line = |q: &str, r: &str| format!("ATOM      1  N   ALA A   1      10.000  10.000  10.000{q:>6}{r:>6}\n");
    let warnings = |lines: &[String]| structure(lines.concat()).warnings.len();
    assert_eq!(warnings(&[line("-0.42", "1.82"), line("0.60", "1.91").replace("10.000", "20.000")]), 1);
    assert_eq!(warnings(&[line("1.00", "1.82"), line("1.00", "1.91").replace("10.000", "20.000")]), 0);
    let with_element = line("-0.42", "1.82").trim_end().to_owned() + "           N\n";
    assert_eq!(warnings(&[with_element, line("0.60", "1.91").replace("10.000", "20.000")]), 0);
    assert_eq!(warnings(&[line("0.50", "21.82"), line("1.00", "1.91").replace("10.000", "20.000")]), 0);
}

#[test]
fn unusual_numbers_and_letters_do_not_reject_a_file() {
    let cif = text("auth_seq_code.cif");
    let s = structure(&cif);
    assert_eq!((s.residue_number[5], s.insertion_code[5]), (2, b'A'));
    // Text without a number is replaced by label_seq_id.
    let s = structure(cif.replace(" 2A ", " x7 "));
    assert_eq!((s.residue_number[5], s.insertion_code[5]), (2, 0));
    assert!(s.warnings[0].contains("replaced by label_seq_id"), "{:?}", s.warnings);
    let s = structure(cif.replace("ALA A 1 2 ?", "ALA A 1 2 BC").replace(" 2A ", " 2 "));
    assert_eq!((s.residue_number[5], s.insertion_code[5]), (2, b'B'));
    // Alternative locations of two characters are different ones.
    let alternatives = cif.replace("ATOM 5 C CB . ALA", "ATOM 5 C CB AA ALA").replace(
        "ATOM 6 N N . ALA A 1 2 ? 3.600 0.000 0.000 1.00 50.0 2A ALA A N 1",
        "ATOM 6 C CB AB ALA A 1 1 ? 1.9 1.7 1.2 0.40 50.0 1 ALA A CB 1",
    );
    let s = structure(&alternatives);
    assert_ne!(s.altloc[4], s.altloc[5]);
    assert_eq!(count(&s, "resi 1"), 5);
}

#[test]
fn residue_numbers_above_9999_are_read_as_programs_write_them() {
    let water = |number: &str| lines("ATOM", "HOH", number, &[("O", 0.0), ("H1", 0.9)]);
    let file = [" 271a", " ffff", " ****", " ****", " A000"].map(|number| water(&number[1..]));
    let s = structure(file.concat());
    let numbers: Vec<i32> = s.residue_number.iter().step_by(2).copied().collect();
    assert_eq!((numbers[0], &numbers[2..]), (0x271a, &[0, 0, 10_000][..]));
    assert_eq!(s.starts_residue.iter().filter(|starts| **starts).count(), 5);
    assert!(s.warnings[0].contains("found `****`, expected a residue number"), "{:?}", s.warnings);
    // A digit in column 27 after blanks.
    let s = structure(water("   ").replace("A        ", "A    5   "));
    assert_eq!((s.residue_number[0], s.insertion_code[0]), (5, 0));
}

#[test]
fn many_atoms_at_one_place_are_reported() {
    let file = |n: usize| -> String {
        (1..=n)
            .map(|i| format!("ATOM  {i:>5}  CA  ALA A{i:>4}       0.000   0.000   0.000  1.00  0.00           C\n"))
            .collect()
    };
    assert_eq!(structure(file(10)).warnings, [""; 0]);
    assert_eq!(
        structure(file(11)).warnings,
        ["11 atoms have the same position (0, 0, 0), the first is atom 1; all are read"]
    );
    let far = |x: f64| file(3).replacen("       0.000", &format!("    {x:>8.3}"), 1);
    assert_eq!(structure(far(999.0)).warnings.len(), 0);
    assert_eq!(structure(far(1001.0)).warnings.len(), 1);
}

#[test]
fn other_formats_are_rejected_by_name() {
    let error = |text: &str| read(text.as_bytes(), &ReadLimits::default()).unwrap_err().to_string();
    let crystal = "data_x\n_cell_length_a 5\nloop_\n_atom_site_label\n_atom_site_fract_x\n_atom_site_fract_y\n\
                   _atom_site_fract_z\nC1 0.1 0.2 0.3\n";
    assert!(error(crystal).contains("fractional coordinates only"), "{}", error(crystal));
    for (text, name) in [
        ("# Name: x\nATOM\n@<TRIPOS>MOLECULE\nx\n", "Tripos MOL2"),
        ("REMARK\n  tool\n\n  1  0  0  0  0  0            999 V2000\n", "an MDL molfile (SDF)"),
    ] {
        let error = error(text);
        assert!(error.contains(name) && error.contains("expected PDB, mmCIF, BinaryCIF, PQR or XYZ"), "{error}");
    }
}

#[test]
fn entities_come_from_the_atoms_if_no_category_has_them() {
    let full = text("entity_no_asym.cif");
    let rows = full.split_once("loop_\n_atom_site").unwrap().1;
    let alone = format!("data_x\nloop_\n_atom_site{rows}");
    for text in [&full, &alone] {
        let s = structure(text);
        let entity = |i: usize| s.entities[s.label_chain.id(i) as usize].as_str();
        assert_eq!(s.entities, ["1", "3", "2"]);
        assert_eq!([0, 25, 52].map(entity), ["1", "3", "2"]);
    }
}

// ---- every atom is meshed or counted ----

/// Returns the number of atom records of a PDB or mmCIF text, counted without the reader.
fn records(text: &str) -> u64 {
    text.lines().filter(|line| line.starts_with("ATOM") || line.starts_with("HETATM")).count() as u64
}

fn meshed_and_left_out(s: &Structure, atoms: &str) -> u64 {
    let found = selected(s, atoms).unwrap();
    found.atoms.len() as u64 + found.left_out.total
}

#[test]
fn every_atom_of_real_files_is_meshed_or_counted() {
    let mut files: Vec<PathBuf> = std::fs::read_dir(folder()).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.extend(["samples/4pti.pdb", "samples/1crn.cif"].map(PathBuf::from));
    files.extend(std::fs::read_dir(tools::some_structures()).unwrap().map(|entry| entry.unwrap().path()));
    let mut n_files = 0;
    for path in files {
        let bytes = std::fs::read(&path).unwrap();
        let Ok(s) = read(&bytes, &ReadLimits::default()) else { continue };
        let all = s.len() as u64 + s.unread.blocks + s.unread.spheres;
        for atoms in ["polymer", "all", "ligand", "water and chain A"] {
            if let Ok(found) = selected(&s, atoms) {
                assert_eq!(found.atoms.len() as u64 + found.left_out.total, all, "{}: {atoms}", path.display());
            }
        }
        if let Ok(text) = std::str::from_utf8(&bytes)
            && path.extension().is_some_and(|end| end == "pdb" || end == "cif")
        {
            assert_eq!(s.len() as u64 + s.unread.blocks, records(text), "{}", path.display());
        }
        n_files += 1;
    }
    assert!(n_files > 30, "{n_files}");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// Permutes, duplicates and removes atoms, and divides them into models, parts or data blocks.
    #[test]
    fn every_atom_of_mutated_files_is_meshed_or_counted(
        case in 0..12_usize,
        picks in proptest::collection::vec((0..1000_usize, 0..8_u8), 1..120),
        atoms in proptest::sample::select(vec!["polymer", "all", "not water", "ligand or protein"]),
    ) {
        let names = ["alt_incomplete.pdb", "alt_segments.pdb", "charmm_membrane.pdb", "cluspro.pdb", "unx.pdb",
            "water_names.pdb", "ligand_atom.pdb", "sheet_reverse.pdb", "auth_seq_code.cif", "entity_no_asym.cif",
            "numberless_alt.cif", "ihm_mixed.cif"];
        let file = text(names[case]);
        let is_cif = names[case].ends_with(".cif");
        let rows: Vec<&str> = file.lines().filter(|l| l.starts_with("ATOM") || l.starts_with("HETATM")).collect();
        let head: String = file.lines().take_while(|l| !l.starts_with("ATOM")).map(|l| l.to_owned() + "\n").collect();
        let atom_head = head.rfind("loop_\n").map_or("", |start| &head[start..]);
        let mut mutated = if is_cif { head.clone() } else { String::new() };
        let mut has_row = false;
        for (i, (pick, action)) in picks.iter().enumerate() {
            let row = rows[pick % rows.len()];
            match action {
                0 if is_cif && has_row => mutated += &format!("#\ndata_block{i}\n{atom_head}"),
                0 if !is_cif => mutated += ["END\n", "ENDMDL\n", "TER\n", "MODEL\n"][pick % 4],
                _ => {}
            }
            mutated += row;
            mutated.push('\n');
            has_row = true;
        }
        let s = structure(&mutated);
        let spheres = s.unread.spheres;
        if selected(&s, atoms).is_ok() {
            prop_assert_eq!(meshed_and_left_out(&s, atoms), records(&mutated) + spheres);
        }
    }
}

/// Negative control: a count that misses the other data blocks is found.
#[test]
fn the_count_of_records_differs_from_the_atoms_that_are_read() {
    let file = text("pymol_objects.cif");
    let s = structure(&file);
    assert_ne!(s.len() as u64, records(&file));
    assert_eq!(meshed_and_left_out(&s, "all"), records(&file));
    // Rows of the block of the atoms itself are not counted twice.
    assert_eq!(s.unread.blocks, 20);
}
