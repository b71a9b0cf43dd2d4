//! Selection of atoms, and errors of empty selections.
#![allow(
    clippy::pedantic,
    clippy::unwrap_used,
    clippy::panic,
    clippy::print_stderr,
    reason = "tests fail by panicking and print what they skip"
)]

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use molmesh::structure::select::{MAX_DEPTH, MAX_DISTANCE, MAX_WITHIN};
use molmesh::structure::{
    BadExpression, Contents, Expression, KindSet, ModelChoice, ReadLimits, Selection, Structure, StructureError, read,
    select, select_with,
};
use molmesh::surface::{CancelToken, Control, MemoryMeter, OutOfMemory};
use proptest::prelude::*;

use crate::tools;

/// Two models; polymer, microheterogeneity, ligand, water, ions, hydrogens, two chains.
const FILE: &str = "\
MODEL        1
ATOM      1  N   ALA A   1       1.000   0.000   0.000  1.00  0.00           N
ATOM      2  CA AALA A   1       2.000   0.000   0.000  0.40  0.00           C
ATOM      3  CA BALA A   1       3.000   0.000   0.000  0.60  0.00           C
ATOM      4  HA BALA A   1       4.000   0.000   0.000  0.60  0.00           H
ATOM      5  CA APRO A   2       5.000   0.000   0.000  0.50  0.00           C
ATOM      6  CB APRO A   2       6.000   0.000   0.000  0.50  0.00           C
ATOM      7  CA BSER A   2       7.000   0.000   0.000  0.50  0.00           C
ATOM      8  CA AGLY B   2A      8.000   0.000   0.000  0.20  0.00           C
ATOM      9  CA CGLY B   2A      9.000   0.000   0.000  0.30  0.00           C
ATOM     10  C  AGLY B   2A     10.000   0.000   0.000  0.20  0.00           C
ATOM     11  C  CGLY B   2A     11.000   0.000   0.000  0.30  0.00           C
HETATM   12 ZN    ZN A 101      12.000   0.000   0.000  1.00  0.00          ZN
HETATM   13  C1  LIG B 102      13.000   0.000   0.000  1.00  0.00           C
HETATM   14  H1  LIG B 102      14.000   0.000   0.000  1.00  0.00           H
HETATM   15  O   HOH A 201      15.000   0.000   0.000  1.00  0.00           O
HETATM   16  D1  DOD B 202      16.000   0.000   0.000  1.00  0.00           D
ATOM     17  OH2 TIP3W   1      17.000   0.000   0.000  1.00  0.00           O
ENDMDL
MODEL        5
ATOM      1  N   ALA A   1      21.000   0.000   0.000  1.00  0.00           N
HETATM    2  O   HOH     1      22.000   0.000   0.000  1.00  0.00           O
ENDMDL
";

fn structure() -> Structure {
    read(FILE.as_bytes(), &ReadLimits::default()).unwrap()
}

/// Returns the x coordinates of the selected atoms, which number them.
fn taken(selection: &Selection) -> Vec<u32> {
    let s = structure();
    select(&s, selection).unwrap().atoms.iter().map(|&i| s.x[i as usize] as u32).collect()
}

fn refusal(selection: &Selection) -> String {
    select(&structure(), selection).unwrap_err().to_string()
}

fn kinds(text: &str) -> Selection {
    Selection { atoms: text.parse().unwrap_or_else(|e| panic!("{text}: {e}")), ..Selection::default() }
}

fn chains(names: &[&str]) -> Option<Vec<String>> {
    Some(names.iter().map(|&n| n.to_owned()).collect())
}

