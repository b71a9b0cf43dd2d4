//! Biological assemblies: tables of all input formats, limits, and comparison with gemmi.
#![allow(clippy::pedantic, clippy::unwrap_used, clippy::panic, reason = "tests fail by panicking")]

use std::fmt::Write as _;
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use molmesh::pipeline::{Choice, JobError, JobLimits, Product, params, run};
use molmesh::structure::{
    Kind, ReadLimits, Selection, Structure, StructureError, read, read_with, select, select_with,
};
use molmesh::surface::{Control, CpuBackend, Exceeded, Limit, MemoryMeter, OutOfMemory, SurfaceError};

use crate::bcif_support::{block, category, file, ints, reals, texts};
use crate::tools;

/// Atoms: `label_asym_id`, author chain, x, y, z.
const ATOMS: [(&str, &str, [f64; 3]); 6] = [
    ("A", "X", [1.0, 2.0, 3.0]),
    ("A", "X", [2.5, 2.0, 3.0]),
    ("B", "X", [10.0, 0.0, -3.25]),
    ("B", "X", [11.5, 0.0, -3.25]),
    ("C", "Y", [-7.0, 5.0, 20.0]),
    ("A", "X", [4.0, 2.0, 3.0]),
];

/// Operators: id, rows of matrix and translation. A third of a turn has numbers that are not exact.
const OPERATORS: [(&str, [f64; 12]); 6] = [
    ("1", [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0]),
    ("2", [-0.5, -0.8660254038, 0.0, 30.125, 0.8660254038, -0.5, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0]),
    ("3", [-1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 12.5, 0.0, 0.0, 1.0, 0.25]),
    ("4", [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 1.0, 0.0, -40.0]),
    ("P", [0.0, -1.0, 0.0, 100.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0]),
    ("X0", [1.0, 0.0, 0.0, -55.5, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0]),
];

/// Rules: assembly, expression, chains.
const RULES: [(&str, &str, &str); 9] = [
    ("1", "1", "A,B,C"),
    ("2", "(1-3)(P,4)", "A"),
    ("3", "P", "B"),
    ("3", "X0", "C,A"),
    ("PAU", "1,2-4", "A, B,\nC"),
    ("large", "(1-1000000)(1-1000000)", "A"),
    ("gap", "1,3-6", "A"),
    ("bad", "(1", "A"),
    ("none", "1", "Z"),
];

/// Atoms of each assembly that can be built.
const COUNTS: [(&str, usize, u64); 4] = [("1", 6, 1), ("2", 3 * 6, 6), ("3", 2 + 4, 2), ("PAU", 24, 4)];

fn mmcif() -> String {
    let mut text = "data_T\nloop_\n".to_owned();
    for item in ["group_PDB", "id", "type_symbol", "label_atom_id", "label_comp_id", "label_asym_id", "label_seq_id"]
        .into_iter()
        .chain([
            "label_alt_id",
            "auth_asym_id",
            "auth_seq_id",
            "Cartn_x",
            "Cartn_y",
            "Cartn_z",
            "occupancy",
            "pdbx_PDB_model_num",
        ])
    {
        writeln!(text, "_atom_site.{item}").unwrap();
    }
    for (i, (label, author, [x, y, z])) in ATOMS.iter().enumerate() {
        let n = i + 1;
        writeln!(text, "ATOM {n} C CA ALA {label} {n} . {author} {n} {x} {y} {z} 1.0 1").unwrap();
    }
    // gemmi needs this category, the types of operators, and `label_alt_id`.
    text.push_str("loop_\n_pdbx_struct_assembly.id\n_pdbx_struct_assembly.details\n");
    text.push_str("_pdbx_struct_assembly.method_details\n_pdbx_struct_assembly.oligomeric_details\n");
    text.push_str("_pdbx_struct_assembly.oligomeric_count\n");
    for (id, ..) in COUNTS {
        writeln!(text, "{id} ? ? ? ?").unwrap();
    }
    text.push_str("loop_\n_pdbx_struct_assembly_gen.assembly_id\n_pdbx_struct_assembly_gen.oper_expression\n");
    text.push_str("_pdbx_struct_assembly_gen.asym_id_list\n");
    for (id, expression, chains) in RULES {
        writeln!(text, "{id} '{expression}'\n;{chains}\n;").unwrap();
    }
    text.push_str("loop_\n_pdbx_struct_oper_list.id\n_pdbx_struct_oper_list.type\n");
    for item in items() {
        writeln!(text, "_pdbx_struct_oper_list.{item}").unwrap();
    }
    for (id, numbers) in OPERATORS {
        writeln!(text, "{id} ? {}", numbers.map(|n| n.to_string()).join(" ")).unwrap();
    }
    text
}

