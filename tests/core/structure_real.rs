//! The reader on all available real structures, compared with a list of their contents, gemmi, biotite and pdbtbx.
//!
//! gemmi runs through `tests/tools/gemmi_dump.py`, biotite through `tests/tools/biotite_residues.py`. Missing files and
//! tools are reported as skipped.
#![allow(
    clippy::pedantic,
    clippy::unwrap_used,
    clippy::panic,
    clippy::print_stderr,
    reason = "tests fail by panicking and print what they skip"
)]

use crate::tools;

use std::collections::BTreeMap;
use std::io::{BufReader, Read};
use std::path::PathBuf;
use std::process::Command;

use molmesh::structure::{Contents, ReadLimits, Selection, Structure, StructureError, read, select};

/// Rows of SOURCES.tsv: file, atoms, models.
fn sources() -> Vec<(String, Option<usize>, Option<usize>)> {
    let list = std::fs::read_to_string(tools::some_structures().join("SOURCES.tsv")).expect("the folder has a list");
    let rows = list.lines().skip(1).map(|line| line.split('\t').collect::<Vec<_>>());
    rows.map(|row| (row[0].to_owned(), row[3].parse().ok(), row[4].parse().ok())).collect()
}

/// The samples, which always exist.
const SAMPLES: [&str; 2] = ["samples/4pti.pdb", "samples/1crn.cif"];

fn path(file: &str) -> PathBuf {
    if SAMPLES.contains(&file) { file.into() } else { tools::some_structures().join(file) }
}

fn bytes(file: &str) -> Vec<u8> {
    std::fs::read(path(file)).expect("a listed file is readable")
}

fn structure(file: &str) -> Structure {
    read(&bytes(file), &ReadLimits::default()).unwrap_or_else(|e| panic!("{file}: {e}"))
}

/// Files without atoms.
const REFUSED: [&str; 1] = ["2ins_header_only.pdb.gz"];

/// BinaryCIF, which neither gemmi nor pdbtbx reads; `tests/core/bcif_oracles.rs` compares it with the text.
const OURS_ALONE: [&str; 1] = ["1gbt.bcif.gz"];

/// Files whose number of models differs from SOURCES.tsv. Here, atoms after an ENDMDL without a MODEL are a model.
const MODELS: [(&str, usize); 1] = [("odd_a_structure.pdb.gz", 2)];

#[test]
fn every_file_matches_the_list() {
    for (file, atoms, models) in sources() {
        if REFUSED.contains(&file.as_str()) || OURS_ALONE.contains(&file.as_str()) {
            continue;
        }
        let s = structure(&file);
        let contents = Contents::of(&s, None);
        assert_eq!(Some(contents.counts.total() as usize), atoms, "{file}: atoms of the first model");
        let models = MODELS.iter().find(|(f, _)| *f == file).map(|(_, n)| *n).or(models);
        assert_eq!(Some(contents.models.len()), models, "{file}: models");
        assert_eq!(s.element.iter().filter(|&&z| z == 0).count(), 0, "{file}: unknown elements");
        assert_eq!(contents.chains.iter().map(|c| c.counts.total()).sum::<u64>(), contents.counts.total(), "{file}");
    }
}

#[test]
fn errors_name_files_without_atoms() {
    if tools::structures().is_none() {
        return;
    }
    let limits = ReadLimits::default();
    match read(&bytes("2ins_header_only.pdb.gz"), &limits) {
        Err(StructureError::NoAtoms { found }) => {
            assert!(found.contains("HEADER") && found.contains("COMPND"), "{found}")
        }
        other => panic!("{other:?}"),
    }
}

#[test]
fn the_default_selection_has_the_atoms_of_the_paper() {
    if tools::structures().is_none() {
        return;
    }
    let counts = [
        ("4pti.pdb.gz", 454),
        ("4pti_1996.ent.gz", 454),
        ("110d.pdb.gz", 120),
        ("1bk2.pdb.gz", 468),
        ("1ql2.cif.gz", 966),
        ("2hhb.ent.gz", 4384),
    ];
    for (file, atoms) in counts {
        assert_eq!(select(&structure(file), &Selection::default()).unwrap().atoms.len(), atoms, "{file}");
    }
}

