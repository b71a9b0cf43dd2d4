//! Kinds of atoms: two-letter chains, modified residues, ions, virtual sites; and counts of atoms that are left out.
//!
//! Inputs are modified samples. If gemmi is installed, its results are compared.
#![allow(
    clippy::pedantic,
    clippy::unwrap_used,
    clippy::panic,
    clippy::print_stderr,
    reason = "tests fail by panicking and print what they skip"
)]

use crate::tools;

use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;

use molmesh::structure::{
    Contents, Kind, KindCount, LeftOut, ReadLimits, ResidueCount, Selection, Structure, read, select,
};

const PDB: &str = include_str!("../../samples/4pti.pdb");
const CIF: &str = include_str!("../../samples/1crn.cif");

/// Atoms of the default selection of the PDB sample.
const POLYMER: usize = 454;

fn structure(text: impl AsRef<[u8]>) -> Structure {
    read(text.as_ref(), &ReadLimits::default()).unwrap_or_else(|e| panic!("{e}"))
}

fn selected(s: &Structure) -> Vec<u32> {
    select(s, &Selection::default()).unwrap().atoms
}

fn left_out(s: &Structure) -> LeftOut {
    select(s, &Selection::default()).unwrap().left_out
}

fn kind(kind: Kind, atoms: u64) -> KindCount {
    KindCount { kind: kind.name(), atoms }
}

fn residue(name: &str, kind: Kind, atoms: u64) -> ResidueCount {
    ResidueCount { name: name.to_owned(), kind: kind.name(), atoms }
}

/// Returns the atom lines of the PDB sample.
fn atoms() -> impl Iterator<Item = String> {
    PDB.lines().filter(|l| l.starts_with("ATOM") || l.starts_with("HETATM")).map(str::to_owned)
}

/// Rewrites columns 18 to 22 of every atom and TER record by residue name and number.
fn rewritten(columns: impl Fn(&str, i32) -> String) -> String {
    let lines = PDB.lines().map(|line| {
        if !["ATOM", "HETATM", "TER"].iter().any(|record| line.starts_with(record)) || line.len() < 27 {
            return line.to_owned() + "\n";
        }
        let new = columns(line[17..20].trim(), line[22..26].trim().parse().unwrap());
        assert_eq!(new.len(), 5, "`{new}`");
        format!("{}{new}{}\n", &line[..17], &line[22..])
    });
    lines.collect()
}

/// Returns chains and residue names in file order.
fn names(s: &Structure) -> Vec<(String, String)> {
    (0..s.len()).map(|i| (s.chain.get(i).to_owned(), s.residue.get(i).to_owned())).collect()
}

/// Reads a file with gemmi. Returns chain, residue name, selection and kind of each atom of the first model, in file
/// order.
fn gemmi(text: &str, extension: &str) -> Option<Vec<(String, String, bool, String)>> {
    let python = tools::python_interpreter().or_else(|| tools::missing("gemmi"))?;
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join(format!("input.{extension}"));
    std::fs::write(&path, text).unwrap();
    let output = Command::new(python).arg("tests/tools/gemmi_dump.py").arg(Path::new(&path)).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let rows = String::from_utf8(output.stdout).unwrap();
    let rows = rows.lines().skip(1).map(|row| {
        let fields: Vec<&str> = row.split('\t').collect();
        (fields[0].to_owned(), fields[3].to_owned(), fields[13] == "1", fields[14].to_owned())
    });
    Some(rows.collect())
}

fn ours(s: &Structure) -> Vec<(String, String, bool)> {
    let taken = selected(s);
    let flags = (0..s.len()).map(|i| taken.binary_search(&(i as u32)).is_ok());
    names(s).into_iter().zip(flags).map(|((chain, residue), taken)| (chain, residue, taken)).collect()
}

/// Compares with gemmi, ignoring the order, since gemmi moves water to the end of its chain.
fn agrees_with_gemmi(text: &str, extension: &str) -> Option<bool> {
    let rows = gemmi(text, extension)?.into_iter();
    let mut theirs: Vec<_> = rows.map(|(chain, residue, taken, _)| (chain, residue, taken)).collect();
    let mut ours = ours(&structure(text));
    theirs.sort();
    ours.sort();
    Some(theirs == ours)
}

// ---- column 21 ----

