//! BinaryCIF files in blocks, compared with the same files in memory.
#![allow(clippy::pedantic, clippy::unwrap_used, clippy::panic, reason = "tests fail by panicking")]

use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

use molmesh::pipeline::tileset::{StreamSource, StructureStream, TilesetReport, write, write_stream};
use molmesh::pipeline::{Choice, JobLimits, Options, params};
use molmesh::structure::stream::{BLOCK_BYTES, Blocks, ScratchFile, StoredBytes};
use molmesh::structure::{ReadLimits, Structure, StructureError, read, read_with};
use molmesh::surface::{Control, CpuBackend, MemoryMeter, OutOfMemory};

use crate::bcif_support::*;

/// Bytes of a block for each row.
const ROW: usize = 60;

// ---- files ----

/// Encoded data and its chain.
type Encoded = (Vec<u8>, Vec<Pack>);

fn size(values: &[i32]) -> i64 {
    values.len() as i64
}

fn plain(values: &[i32]) -> Encoded {
    (i32s(values), vec![byte_array(3)])
}

/// Encodes values with `IntegerPacking` of one or two signed bytes.
fn packed(values: &[i32], bytes: i64) -> Encoded {
    let [low, high] = if bytes == 1 { [-128, 127] } else { [-32_768, 32_767] };
    let mut parts = Vec::new();
    for mut value in values.iter().copied() {
        while value >= high || value <= low {
            let part = if value > 0 { high } else { low };
            parts.push(part);
            value -= part;
        }
        parts.push(value);
    }
    let data = parts.iter().flat_map(|part| part.to_le_bytes()[..bytes as usize].to_vec()).collect();
    (data, vec![packing(bytes, false, size(values)), byte_array(bytes)])
}

/// Encodes values with `RunLength`, then with `IntegerPacking`.
fn runs(values: &[i32]) -> Encoded {
    let pairs: Vec<i32> = values.chunk_by(|a, b| a == b).flat_map(|run| [run[0], run.len() as i32]).collect();
    let (data, chain) = packed(&pairs, 1);
    (data, [vec![run_length(size(values))], chain].concat())
}

/// Encodes values with `Delta`, then with `then`.
fn differences(values: &[i32], then: impl Fn(&[i32]) -> Encoded) -> Encoded {
    let before = std::iter::once(&values[0]).chain(values);
    let all: Vec<i32> = values.iter().zip(before).map(|(value, before)| value - before).collect();
    let (data, chain) = then(&all);
    (data, [vec![delta(values[0].into())], chain].concat())
}

/// Encodes numbers with `FixedPoint`, then with `then`.
fn fixed(values: &[f64], factor: f64, then: impl Fn(&[i32]) -> Encoded) -> Encoded {
    let whole: Vec<i32> = values.iter().map(|value| (value * factor).round() as i32).collect();
    let (data, chain) = then(&whole);
    (data, [vec![fixed_point(factor)], chain].concat())
}

/// Encodes numbers as steps of 0.001 from `min` on.
fn quantized(values: &[f64], min: f64) -> Encoded {
    let steps: Vec<i32> = values.iter().map(|value| ((value - min) * 1000.0).round() as i32).collect();
    let (data, chain) = packed(&steps, 2);
    (data, [vec![interval(min, min + 2000.0, 2_000_001)], chain].concat())
}

/// Returns a column of numbers.
fn numbers(name: &str, (data, chain): Encoded) -> Pack {
    column(name, data, chain)
}

/// Returns a column of texts whose ids are encoded with `ids`. Empty texts have no id.
fn names(name: &str, values: &[&str], ids: impl Fn(&[i32]) -> Encoded) -> Pack {
    let (mut all, mut joined, mut offsets) = (Vec::new(), String::new(), vec![0]);
    let mut id = |value: &str| {
        if value.is_empty() {
            return -1;
        }
        let known = all.iter().position(|text| text == value);
        known.unwrap_or_else(|| {
            all.push(value.to_owned());
            joined.push_str(value);
            offsets.push(joined.len() as i32);
            all.len() - 1
        }) as i32
    };
    let (data, chain) = ids(&values.iter().map(|value| id(value)).collect::<Vec<_>>());
    column(name, data, vec![string_array(&joined, &offsets, chain)])
}