#[test]
fn selects_polymer_without_hydrogens_by_default() {
    // Residue 1 uses B (0.6), residue 2 uses A (a tie, although its other name has fewer atoms), residue 2A uses C.
    assert_eq!(taken(&Selection::default()), [1, 3, 5, 6, 9, 11]);
    let s = structure();
    let selected = select(&s, &Selection::default()).unwrap();
    assert_eq!(selected.model, 1);
    let spheres = selected.spheres(&s).unwrap();
    assert_eq!((spheres.len(), spheres.radius(0), spheres.centre(1)), (6, 1.55, [3.0, 0.0, 0.0]));
}

#[test]
fn selects_kinds_by_name() {
    assert_eq!(taken(&kinds("polymer")), taken(&Selection::default()));
    assert_eq!(taken(&kinds("polymer,hydrogens")), [1, 3, 4, 5, 6, 9, 11]);
    assert_eq!(taken(&kinds("ligand")), [13]);
    assert_eq!(taken(&kinds("ion,ligand")), [12, 13]);
    assert_eq!(taken(&kinds("protein")), taken(&kinds("polymer")));
    assert_eq!(taken(&kinds(" ligand , hydrogens ")), [13, 14]);
    assert_eq!(taken(&kinds("water")), [15, 17]);
    assert_eq!(taken(&kinds("water,hydrogens")), [15, 16, 17]);
    assert_eq!(taken(&kinds("all")), [1, 3, 4, 5, 6, 9, 11, 12, 13, 14, 15, 16, 17]);
    assert_eq!(kinds("all"), kinds("hydrogens,water,ion,ligand,polymer"));
}

#[test]
fn properties_select_atoms() {
    for (text, expected) in [
        ("chain B", &[9, 11, 13][..]),
        ("chain A,B and polymer", &[1, 3, 5, 6, 9, 11]),
        ("chain A B and not polymer", &[12, 13, 15]),
        ("chain A+W", &[1, 3, 5, 6, 12, 15, 17]),
        ("chain A,water", &[1, 3, 5, 6, 12, 15, 17]),
        ("resi 1", &[1, 3, 17]),
        ("resi 1-2", &[1, 3, 5, 6, 9, 11, 17]),
        ("resi 2", &[5, 6]),
        ("resi 2A", &[9, 11]),
        ("resi 2A-102", &[9, 11, 12, 13]),
        ("resid 1,101-102", &[1, 3, 12, 13, 17]),
        ("resn ala,LIG", &[1, 3, 13]),
        ("resname PRO", &[5, 6]),
        ("name CA", &[3, 5, 9]),
        ("elem Zn", &[12]),
        ("element N,zn", &[1, 12]),
        ("hydrogen", &[4, 14, 16]),
        ("hydrogens", &[4, 14, 16]),
        ("elem H and polymer", &[4]),
        ("all and resi 1", &[1, 3, 4, 17]),
        ("chain A and (ion or water)", &[12, 15]),
        ("not (polymer or water)", &[12, 13]),
        ("protein and name \"CB\"", &[6]),
        // Distances between neighbours are 1 Å; H 14 and D 16 count only if hydrogens are selected.
        ("within 1 of ion", &[11, 12, 13]),
        ("within 1.0 of (ion)", &[11, 12, 13]),
        ("polymer within 2.5 of ion", &[11]),
        ("polymer and within 3 of ion", &[9, 11]),
        ("within 0.999 of ion", &[12]),
        ("not within 10 of resn LIG", &[1]),
        ("within 1 of elem H", &[3, 4, 5, 13, 14, 15, 16, 17]),
        ("byres elem Zn", &[12]),
        ("byres name CB", &[5, 6]),
        ("byres within 1 of ion", &[9, 11, 12, 13]),
        ("within 1 of byres name CB", &[5, 6]),
        ("within 1 of within 1 of ion", &[11, 12, 13]),
    ] {
        assert_eq!(taken(&kinds(text)), expected, "{text}");
    }
    // A distance is measured in the selected model, and to atoms of other chains.
    let second = Selection { model: ModelChoice::Number(5), ..kinds("within 1 of water") };
    assert_eq!(taken(&second), [21, 22]);
    let of_chain = Selection { chains: chains(&["B"]), ..kinds("within 1 of ion") };
    assert_eq!(taken(&of_chain), [11, 13]);
    assert_eq!(taken(&Selection { model: ModelChoice::Number(5), ..kinds("chain _") }), [22]);
    assert_eq!(taken(&Selection { model: ModelChoice::Number(5), ..kinds("chain \"\"") }), [22]);
    let found = refusal(&kinds("polymer or chain Z"));
    assert_eq!(found, "selected chain `Z` is not in the file; it has 3 chains: A, B, W");
    let quoted = FILE.replace(" CB APRO A", " O\"\"APRO A");
    let s = read(quoted.as_bytes(), &ReadLimits::default()).unwrap();
    assert_eq!(select(&s, &kinds("name \"O\"\"\"\"\"")).unwrap().atoms, [5]);
}