/// `HIS` in place of `ALA`: the sample has no histidine.
fn with_histidine(name: &str) -> &str {
    if name == "ALA" { "HIS" } else { name }
}

#[test]
fn two_letter_chains_keep_every_residue() {
    // With these first letters HIS, LYS, ASP, GLU, CYS, ARG, ALA and MET spell a residue name of four letters.
    for chain in ["AA", "HA", "2A", "DA", "EA", "BA", "NA", "TA", "Az", "1x"] {
        let text = rewritten(|name, _| format!("{:>3}{chain}", with_histidine(name)));
        let s = structure(&text);
        for (found, line) in names(&s).into_iter().zip(atoms()) {
            assert_eq!(found, (chain.to_owned(), with_histidine(line[17..20].trim()).to_owned()));
        }
        let selection = Selection { chains: Some(vec![chain.to_owned()]), ..Selection::default() };
        assert_eq!(select(&s, &selection).unwrap().atoms.len(), POLYMER, "{chain}");
        if let Some(agrees) = agrees_with_gemmi(&text, "pdb") {
            assert!(agrees, "{chain}: gemmi reads other chains or residues");
        }
    }
}

#[test]
fn mixes_one_and_two_letter_chains() {
    let text: String = [" A", "AA", "HA", "BA", " B", "HB"]
        .map(|chain| rewritten(|name, _| format!("{:>3}{chain}", with_histidine(name))).replace("END", "REMARK"))
        .concat();
    let mut counts: BTreeMap<String, usize> = BTreeMap::new();
    names(&structure(&text)).into_iter().for_each(|(chain, _)| *counts.entry(chain).or_default() += 1);
    let expected = ["A", "AA", "B", "BA", "HA", "HB"].map(|chain| (chain.to_owned(), 514));
    assert_eq!(counts.into_iter().collect::<Vec<_>>(), expected);
    if let Some(agrees) = agrees_with_gemmi(&text, "pdb") {
        assert!(agrees);
    }
}

#[test]
fn keeps_four_letter_residue_names() {
    // GROMOS names of charged and bonded residues.
    let gromos = |name: &str| match name {
        "LYS" | "ASP" | "GLU" | "CYS" => format!("{name}HA"),
        "ARG" => "ARGNA".to_owned(),
        "ALA" => "HISAA".to_owned(),
        name => format!("{name:>3} A"),
    };
    // AMBER names of chain ends.
    let amber = |name: &str, number: i32| match number {
        1 => "NMETA".to_owned(),
        58 => "CALAA".to_owned(),
        _ => format!("{name:>3} A"),
    };
    // Names right-aligned in four columns.
    let right = |name: &str| format!("{name:>4}A");
    for (case, text) in [
        ("gromos", rewritten(|name, _| gromos(name))),
        ("amber", rewritten(amber)),
        ("right", rewritten(|name, _| right(name))),
    ] {
        let s = structure(&text);
        assert!(names(&s).iter().all(|(chain, _)| chain == "A"), "{case}");
        assert_eq!(selected(&s).len(), POLYMER, "{case}");
        for ((_, residue), line) in names(&s).into_iter().zip(atoms()) {
            let (name, number) = (line[17..20].trim(), line[22..26].trim().parse().unwrap());
            let expected = match case {
                "gromos" => gromos(name)[..4].trim().to_owned(),
                "amber" => amber(name, number)[..4].trim().to_owned(),
                _ => name.to_owned(),
            };
            assert_eq!(residue, expected, "{case}: {line}");
        }
        // Control: gemmi always reads a chain of two letters, so the comparison above can fail.
        if let Some(agrees) = agrees_with_gemmi(&text, "pdb") {
            assert!(!agrees, "{case}: gemmi reads residue names of four letters now");
        }
    }
}

#[test]
fn keeps_names_of_lipids_and_water_of_simulations() {
    let line = |residue: &str, number: i32, x: f64| {
        format!("ATOM      1  P   {residue}{number:>4}    {x:8.3}   0.000   0.000  1.00  0.00\n")
    };
    let mut text = rewritten(|name, _| format!("{name:>3} A"));
    for i in 1..=6 {
        text += &line(if i % 2 == 0 { "POPCM" } else { "DOPCM" }, i, 100.0 + f64::from(i));
        text += &line("TIP3W", i, 200.0 + f64::from(i));
    }
    let s = structure(&text);
    let tail: Vec<_> = names(&s)[514..].iter().map(|(c, r)| format!("{r} {c}")).collect();
    assert_eq!(tail, ["DOPC M", "TIP3 W", "POPC M", "TIP3 W"].repeat(3));
}