/// Adds a mask of the rows for which `is_null` is true.
fn with_mask(column: Pack, n: usize, is_null: impl Fn(usize) -> bool) -> Pack {
    let (data, chain) = runs(&(0..n).map(|i| 2 * i32::from(is_null(i))).collect::<Vec<_>>());
    column.with("mask", Pack::Map(vec![("data", Pack::Bytes(data)), ("encoding", Pack::Array(chain))]))
}

/// Content of [`copies`].
#[derive(Clone, Copy)]
struct Content {
    entities: bool,
    /// True if HETATM records have a `label_seq_id`. One of them is not water then.
    numbered: bool,
}

const PLAIN: Content = Content { entities: true, numbered: false };

/// Returns a file of copies of the sample, with every encoding and with the atoms in the middle of it.
fn copies(n: usize, Content { entities, numbered }: Content) -> Vec<u8> {
    let s = read(include_bytes!("../../samples/4pti.pdb"), &ReadLimits::default()).unwrap();
    let rows: Vec<(usize, usize)> = (0..n).flat_map(|copy| (0..s.len()).map(move |i| (copy, i))).collect();
    let n_rows = rows.len();
    let chain = |copy: usize| ["B", "A", "Z", "Q", "C"][copy % 5].to_owned() + &(copy / 5).to_string();
    let of = |value: &dyn Fn(usize, usize) -> f64| rows.iter().map(|&(copy, i)| value(copy, i)).collect::<Vec<f64>>();
    let ints = |value: &dyn Fn(usize) -> i32| rows.iter().map(|&(_, i)| value(i)).collect::<Vec<i32>>();
    let texts = |value: &dyn Fn(usize, usize) -> String| rows.iter().map(|&(c, i)| value(c, i)).collect::<Vec<_>>();
    let label = |copy: usize, i: usize| chain(copy) + if s.hetero[i] { "w" } else { "" };
    let columns: Vec<(&str, Vec<String>)> = vec![
        ("group_PDB", texts(&|_, i| if s.hetero[i] { "HETATM" } else { "ATOM" }.to_owned())),
        ("type_symbol", texts(&|_, i| molmesh::structure::element::symbol(s.element[i]).to_owned())),
        ("label_atom_id", texts(&|_, i| s.name.get(i).to_owned())),
        // Other names than those of the fallback, in a few rows.
        ("auth_atom_id", texts(&|c, i| if c == 1 && i % 90 == 3 { "C9" } else { "" }.to_owned())),
        (
            "auth_comp_id",
            texts(&|c, i| if numbered && c == 1 && i + 1 == s.len() { "LIG" } else { s.residue.get(i) }.to_owned()),
        ),
        ("label_asym_id", texts(&label)),
        ("label_alt_id", texts(&|_, i| if s.residue_number[i] == 20 && i % 2 == 0 { "A" } else { "" }.to_owned())),
        ("type", vec!["unused".to_owned(); n_rows]),
    ];
    let mut all: Vec<Pack> = columns
        .iter()
        .enumerate()
        .map(|(number, (name, values))| {
            let values: Vec<&str> = values.iter().map(String::as_str).collect();
            match number % 4 {
                0 => names(name, &values, runs),
                1 => names(name, &values, |ids| packed(ids, 1)),
                2 => names(name, &values, |ids| differences(ids, |ids| packed(ids, 2))),
                _ => names(name, &values, plain),
            }
        })
        .collect();
    let residues = ints(&|i| s.residue_number[i]);
    let is_open = |row: usize| rows[row].1 % 50 < 7;
    let authors: Vec<i32> = residues.iter().enumerate().map(|(row, v)| if is_open(row) { -999 } else { *v }).collect();
    let single: Vec<u8> = of(&|_, i| s.z[i]).iter().flat_map(|v| (*v as f32).to_le_bytes()).collect();
    let b_factors: Vec<u8> = of(&|_, i| s.b_factor[i].into()).iter().flat_map(|v| v.to_le_bytes()).collect();
    let sequence = with_mask(numbers("label_seq_id", differences(&residues, runs)), n_rows, |row| {
        s.hetero[rows[row].1] && !numbered
    });
    let chains: Vec<i32> = rows.iter().map(|(copy, _)| 7 * *copy as i32 + 1).collect();
    all.extend([
        numbers("auth_asym_id", differences(&chains, runs)),
        with_mask(numbers("auth_seq_id", plain(&authors)), n_rows, is_open),
        sequence,
        numbers("Cartn_x", fixed(&of(&|c, i| s.x[i] + 60.0 * c as f64), 1000.0, |v| differences(v, |v| packed(v, 2)))),
        numbers("Cartn_y", quantized(&of(&|c, i| s.y[i] + 25.0 * (c % 2) as f64), -1000.0)),
        column("Cartn_z", single, vec![byte_array(32)]),
        numbers("occupancy", fixed(&of(&|_, i| s.occupancy[i].into()), 100.0, runs)),
        column("B_iso_or_equiv", b_factors, vec![byte_array(33)]),
        numbers("pdbx_PDB_model_num", runs(&ints(&|_| 1))),
    ]);
    let title = category("_struct", 1, vec![names("title", &["Several copies"], plain)]);
    let both: Vec<String> = (0..n).flat_map(|copy| [chain(copy), chain(copy) + "w"]).collect();
    let ids = names("id", &both.iter().map(String::as_str).collect::<Vec<_>>(), plain);
    let of_chains: Vec<&str> = both.iter().map(|id| if id.ends_with('w') { "2" } else { "1" }).collect();
    let chains = category("_struct_asym", 2 * n as i64, vec![ids, names("entity_id", &of_chains, plain)]);
    let types = names("type", &["polymer", "water"], plain);
    let types = category("_entity", 2, vec![names("id", &["1", "2"], plain), types]);
    let mut categories = vec![title, category("_atom_site", n_rows as i64, all)];
    categories.extend(entities.then_some([types, chains]).into_iter().flatten());
    file(vec![block("EMPTY", vec![category("_atom_site", 0, vec![])]), block("COPIES", categories)])
}