#[test]
fn equal_expressions_have_one_canonical_form() {
    let canonical = |text: &str| kinds(text).atoms.to_string();
    for (text, expected) in [
        ("polymer", "polymer"),
        ("nucleic or protein , polymer", "polymer"),
        ("all", "all"),
        ("polymer,ligand,ion,water", "polymer or ligand or ion or water"),
        ("hydrogens,water,ion,ligand,polymer", "all"),
        ("polymer and not protein", "(polymer and not protein)"),
        ("protein and ligand", "(water and not water)"),
        ("not not chain B", "chain B"),
        ("((chain B) or chain A)", "chain A,B"),
        ("resn hem or resn NAG+FUC", "resn FUC,HEM,NAG"),
        ("resi 5,1-3 or resi 52A", "resi 1-3,5,52A"),
        ("resi 3-3,3", "resi 3,3-3"),
        ("elem FE or hydrogen", "elem H,Fe,hydrogens"),
        ("name CA and protein and chain A and name CA", "(protein) and (chain A) and (name CA)"),
        ("within 5.50 of ligand", "within 5.5 of (ligand)"),
        ("chain \"all\",\"a b\",_", "chain _,\"a b\",\"all\""),
        ("byres not water", "byres (polymer or ligand or ion)"),
        ("not (resi -5--1)", "not (resi -5--1)"),
    ] {
        assert_eq!(canonical(text), expected, "{text}");
        assert_eq!(canonical(expected), expected, "{text}");
    }
}

#[test]
fn errors_point_at_the_character() {
    let error = |text: &str| text.parse::<Expression>().unwrap_err();
    for (text, column, found, expected) in [
        ("", 1, "the end", "a kind (polymer, protein"),
        ("proteins", 1, "`proteins`", "a kind (polymer, protein"),
        ("polymer,,water", 9, "`,`", "a kind"),
        ("polymer water", 9, "`water`", "`and`, `or`, `,` or the end"),
        ("Å", 1, "`Å`", "a kind"),
        ("chain Å and or", 13, "`or`", "a kind"),
        ("(chain A", 9, "the end", "`and`, `or` or `)`"),
        ("(polymer,water)", 9, "`,`", "`and`, `or` or `)`"),
        ("chain", 6, "the end", "the name of a chain"),
        ("chain all", 7, "`all`", "the name of a chain; `all` is a keyword, write it in quotes"),
        ("resi 1,x", 8, "`x`", "a residue number such as 52 or 52A"),
        ("resi 20-10", 6, "`20-10`", "a residue number"),
        ("resi 99999999999", 6, "`99999999999`", "a residue number"),
        ("elem Fe Xx", 9, "`Xx`", "the symbol of an element"),
        ("resn \"\"", 6, "``", "the name of a residue"),
        ("name \"CA", 9, "the end", "a closing `\"`"),
        ("within five of ion", 8, "`five`", "a distance above 0 and up to 50 Å"),
        ("within 0 of ion", 8, "`0`", "a distance above 0"),
        ("within 50.001 of ion", 8, "`50.001`", "a distance above 0"),
        ("within 1.2345 of ion", 8, "`1.2345`", "at most three decimals"),
        ("within 5 ion", 10, "`ion`", "`of`"),
        ("chain A\u{7}", 8, "`\\u{7}`", "no control characters"),
    ] {
        let BadExpression { column: at, found: what, expected: wanted } = error(text);
        assert_eq!((at, what.as_str()), (column, found), "{text}: {wanted}");
        assert!(wanted.contains(expected), "{text}: {wanted}");
    }
    assert!(error(&"x".repeat(10_000)).to_string().len() < 400);
}