#[test]
fn seqres_identifies_a_chain_with_one_residue_name() {
    let atoms: String = (1..=9)
        .map(|i| format!("ATOM  {i:>5}  CA  HISHA{i:>4}    {i:8.3}   0.000   0.000  1.00  0.00           C\n"))
        .collect();
    assert_eq!(names(&structure(&atoms))[0], ("A".to_owned(), "HISH".to_owned()));
    let listed = format!("SEQRES   1HA    9  HIS HIS HIS HIS HIS HIS HIS HIS HIS\n{atoms}");
    assert_eq!(names(&structure(listed))[0], ("HA".to_owned(), "HIS".to_owned()));
}

#[test]
fn ligands_have_two_letter_chains_too() {
    let protein = rewritten(|name, _| format!("{name:>3}AA"));
    let ligand = "HETATM    1  C1  LIGBA 900     100.000   0.000   0.000  1.00  0.00           C\n";
    assert_eq!(names(&structure(protein + ligand)).last().unwrap(), &("BA".to_owned(), "LIG".to_owned()));
    // Without such chains the name may have four letters.
    assert_eq!(names(&structure(ligand)), [("A".to_owned(), "LIGB".to_owned())]);
}

// ---- HETATM residues of a polymer ----

/// The PDB sample with methionine 52 as a HETATM record of another name, and `remarks` before the atoms.
fn modified(name: &str, remarks: &str, shift: f64) -> String {
    let lines = atoms().map(|line| {
        if &line[17..26] != "MET A  52" {
            return line + "\n";
        }
        let x: f64 = line[30..38].trim().parse().unwrap();
        format!("HETATM{}{name:>3}{}{:8.3}{}\n", &line[6..17], &line[20..30], x + shift, &line[38..])
    });
    remarks.to_owned() + &lines.collect::<String>()
}

#[test]
fn a_residue_with_peptide_bonds_is_polymer() {
    for name in ["MSE", "SME", "XYZ"] {
        let text = modified(name, "", 0.0);
        let s = structure(&text);
        assert_eq!(selected(&s), selected(&structure(PDB)), "{name}");
        assert_eq!(s.hetero.iter().filter(|h| **h).count(), 60 + 8, "{name}: records stay what they are");
    }
    // Control: the same residue 10 Å away is a ligand, unless the file lists it.
    let apart = structure(modified("MSE", "", 10.0));
    assert_eq!(selected(&apart).len(), POLYMER - 8);
    assert_eq!(left_out(&apart).residues, [residue("HOH", Kind::Water, 60), residue("MSE", Kind::Ligand, 8)]);
    assert_eq!(left_out(&apart).kinds, [kind(Kind::Water, 60), kind(Kind::Ligand, 8)]);
    for listed in ["SEQRES   5 A   58  ARG MSE CYS GLY GLY ALA\n", "MODRES 4PTI MSE A   52  MET  SELENOMETHIONINE\n"] {
        assert_eq!(selected(&structure(modified("MSE", listed, 10.0))).len(), POLYMER, "{listed}");
        let other_chain = listed.replace(" A   5", " B   5");
        assert_eq!(selected(&structure(modified("MSE", &other_chain, 10.0))).len(), POLYMER - 8, "{other_chain}");
    }
    // A standard amino acid may be a ligand of a protein that contains it.
    let free = modified("MET", "SEQRES   5 A   58  ARG MET CYS GLY GLY ALA\n", 10.0);
    assert_eq!(selected(&structure(free)).len(), POLYMER - 8);
}

#[test]
fn gemmi_selects_the_same_modified_residues() {
    for name in ["MSE", "SEP"] {
        if let Some(agrees) = agrees_with_gemmi(&modified(name, "", 0.0), "pdb") {
            assert!(agrees, "{name}");
        }
    }
    if let Some(agrees) = agrees_with_gemmi(CIF, "cif") {
        assert!(agrees && agrees_with_gemmi(&modified_cif("LIG"), "cif") == Some(true));
        // Control: gemmi decides by the end of the chain, molmesh by bonds.
        assert_eq!(agrees_with_gemmi(&modified("MSE", "", 10.0), "pdb"), Some(false));
    }
}