// ---- reading ----

type Atom = ([String; 5], [i32; 3], [u8; 3], [f64; 3], [f32; 2], bool, molmesh::structure::Kind);

fn atoms_of(s: &Structure, len: usize) -> Vec<Atom> {
    let entity = |i: usize| s.label_chain.ids().get(i).map_or("", |id| s.entities[*id as usize].as_str());
    let label = |i: usize| if s.label_chain.is_empty() { "" } else { s.label_chain.get(i) };
    let atom = |i: usize| {
        (
            [s.name.get(i), s.residue.get(i), s.chain.get(i), label(i), entity(i)].map(str::to_owned),
            [s.residue_number[i], s.model[i], i32::from(s.radius.is_empty())],
            [s.insertion_code[i], s.altloc[i], s.element[i]],
            [s.x[i], s.y[i], s.z[i]],
            [s.occupancy[i], s.b_factor[i]],
            s.hetero[i],
            s.kind[i],
        )
    };
    (0..len).map(atom).collect()
}

fn scratch(file: File) -> ScratchFile {
    ScratchFile { file, meter: Arc::new(()) }
}

fn stored() -> Arc<StoredBytes> {
    Arc::new(StoredBytes::new(scratch(tempfile::tempfile().unwrap())))
}

/// Atoms, number of blocks, and title and id.
type Streamed = (Vec<Atom>, usize, [Option<String>; 2]);

/// Reads a file in blocks. Returns all atoms, the number of blocks, and title and id.
fn streamed(bytes: &[u8], block_bytes: usize, limits: &ReadLimits) -> Result<Streamed, StructureError> {
    let control = Control::default();
    let mut blocks = Blocks::new(Box::new(bytes), block_bytes, true, &stored(), limits, &control)?;
    let (mut found, mut n, mut description) = (Vec::new(), 0, [None, None]);
    while let Some(block) = blocks.next(&control)? {
        found.extend(atoms_of(&block.structure, block.len));
        description = [block.structure.title, block.structure.id];
        n += 1;
    }
    assert!(blocks.next(&control).unwrap().is_none());
    Ok((found, n, description))
}