#[test]
fn nesting_distances_and_their_number_are_limited() {
    let parse = |text: String| text.parse::<Expression>().map_err(|e| e.expected);
    for (open, close) in [("(", ")"), ("not ", ""), ("byres ", "")] {
        let nested = |n: usize| open.repeat(n) + "chain A" + &close.repeat(n);
        assert!(parse(nested(MAX_DEPTH)).is_ok(), "{open}");
        assert!(parse(nested(MAX_DEPTH + 1)).unwrap_err().contains("at most 16 levels"), "{open}");
        assert!(parse(nested(100_000)).is_err());
    }
    let several = |n: usize| vec!["within 5 of ion"; n].join(" or ");
    assert!(parse(several(MAX_WITHIN)).is_ok());
    assert!(parse(several(MAX_WITHIN + 1)).unwrap_err().contains("at most 8 times `within`"));
    assert!(parse(format!("within {MAX_DISTANCE} of ion")).is_ok());
}

// ---- a second evaluator ----

/// Expression that is printed and evaluated without the parser.
#[derive(Debug, Clone)]
enum Naive {
    Kind(usize),
    Chain(usize),
    Residues(i32, i32),
    Residue(usize),
    Name(usize),
    Element(usize),
    Hydrogen,
    All,
    Within(u32, Box<Self>),
    ByResidue(Box<Self>),
    Not(Box<Self>),
    And(Box<Self>, Box<Self>),
    Or(Box<Self>, Box<Self>),
}

const CHAINS: [&str; 3] = ["A", "B", "_"];
const RESIDUES: [&str; 6] = ["ALA", "HOH", "LIG", "ZN", "GLY", "QQQ"];
const NAMES: [&str; 5] = ["N", "CA", "CB", "O", "ZN"];
const ELEMENTS: [(&str, u8); 4] = [("H", 1), ("C", 6), ("n", 7), ("Zn", 30)];

impl Naive {
    fn text(&self) -> String {
        match self {
            Self::Kind(i) => KindSet::NAMED[*i].0.to_owned(),
            Self::Chain(i) => format!("chain {}", CHAINS[*i]),
            Self::Residues(first, last) => format!("resi {first}-{last}"),
            Self::Residue(i) => format!("resn {}", RESIDUES[*i]),
            Self::Name(i) => format!("name {}", NAMES[*i]),
            Self::Element(i) => format!("elem {}", ELEMENTS[*i].0),
            Self::Hydrogen => "hydrogen".to_owned(),
            Self::All => "all".to_owned(),
            Self::Within(steps, of) => format!("within {} of ({})", f64::from(*steps) / 1000.0, of.text()),
            Self::ByResidue(of) => format!("byres ({})", of.text()),
            Self::Not(of) => format!("not ({})", of.text()),
            Self::And(a, b) => format!("({}) and ({})", a.text(), b.text()),
            Self::Or(a, b) => format!("({}) or ({})", a.text(), b.text()),
        }
    }

    fn names_hydrogens(&self) -> bool {
        match self {
            Self::Hydrogen | Self::All | Self::Element(0) => true,
            Self::Within(_, of) | Self::ByResidue(of) | Self::Not(of) => of.names_hydrogens(),
            Self::And(a, b) | Self::Or(a, b) => a.names_hydrogens() || b.names_hydrogens(),
            _ => false,
        }
    }