/// Items of the numbers of an operator, by row.
fn items() -> Vec<String> {
    let row = |i: usize| [1, 2, 3].map(|j| format!("matrix[{i}][{j}]")).into_iter().chain([format!("vector[{i}]")]);
    [1, 2, 3].into_iter().flat_map(row).collect()
}

fn binary() -> Vec<u8> {
    let column = |k: usize| ATOMS.map(|(_, _, at)| at[k]);
    let atoms = vec![
        texts("type_symbol", &["C"; 6]),
        texts("label_asym_id", &ATOMS.map(|atom| atom.0)),
        texts("auth_asym_id", &ATOMS.map(|atom| atom.1)),
        ints("auth_seq_id", &[1, 2, 3, 4, 5, 6]),
        reals("Cartn_x", &column(0)),
        reals("Cartn_y", &column(1)),
        reals("Cartn_z", &column(2)),
    ];
    let rules = vec![
        texts("assembly_id", &RULES.map(|rule| rule.0)),
        texts("oper_expression", &RULES.map(|rule| rule.1)),
        texts("asym_id_list", &RULES.map(|rule| rule.2)),
    ];
    let mut operators = vec![texts("id", &OPERATORS.map(|operator| operator.0))];
    for (i, item) in items().iter().enumerate() {
        operators.push(reals(item, &OPERATORS.map(|operator| operator.1[i])));
    }
    file(vec![block(
        "T",
        vec![
            category("_pdbx_struct_assembly_gen", RULES.len() as i64, rules),
            category("_pdbx_struct_oper_list", OPERATORS.len() as i64, operators),
            category("_atom_site", 6, atoms),
        ],
    )])
}

/// Returns a PDB file whose first assembly has two rules with lists of chains in several records.
fn pdb() -> String {
    let mut text = String::new();
    let mut remark = |line: &str| writeln!(text, "{:<80}", format!("REMARK 350{line}")).unwrap();
    let biomt = |serial: usize, (_, m): (&str, [f64; 12]), remark: &mut dyn FnMut(&str)| {
        for (k, row) in m.chunks(4).enumerate() {
            let [a, b, c, t] = row else { panic!() };
            remark(&format!("   BIOMT{} {serial:>3}{a:>10.6}{b:>10.6}{c:>10.6}{t:>15.5}", k + 1));
        }
    };
    remark(" BIOMOLECULE: 1");
    remark(" APPLY THE FOLLOWING TO CHAINS: A, B,");
    remark("                    AND CHAINS: C");
    biomt(1, OPERATORS[0], &mut remark);
    biomt(2, OPERATORS[2], &mut remark);
    remark(" APPLY THE FOLLOWING TO CHAINS: B");
    biomt(3, OPERATORS[4], &mut remark);
    remark("");
    remark(" BIOMOLECULE: 2");
    remark(" APPLY THE FOLLOWING TO CHAINS: C");
    biomt(1, OPERATORS[3], &mut remark);
    biomt(2, OPERATORS[5], &mut remark);
    for (i, (chain, _, [x, y, z])) in ATOMS.iter().enumerate() {
        let n = i + 1;
        writeln!(text, "ATOM  {n:>5}  CA  ALA {chain}{n:>4}    {x:>8.3}{y:>8.3}{z:>8.3}  1.00  0.00           C  ")
            .unwrap();
    }
    text
}

fn parse(bytes: &[u8]) -> Structure {
    read(bytes, &ReadLimits::default()).unwrap()
}

fn of(id: &str) -> Selection {
    let mut selection = Selection { assembly: Some(id.to_owned()), ..Selection::default() };
    selection.atoms = "all".parse().unwrap();
    selection
}