#[test]
fn blocks_have_the_atoms_of_the_file() {
    let limits = ReadLimits::default();
    for options in [PLAIN, Content { entities: false, ..PLAIN }] {
        let bytes = copies(6, options);
        let whole = read(&bytes, &limits).unwrap();
        let expected = atoms_of(&whole, whole.len());
        assert!(whole.len() > 2000 && expected.iter().any(|atom| atom.0[0] == "C9"));
        for rows in [1, 7, 100, 1000, whole.len() - 1, whole.len(), 10 * whole.len()] {
            let (found, n, description) = streamed(&bytes, ROW * rows, &limits).unwrap();
            assert!(found == expected, "{rows} rows");
            assert_eq!(description, [whole.title.clone(), whole.id.clone()]);
            assert_eq!(n == 1, rows >= whole.len(), "{n} blocks of {rows} rows");
        }
    }
}

/// Negative control: a changed number gives another atom.
#[test]
fn blocks_depend_on_the_bytes_of_a_column() {
    let (limits, bytes) = (ReadLimits::default(), copies(2, PLAIN));
    let expected = streamed(&bytes, ROW * 100, &limits).unwrap().0;
    let at = memchr_of(&bytes, b"Cartn_z") + 200;
    let mut changed = bytes.clone();
    changed[at] ^= 1;
    let found = streamed(&changed, ROW * 100, &limits).unwrap().0;
    assert_eq!(found.iter().zip(&expected).filter(|(a, b)| a != b).count(), 1);
    let whole = read(&changed, &limits).unwrap();
    assert!(found == atoms_of(&whole, whole.len()));
}

fn memchr_of(bytes: &[u8], word: &[u8]) -> usize {
    bytes.windows(word.len()).position(|part| part == word).unwrap()
}

#[test]
fn blocks_of_files_of_another_writer() {
    let limits = ReadLimits::default();
    let whole = read(CRAMBIN, &limits).unwrap();
    for rows in [1, 50, 200] {
        assert!(streamed(CRAMBIN, ROW * rows, &limits).unwrap().0 == atoms_of(&whole, whole.len()), "{rows} rows");
    }
}

// ---- damaged files ----

/// Result of reading a file in blocks.
#[derive(Debug, PartialEq)]
enum Outcome {
    Read,
    Failed,
    /// The file can be read in memory only.
    NotAStream,
}

/// Asserts that a file gives the same atoms or the same error in blocks as in memory, unless blocks reject it because
/// they would need all its rows at once.
fn assert_equal_results(bytes: &[u8], limits: &ReadLimits, rows: usize, what: &dyn std::fmt::Debug) -> Outcome {
    let expected = read(bytes, limits).map(|structure| atoms_of(&structure, structure.len()));
    let found = streamed(bytes, ROW * rows, limits).map(|found| found.0);
    if expected.is_ok() && matches!(found, Err(StructureError::NotAStream { .. })) {
        return Outcome::NotAStream;
    }
    assert!(found == expected, "{what:?}: {:?} {:?}", found.as_ref().err(), expected.as_ref().err());
    if found.is_ok() { Outcome::Read } else { Outcome::Failed }
}

#[test]
fn truncated_files_give_the_errors_of_files_in_memory() {
    let limits = ReadLimits { max_inflated_bytes: 1 << 20, max_atoms: 1_000, ..ReadLimits::default() };
    for cut in (0..CRAMBIN.len()).step_by(19).chain(CRAMBIN.len() - 50..CRAMBIN.len()) {
        assert_eq!(assert_equal_results(&CRAMBIN[..cut], &limits, 20, &cut), Outcome::Failed);
    }
    let bytes = copies(1, PLAIN);
    for cut in (0..bytes.len()).step_by(97) {
        assert_eq!(assert_equal_results(&bytes[..cut], &limits, 20, &cut), Outcome::Failed);
    }
    // Bytes after the file are not read.
    let more = [&bytes[..], &[0xC6, 0, 0, 0xFF, 0xFF, 1, 2, 0xC1]].concat();
    assert_eq!(assert_equal_results(&more, &limits, 20, &"more"), Outcome::Read);
}