#[test]
fn ids_and_titles() {
    if tools::structures().is_none() {
        return;
    }
    let cases = [
        ("4pti.pdb.gz", Some("4PTI"), "THE GEOMETRY OF THE REACTIVE SITE"),
        ("4pti_1996.ent.gz", Some("4PTI"), ""),
        ("1rb8.pdb.gz", Some("1RB8"), ""),
        ("1zni.pdb1.gz", None, "INSULIN"),
        ("1ql2.cif.gz", Some("1QL2"), ""),
        ("6zu5.cif.gz", Some("6ZU5"), ""),
        ("1crn.cif.gz", Some("1CRN"), "WATER STRUCTURE OF A HYDROPHOBIC PROTEIN AT ATOMIC RESOLUTION. PENTAGON RINGS"),
    ];
    for (file, id, title) in cases {
        let s = structure(file);
        assert_eq!(s.id.as_deref(), id, "{file}");
        assert!(s.title.as_deref().unwrap_or("").starts_with(title), "{file}: {:?}", s.title);
    }
}

#[test]
fn old_and_new_files_of_one_entry_agree() {
    if tools::structures().is_none() {
        return;
    }
    let (new, old) = (structure("4pti.pdb.gz"), structure("4pti_1996.ent.gz"));
    // Compares names and elements. The remediated file moved some atoms by a few thousandths of an ångström.
    assert_eq!(new.element, old.element);
    for i in 0..new.len() {
        assert_eq!((new.name.get(i), new.residue_number[i]), (old.name.get(i), old.residue_number[i]));
    }
}

#[test]
fn results_do_not_depend_on_the_number_of_threads() {
    for (file, atoms, _) in sources().into_iter().filter(|(_, atoms, _)| atoms.is_some_and(|n| n > 15_000)) {
        let text = bytes(&file);
        let with = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| read(&text, &ReadLimits::default()).unwrap())
        };
        let one = with(1);
        assert!(one.len() >= atoms.unwrap());
        for threads in [2, 7] {
            assert!(one == with(threads), "{file}: {threads} threads");
        }
    }
}

#[test]
fn an_atom_takes_61_bytes() {
    if tools::structures().is_none() {
        return;
    }
    for file in ["6zu5.cif.gz", "1aon.pdb.gz", "3v2u.pdb.gz"] {
        let s = structure(file);
        let columns = 8 * (s.x.capacity() + s.y.capacity() + s.z.capacity())
            + 4 * (s.residue_number.capacity() + s.occupancy.capacity() + s.b_factor.capacity() + s.model.capacity())
            + s.element.capacity() + s.insertion_code.capacity() + s.altloc.capacity() + s.hetero.capacity() + s.kind.capacity()
            // Ids of four text columns.
            + 4 * 4 * s.len();
        let per_atom = columns as f64 / s.len() as f64;
        assert!(per_atom <= 71.0, "{file}: {per_atom} bytes per atom");
    }
}

// ---- gemmi ----

/// Files that gemmi 0.7.5 rejects, with its message.
const GEMMI_REFUSES: [(&str, &str); 2] = [
    // Columns 79-80 of files from before 1996 contain a line number.
    ("4pti_1996.ent.gz", "Wrong format for charge"),
    ("2hhb.ent.gz", "Wrong format for charge"),
];

/// Differences to gemmi 0.7.5: file, field, number of atoms, reason.
const DISAGREEMENTS: &[(&str, &str, usize, &str)] = &[
    ("md_1tw7_charmm.pdb.gz", "chain", 47_175, "TIP3 ends in column 21, where gemmi begins a chain of two letters"),
    ("md_1tw7_charmm.pdb.gz", "number", 17_178, "14669 ends in column 27, where gemmi reads an insertion code 9"),
    ("md_1tw7_charmm.pdb.gz", "code", 17_178, "the same: no insertion code is a digit"),
    ("md_1tw7_charmm.pdb.gz", "residue", 47_175, "TIP3 is a name of four letters, gemmi cuts it to three"),
    ("md_1tw7_charmm.pdb.gz", "element", 8, "CLA in CLA is CHARMM's chloride, gemmi takes it for carbon"),
    ("md_1tw7_charmm.pdb.gz", "kind", 8, "the same: chlorides are ions"),
    (
        "odd_a_structure.pdb.gz",
        "element",
        1,
        "a misplaced CA of pyroglutamic acid is no calcium; only its columns say so",
    ),
    (
        "odd_a_structure.pdb.gz",
        "selected",
        8,
        "a pyroglutamic acid in HETATM records that is alone in its model is a ligand",
    ),
    ("odd_a_structure.pdb.gz", "kind", 9, "the same: gemmi decides by the name"),
    ("odd_occupancy.pdb.gz", "b", 1, "a B-factor that is left out is 0 here and 20 in gemmi"),
];

