//! The local archive folder: layouts, limits, and protection against links that lead outside.
#![allow(
    clippy::pedantic,
    clippy::unwrap_used,
    clippy::panic,
    reason = "tests fail by panicking and print what they skip"
)]

use std::fs;
use std::path::Path;

use crate::tools;

use molmesh::structure::{Archive, ArchiveError, EntryId};

fn id(text: &str) -> EntryId {
    text.parse().unwrap()
}

fn put(root: &Path, file: &str) {
    let path = root.join(file);
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    fs::write(path, file).unwrap();
}

#[test]
fn validates_ids_and_converts_them_to_lower_case() {
    for (text, canonical) in [
        ("4pti", "4pti"),
        ("4PTI", "4pti"),
        ("1000", "1000"),
        ("pdb_00001abc", "1abc"),
        ("PDB_00001ABC", "1abc"),
        ("pdb_12345678", "pdb_12345678"),
        ("pdb_0000abcd", "pdb_0000abcd"),
        ("pdb_10001abc", "pdb_10001abc"),
    ] {
        assert_eq!(id(text).as_str(), canonical);
    }
    let long = "1".repeat(1 << 20);
    for bad in [
        "",
        "abc",
        "abcd",
        "1ab",
        "1abcd",
        "1ab/",
        "1ab.",
        "../a",
        "1a\0b",
        "1äb",
        "pdb_1234567",
        "pdb_123456789",
        "pdb_1234567/",
        "pdb-12345678",
        "1abc ",
        " 1abc",
        "1abc\n",
        "%31abc",
        "١abc",
        &long,
    ] {
        match bad.parse::<EntryId>() {
            Err(e @ ArchiveError::BadId { .. }) => assert!(e.to_string().len() < 250),
            other => panic!("{bad:?}: {other:?}"),
        }
    }
}

#[test]
fn finds_every_layout_and_prefers_mmcif() {
    let files = [
        "1abc.cif",
        "ab/1abc.cif",
        "divided/mmCIF/ab/1abc.cif",
        "1abc.cif.gz",
        "ab/1abc.cif.gz",
        "divided/mmCIF/ab/1abc.cif.gz",
        "1abc.pdb",
        "1abc.pdb.gz",
        "ab/pdb1abc.ent.gz",
        "pdb1abc.ent",
        "divided/pdb/ab/pdb1abc.ent.gz",
        "divided/pdb/ab/pdb1abc.ent",
        "ab/pdb_00001abc.cif.gz",
        "1abc.bcif",
        "1abc.bcif.gz",
        "ab/1abc.bcif",
        "ab/pdb_00001abc.bcif.gz",
    ];
    for file in files {
        let dir = tempfile::tempdir().unwrap();
        put(dir.path(), file);
        put(dir.path(), "divided/mmCIF/ab/2abc.cif.gz");
        let archive = Archive::new(dir.path());
        assert_eq!(archive.fetch(&id("1ABC")).unwrap().unwrap().0, file.as_bytes());
        assert_eq!(archive.fetch(&id("pdb_00001abc")).unwrap().unwrap().0, file.as_bytes());
    }
    let dir = tempfile::tempdir().unwrap();
    // BinaryCIF comes last.
    for file in ["1abc.bcif", "ab/pdb1abc.ent.gz"] {
        put(dir.path(), file);
    }
    assert_eq!(Archive::new(dir.path()).fetch(&id("1abc")).unwrap().unwrap().0, b"ab/pdb1abc.ent.gz");
    put(dir.path(), "pdb_87654321.bcif.gz");
    assert_eq!(Archive::new(dir.path()).fetch(&id("pdb_87654321")).unwrap().unwrap().0, b"pdb_87654321.bcif.gz");
    for file in ["1abc.pdb", "pdb1abc.ent.gz", "ab/1abc.cif.gz"] {
        put(dir.path(), file);
    }
    assert_eq!(Archive::new(dir.path()).fetch(&id("1abc")).unwrap().unwrap().0, b"ab/1abc.cif.gz");
    put(dir.path(), "divided/mmCIF/67/pdb_12345678.cif.gz");
    assert_eq!(
        Archive::new(dir.path()).fetch(&id("pdb_12345678")).unwrap().unwrap().0,
        b"divided/mmCIF/67/pdb_12345678.cif.gz"
    );
}

#[test]
fn missing_entries_and_folders_are_no_errors() {
    let dir = tempfile::tempdir().unwrap();
    fs::create_dir(dir.path().join("1abc.cif")).unwrap();
    fs::write(dir.path().join("ab"), "a file where a folder would be").unwrap();
    assert!(Archive::new(dir.path()).fetch(&id("1abc")).unwrap().is_none());
    assert!(Archive::new(dir.path().join("missing")).fetch(&id("1abc")).unwrap().is_none());
}

#[test]
fn limits_file_sizes() {
    let dir = tempfile::tempdir().unwrap();
    put(dir.path(), "1abc.cif");
    let archive = Archive::new(dir.path());
    assert_eq!(archive.clone().with_max_bytes(8).fetch(&id("1abc")).unwrap().unwrap().0, b"1abc.cif");
    let error = archive.with_max_bytes(7).fetch(&id("1abc")).unwrap_err();
    assert_eq!(error.to_string(), "entry 1abc has 8 bytes, the limit is 7");
}

#[cfg(unix)]
#[test]
fn ignores_links_that_lead_outside() {
    use std::os::unix::fs::symlink;
    let outside = tempfile::tempdir().unwrap();
    put(outside.path(), "secret");
    let dir = tempfile::tempdir().unwrap();
    put(dir.path(), "data/5abc");
    symlink(outside.path().join("secret"), dir.path().join("1abc.cif")).unwrap();
    symlink(outside.path(), dir.path().join("bc")).unwrap();
    put(outside.path(), "2bcd.cif");
    symlink("missing", dir.path().join("3abc.cif")).unwrap();
    symlink("data/5abc", dir.path().join("5abc.cif")).unwrap();
    let archive = Archive::new(dir.path());
    for entry in ["1abc", "2bcd", "3abc"] {
        assert!(archive.fetch(&id(entry)).unwrap().is_none(), "{entry}");
    }
    assert_eq!(archive.fetch(&id("5abc")).unwrap().unwrap().0, b"data/5abc", "a link inside the folder");
    // The folder itself may be a link.
    let link = outside.path().join("link");
    symlink(dir.path(), &link).unwrap();
    assert_eq!(Archive::new(link).fetch(&id("5abc")).unwrap().unwrap().0, b"data/5abc");
}

#[cfg(unix)]
#[test]
fn ignores_named_pipes() {
    let dir = tempfile::tempdir().unwrap();
    let made = std::process::Command::new("mkfifo").arg(dir.path().join("1abc.cif")).status();
    if !made.is_ok_and(|s| s.success()) {
        return tools::skip("mkfifo does not work here").unwrap_or_default();
    }
    assert!(Archive::new(dir.path()).fetch(&id("1abc")).unwrap().is_none());
}