#[test]
fn bonds_connect_several_modified_residues_but_not_ligands() {
    let line = |record: &str, name: &str, residue: &str, number: i32, x: f64| {
        format!(
            "{record:<6}    1  {name:<3} {residue} A{number:>4}    {x:8.3}   0.000   0.000  1.00  0.00           {}\n",
            &name[..1]
        )
    };
    // Each residue is 3.8 Å long, its C 1.3 Å from the next N.
    let residue = |record: &str, name: &str, number: i32| {
        let x = 3.8 * f64::from(number);
        line(record, "N", name, number, x) + &line(record, "C", name, number, x + 2.5)
    };
    let chain = |records: [&str; 4]| -> String {
        records
            .iter()
            .zip(1..)
            .map(|(record, i)| residue(record, ["GLY", "AIB", "DVA", "NH2"][i as usize - 1], i))
            .collect()
    };
    let taken = |text: &str| select(&structure(text), &Selection::default()).map(|s| s.atoms.len()).unwrap_or(0);
    assert_eq!(taken(&chain(["ATOM", "HETATM", "HETATM", "HETATM"])), 8);
    assert_eq!(taken(&chain(["HETATM", "HETATM", "HETATM", "ATOM"])), 8);
    // A peptide without any polymer residue is a ligand.
    assert_eq!(taken(&chain(["HETATM"; 4])), 0);
    let broken =
        chain(["ATOM", "HETATM", "HETATM", "HETATM"]).replace("DVA A   3      13.900", "DVA A   3      19.900");
    assert_eq!(taken(&broken), 6, "the last one is bonded to none");
    // There are no bonds between chains or models.
    assert_eq!(taken(&chain(["ATOM", "HETATM", "HETATM", "HETATM"]).replace("AIB A", "AIB B")), 2);
    let nucleotides = line("ATOM", "P", " DA", 1, 0.0)
        + &line("ATOM", "O3'", " DA", 1, 4.0)
        + &line("HETATM", "P", "5CM", 2, 5.6)
        + &line("HETATM", "C1'", "5CM", 2, 7.0);
    assert_eq!(taken(&nucleotides), 4);
    assert_eq!(taken(&nucleotides.replace("O3'", "O2'")), 2);
}

/// The mmCIF sample with threonine 2 as a HETATM record of another name.
fn modified_cif(name: &str) -> String {
    let rows = CIF.lines().map(|line| {
        if line.starts_with("ATOM") && line.split_whitespace().nth(8) == Some("2") {
            line.replacen("ATOM", "HETATM", 1).replace("THR", name) + "\n"
        } else {
            line.to_owned() + "\n"
        }
    });
    rows.collect()
}

/// Returns the sample with new values of an item of `atom_site`, computed from the old ones.
fn with_item(text: &str, item: &str, value: impl Fn(&str, bool) -> String) -> String {
    let place =
        text.lines().filter(|l| l.starts_with("_atom_site.")).position(|l| l.trim() == format!("_atom_site.{item}"));
    let place = place.unwrap();
    let lines = text.lines().map(|line| {
        if !(line.starts_with("ATOM") || line.starts_with("HETATM")) {
            return line.to_owned() + "\n";
        }
        let mut values: Vec<String> = line.split_whitespace().map(str::to_owned).collect();
        values[place] = value(&values[place], line.starts_with("HETATM"));
        values.join(" ") + "\n"
    });
    lines.collect()
}

#[test]
fn entities_decide_at_any_place_in_the_file() {
    let sample = structure(CIF);
    let text = modified_cif("LIG");
    let s = structure(&text);
    assert_eq!(s.hetero.iter().filter(|h| **h).count(), 7);
    assert_eq!(selected(&s), selected(&sample));
    // The entity decides, even against sequence numbers and bonds.
    let ligand =
        text.replace("_entity.type                       polymer", "_entity.type                       non-polymer");
    let ligand = ligand.replace("_entity_poly.entity_id", "_entity_poly.other_id");
    assert_ne!(ligand, text);
    assert_eq!(selected(&structure(&ligand)).len(), sample.len() - 7);
    // After the atoms, as in files sorted by name.
    let (head, tail): (Vec<&str>, Vec<&str>) =
        text.lines().partition(|l| !(l.starts_with("_entity.") || l.starts_with("_struct_asym.")));
    let behind = format!("{}\n{}\n", head.join("\n"), tail.join("\n"));
    assert_eq!(selected(&structure(&behind)), selected(&sample));
    let behind = behind.replace("_entity.type                       polymer", "_entity.type non-polymer");
    assert_eq!(
        selected(&structure(behind.replace("_entity_poly.entity_id", "_entity_poly.other_id"))).len(),
        sample.len() - 7
    );
}