/// Compared fields of an atom by name, except the position.
const FIELDS: [&str; 12] =
    ["chain", "number", "code", "residue", "name", "altloc", "element", "occupancy", "b", "hetero", "selected", "kind"];

type Rows = Vec<([i64; 3], Vec<String>)>;

/// Rounds to 10⁻⁴ Å, so that the rounding of the other program does not matter.
fn place(x: f64, y: f64, z: f64) -> [i64; 3] {
    [x, y, z].map(|v| (v * 1e4).round() as i64)
}

fn ours(s: &Structure) -> Rows {
    let selected = select(s, &Selection::default()).map(|s| s.atoms).unwrap_or_default();
    let mut rows: Rows = (0..s.len())
        .filter(|&i| s.model[i] == s.model[0])
        .map(|i| {
            let letter = |b: u8| if b == 0 { String::new() } else { char::from(b).to_string() };
            let flag = |b: bool| u8::from(b).to_string();
            let fields = vec![
                s.chain.get(i).to_owned(),
                s.residue_number[i].to_string(),
                letter(s.insertion_code[i]),
                s.residue.get(i).to_owned(),
                s.name.get(i).to_owned(),
                letter(s.altloc[i]),
                s.element[i].to_string(),
                format!("{:.4}", s.occupancy[i]),
                format!("{:.4}", s.b_factor[i]),
                flag(s.hetero[i]),
                flag(selected.binary_search(&(i as u32)).is_ok()),
                // The other programs do not distinguish cofactors.
                s.kind[i].name().replace("cofactor", "ligand"),
            ];
            (place(s.x[i], s.y[i], s.z[i]), fields)
        })
        .collect();
    rows.sort();
    rows
}

fn gemmis(output: &str) -> (Vec<usize>, Rows) {
    let mut lines = output.lines();
    let models = lines.next().unwrap().split(' ').skip(1).map(|n| n.parse().unwrap()).collect();
    let mut rows: Rows = lines
        .map(|line| {
            let mut fields: Vec<String> = line.split('\t').map(str::to_owned).collect();
            let xyz: Vec<f64> = fields.drain(7..10).map(|v| v.parse().unwrap()).collect();
            (place(xyz[0], xyz[1], xyz[2]), fields)
        })
        .collect();
    rows.sort();
    (models, rows)
}