#[test]
fn changed_files_give_the_results_of_files_in_memory() {
    let limits = ReadLimits { max_inflated_bytes: 1 << 20, max_atoms: 1_000, ..ReadLimits::default() };
    let mut changed = CRAMBIN.to_vec();
    let (mut read_still, mut rejected) = (0, 0);
    for at in (0..CRAMBIN.len()).step_by(7) {
        // Values, lengths, extensions and containers.
        let value = [changed[at] ^ 0x01, changed[at] ^ 0x80, 0xC7, 0xC6, 0xDD][at % 5];
        changed[at] = value;
        let outcome = assert_equal_results(&changed, &limits, 40, &(at, value));
        read_still += usize::from(outcome == Outcome::Read);
        rejected += usize::from(outcome == Outcome::NotAStream);
        changed[at] = CRAMBIN[at];
    }
    assert!(read_still > 100 && rejected < read_still / 10, "{read_still} {rejected}");
}

#[test]
fn inconsistent_columns_give_the_errors_of_files_in_memory() {
    let n = 500;
    let values: Vec<i32> = (0..n as i32).collect();
    let (few, many): (Vec<i32>, Vec<i32>) = (values[1..].to_vec(), (0..=n as i32).collect());
    let limits = ReadLimits::default();
    let with_size = |size: i64| {
        column("auth_seq_id", runs(&values).0, vec![run_length(size), packing(1, false, 1000), byte_array(1)])
    };
    let mut last_nan = vec![0.5; n];
    last_nan[444] = f64::NAN;
    let odd = |ids: &[i32]| {
        let mut ids = ids.to_vec();
        ids[333] = 7;
        plain(&ids)
    };
    let ok = names("auth_asym_id", &vec!["A"; n], plain);
    let cases = [
        (ints("auth_seq_id", &values), ""),
        (ok.clone(), ""),
        (with_size(500), ""),
        (ints("auth_seq_id", &few), "auth_seq_id: found 499 values, expected 500, as rowCount says"),
        (ints("auth_seq_id", &many), "auth_seq_id: found 501 values, expected 500, as rowCount says"),
        (with_size(499), "RunLength (encoding 1 of 3): found 500 values, expected 499, as srcSize says"),
        (numbers("auth_seq_id", runs(&many)), "auth_seq_id: found 501 values"),
        (with_mask(ints("auth_seq_id", &values), n - 1, |_| false), "auth_seq_id, mask: found 499 values"),
        (with_mask(ints("auth_seq_id", &values), n + 1, |_| true), "auth_seq_id, mask: found 501 values"),
        (reals("Cartn_x", &last_nan), "Cartn_x, row 445: found NaN"),
        (names("auth_asym_id", &vec!["A"; n], odd), "auth_asym_id, StringArray: found text 7"),
        (
            column("auth_seq_id", vec![127; n], vec![packing(1, false, 1), byte_array(1)]),
            "IntegerPacking (encoding 1 of 2): found the end of the data within a value",
        ),
        (column("auth_seq_id", vec![0; 3], vec![byte_array(3)]), "found 3 bytes, expected whole numbers of 4 bytes"),
        (ok.clone().with("data", Pack::Nil), "auth_asym_id: found nil"),
    ];
    for (column, expected) in cases {
        let bytes = atoms(n, vec![column]);
        for rows in [3, 100, 499] {
            let outcome = assert_equal_results(&bytes, &limits, rows, &expected);
            assert_eq!(outcome, if expected.is_empty() { Outcome::Read } else { Outcome::Failed }, "{expected}");
        }
        if let Err(error) = streamed(&bytes, ROW * 100, &limits) {
            assert!(error.to_string().contains(expected), "{error}: {expected}");
        }
    }
}