#[test]
fn sequence_numbers_and_bonds_decide_without_entities() {
    let sample = structure(CIF);
    let unknown = modified_cif("LIG").replace("_struct_asym.entity_id", "_struct_asym.other_id");
    let unknown = unknown.replace("_atom_site.label_entity_id", "_atom_site.other_id");
    assert_eq!(selected(&structure(&unknown)), selected(&sample), "bonds");
    // Far from its neighbours the residue is a ligand.
    let far = with_item(&unknown, "Cartn_x", |x, hetero| if hetero { "99.0".to_owned() } else { x.to_owned() });
    assert_eq!(selected(&structure(&far)).len(), sample.len() - 7);
    // Its sequence number makes it polymer, if another HETATM record has none ...
    let water = far.lines().find(|l| l.starts_with("HETATM")).unwrap().replace("LIG", "HOH").replace("THR", "HOH");
    let row = |number: &str| {
        let row = with_item(&format!("{}{water}\n", header(&far)), "label_seq_id", |_, _| number.to_owned());
        row.lines().last().unwrap().to_owned()
    };
    let with = |number: &str| far.replacen("HETATM", &format!("{}\nHETATM", row(number)), 1);
    assert_eq!(selected(&structure(with("."))).len(), sample.len());
    // ... and means nothing if water is numbered too.
    assert_eq!(selected(&structure(with("7"))).len(), sample.len() - 7);
}

/// The lines before the first atom.
fn header(text: &str) -> String {
    text.lines().take_while(|l| !l.starts_with("ATOM")).map(|l| l.to_owned() + "\n").collect()
}

// ---- ions and virtual sites ----

fn line(record: &str, name: &str, residue: &str, number: i32, x: f64, element: &str) -> String {
    format!(
        "{record:<6}    1 {name:<4} {residue:<4}A{number:>4}    {x:8.3}   0.000   0.000  1.00  0.00          {element:>2}\n"
    )
}

#[test]
fn single_ions_are_ions_in_any_record() {
    for (name, residue) in [
        ("NA  ", "NA"),
        ("CL  ", "CL-"),
        ("SOD ", "SOD"),
        ("CLA ", "CLA"),
        (" K  ", "K+"),
        ("ZN  ", "ZN2"),
        ("FE  ", "FE2"),
        ("YB  ", "YB"),
        (" I  ", "IOD"),
    ] {
        for record in ["ATOM", "HETATM"] {
            let s = structure(line(record, name, residue, 1, 0.0, ""));
            assert_eq!(s.kind, [Kind::Ion], "{record} {residue}");
        }
    }
    // Two ions with the same residue number, and a chlorophyll with the name of CHARMM's chloride.
    let pair = line("HETATM", "NA  ", "NA", 1, 0.0, "NA") + &line("HETATM", "CL  ", "CL", 1, 9.0, "CL");
    assert_eq!(structure(pair).kind, [Kind::Ion; 2]);
    let chlorophyll = line("HETATM", "MG  ", "CLA", 1, 0.0, "MG") + &line("HETATM", " CHA", "CLA", 1, 3.0, "C");
    assert_eq!(structure(chlorophyll).kind, [Kind::Cofactor; 2]);
    // Control: a residue of neither metals nor halogens, and alpha carbons.
    for (name, residue, element, kind) in [
        (" S  ", "S", "S", Kind::Ligand),
        (" O  ", "O", "O", Kind::Water),
        ("XE  ", "XE", "XE", Kind::Ligand),
        ("SE  ", "MSE", "SE", Kind::Ligand),
        ("BR  ", "5BU", "C", Kind::Ligand),
    ] {
        assert_eq!(structure(line("HETATM", name, residue, 1, 0.0, element)).kind, [kind], "{residue}");
    }
    for (residue, kind) in [
        ("ALA", Kind::Protein),
        ("DC", Kind::Nucleic),
        ("RU", Kind::Nucleic),
        ("C", Kind::Nucleic),
        ("LIG", Kind::Polymer),
        ("POPC", Kind::Polymer),
        ("HEM", Kind::Cofactor),
        ("NAG", Kind::Glycan),
    ] {
        assert_eq!(structure(line("ATOM", " C1 ", residue, 1, 0.0, "")).kind, [kind], "{residue}");
    }
}