#[test]
fn agrees_with_gemmi_except_for_listed_differences() {
    let Some(python) = tools::python_interpreter().or_else(|| tools::missing("gemmi")) else { return };
    let mut found: Vec<(String, &str, usize)> = Vec::new();
    let not_for_it = [&REFUSED[..], &OURS_ALONE].concat();
    let listed = sources().into_iter().map(|(file, ..)| file).filter(|file| !not_for_it.contains(&file.as_str()));
    for file in listed.chain(SAMPLES.map(str::to_owned)) {
        let output = Command::new(&python).arg("tests/tools/gemmi_dump.py").arg(path(&file)).output().unwrap();
        if let Some((_, words)) = GEMMI_REFUSES.iter().find(|(f, _)| *f == file) {
            let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
            assert!(!output.status.success() && stderr.contains(words), "{file}: gemmi reads it now: {stderr}");
            continue;
        }
        assert!(output.status.success(), "{file}: {}", String::from_utf8_lossy(&output.stderr));
        let s = structure(&file);
        let (models, theirs) = gemmis(std::str::from_utf8(&output.stdout).unwrap());
        let mut sizes: BTreeMap<usize, usize> = BTreeMap::new();
        let numbers = Contents::of(&s, None).models;
        for m in &s.model {
            *sizes.entry(numbers.iter().position(|n| n == m).unwrap()).or_default() += 1;
        }
        assert_eq!(sizes.into_values().collect::<Vec<_>>(), models, "{file}: atoms of each model");
        let ours = ours(&s);
        assert_eq!(ours.len(), theirs.len(), "{file}");
        for (field, name) in FIELDS.iter().enumerate() {
            let differ: Vec<_> = ours.iter().zip(&theirs).filter(|(a, b)| a.1[field] != b.1[field]).collect();
            if let Some((a, b)) = differ.first() {
                eprintln!("{file}: {} × {name}, first {a:?} against {b:?}", differ.len());
                found.push((file.clone(), name, differ.len()));
            }
        }
        assert!(ours.iter().zip(&theirs).all(|(a, b)| a.0 == b.0), "{file}: positions");
    }
    // The table lists files that may be missing.
    let read: Vec<String> = sources().into_iter().map(|(file, ..)| file).collect();
    let explained = DISAGREEMENTS.iter().filter(|(f, ..)| read.iter().any(|file| file == f));
    let expected: Vec<_> = explained.map(|(f, name, n, _)| ((*f).to_owned(), *name, *n)).collect();
    assert_eq!(found, expected, "disagreements found, and those that the table explains");
}

// ---- biotite ----

/// Files whose residues biotite 1.6.0 reads differently, with the number of residues of the first model that differ and
/// the reason.
const BIOTITE_DIFFERS: &[(&str, usize, &str)] = &[
    (
        "md_1tw7_charmm.pdb.gz",
        15_725,
        "TIP3 ends in column 21 and 14669 in column 27; biotite cuts both and reads no chain",
    ),
    ("odd_a_structure.pdb.gz", 184, "atoms after an ENDMDL without a MODEL are a second model here"),
];

/// Files that biotite 1.6.0 rejects, with its message.
const BIOTITE_REFUSES: [(&str, &str); 1] = [
    // A line without occupancy and B-factor.
    ("odd_occupancy.pdb.gz", "could not convert string to float: ''"),
];

/// Report of `tests/tools/biotite_residues.py`.
#[derive(serde::Deserialize)]
#[serde(untagged)]
enum Biotites {
    Read { models: Vec<usize>, residues: Vec<Residue> },
    Rejected(String),
}

/// Chain, number with insertion code, name and number of atoms of a residue.
type Residue = (String, String, String, usize);

/// Returns the residues of the first model, sorted.
fn residues(s: &Structure) -> Vec<Residue> {
    let mut found: BTreeMap<(String, String, String), usize> = BTreeMap::new();
    for i in (0..s.len()).filter(|&i| s.model[i] == s.model[0]) {
        let code = Some(s.insertion_code[i]).filter(|code| *code != 0).map(char::from);
        let number = format!("{}{}", s.residue_number[i], code.map(String::from).unwrap_or_default());
        *found.entry((s.chain.get(i).to_owned(), number, s.residue.get(i).to_owned())).or_default() += 1;
    }
    found.into_iter().map(|((chain, number, name), n)| (chain, number, name, n)).collect()
}

