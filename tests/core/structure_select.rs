//! Selection of atoms, and errors of empty selections.
#![allow(
    clippy::pedantic,
    clippy::unwrap_used,
    clippy::panic,
    clippy::print_stderr,
    reason = "tests fail by panicking and print what they skip"
)]

use molmesh::structure::{Contents, ReadLimits, Selection, Structure, StructureError, read, select};

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

fn kinds(list: &str) -> Selection {
    let mut selection = Selection::default();
    selection.set_kinds(list).unwrap();
    selection
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
    assert_eq!(taken(&kinds("ligand")), [12, 13]);
    assert_eq!(taken(&kinds(" ligand , hydrogens ")), [12, 13, 14]);
    assert_eq!(taken(&kinds("water")), [15, 17]);
    assert_eq!(taken(&kinds("water,hydrogens")), [15, 16, 17]);
    assert_eq!(taken(&kinds("all")), [1, 3, 4, 5, 6, 9, 11, 12, 13, 14, 15, 16, 17]);
    assert_eq!(kinds("all"), kinds("hydrogens,water,ligand,polymer"));
    for list in ["polymer", "ligand,water", "polymer,ligand,water,hydrogens"] {
        assert_eq!(kinds(list).kinds(), list);
    }
    let keeps = Selection { model: Some(5), chains: chains(&["A"]), altloc: Some('B'), ..Selection::default() };
    let mut changed = keeps.clone();
    changed.set_kinds("all").unwrap();
    assert_eq!((changed.model, changed.chains, changed.altloc), (keeps.model, keeps.chains, keeps.altloc));
}

#[test]
fn rejects_invalid_lists_of_kinds() {
    let refused = |list: &str| Selection::default().set_kinds(list).unwrap_err().to_string();
    assert_eq!(
        refused("protein"),
        "`protein` is not a kind of atoms; expected a list of polymer, ligand, water, hydrogens, all"
    );
    assert_eq!(
        refused("polymer,,water"),
        "`` is not a kind of atoms; expected a list of polymer, ligand, water, hydrogens, all"
    );
    assert!(refused("").contains("expected a list of"));
    assert!(refused("hydrogens").contains("expected polymer, ligand or water as well"));
    assert!(refused(&"x".repeat(10_000)).len() < 200);
}

#[test]
fn models_chains_and_alternatives() {
    assert_eq!(taken(&Selection { model: Some(5), ..Selection::default() }), [21]);
    assert_eq!(taken(&Selection { chains: chains(&["B"]), ..Selection::default() }), [9, 11]);
    assert_eq!(taken(&Selection { chains: chains(&["B", "A"]), ..Selection::default() }), [1, 3, 5, 6, 9, 11]);
    assert_eq!(taken(&Selection { altloc: Some('A'), ..Selection::default() }), [1, 2, 5, 6, 8, 10]);
    // Residues without the letter keep their best alternative.
    assert_eq!(taken(&Selection { altloc: Some('C'), ..Selection::default() }), [1, 3, 5, 6, 9, 11]);
    assert_eq!(taken(&Selection { altloc: Some('B'), ..Selection::default() }), [1, 3, 7, 9, 11]);
    for blank in ["", "_"] {
        assert_eq!(taken(&Selection { model: Some(5), chains: chains(&[blank]), ..kinds("water") }), [22]);
    }
}

#[test]
fn errors_list_the_available_values() {
    assert_eq!(
        refusal(&Selection { model: Some(2), ..Selection::default() }),
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
        refusal(&Selection { altloc: Some('Å'), model: Some(5), ..Selection::default() }),
        "alternative location `Å` is not in the file; it has none"
    );
    assert_eq!(
        refusal(&Selection { chains: chains(&["W"]), ..Selection::default() }),
        "the selection holds no atoms: polymer of chains W was asked for; model 1 has 8 polymer, 2 ligand, 2 water and 3 \
         hydrogen atoms in 3 chains: A, B, W; the file has 2 models: 1, 5; `select=polymer,ligand,water` takes them"
            .replace("8 polymer", "10 polymer")
    );
    let hydrogen = "HETATM   14  H1  LIG B 102      14.000   0.000   0.000  1.00  0.00           H\n";
    let s = read(hydrogen.as_bytes(), &ReadLimits::default()).unwrap();
    match select(&s, &Selection::default()) {
        Err(StructureError::EmptySelection { holds }) => {
            assert!(holds.contains("1 hydrogen") && holds.ends_with("`select=all` takes them"), "{holds}")
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
    assert_eq!((c.polymer, c.ligand, c.water, c.hydrogens, c.total()), (10, 2, 2, 3, 17));
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