/// Returns the positions of the atoms without alternative locations.
fn positions(structure: &Structure, id: &str) -> Vec<[f64; 3]> {
    let selected = select(structure, &of(id)).unwrap();
    let spheres = selected.spheres(structure).unwrap();
    assert_eq!(spheres.len(), selected.atoms.len());
    let rows = (0..spheres.len()).filter(|&row| structure.altloc[selected.atoms[row] as usize] == 0);
    rows.map(|row| spheres.centre(row)).collect()
}

#[test]
fn text_and_binary_files_describe_the_same_assemblies() {
    let [text, packed] = [parse(mmcif().as_bytes()), parse(&binary())];
    for (id, atoms, copies) in COUNTS {
        let found = positions(&text, id);
        assert_eq!(found.len(), atoms, "{id}");
        assert_eq!(positions(&packed, id), found, "{id}");
        assert_eq!(select(&text, &of(id)).unwrap().copies.len() as u64, copies, "{id}");
    }
    let listed = text.assemblies.list(1000);
    let counts: Vec<_> = COUNTS.iter().map(|(id, _, copies)| (*id, Some(*copies))).collect();
    assert_eq!(listed[..4], counts);
    assert_eq!(listed[4..], [("large", None), ("gap", Some(5)), ("bad", None), ("none", Some(1))]);
    // The operator on the right is applied first: a quarter turn and 100 Å, then two rotations.
    let [first, second] = [positions(&text, "2")[0], positions(&text, "2")[12]];
    assert_eq!((first, second), ([98.0, 1.0, 3.0], [-98.0, 11.5, 3.25]));
    // Rules are copied in file order, and an atom left out by the assembly is counted.
    let third = select(&text, &of("3")).unwrap();
    assert_eq!(third.atoms, [2, 3, 0, 1, 5, 4]);
    assert_eq!(select(&text, &of("2")).unwrap().left_out.other_chains, 3);
}

#[test]
fn remarks_describe_assemblies_of_pdb_files() {
    let structure = parse(pdb().as_bytes());
    assert_eq!(structure.assemblies.list(100), [("1", Some(3)), ("2", Some(2))]);
    let [first, second] = ["1", "2"].map(|id| positions(&structure, id));
    assert_eq!((first.len(), second.len()), (14, 2));
    assert_eq!(first[..2], [[1.0, 2.0, 3.0], [2.5, 2.0, 3.0]]);
    assert_eq!(first[12], [100.0, 10.0, -3.25]);
    assert_eq!(second, [[-7.0, -20.0, -35.0], [-62.5, -5.0, -20.0]]);
    // The result depends neither on the position of the records nor on the number of pieces.
    let text = pdb();
    let atoms = text.find("ATOM").unwrap();
    let moved = format!("{}{}", &text[atoms..], &text[..atoms]);
    assert_eq!(parse(moved.as_bytes()).assemblies, structure.assemblies);
    // An operator with a missing row, or with a word that is no number, cannot be used.
    for broken in [text.replacen("   BIOMT2   2", "   BIOMTX   2", 1), text.replacen("12.50000", "12.5x000", 1)] {
        let error = select(&parse(broken.as_bytes()), &of("1")).unwrap_err();
        assert!(matches!(&error, StructureError::BadAssembly { found, .. } if found == "`2`"), "{error}");
    }
    // So does an operator whose last row is missing, even the last one of the file.
    for first in ["   BIOMT3   1", "   BIOMT3   2"] {
        let line = text.lines().find(|line| line.contains(first)).unwrap();
        let structure = parse(text.replacen(&format!("{line}\n"), "", 1).as_bytes());
        assert!(matches!(select(&structure, &of("1")), Err(StructureError::BadAssembly { .. })), "{line}");
    }
    // An assembly without a number is the first; the blank chain is `NULL`.
    let blank =
        text.replace("ALA A", "ALA  ").replace("TO CHAINS: A,", "TO CHAINS: NULL,").replacen("BIOMOLECULE: 1", "", 1);
    assert_eq!(positions(&parse(blank.as_bytes()), "1"), first);
}