#[test]
fn residues_of_polymers_are_protein_or_nucleic_by_name_backbone_or_neighbour() {
    let residue = |record: &str, name: &str, number: i32, atoms: &[&str]| -> String {
        let x = 3.8 * f64::from(number);
        // The last atom of each residue lies 1.3 Å before the first one of the next.
        let at = |i: usize| if i + 1 == atoms.len() { x + 2.5 } else { x + 0.1 * i as f64 };
        atoms
            .iter()
            .enumerate()
            .map(|(i, atom)| line(record, &format!(" {atom:<3}"), name, number, at(i), "C"))
            .collect()
    };
    let kinds = |text: String| {
        let mut kinds = structure(text).kind;
        kinds.dedup();
        kinds
    };
    let amino = ["N", "CA", "C"];
    let nucleotide = ["P", "C1'", "O3'"];
    assert_eq!(kinds(residue("ATOM", "XAA", 1, &amino)), [Kind::Protein], "an unknown amino acid");
    assert_eq!(kinds(residue("ATOM", "XAA", 1, &["CA"])), [Kind::Protein], "an alpha carbon alone");
    assert_eq!(kinds(residue("ATOM", "XN", 1, &nucleotide)), [Kind::Nucleic], "an unknown nucleotide");
    assert_eq!(kinds(residue("ATOM", "XSP", 1, &["N", "CA", "P", "C"])), [Kind::Protein], "a phosphorylated residue");
    assert_eq!(kinds(residue("ATOM", "QQQ", 1, &["C1", "C2"])), [Kind::Polymer]);
    // A chromophore has neither backbone. It has the kind of the preceding residue if the file declares it polymer.
    let chromophore = |record| residue("ATOM", "GLY", 1, &amino) + &residue(record, "CRO", 2, &["N1", "CA1", "C3"]);
    let listed = "SEQRES   1 A    2  GLY CRO\n".to_owned();
    assert_eq!(kinds(listed.clone() + &chromophore("HETATM")), [Kind::Protein]);
    assert_eq!(kinds(listed + &chromophore("ATOM")), [Kind::Protein]);
    assert_eq!(kinds(chromophore("ATOM")), [Kind::Protein, Kind::Ligand]);
    assert_eq!(kinds(chromophore("HETATM")), [Kind::Protein, Kind::Ligand]);
    // A cofactor or saccharide in the sequence of the file is part of the polymer.
    for name in ["PNS", "NAG"] {
        let text = residue("ATOM", "GLY", 1, &amino) + &residue("ATOM", name, 2, &["C1", "C2"]);
        let other = if name == "NAG" { Kind::Glycan } else { Kind::Cofactor };
        assert_eq!(kinds(text.clone()), [Kind::Protein, other]);
        assert_eq!(kinds(format!("SEQRES   1 A    2  GLY {name}\n{text}")), [Kind::Protein]);
    }
}

#[test]
fn branched_entities_are_glycans() {
    let items = "id group_PDB type_symbol label_atom_id label_comp_id label_asym_id label_entity_id auth_asym_id \
                 auth_seq_id label_alt_id label_seq_id pdbx_PDB_model_num Cartn_x Cartn_y Cartn_z";
    let tags: String = items.split_whitespace().map(|item| format!("_atom_site.{item}\n")).collect();
    let rows = "1 HETATM C C1 QQQ B 1 B 1 . . 1 0 0 0\n2 HETATM O O1 QQQ B 1 B 1 . . 1 1.4 0 0\n";
    let file = |kind: &str| {
        let entities = format!("loop_\n_entity.id\n_entity.type\n1 {kind}\n");
        format!("data_x\n{entities}loop_\n_struct_asym.id\n_struct_asym.entity_id\nB 1\nloop_\n{tags}{rows}")
    };
    for (entity, kind) in [("branched", Kind::Glycan), ("non-polymer", Kind::Ligand), ("polymer", Kind::Polymer)] {
        assert_eq!(structure(file(entity)).kind, [kind; 2], "{entity}");
        if let Some(rows) = gemmi(&file(entity), "cif") {
            assert!(rows.iter().all(|row| row.3 == kind.name()), "{entity}: {rows:?}");
        }
    }
}