    /// Returns true if atom `i` matches the condition. `usable` atoms count for distances and residues.
    fn holds(&self, s: &Structure, usable: &[bool], i: usize) -> bool {
        let others = || (0..s.len()).filter(|&j| usable[j]);
        match self {
            Self::Kind(k) => KindSet::NAMED[*k].1.has(s.kind[i]),
            Self::Chain(k) => s.chain.get(i) == CHAINS[*k].trim_matches('_'),
            Self::Residues(first, last) => (*first..=*last).contains(&s.residue_number[i]),
            Self::Residue(k) => s.residue.get(i) == RESIDUES[*k],
            Self::Name(k) => s.name.get(i) == NAMES[*k],
            Self::Element(k) => s.element[i] == ELEMENTS[*k].1,
            Self::Hydrogen => s.element[i] == 1,
            Self::All => true,
            Self::Within(steps, of) => {
                let d = f64::from(*steps) / 1000.0;
                let apart = |j: usize| [&s.x, &s.y, &s.z].map(|c| (c[i] - c[j]).powi(2)).iter().sum::<f64>();
                others().any(|j| apart(j) <= d * d && of.holds(s, usable, j))
            }
            Self::ByResidue(of) => {
                let residue =
                    |i: usize| (s.model[i], s.chain.get(i), s.residue_number[i], s.insertion_code[i], s.residue.get(i));
                others().any(|j| residue(i) == residue(j) && of.holds(s, usable, j))
            }
            Self::Not(of) => !of.holds(s, usable, i),
            Self::And(a, b) => a.holds(s, usable, i) && b.holds(s, usable, i),
            Self::Or(a, b) => a.holds(s, usable, i) || b.holds(s, usable, i),
        }
    }
}

fn naive() -> impl Strategy<Value = Naive> {
    let leaf = prop_oneof![
        (0..KindSet::NAMED.len()).prop_map(Naive::Kind),
        (0..CHAINS.len()).prop_map(Naive::Chain),
        (-3..9, 0..9).prop_map(|(first, n)| Naive::Residues(first, first + n)),
        (0..RESIDUES.len()).prop_map(Naive::Residue),
        (0..NAMES.len()).prop_map(Naive::Name),
        (0..ELEMENTS.len()).prop_map(Naive::Element),
        Just(Naive::Hydrogen),
        Just(Naive::All),
    ];
    leaf.prop_recursive(4, 24, 2, |inner| {
        let boxed = || inner.clone().prop_map(Box::new);
        prop_oneof![
            (1..9_000_u32, boxed()).prop_map(|(steps, of)| Naive::Within(steps, of)),
            boxed().prop_map(Naive::ByResidue),
            boxed().prop_map(Naive::Not),
            (boxed(), boxed()).prop_map(|(a, b)| Naive::And(a, b)),
            (boxed(), boxed()).prop_map(|(a, b)| Naive::Or(a, b)),
        ]
    })
}