#[test]
fn unusable_assemblies_are_rejected_before_they_are_expanded() {
    let structure = parse(mmcif().as_bytes());
    let error = |id: &str| select(&structure, &of(id)).unwrap_err();
    let message = error("7").to_string();
    assert_eq!(message, "assembly `7` is not in the file; it has the assemblies 1, 2, 3, PAU, large, gap, bad, none");
    let start = Instant::now();
    let copies = |id: &str, max| {
        let subject = format!("assembly {id}").into();
        Exceeded { subject, ..Exceeded::new(Limit::Copies, max) }.error::<StructureError>()
    };
    assert_eq!(error("large"), copies("large", 10_000));
    assert!(start.elapsed() < Duration::from_secs(1));
    assert!(matches!(error("gap"), StructureError::BadAssembly { found, .. } if found == "`5`"));
    assert!(matches!(error("bad"), StructureError::BadAssembly { found, .. } if found == "`(1`"));
    let empty = error("none").to_string();
    assert!(empty.contains("assembly none: found chains without atoms: Z"), "{empty}");
    let none = parse(mmcif().split("loop_\n_pdbx").next().unwrap().as_bytes());
    let message = select(&none, &of("1")).unwrap_err().to_string();
    assert_eq!(message, "assembly `1` is not in the file; it has no assemblies");

    // The limits are exact.
    let limited = |max_copies, max_atoms| {
        let limits = ReadLimits { max_copies, max_atoms, ..ReadLimits::default() };
        select_with(&structure, &of("PAU"), &limits, &Control::default()).map(|selected| selected.atoms.len())
    };
    assert_eq!(limited(4, 24), Ok(24));
    assert_eq!(limited(3, 24), Err(copies("PAU", 3)));
    let subject = "the selection of assembly PAU".into();
    let atoms = Exceeded { subject, actual: Some(24), ..Exceeded::new(Limit::Atoms, 23) };
    assert_eq!(limited(4, 23), Err(atoms.error()));
}

/// Counter that refuses memory beyond a limit.
#[derive(Debug, Default)]
struct Meter {
    limit: u64,
    held: AtomicU64,
}

impl MemoryMeter for Meter {
    fn grow(&self, needed: u64) -> Result<(), OutOfMemory> {
        let held = self.held.fetch_add(needed, Ordering::SeqCst);
        if held + needed <= self.limit {
            return Ok(());
        }
        self.held.fetch_sub(needed, Ordering::SeqCst);
        Err(OutOfMemory::Budget { needed, held, limit: self.limit })
    }

    fn shrink(&self, bytes: u64) {
        self.held.fetch_sub(bytes, Ordering::SeqCst);
    }
}

#[test]
fn memory_is_counted_before_it_is_used() {
    let metered = |limit| {
        let meter = Arc::new(Meter { limit, ..Meter::default() });
        (Arc::clone(&meter), Control { memory: meter, ..Control::default() })
    };
    // Tables belong to the structure.
    let held = |text: &str| {
        let (meter, control) = metered(u64::MAX);
        read_with(text.as_bytes(), &ReadLimits::default(), &control).unwrap();
        meter.held.load(Ordering::SeqCst)
    };
    let text = mmcif();
    let tables = held(&text) - held(text.split("loop_\n_pdbx").next().unwrap());
    assert!(tables > (OPERATORS.len() * 96) as u64, "{tables}");
    // So do the copies: 24 atoms and four operators.
    let structure = parse(text.as_bytes());
    let selected = |limit| {
        let (meter, control) = metered(limit);
        let selected = select_with(&structure, &of("PAU"), &ReadLimits::default(), &control);
        selected.map(|_| meter.held.load(Ordering::SeqCst))
    };
    let needed = selected(u64::MAX).unwrap();
    assert!(needed >= 24 * 4 + 4 * 96, "{needed}");
    assert!(matches!(selected(needed - 1), Err(StructureError::Memory(_))));
}

fn meshed(text: &str, pairs: &[(&str, &str)], threads: usize) -> Result<Product, JobError> {
    let backend = CpuBackend::new(Some(threads)).unwrap();
    let choice = Choice { backend: &backend, reason: "" };
    let options = params::parse(pairs.iter().copied()).unwrap().options;
    run(text.as_bytes(), &options, &JobLimits::default(), &choice, &Control::default(), &(), None)
}