/// A protein, a nucleotide, a cofactor, a saccharide, a ligand, two ions and water, in records of both types.
fn mixture() -> String {
    let mut text = PDB.replace("END", "REMARK");
    for (record, name, residue, number, element) in [
        ("ATOM", " P  ", " DA", 300, "P"),
        ("ATOM", " C1'", " DA", 300, "C"),
        ("HETATM", "FE  ", "HEM", 400, "FE"),
        ("HETATM", " NA ", "HEM", 400, "N"),
        ("HETATM", " C1 ", "NAG", 401, "C"),
        ("HETATM", " O1 ", "NAG", 401, "O"),
        ("HETATM", " C1 ", "STI", 402, "C"),
        ("HETATM", " N1 ", "STI", 402, "N"),
        ("HETATM", "ZN  ", " ZN", 403, "ZN"),
        ("ATOM", "CL  ", " CL", 404, "CL"),
        ("HETATM", " S  ", "SO4", 405, "S"),
        ("HETATM", " O1 ", "SO4", 405, "O"),
    ] {
        text += &line(record, name, residue, number, 100.0 + 10.0 * f64::from(text.len() as u32 % 97), element);
    }
    text
}

#[test]
fn gemmi_and_biotite_assign_the_same_kinds() {
    let mut expected: Vec<(String, String)> = Vec::new();
    let s = structure(mixture());
    let all: Vec<Kind> = s.kind.iter().copied().filter(|kind| *kind != Kind::Water).collect();
    use Kind::{Cofactor, Glycan, Ion, Ligand, Nucleic};
    let tail = [Nucleic, Nucleic, Cofactor, Cofactor, Glycan, Glycan, Ligand, Ligand, Ion, Ion, Ligand, Ligand];
    assert_eq!(all[POLYMER..], tail);
    assert!(all[..POLYMER].iter().all(|kind| *kind == Kind::Protein));
    let counts = Contents::of(&s, None).counts;
    assert_eq!((counts.polymer, counts.protein, counts.nucleic), (456, 454, 2));
    assert_eq!((counts.ligand, counts.cofactor, counts.glycan, counts.ion, counts.water), (8, 2, 2, 2, 60));
    let found = left_out(&s);
    assert_eq!(found.kinds[..2], [kind(Kind::Water, 60), kind(Kind::Ligand, 4)]);
    assert_eq!(found.total, 70);
    for (kind, (_, residue)) in s.kind.iter().zip(names(&s)) {
        expected.push((residue, kind.name().replace("cofactor", "ligand")));
    }
    let Some(rows) = gemmi(&mixture(), "pdb") else { return };
    let mut theirs: Vec<_> = rows.into_iter().map(|(_, residue, _, kind)| (residue, kind)).collect();
    theirs.sort();
    expected.sort();
    assert_eq!(theirs, expected);
}

#[test]
fn virtual_sites_are_not_atoms() {
    let sites = [
        (" MW ", "SOL"),
        (" M  ", "WAT"),
        ("EPW ", "WAT"),
        ("EP1 ", "TP5"),
        ("LP1 ", "TIP5"),
        (" OM ", "TIP4"),
        ("LP1A", "LIG"),
        ("LPA ", "ALA"),
        ("LG1 ", "CYS"),
        ("MCB1", "ALA"),
        ("MN1 ", "LYS"),
        (" M1 ", "SOL"),
    ];
    for (name, residue) in sites {
        for record in ["ATOM", "HETATM"] {
            let s = structure(line(record, name, residue, 1, 0.0, ""));
            assert_eq!(s.kind, [Kind::VirtualSite], "{name} in {residue}");
            let all = Selection { atoms: "all".parse().unwrap(), ..Selection::default() };
            assert!(select(&s, &all).unwrap_err().to_string().contains("1 virtual sites"), "{name} in {residue}");
        }
    }
    let atoms = [
        (" MG ", "MG", ""),
        ("MN  ", "MN", ""),
        (" OW ", "SOL", ""),
        ("HW1 ", "SOL", ""),
        (" M1 ", "LIG", ""),
        ("LP  ", "LIG", "C"),
        ("LA  ", "LA", ""),
        (" OM ", "LIG", ""),
        (" D  ", "ALA", ""),
        ("EU  ", "EU", ""),
    ];
    for (name, residue, element) in atoms {
        assert_ne!(structure(line("ATOM", name, residue, 1, 0.0, element)).kind, [Kind::VirtualSite], "{name}");
    }
}