/// Atoms of all kinds at random places, in three chains.
fn cloud() -> Structure {
    let rows =
        [("ATOM", "ALA", 4), ("ATOM", "GLY", 3), ("HETATM", "LIG", 2), ("HETATM", "ZN", 1), ("HETATM", "HOH", 1)];
    let names = [(" N  ", "N"), (" CA ", "C"), (" CB ", "C"), (" HA ", "H")];
    let (mut text, mut random, mut number) = (String::new(), 7_u64, -2);
    for chain in ["A", "B", " "] {
        for turn in 0..12 {
            let (record, residue, n) = rows[turn % rows.len()];
            number += 1;
            for (name, element) in names.iter().take(n) {
                let [x, y, z] = [0; 3].map(|_: i32| {
                    random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                    (random >> 40) as f64 / f64::from(1 << 24) * 14.0
                });
                let (name, element) = match residue {
                    "ZN" => ("ZN  ", "ZN"),
                    "HOH" => (" O  ", "O"),
                    _ => (*name, *element),
                };
                let number = number % 9;
                text += &format!(
                    "{record:<6}    1 {name} {residue:>3} {chain}{number:>4}    {x:8.3}{y:8.3}{z:8.3}  1.00  0.00          {element:>2}\n"
                );
            }
        }
    }
    read(text.as_bytes(), &ReadLimits::default()).unwrap()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]

    #[test]
    fn random_expressions_select_what_a_naive_evaluator_does(naive in naive()) {
        let s = cloud();
        let hydrogens = naive.names_hydrogens();
        let usable: Vec<bool> = (0..s.len()).map(|i| hydrogens || !s.is_hydrogen(i)).collect();
        let expected: Vec<u32> =
            (0..s.len()).filter(|&i| usable[i] && naive.holds(&s, &usable, i)).map(|i| i as u32).collect();
        let Ok(atoms) = naive.text().parse::<Expression>() else {
            // Too many levels or distances.
            prop_assert!(naive.text().matches("within").count() > MAX_WITHIN || naive.text().matches('(').count() > 8);
            return Ok(());
        };
        let found = |atoms: Expression| match select(&s, &Selection { atoms, ..Selection::default() }) {
            Ok(selected) => selected.atoms,
            Err(StructureError::EmptySelection { .. }) => Vec::new(),
            Err(other) => panic!("{other}"),
        };
        let canonical: Expression = atoms.to_string().parse().map_err(|e| TestCaseError::fail(format!("{atoms}: {e}")))?;
        prop_assert_eq!(&canonical, &atoms);
        prop_assert_eq!(found(atoms), expected, "{}", naive.text());
    }
}

// ---- gemmi ----

/// Expressions with the equivalent selections of gemmi. `NUMBER of SELECTION` means the atoms within that distance.
const GEMMI: [(&str, &str); 12] = [
    ("chain A", "//A"),
    ("chain A and name CA", "//A//CA"),
    ("resi 10-20", "//*/10-20"),
    ("chain A and resi 1-30 and name N,C", "//A/1-30/N,C"),
    ("resn LYS,ARG", "(LYS,ARG)"),
    ("not resn HOH,CYS", "(!HOH,CYS)"),
    ("elem S", "[S]"),
    ("elem O and resn HOH", "//*/(HOH)/[O]"),
    ("resi 60-70 and elem C,N", "//*/60-70/[C,N]"),
    ("within 4 of resn ARG", "4 of (ARG)"),
    ("within 12.5 of (elem S)", "12.5 of [S]"),
    ("within 30 of (chain A and resi 1-2)", "30 of //A/1-2"),
];

/// Structures without hydrogens and alternative locations; all but the samples may be missing.
const GEMMI_FILES: [&str; 6] =
    ["samples/4pti.pdb", "samples/1crn.cif", "1a0q.pdb.gz", "1gbt.cif.gz", "1ubq.pdb.gz", "110d.pdb.gz"];