#[test]
fn agrees_with_biotite_on_chains_residues_and_counts() {
    // Large files take minutes and cover nothing more.
    let listed = sources().into_iter().filter(|(_, atoms, _)| atoms.is_some_and(|n| (1..60_000).contains(&n)));
    let listed = listed.map(|(file, ..)| file).filter(|file| !OURS_ALONE.contains(&file.as_str()));
    let files: Vec<String> = listed.chain(SAMPLES.map(str::to_owned)).collect();
    let paths: Vec<PathBuf> = files.iter().map(|file| path(file)).collect();
    let Some(reports) = tools::python::<Biotites>("biotite_residues.py", &paths) else { return };
    let (mut differing, mut rejected) = (Vec::new(), Vec::new());
    for (file, report) in files.iter().zip(reports) {
        let (models, theirs) = match report {
            Biotites::Read { models, residues } => (models, residues),
            Biotites::Rejected(error) => {
                rejected.push((file.as_str(), error));
                continue;
            }
        };
        let s = structure(file);
        let ours = residues(&s);
        let only = |a: &[Residue], b: &[Residue]| a.iter().filter(|row| b.binary_search(row).is_err()).count();
        let n = only(&ours, &theirs).max(only(&theirs, &ours));
        if n > 0 {
            differing.push((file.as_str(), n));
            continue;
        }
        let sizes: Vec<usize> = s.model.chunk_by(|a, b| a == b).map(<[i32]>::len).collect();
        assert_eq!(sizes, models, "{file}: atoms of each model");
        // The comparison finds an atom that moves to another residue.
        let mut moved = ours.clone();
        moved[0].3 += 1;
        assert_eq!(only(&moved, &theirs), 1, "{file}");
    }
    let is_read = |file: &str| files.iter().any(|other| other == file);
    let expected: Vec<_> = BIOTITE_DIFFERS.iter().filter(|row| is_read(row.0)).map(|row| (row.0, row.1)).collect();
    assert_eq!(differing, expected, "differences found, and those that the table explains");
    let expected: Vec<_> = BIOTITE_REFUSES.iter().filter(|row| is_read(row.0)).collect();
    assert_eq!(rejected.len(), expected.len(), "{rejected:?}");
    for ((file, error), (listed, words)) in rejected.iter().zip(expected) {
        assert!(file == listed && error.contains(words), "{file}: {error}");
    }
}

// ---- pdbtbx ----

/// Files that pdbtbx 0.12 (strictness `Loose`) reads incorrectly or not at all, with the reason.
const PDBTBX_FAILS: &[(&str, &str)] = &[
    // Entry id and line number in columns 73-80, which it reads as other fields.
    ("4pti_1996.ent.gz", "refuses"),
    ("110d.pdb.gz", "refuses"),
    // A DBREF line of 67 columns.
    ("odd_1crn_10a.pdb.gz", "refuses"),
    // Two residue names for one number; SEQRES has one.
    ("1ejg.pdb.gz", "refuses"),
    // A MODRES line of 28 columns.
    ("133d.pdb.gz", "panics"),
    // It repeats atoms without alternatives for every alternative of their residue.
    ("4cup.cif.gz", "1111 atoms, ours 1107"),
    ("1pfe.cif.gz", "370 atoms, ours 342"),
    // SEQADV of a deleted residue, which has no number.
    ("1a0q.pdb.gz", "refuses"),
    // Unknown names of space groups.
    ("2hhb.ent.gz", "panics"),
    ("1zni.pdb1.gz", "panics"),
    // SEQADV again.
    ("1tii.pdb.gz", "refuses"),
    // Repeated atoms again.
    ("3hsy.pdb.gz", "6625 atoms, ours 6601"),
    ("3v2u.pdb.gz", "16041 atoms, ours 15960"),
    ("7cth.cif.gz", "16676 atoms, ours 16667"),
    // A space group again.
    ("1rb8.pdb.gz", "panics"),
    // REMARK without a number.
    ("md_1tw7_charmm.pdb.gz", "refuses"),
    ("odd_a_structure.pdb.gz", "refuses"),
    ("odd_disordered.pdb.gz", "refuses"),
    ("odd_occupancy.pdb.gz", "refuses"),
];