#[test]
fn identifies_drude_particles_by_position_and_name() {
    let pair = |name: &str, shift: f64| {
        structure(line("ATOM", " C1 ", "LIG", 1, 0.0, "") + &line("ATOM", name, "LIG", 1, shift, "")).kind[1]
    };
    assert_eq!(pair("DC1 ", 0.05), Kind::VirtualSite);
    assert_eq!(pair("DC1 ", 1.05), Kind::Polymer, "a deuterium of a neutron structure");
    assert_eq!(pair("DC2 ", 0.05), Kind::Polymer);
}

#[test]
fn counts_virtual_sites_of_mmcif_separately() {
    let rows =
        "ATOM O OW SOL 1 0.0\nATOM H HW1 SOL 1 1.0\nATOM H HW2 SOL 1 -1.0\nATOM ? MW SOL 1 0.1\nATOM C CA ALA 2 9.0\n";
    let rows: String = rows.lines().map(|row| format!("{row} 0.0 0.0\n")).collect();
    let items =
        ["group_PDB", "type_symbol", "auth_atom_id", "auth_comp_id", "auth_seq_id", "Cartn_x", "Cartn_y", "Cartn_z"];
    let tags: String = items.iter().map(|item| format!("_atom_site.{item}\n")).collect();
    let s = structure(format!("data_x\nloop_\n{tags}{rows}"));
    let counts = Contents::of(&s, None).counts;
    assert_eq!((counts.polymer, counts.water, counts.hydrogens, counts.virtual_sites, counts.total()), (1, 1, 2, 1, 5));
    let left_out = left_out(&s);
    assert_eq!((left_out.total, left_out.virtual_sites), (4, 1));
    assert_eq!(left_out.residues, [residue("SOL", Kind::Water, 3)]);
}

// ---- what is left out ----

#[test]
fn counts_atoms_left_out_once_and_bounds_the_names() {
    let mut text = PDB.replace("END", "REMARK");
    for i in 0..15 {
        let ligand = format!("L{i:02}");
        (0..=i).for_each(|n| text += &line("HETATM", " C1 ", &ligand, 300 + i, 100.0 + f64::from(n), "C"));
    }
    text += &line("ATOM", " H  ", "ALA", 400, 200.0, "H");
    text += &line("ATOM", " CAA", "ALA", 401, 201.0, "C").replacen("CAA ", "CA A", 1);
    text += &line("ATOM", " CAB", "ALA", 401, 201.0, "C").replacen("CAB ", "CA B", 1);
    let s = structure(&text);
    let found = left_out(&s);
    assert_eq!(found.residues.len(), 10);
    let first = [residue("HOH", Kind::Water, 60), residue("L14", Kind::Ligand, 15), residue("L13", Kind::Ligand, 14)];
    assert_eq!(found.residues[..3], first);
    assert_eq!(found.kinds, [kind(Kind::Ligand, (1..=15).sum()), kind(Kind::Water, 60)]);
    assert_eq!(found.other_residues, (1..=6).sum::<u64>());
    assert_eq!((found.hydrogens, found.alternatives, found.other_chains, found.virtual_sites), (1, 1, 0, 0));
    assert_eq!(found.total as usize + selected(&s).len(), s.len());
    let none = Selection { chains: Some(vec!["A".to_owned()]), ..Selection::default() };
    let other = structure(
        PDB.replace("END", "REMARK")
            + "ATOM      1  CA  ALA B   1       0.0     0.0     0.0    1.00  0.00           C\n",
    );
    let found = select(&other, &none).unwrap().left_out;
    assert_eq!((found.other_chains, found.total), (1, 61));
}