#[test]
fn gemmi_selects_as_many_atoms() {
    let Some(python) = tools::python_interpreter().or_else(|| tools::missing("gemmi")) else { return };
    for file in GEMMI_FILES {
        let path = if file.starts_with("samples/") { Some(file.into()) } else { tools::some_structure(file) };
        let Some(path) = path else { continue };
        let s = read(&std::fs::read(&path).unwrap(), &ReadLimits::default()).unwrap();
        let ours = |text: &str| match select(&s, &kinds(text)) {
            Ok(selected) => selected.atoms.len(),
            Err(StructureError::EmptySelection { .. }) => 0,
            Err(error) => panic!("{file}: {text}: {error}"),
        };
        // The sample 110d has one chain without a name.
        let pairs: Vec<_> =
            GEMMI.iter().filter(|(text, _)| !text.contains("chain A") || s.chain.texts().any(|c| c == "A")).collect();
        let selections = pairs.iter().map(|(_, selection)| *selection);
        let output = std::process::Command::new(&python)
            .arg("tests/tools/gemmi_select.py")
            .arg(&path)
            .args(selections)
            .output()
            .unwrap();
        assert!(output.status.success(), "{file}: {}", String::from_utf8_lossy(&output.stderr));
        let counts = String::from_utf8(output.stdout).unwrap();
        let theirs: Vec<usize> = counts.split_whitespace().map(|n| n.parse().unwrap()).collect();
        let expected: Vec<_> = pairs.iter().zip(theirs).map(|((text, _), n)| (*text, n)).collect();
        let found: Vec<_> = pairs.iter().map(|(text, _)| (*text, ours(text))).collect();
        assert_eq!(found, expected, "{file}");
        assert!(found.iter().filter(|(_, n)| *n > 0).count() >= 5, "{file}: {found:?}");
    }
}

// ---- memory and cancellation ----

/// Budget that cancels at an amount of memory.
#[derive(Debug, Default)]
struct Budget {
    limit: u64,
    held: AtomicU64,
    most: AtomicU64,
    cancel: CancelToken,
    cancel_at: Option<u64>,
}

impl MemoryMeter for Budget {
    fn grow(&self, bytes: u64) -> Result<(), OutOfMemory> {
        let held = self.held.fetch_add(bytes, Ordering::SeqCst) + bytes;
        if held > self.limit {
            self.held.fetch_sub(bytes, Ordering::SeqCst);
            return Err(OutOfMemory::Budget { needed: bytes, held: held - bytes, limit: self.limit });
        }
        self.most.fetch_max(held, Ordering::SeqCst);
        if self.cancel_at.is_some_and(|at| held >= at) {
            self.cancel.cancel();
        }
        Ok(())
    }

    fn shrink(&self, bytes: u64) {
        self.held.fetch_sub(bytes, Ordering::SeqCst);
    }
}

#[test]
fn evaluation_reserves_memory_and_can_be_cancelled() {
    let s = read(include_bytes!("../../samples/4pti.pdb"), &ReadLimits::default()).unwrap();
    let n = s.len() as u64;
    let run = |limit: u64, cancel_at: Option<u64>| {
        let budget = Arc::new(Budget { limit, cancel_at, ..Budget::default() });
        let memory: Arc<dyn MemoryMeter> = Arc::<Budget>::clone(&budget);
        let control = Control { cancel: budget.cancel.clone(), memory, ..Control::default() };
        let found =
            select_with(&s, &kinds("within 5 of (elem S) and not byres water"), &ReadLimits::default(), &control);
        // The tables of names are charged until the end of the work, because colours use them as well.
        assert!([0, s.table_bytes()].contains(&budget.held.load(Ordering::SeqCst)), "all other memory is returned");
        (found.map(|selected| selected.atoms.len()), budget.most.load(Ordering::SeqCst))
    };
    let (found, most) = run(u64::MAX, None);
    assert!(found.unwrap() > 10 && (3 * n..100 * n).contains(&most), "{most}");
    for limit in [0, n, 2 * n, most - 1] {
        assert!(matches!(run(limit, None).0, Err(StructureError::Memory(_))), "{limit}");
    }
    for cancel_at in [1, 2 * n, most] {
        assert_eq!(run(u64::MAX, Some(cancel_at)).0, Err(StructureError::Cancelled), "{cancel_at}");
    }
}