#[test]
fn agrees_with_pdbtbx_except_for_listed_files() {
    use pdbtbx::{Format, ReadOptions, StrictnessLevel};
    let mut wrong: Vec<String> = Vec::new();
    let hook = std::panic::take_hook();
    let here = std::thread::current().id();
    std::panic::set_hook(Box::new(move |info| {
        // Panics of pdbtbx are expected here; other panics are not.
        if std::thread::current().id() != here {
            hook(info);
        }
    }));
    // Large files take seconds and cover nothing more.
    for (file, _, _) in sources().into_iter().filter(|(_, atoms, _)| atoms.is_some_and(|n| (1..60_000).contains(&n))) {
        if REFUSED.contains(&file.as_str()) || OURS_ALONE.contains(&file.as_str()) {
            continue;
        }
        let mut text = Vec::new();
        flate2::read::MultiGzDecoder::new(&bytes(&file)[..]).read_to_end(&mut text).unwrap();
        let format = if file.contains(".cif") { Format::Mmcif } else { Format::Pdb };
        let result = std::panic::catch_unwind(|| {
            ReadOptions::new().set_format(format).set_level(StrictnessLevel::Loose).read_raw(BufReader::new(&text[..]))
        });
        let verdict = match result {
            Err(_) => "panics".to_owned(),
            Ok(Err(_)) => "refuses".to_owned(),
            Ok(Ok((pdb, _))) => {
                let s = structure(&file);
                let ours: usize = s.model.iter().filter(|&&m| m == s.model[0]).count();
                let model = pdb.models().next().unwrap();
                let mut theirs: Vec<_> = model
                    .atoms()
                    .map(|a| (place(a.x(), a.y(), a.z()), a.element().map_or(0, |e| e.atomic_number())))
                    .collect();
                let mut mine: Vec<_> =
                    (0..ours).map(|i| (place(s.x[i], s.y[i], s.z[i]), usize::from(s.element[i]))).collect();
                theirs.sort_unstable();
                mine.sort_unstable();
                match (theirs.len() == mine.len(), theirs == mine) {
                    (_, true) => continue,
                    (false, _) => format!("{} atoms, ours {}", theirs.len(), mine.len()),
                    (true, false) => {
                        format!("{} atoms differ", theirs.iter().zip(&mine).filter(|(a, b)| a != b).count())
                    }
                }
            }
        };
        wrong.push(format!("{file}: {verdict}"));
    }
    let listed: Vec<String> = sources().into_iter().map(|(file, ..)| file).collect();
    let known = PDBTBX_FAILS.iter().filter(|(file, _)| listed.iter().any(|other| other == file));
    let expected: Vec<String> = known.map(|(file, verdict)| format!("{file}: {verdict}")).collect();
    assert_eq!(wrong, expected);
}

#[test]
fn gemmi_reads_the_same_helices_and_strands() {
    use molmesh::structure::Kind;
    use molmesh::structure::annotations::{SecondaryRanges, SecondaryStructure};

    let files: Vec<String> = sources().into_iter().map(|(file, ..)| file).chain(SAMPLES.map(str::to_owned)).collect();
    let texts = files.iter().filter(|file| !REFUSED.contains(&file.as_str()) && !OURS_ALONE.contains(&file.as_str()));
    let texts: Vec<&String> = texts.collect();
    let paths: Vec<PathBuf> = texts.iter().map(|file| path(file)).collect();
    type Residues = Vec<(String, String, String)>;
    let Some(reports) = tools::python::<Option<Residues>>("gemmi_secondary.py", &paths) else { return };
    let (mut with_ranges, mut rejected) = (0, 0);
    for (file, residues) in texts.into_iter().zip(reports) {
        let Some(residues) = residues else {
            rejected += 1;
            continue;
        };
        let s = structure(file);
        let Some(ranges) = SecondaryRanges::of(&s) else {
            assert!(residues.iter().all(|(.., kind)| kind == "-"), "{file}");
            continue;
        };
        let expected: BTreeMap<(String, String), String> =
            residues.into_iter().map(|(chain, number, kind)| ((chain, number), kind)).collect();
        let (mut n, mut assigned) = (0, 0);
        for i in (0..s.len()).filter(|&i| s.model[i] == s.model[0] && s.kind[i] == Kind::Protein) {
            let code = Some(s.insertion_code[i]).filter(|code| *code != 0).map(|code| char::from(code).to_string());
            let number = format!("{}{}", s.residue_number[i], code.unwrap_or_default());
            let Some(kind) = expected.get(&(s.chain.get(i).to_owned(), number.clone())) else { continue };
            let found = match ranges.get(&s, i) {
                Some(SecondaryStructure::Strand) => "E",
                Some(SecondaryStructure::Turn) | None => "-",
                Some(_) => "H",
            };
            assert_eq!(found, kind, "{file} {} {number}", s.chain.get(i));
            (n, assigned) = (n + 1, assigned + usize::from(found != "-"));
        }
        assert!(n > 100 && assigned > 0, "{file}: {n} {assigned}");
        with_ranges += 1;
    }
    assert!(with_ranges >= 3 && rejected <= 3, "{with_ranges} {rejected}");
}