#[test]
fn a_mesh_of_an_assembly_is_the_same_on_any_number_of_threads() {
    let pairs = [("assembly", "PAU"), ("atom_ids", "true")];
    let one = meshed(&mmcif(), &pairs, 1).unwrap();
    assert_eq!((one.report.atoms, one.report.atoms_in_file), (24, 6));
    let assembly = one.report.assembly.as_ref().unwrap();
    assert_eq!((assembly.id.as_str(), assembly.copies), ("PAU", 4));
    for threads in [2, 7] {
        let other = meshed(&mmcif(), &pairs, threads).unwrap();
        assert_eq!((&other.mesh.positions, &other.mesh.triangles), (&one.mesh.positions, &one.mesh.triangles));
        assert_eq!(other.mesh.atom_ids, one.mesh.atom_ids);
    }
    // Copies share the indices of the file.
    let mut ids = one.mesh.atom_ids.clone().unwrap().to_vec();
    ids.sort_unstable();
    ids.dedup();
    assert_eq!(ids, [0, 1, 2, 3, 4, 5]);
    let unit = meshed(&mmcif(), &[], 1).unwrap().report;
    assert!((one.report.area / unit.area - 4.0).abs() < 0.1, "{} {}", one.report.area, unit.area);
    assert!(unit.assembly.is_none());
}

#[test]
fn copies_far_from_the_origin_keep_their_precision() {
    let rule = |expression: &str| mmcif().replace("1 '1'", &format!("1 '{expression}'"));
    let shifted = |by: &str| {
        let operator = format!("far ? 1 0 0 {by} 0 1 0 {by} 0 0 1 -{by}\n");
        rule("far") + &operator
    };
    // A multiple of the size of a tile, which keeps the order of triangles.
    let near = meshed(&rule("1"), &[("assembly", "1")], 2).unwrap().mesh;
    let far = meshed(&shifted("90016"), &[("assembly", "1")], 2).unwrap().mesh;
    assert_eq!(near.triangles, far.triangles);
    let error = near.positions.iter().zip(&far.positions).flat_map(|(a, b)| [0, 1, 2].map(|k| (a[k] - b[k]).abs()));
    let error = error.fold(0.0, f32::max);
    assert!(error < 1e-4, "{error}");
    assert!((far.centre[0] - near.centre[0] - 90_016.0).abs() < 1e-9);
    // Beyond the range of coordinates there is no mesh.
    let beyond = meshed(&shifted("99995"), &[("assembly", "1")], 2).unwrap_err();
    assert!(matches!(beyond, JobError::Surface(SurfaceError::BadSphere { .. })), "{beyond}");
}

#[test]
fn coinciding_copies_are_limited() {
    let text = mmcif().replace("1 '1'", "1 '1,1,1,1,1'");
    let options = params::parse([("assembly", "1")]).unwrap().options;
    let backend = CpuBackend::new(Some(1)).unwrap();
    let choice = Choice { backend: &backend, reason: "" };
    let meshed = |max_duplicates| {
        let read = ReadLimits { max_duplicates, ..ReadLimits::default() };
        let limits = JobLimits { read, ..JobLimits::default() };
        run(text.as_bytes(), &options, &limits, &choice, &Control::default(), &(), None)
            .map(|product| product.report.atoms)
    };
    assert_eq!(meshed(5).unwrap(), 30);
    let refused = meshed(4).unwrap_err();
    assert!(matches!(&refused, JobError::Surface(error) if error.exceeded(Limit::Duplicates).is_some()), "{refused}");
}

/// Returns positions in units of 10⁻³ Å, sorted. Rounding in another order may move them by one unit.
fn sorted(positions: impl IntoIterator<Item = [f64; 3]>) -> Vec<[i64; 3]> {
    let mut all: Vec<_> = positions.into_iter().map(|at| at.map(|v| (v * 1e3).round() as i64)).collect();
    all.sort_unstable();
    all
}

/// Returns the structures of the repository.
fn committed() -> Vec<std::path::PathBuf> {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/structures");
    let files = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    let mut files: Vec<_> = files.filter(|path| path.extension().is_some_and(|end| end == "gz")).collect();
    files.sort();
    files
}