#[test]
fn hetatm_records_that_depend_on_the_whole_file_are_rejected() {
    let limits = ReadLimits::default();
    let all_numbered = copies(2, Content { entities: false, numbered: true });
    let found = streamed(&all_numbered, ROW * 100, &limits).unwrap_err();
    assert!(matches!(found, StructureError::NotAStream { .. }), "{found}");
    assert!(read(&all_numbered, &limits).is_ok());
    // Control: known entities decide.
    let known = copies(2, Content { numbered: true, ..PLAIN });
    assert_eq!(assert_equal_results(&known, &limits, 100, &"entities"), Outcome::Read);
}

#[test]
fn limits_apply_to_the_file() {
    let bytes = copies(2, PLAIN);
    let n = read(&bytes, &ReadLimits::default()).unwrap().len() as u64;
    for limits in [
        ReadLimits { max_atoms: n - 1, ..ReadLimits::default() },
        ReadLimits { max_inflated_bytes: bytes.len() as u64 - 1, ..ReadLimits::default() },
        ReadLimits { max_inflated_bytes: 70 * n, ..ReadLimits::default() },
    ] {
        assert_eq!(assert_equal_results(&bytes, &limits, 50, &limits), Outcome::Failed);
    }
}

#[test]
fn a_temporary_file_that_fails_is_an_error() {
    let bytes = copies(2, PLAIN);
    let file = tempfile::NamedTempFile::new().unwrap();
    let read_only = Arc::new(StoredBytes::new(scratch(File::open(file.path()).unwrap())));
    let control = Control::default();
    let found = Blocks::new(Box::new(&bytes[..]), ROW * 100, true, &read_only, &ReadLimits::default(), &control);
    assert!(matches!(found.err(), Some(StructureError::Scratch { .. })));
    // Blocks of small files move all columns, also those of categories whose faults are only warnings.
    let write_only = scratch(File::options().write(true).open(file.path()).unwrap());
    let write_only = Arc::new(StoredBytes::new(write_only));
    for bytes in [bytes, CRAMBIN.to_vec()] {
        let found = Blocks::new(Box::new(&bytes[..]), ROW, true, &write_only, &ReadLimits::default(), &control);
        assert!(matches!(found.err(), Some(StructureError::Scratch { .. })));
    }
    // Each write to this device fails for lack of space.
    let full = scratch(File::options().read(true).write(true).open("/dev/full").unwrap());
    let found = StoredBytes::new(full).write(0, b"atoms");
    assert_eq!(found, Err(StructureError::DiskFull));
}

// ---- memory ----

/// Meter with a limit, which records its maximum.
#[derive(Debug)]
struct Meter {
    limit: u64,
    held: AtomicU64,
    most: AtomicU64,
}

impl MemoryMeter for Meter {
    fn grow(&self, bytes: u64) -> Result<(), OutOfMemory> {
        let held = self.held.fetch_add(bytes, Ordering::SeqCst) + bytes;
        if held > self.limit {
            self.held.fetch_sub(bytes, Ordering::SeqCst);
            return Err(OutOfMemory::Budget { needed: bytes, held: held - bytes, limit: self.limit });
        }
        self.most.fetch_max(held, Ordering::SeqCst);
        Ok(())
    }

    fn shrink(&self, bytes: u64) {
        self.held.fetch_sub(bytes, Ordering::SeqCst);
    }
}

/// Reads all blocks with a limit of memory. Returns the maximum memory.
fn most_memory(bytes: &[u8], rows: usize, limit: u64) -> Result<u64, StructureError> {
    let meter = Arc::new(Meter { limit, held: AtomicU64::new(0), most: AtomicU64::new(0) });
    let memory: Arc<dyn MemoryMeter> = Arc::<Meter>::clone(&meter);
    let control = Control { memory, ..Control::default() };
    let read_all = || {
        let limits = ReadLimits::default();
        let mut blocks = Blocks::new(Box::new(bytes), ROW * rows, true, &stored(), &limits, &control)?;
        loop {
            let memory = Arc::new(molmesh::surface::Reservation::new(&control.memory));
            let of_block = Control { memory, ..control.clone() };
            if blocks.next(&of_block)?.is_none() {
                return Ok(());
            }
        }
    };
    let done = read_all();
    assert_eq!(meter.held.load(Ordering::SeqCst), 0);
    assert!(meter.most.load(Ordering::SeqCst) <= limit);
    done.map(|()| meter.most.load(Ordering::SeqCst))
}

