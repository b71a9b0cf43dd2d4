//! BinaryCIF compared with other programs. Files written by biotite with each encoding, and files of the PDB archive,
//! must have the same content as the text. gemmi must count the same atoms, and meshes must be equal byte for byte.
//!
//! `tests/tools/setup.sh` installs biotite and gemmi. The test also uses a folder of structures beside the repository.
#![allow(
    clippy::pedantic,
    clippy::unwrap_used,
    clippy::panic,
    reason = "tests fail by panicking and print what they skip"
)]

use crate::bcif_support;
use crate::tools;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::Command;

use bcif_support::anonymous;
use molmesh::formats::{Format, Meta};
use molmesh::structure::{ReadLimits, Selection, SourceFormat, Structure, read, select};
use molmesh::surface::{Backend, Control, CpuBackend, SurfaceLimits, SurfaceOptions, SurfaceParams};
use serde::Deserialize;
use tools::files::encoded;

const VARIANTS: [&str; 7] = ["plain", "packed", "bytes", "texts", "compressed", "single", "quantized"];

fn structure(path: &Path) -> Structure {
    let bytes = std::fs::read(path).unwrap();
    read(&bytes, &ReadLimits::default()).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// mmCIF files: crambin; four more with alternative locations, several models, ligands, insertion codes.
fn sources() -> Vec<PathBuf> {
    let more =
        ["1gbt.cif.gz", "1pfe.cif.gz", "4cup.cif.gz", "1lcd.cif.gz"].into_iter().filter_map(tools::some_structure);
    [PathBuf::from("samples/1crn.cif")].into_iter().chain(more).collect()
}

/// Returns a mesh file without the fields that depend on the source format.
fn mesh(structure: &Structure) -> Vec<u8> {
    let spheres = select(structure, &Selection::default()).unwrap().spheres(structure).unwrap();
    let params = SurfaceParams::new(&SurfaceOptions { resolution: Some(1.0), ..SurfaceOptions::default() }).unwrap();
    let backend = CpuBackend::new(Some(2)).unwrap();
    let meshed = backend.run(&spheres, &params, &SurfaceLimits::default(), &Control::default()).unwrap();
    encoded(Format::Glb, &meshed.mesh, &Meta::default())
}

/// Summary that the writer prints.
#[derive(Debug, Deserialize)]
struct Written {
    atoms: usize,
    encodings: BTreeSet<String>,
}

/// Largest difference of coordinates, Å.
fn farthest(a: &Structure, b: &Structure) -> f64 {
    let pairs = [(&a.x, &b.x), (&a.y, &b.y), (&a.z, &b.z)].into_iter().flat_map(|(a, b)| a.iter().zip(b));
    pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

/// Returns the structure with the real numbers of another one.
fn with_numbers_of(a: &Structure, b: &Structure) -> Structure {
    let (x, y, z) = (b.x.clone(), b.y.clone(), b.z.clone());
    Structure { x, y, z, occupancy: b.occupancy.clone(), b_factor: b.b_factor.clone(), ..anonymous(a) }
}

#[test]
fn files_of_biotite_have_the_content_of_the_text() {
    let folder = tempfile::tempdir().unwrap();
    let mut lines = Vec::new();
    let mut files = Vec::new();
    for (i, source) in sources().into_iter().enumerate() {
        for variant in VARIANTS {
            let target = folder.path().join(format!("{i}-{variant}.bcif"));
            lines.push(PathBuf::from(format!("{variant}\t{}\t{}", source.display(), target.display())));
            files.push((source.clone(), variant, target));
        }
    }
    let Some(written) = tools::python::<Written>("write_bcif.py", &lines) else { return };
    let mut encodings = BTreeSet::new();
    for ((source, variant, target), written) in files.iter().zip(written) {
        let (text, binary) = (structure(source), structure(target));
        let what = format!("{} {variant}", source.display());
        assert_eq!(
            (binary.format, binary.len(), text.len()),
            (SourceFormat::BinaryCif, written.atoms, written.atoms),
            "{what}"
        );
        match *variant {
            "single" => {
                let rounded = |v: &[f64]| v.iter().map(|&v| f64::from(v as f32)).collect::<Vec<_>>();
                assert_eq!((binary.x.clone(), binary.z.clone()), (rounded(&text.x), rounded(&text.z)), "{what}");
                assert_eq!(with_numbers_of(&text, &binary), anonymous(&binary), "{what}");
                assert_eq!((&text.occupancy, &text.b_factor), (&binary.occupancy, &binary.b_factor), "{what}");
            }
            "quantized" => {
                let range =
                    |v: &[f64]| v.iter().fold(f64::MIN, |a, b| a.max(*b)) - v.iter().fold(f64::MAX, |a, b| a.min(*b));
                // biotite rounds up to the next step, not to the nearest.
                let step = [&text.x, &text.y, &text.z].map(|v| range(v) / 1e6).into_iter().fold(0.0, f64::max);
                let far = farthest(&text, &binary);
                assert!(far > 0.0 && far <= step * 1.000_001, "{what}: {far} Å, a step is {step}");
                assert_eq!(with_numbers_of(&text, &binary), anonymous(&binary), "{what}");
            }
            _ => {
                assert!(anonymous(&text) == anonymous(&binary), "{what}: {} Å", farthest(&text, &binary));
                if text.len() < 5000 {
                    assert!(mesh(&text) == mesh(&binary), "{what}: another mesh");
                }
            }
        }
        // Control: moving one atom by 0.001 Å changes atoms and mesh.
        let mut moved = text.clone();
        let last = select(&text, &Selection::default()).unwrap().atoms.last().map_or(0, |&i| i as usize);
        moved.x[last] += 0.001;
        assert!(anonymous(&moved) != anonymous(&text) && farthest(&moved, &text) > 0.000_9);
        if *variant == "plain" && text.len() < 5000 {
            assert!(mesh(&moved) != mesh(&text), "{what}");
        }
        encodings.extend(written.encodings);
    }
    let all =
        ["ByteArray", "Delta", "FixedPoint", "IntegerPacking", "IntervalQuantization", "RunLength", "StringArray"];
    assert_eq!(encodings, all.map(str::to_owned).into());
}

/// Counts the atoms of the first model by chain and element.
type Counts = BTreeMap<(String, u8), usize>;

fn counts(structure: &Structure) -> Counts {
    let mut counts = Counts::new();
    for i in (0..structure.len()).filter(|&i| structure.model[i] == structure.model[0]) {
        *counts.entry((structure.chain.get(i).to_owned(), structure.element[i])).or_default() += 1;
    }
    counts
}

/// Counts the atoms of a text with gemmi.
fn gemmi_counts(python: &Path, file: &Path) -> Counts {
    let output = Command::new(python).arg("tests/tools/gemmi_dump.py").arg(file).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let mut counts = Counts::new();
    for line in String::from_utf8(output.stdout).unwrap().lines().skip(1) {
        let fields: Vec<&str> = line.split('\t').collect();
        *counts.entry((fields[0].to_owned(), fields[6].parse().unwrap())).or_default() += 1;
    }
    counts
}

#[test]
fn gemmi_counts_the_same_atoms() {
    let Some(python) = tools::python_interpreter() else {
        return tools::missing::<()>("gemmi").unwrap_or_default();
    };
    let committed = read(bcif_support::CRAMBIN, &ReadLimits::default()).unwrap();
    let crambin = gemmi_counts(&python, Path::new("samples/1crn.cif"));
    assert_eq!(counts(&committed), crambin);
    assert_eq!(crambin.values().sum::<usize>(), 327);
    let Some((text, binary)) = tools::some_structure("1gbt.cif.gz").zip(tools::some_structure("1gbt.bcif.gz")) else {
        return;
    };
    assert_eq!(counts(&structure(&binary)), gemmi_counts(&python, &text));
    // Control: another entry has other atoms.
    assert_ne!(counts(&structure(&binary)), crambin);
}

#[test]
fn the_committed_file_is_the_sample() {
    let text = structure(Path::new("samples/1crn.cif"));
    let binary = read(bcif_support::CRAMBIN, &ReadLimits::default()).unwrap();
    assert_eq!(anonymous(&text), anonymous(&binary));
    assert_eq!((binary.format.name(), binary.id.as_deref()), ("bcif", Some("1CRN")));
    assert!(mesh(&text) == mesh(&binary));
}

/// `1gbt` as distributed by the archive, written by the reference implementation.
#[test]
fn an_entry_of_the_archive_is_the_same_in_both_formats() {
    let Some((text, binary)) = tools::some_structure("1gbt.cif.gz").zip(tools::some_structure("1gbt.bcif.gz")) else {
        return;
    };
    let (text, binary) = (structure(&text), structure(&binary));
    assert_eq!((binary.len(), binary.id.as_deref()), (1761, Some("1GBT")));
    assert!(anonymous(&text) == anonymous(&binary), "{} Å", farthest(&text, &binary));
    assert!(mesh(&text) == mesh(&binary));
}