#[test]
fn models_chains_and_alternatives() {
    assert_eq!(taken(&Selection { model: ModelChoice::Number(5), ..Selection::default() }), [21]);
    assert_eq!(taken(&Selection { chains: chains(&["B"]), ..Selection::default() }), [9, 11]);
    assert_eq!(taken(&Selection { chains: chains(&["B", "A"]), ..Selection::default() }), [1, 3, 5, 6, 9, 11]);
    assert_eq!(taken(&Selection { altloc: Some('A'), ..Selection::default() }), [1, 2, 5, 6, 8, 10]);
    // Residues without the letter keep their best alternative.
    assert_eq!(taken(&Selection { altloc: Some('C'), ..Selection::default() }), [1, 3, 5, 6, 9, 11]);
    assert_eq!(taken(&Selection { altloc: Some('B'), ..Selection::default() }), [1, 3, 7, 9, 11]);
    for blank in ["", "_"] {
        assert_eq!(
            taken(&Selection { model: ModelChoice::Number(5), chains: chains(&[blank]), ..kinds("water") }),
            [22]
        );
    }
}

#[test]
fn errors_list_the_available_values() {
    assert_eq!(
        refusal(&Selection { model: ModelChoice::Number(2), ..Selection::default() }),
        "model 2 is not in the file; it has 2 models: 1, 5"
    );
    assert_eq!(
        refusal(&Selection { chains: chains(&["A", "Z"]), ..Selection::default() }),
        "chain `Z` is not in the file; it has 3 chains: A, B, W"
    );
    assert_eq!(
        refusal(&Selection { altloc: Some('Z'), ..Selection::default() }),
        "alternative location `Z` is not in the file; it has A, B, C"
    );
    assert_eq!(
        refusal(&Selection { altloc: Some('Å'), model: ModelChoice::Number(5), ..Selection::default() }),
        "alternative location `Å` is not in the file; it has none"
    );
    assert_eq!(
        refusal(&Selection { chains: chains(&["W"]), ..Selection::default() }),
        "the selection holds no atoms: polymer of chains W was requested; model 1 has 10 polymer, 1 \
         ligand, 1 ion, 2 water and 3 hydrogen atoms in 3 chains: A, B, W; the file has 2 models: 1, 5; \
         `select=polymer,ligand,ion,water` selects them"
    );
    let hydrogen = "HETATM   14  H1  LIG B 102      14.000   0.000   0.000  1.00  0.00           H\n";
    let s = read(hydrogen.as_bytes(), &ReadLimits::default()).unwrap();
    match select(&s, &Selection::default()) {
        Err(StructureError::EmptySelection { holds }) => {
            assert!(holds.contains("1 hydrogen") && holds.ends_with("`select=all` selects them"), "{holds}")
        }
        other => panic!("{other:?}"),
    }
}

#[test]
fn contents_count_every_atom_once() {
    let s = structure();
    let contents = Contents::of(&s, None);
    assert_eq!((contents.atoms, contents.model, &contents.models[..]), (19, 1, &[1, 5][..]));
    let c = contents.counts;
    assert_eq!((c.polymer, c.ligand, c.ion, c.water, c.hydrogens, c.total()), (10, 1, 1, 2, 3, 17));
    assert_eq!((contents.alternatives, contents.unknown_elements), (10, 0));
    let names: Vec<_> = contents.chains.iter().map(|c| (&*c.name, c.counts.total())).collect();
    assert_eq!(names, [("A", 9), ("B", 7), ("W", 1)]);
    let second = Contents::of(&s, Some(5));
    assert_eq!((second.counts.total(), &*second.chains[1].name), (2, ""));
    assert_eq!(Contents::of(&s, Some(9)).counts.total(), 0);
}

#[test]
fn identifies_interleaved_models_of_mmcif_by_number() {
    let text = "data_x loop_ _atom_site.pdbx_PDB_model_num _atom_site.Cartn_x _atom_site.Cartn_y _atom_site.Cartn_z
2 1 0 0 1 2 0 0 2 3 0 0 1 4 0 0";
    let s = read(text.as_bytes(), &ReadLimits::default()).unwrap();
    assert_eq!(Contents::of(&s, None).models, [2, 1]);
    assert_eq!(select(&s, &Selection::default()).unwrap().atoms, [0, 2]);
}