#[test]
fn memory_depends_on_a_block() {
    let bytes = copies(200, PLAIN);
    let meter = Arc::new(Meter { limit: u64::MAX, held: AtomicU64::new(0), most: AtomicU64::new(0) });
    let memory: Arc<dyn MemoryMeter> = Arc::<Meter>::clone(&meter);
    read_with(&bytes, &ReadLimits::default(), &Control { memory, ..Control::default() }).unwrap();
    let whole = meter.most.load(Ordering::SeqCst);
    let most = most_memory(&bytes, 1000, u64::MAX).unwrap();
    assert!(most < whole / 2, "{most} {whole}");
    // Columns have buffers, so the difference is that of the texts.
    let half = most_memory(&copies(100, PLAIN), 1000, u64::MAX).unwrap();
    assert!(most - half < whole / 20, "{most} {half} {whole}");
    for limit in [1000, 1 << 20, most - 1] {
        assert!(matches!(most_memory(&bytes, 1000, limit), Err(StructureError::Memory(_))), "{limit}");
    }
    assert_eq!(most_memory(&bytes, 1000, most), Ok(most));
}

// ---- tilesets ----

type Written = (BTreeMap<String, Vec<u8>>, String);

fn written(make: impl FnOnce(&(dyn Fn(&str, &[u8]) -> std::io::Result<()> + Sync)) -> TilesetReport) -> Written {
    let files = Mutex::new(BTreeMap::new());
    let report = make(&|path: &str, bytes: &[u8]| {
        files.lock().unwrap().insert(path.to_owned(), bytes.to_owned());
        Ok(())
    });
    (files.into_inner().unwrap(), serde_json::to_string(&report).unwrap())
}

fn in_memory(bytes: &[u8], options: &Options) -> Written {
    let (limits, control, backend) = (JobLimits::default(), Control::default(), CpuBackend::default());
    let choice = Choice { backend: &backend, reason: "test" };
    let read = |_: &Control<'_>| read(bytes, &limits.read).map(Box::new);
    written(|store| write(read, options, &choice, &limits, &control, &(), store).unwrap())
}

fn from_stream(files: &[&[u8]], block_bytes: usize, options: &Options) -> Written {
    let (limits, control, backend) = (JobLimits::default(), Control::default(), CpuBackend::default());
    let choice = Choice { backend: &backend, reason: "test" };
    let files = files.iter().map(|file| Box::new(*file) as Box<dyn Read + Send>).collect();
    let source = StreamSource::Files(files);
    let scratch = [(); 2].map(|()| scratch(tempfile::tempfile().unwrap()));
    let stream = StructureStream { source, scratch, block_bytes, began: &|_| {} };
    written(|store| write_stream(stream, options, &choice, &limits, &control, &(), store).unwrap())
}

#[test]
fn a_stream_gives_the_bytes_of_a_structure_in_memory() {
    let (bytes, other) = (copies(6, PLAIN), copies(5, PLAIN));
    for query in [
        &[("resolution", "2"), ("color", "chain"), ("atom_ids", "true")][..],
        &[("resolution", "2"), ("color", "entity"), ("select", "all")],
        &[("resolution", "4"), ("color", "residue"), ("surface", "ses")],
        &[("resolution", "3"), ("color", "bfactor"), ("color_range", "5,40"), ("select", "byres name CA")],
    ] {
        let options = params::parse(query.iter().copied().chain([("compress", "meshopt")])).unwrap().options;
        let expected = in_memory(&bytes, &options);
        assert!(expected.0.len() > 4, "{query:?}");
        assert!(in_memory(&other, &options) != expected);
        for block_bytes in [3000, 20_000, BLOCK_BYTES] {
            assert!(from_stream(&[&bytes], block_bytes, &options) == expected, "{query:?} {block_bytes}");
        }
    }
}