#[test]
fn agrees_with_gemmi() {
    let Some(python) = tools::python_interpreter().or_else(|| tools::missing("gemmi")) else { return };
    let folder = tempfile::tempdir().unwrap();
    let made = |name: &str, text: String| {
        let path = folder.path().join(name);
        std::fs::write(&path, text).unwrap();
        path
    };
    let (cif, pdb) = (made("made.cif", mmcif().replace(";A, B,\nC\n;", "A,B,C")), made("made.pdb", pdb()));
    let mut cases = vec![("samples/4pti.pdb".into(), "1"), ("samples/1crn.cif".into(), "1"), (pdb.clone(), "1")];
    cases.push((pdb, "2"));
    // gemmi 0.7.5 reads the first group of a product and no blanks in lists of chains.
    cases.extend(COUNTS.map(|(id, ..)| (cif.clone(), id)).into_iter().filter(|(_, id)| *id != "2"));
    let real = [
        ("1rb8.pdb.gz", "1"),
        ("1lzh.pdb.gz", "2"),
        ("3o21.pdb.gz", "1"),
        ("3o21.pdb.gz", "2"),
        ("1gbt.cif.gz", "1"),
        ("4cup.cif.gz", "1"),
        ("7cth.cif.gz", "1"),
    ];
    cases.extend(real.into_iter().filter_map(|(file, id)| Some((tools::some_structure(file)?, id))));
    let mut cases: Vec<_> = cases.into_iter().map(|(path, id)| (path, id.to_owned())).collect();
    // Every assembly of the committed structures, with the ids and the numbers of atoms that gemmi finds.
    let mut n_committed = 0;
    for path in committed() {
        let output = Command::new(&python).arg("tests/tools/gemmi_assembly.py").arg(&path).output().unwrap();
        assert!(output.status.success(), "{}: {}", path.display(), String::from_utf8_lossy(&output.stderr));
        let theirs = String::from_utf8(output.stdout).unwrap();
        let structure = parse(&std::fs::read(&path).unwrap());
        let count = |id: &str| {
            let selected = select(&structure, &of(id)).unwrap();
            let copies: usize = selected.copies.len();
            // gemmi counts alternative locations, in every copy of these chains.
            let all = structure.len() - structure.kind.iter().filter(|kind| **kind == Kind::VirtualSite).count();
            (all * copies).to_string()
        };
        let ours = structure.assemblies.list(u64::MAX).into_iter().map(|(id, _)| format!("{id} {}\n", count(id)));
        assert_eq!(ours.collect::<String>(), theirs, "{}", path.display());
        let ids = structure.assemblies.list(u64::MAX).into_iter().map(|(id, _)| id.to_owned());
        cases.extend(ids.map(|id| (path.clone(), id)));
        n_committed += 1;
    }
    assert!(n_committed >= 3);
    for (path, id) in &cases {
        let name = format!("{}, assembly {id}", path.display());
        let output = Command::new(&python).arg("tests/tools/gemmi_assembly.py").arg(path).arg(id).output().unwrap();
        assert!(output.status.success(), "{name}: {}", String::from_utf8_lossy(&output.stderr));
        let numbers = |line: &str| {
            let all: Vec<f64> = line.split(' ').map(|v| v.parse().unwrap()).collect();
            [all[0], all[1], all[2]]
        };
        let theirs = sorted(String::from_utf8(output.stdout).unwrap().lines().map(numbers));
        let ours = sorted(positions(&parse(&std::fs::read(path).unwrap()), id));
        assert_eq!(ours.len(), theirs.len(), "{name}");
        assert!(!ours.is_empty());
        // Rounding may change the order of atoms, so each is compared with its neighbours too.
        let near = |a: &[i64; 3], b: &[i64; 3]| (0..3).all(|k| a[k].abs_diff(b[k]) <= 1);
        let unmatched = ours.iter().enumerate().filter(|(i, at)| {
            let around = i.saturating_sub(50)..(i + 50).min(theirs.len());
            !theirs[around].iter().any(|other| near(at, other))
        });
        assert_eq!(unmatched.count(), 0, "{name}");
        // Negative control: an atom that is 0.01 Å away.
        let moved = ours[0].map(|v| v + 10);
        assert!(!near(&moved, &ours[0]), "{name}");
    }
}

#[test]
fn binary_twins_of_real_files_have_the_same_assemblies() {
    let Some(text) = tools::some_structure("1gbt.cif.gz") else { return };
    let paths = [text.clone(), text.with_file_name("1gbt.bcif.gz")];
    let [text, packed] = paths.map(|path| parse(&std::fs::read(path).unwrap()));
    assert_eq!(text.assemblies, packed.assemblies);
    assert!(!text.assemblies.list(100).is_empty());
}
