//! Reads a structure file in blocks, so that the memory depends on a block and not on the file.
//!
//! A block is a number of rows of `atom_site`, with everything before the first row of an mmCIF file, or all other
//! categories of a BinaryCIF file. It ends where the residues before and after do not depend on each other. Files of
//! other formats are one block.

mod lines;

use std::io::{BufReader, Read};
use std::sync::Arc;

use molmesh_surface::{Control, MemoryMeter as _, Reservation};

use self::lines::{TagsAfterAtoms, end_of_rows, rows};
use super::assembly::Assemblies;
use super::atoms::{Columns, Structure, Tables};
use super::bcif::{self, RowStream, Skeleton};
use super::decoder::Decoder;
use super::divisions::{self, BlockFindings};
use super::error::StructureError;
use super::read::{ReadLimits, Reading, check, of_text, without_mark};
use super::source::{SourceFields, SourceFormat};
use super::{duplicates, mmcif, sniff};

pub use super::stored::{ScratchFile, StoredBytes};

/// Bytes of the rows of a block: about 270,000 atoms.
pub const BLOCK_BYTES: usize = 16 << 20;
/// Size of the buffer of the input, bytes.
const BUFFER: usize = 1 << 18;
/// Bytes that are read at first.
const FIRST_BYTES: usize = 1 << 20;
/// Bytes of a block for each row of a BinaryCIF file.
const ROW_BYTES: usize = 60;
/// Size of a block relative to the smallest byte string that is moved to the temporary file: 64 KiB of 16 MiB.
const MOVED_PART: usize = 256;

/// Some atoms of a structure.
#[derive(Debug)]
pub struct Block {
    /// The atoms, followed by the first ones of the next block.
    pub structure: Structure,
    /// Number of atoms of this block.
    pub len: usize,
}

impl Block {
    /// Takes the structure without its atoms: format, id and title.
    pub fn take_description(&mut self) -> Structure {
        let Structure { format, id, title, unread, .. } = &mut self.structure;
        let source = SourceFields { id: id.take(), title: title.take(), unread: *unread, ..SourceFields::new(*format) };
        Columns::default().into_structure(Tables::default(), source, Vec::new())
    }
}

/// Rejects atoms of one model of which more than allowed have the same position. `centre` returns the position of an
/// atom below `n`, Å.
///
/// # Errors
/// Returns [`StructureError::Limit`] and the errors of memory and cancellation.
pub fn check_positions(
    n: usize,
    centre: impl Fn(usize) -> [f64; 3],
    limits: &ReadLimits,
    control: &Control<'_>,
) -> Result<(), StructureError> {
    duplicates::check(n, |i| (1, centre(i)), &Reading::new(limits, control))
}

/// Content of a BinaryCIF file.
enum Binary {
    /// File that is one block.
    Whole(Skeleton),
    Rows(Box<RowStream>),
}

/// Blocks of a file, in file order.
pub struct Blocks<'a> {
    input: Decoder<'a>,
    limits: ReadLimits,
    /// Text before the first row, and rows that are not in a block yet.
    text: Vec<u8>,
    memory: Reservation,
    /// Length of the text before the first row; `None` to read the file as one block.
    head: Option<usize>,
    /// Content of a BinaryCIF file.
    binary: Option<Binary>,
    /// Bytes of the rows of a block.
    block_bytes: usize,
    /// Number of lines in the blocks so far.
    lines: u64,
    finished: bool,
    findings: BlockFindings,
    /// True to reject helices and strands after the atoms.
    needs_secondary: bool,
    tags: TagsAfterAtoms,
    /// Assemblies of the file, after the last block.
    assemblies: Assemblies,
}

impl<'a> Blocks<'a> {
    /// Begins to read a file in blocks of about `block_bytes`. With `needs_secondary`, helices and strands of an mmCIF
    /// file must precede the atoms. Large columns of a BinaryCIF file are moved to `stored`.
    ///
    /// # Errors
    /// Returns the errors of reading.
    pub fn new(
        input: Box<dyn Read + Send + 'a>,
        block_bytes: usize,
        needs_secondary: bool,
        stored: &Arc<StoredBytes>,
        limits: &ReadLimits,
        control: &Control<'_>,
    ) -> Result<Self, StructureError> {
        let input = Box::new(BufReader::with_capacity(BUFFER, input));
        let mut blocks = Self {
            input: Decoder::new(input, limits.max_inflated_bytes, control)?,
            limits: *limits,
            text: Vec::new(),
            memory: Reservation::new(&control.memory),
            head: None,
            binary: None,
            block_bytes,
            lines: 0,
            finished: false,
            findings: BlockFindings::default(),
            needs_secondary,
            tags: TagsAfterAtoms::default(),
            assemblies: Assemblies::default(),
        };
        let mut size = FIRST_BYTES;
        loop {
            blocks.fill(size, control)?;
            let text = without_mark(&blocks.text);
            match sniff::sniff(text)? {
                SourceFormat::Mmcif => {
                    blocks.head = mmcif::first_row(text).map(|first| blocks.text.len() - text.len() + first);
                    if blocks.head.is_none() && !blocks.input.at_end() {
                        size *= 2;
                        continue;
                    }
                }
                SourceFormat::BinaryCif => blocks.binary = Some(blocks.open_binary(stored, control)?),
                _ => {}
            }
            break;
        }
        if let Some(head) = &mut blocks.head {
            let line = memchr::memrchr(b'\n', &blocks.text[..*head]).map_or(0, |i| i + 1);
            if !blocks.text[line..*head].iter().all(u8::is_ascii_whitespace) {
                return Err(not_lines("a row on the line of the last item"));
            }
            *head = line;
        }
        Ok(blocks)
    }

    /// Reads a BinaryCIF file.
    fn open_binary(&mut self, stored: &Arc<StoredBytes>, control: &Control<'_>) -> Result<Binary, StructureError> {
        let mut skeleton = Skeleton::new(stored, (self.block_bytes / MOVED_PART) as u64, control);
        skeleton.add(without_mark(&self.text))?;
        while !self.input.at_end() {
            self.text.clear();
            self.fill(1, control)?;
            skeleton.add(&self.text)?;
        }
        let rows = (self.block_bytes / ROW_BYTES).max(1);
        let Some(mut opened) = RowStream::open(&skeleton, rows, &self.limits, control)? else {
            return Ok(Binary::Whole(skeleton));
        };
        self.assemblies = opened.take_assemblies();
        Ok(Binary::Rows(Box::new(opened)))
    }

    /// Returns the next block; `None` at the end. The memory of its structure stays added to the meter of `control`.
    ///
    /// # Errors
    /// Returns the errors of [`super::read_with`], and [`StructureError::NotAStream`] if the whole file would give
    /// other atoms.
    pub fn next(&mut self, control: &Control<'_>) -> Result<Option<Block>, StructureError> {
        if self.finished {
            return Ok(None);
        }
        if let Some(Binary::Rows(rows)) = &mut self.binary {
            return rows.next(&self.limits, control);
        }
        let Some(head) = self.head else {
            self.finished = true;
            self.fill(usize::MAX, control)?;
            let reading = Reading::new(&self.limits, control);
            let mut structure = match &self.binary {
                Some(Binary::Whole(skeleton)) => bcif::read_skeleton(skeleton, &reading)?,
                _ => of_text(without_mark(&self.text), &reading)?,
            };
            self.assemblies = std::mem::take(&mut structure.assemblies);
            return Ok(Some(Block { len: structure.len(), structure }));
        };
        let mut size = self.block_bytes;
        loop {
            check(control)?;
            self.fill(head.saturating_add(size), control)?;
            let most = self.text.len().min(head.saturating_add(size));
            let rows_end = end_of_rows(&self.text[head..most]).map(|end| head + end);
            let is_last = rows_end.is_some() || (self.input.at_end() && most == self.text.len());
            let whole_lines = || memchr::memrchr(b'\n', &self.text[head..most]).map_or(head, |i| head + i + 1);
            let end = rows_end.unwrap_or_else(|| if is_last { most } else { whole_lines() });
            let n_rows = rows(&self.text[head..end]).count();
            if n_rows == 0 && is_last {
                self.finished = true;
                self.end(end, control)?;
                return Ok(None);
            }
            if n_rows == 0 {
                size = size.saturating_mul(2);
                continue;
            }
            let is_whole = is_last && self.lines == 0;
            let (metered, memory) = control.with_reservation();
            let begin = if is_whole { Reading::new } else { Reading::of_block };
            let reading = begin(&self.limits, &metered);
            let structure = mmcif::read(without_mark(&self.text[..end]), &reading)
                .map_err(|error| if is_last { self.moved(error, head) } else { self.of_block(error, head, end) })?;
            if structure.len() != n_rows && !is_whole {
                return Err(not_lines(&format!("{} rows in {n_rows} lines", structure.len())));
            }
            let len = if is_last { Some(structure.len()) } else { divisions::last_division(&structure) };
            let Some(len) = len else {
                // All residues depend on each other.
                size = size.saturating_mul(2);
                continue;
            };
            if !is_whole {
                self.findings.add(&reading);
            }
            // Subtracts the memory of reading first.
            drop(reading);
            memory.keep();
            let used = rows(&self.text[head..end]).nth(len).map_or(end, |(start, _)| head + start);
            self.lines += memchr::memchr_iter(b'\n', &self.text[head..used]).count() as u64;
            if is_last {
                self.finished = true;
                self.end(end, control)?;
            } else {
                self.text.drain(head..used);
            }
            return Ok(Some(Block { structure, len }));
        }
    }

    /// Takes the assemblies of the file, after the last block. The caller charges their memory.
    pub fn take_assemblies(&mut self) -> Assemblies {
        std::mem::take(&mut self.assemblies)
    }

    /// Reads until the text has `size` bytes, or the input ends.
    fn fill(&mut self, size: usize, control: &Control<'_>) -> Result<(), StructureError> {
        self.input.fill(size, &mut self.text, &self.memory, control)
    }

    /// Reads the rest of the data block, from `end` of the text on, and rejects categories that change the atoms.
    fn end(&mut self, end: usize, control: &Control<'_>) -> Result<(), StructureError> {
        self.findings.check("the categories `entity` and `struct_asym` before the atoms")?;
        let head = self.head.unwrap_or(0);
        self.text.drain(head..end);
        self.memory.grow(head as u64)?;
        self.tags.assemblies = self.text[..head].to_vec();
        // Ends the loop of the atoms, which has no rows here.
        self.tags.assemblies.extend_from_slice(b"\nsave_\n");
        self.text.drain(..head);
        let (mut is_last, mut searched) = (false, 0);
        while !is_last {
            check(control)?;
            let newline = memchr::memrchr(b'\n', &self.text[searched..]);
            let whole = if self.input.at_end() { self.text.len() } else { newline.map_or(0, |i| searched + i + 1) };
            let kept = self.tags.assemblies.len();
            for line in self.text[..whole].split_inclusive(|&b| b == b'\n') {
                self.tags.add(line, self.needs_secondary)?;
            }
            self.memory.grow((self.tags.assemblies.len() - kept) as u64)?;
            is_last = self.input.at_end();
            self.text.drain(..whole);
            // The rest has no newline.
            searched = self.text.len();
            self.fill(self.text.len() + 1, control)?;
        }
        let reading = Reading::new(&self.limits, control);
        self.assemblies = mmcif::assemblies(without_mark(&self.tags.assemblies), &reading)?;
        Ok(())
    }

    /// Converts the error of a block that more rows follow. A row that does not end within the block has several lines.
    fn of_block(&self, error: StructureError, head: usize, end: usize) -> StructureError {
        let n_lines = memchr::memchr_iter(b'\n', &self.text[..end]).count() as u64;
        match error {
            StructureError::Syntax { line, .. } if line > n_lines => not_lines("a row of several lines"),
            error => self.moved(error, head),
        }
    }

    /// Converts the line of an error from that of the text to that of the file.
    fn moved(&self, mut error: StructureError, head: usize) -> StructureError {
        if let StructureError::Syntax { line, .. } = &mut error
            && *line > memchr::memchr_iter(b'\n', &self.text[..head]).count() as u64
        {
            *line += self.lines;
        }
        error
    }
}

fn not_a_stream(found: &str, expected: &'static str) -> StructureError {
    StructureError::NotAStream { found: found.to_owned(), expected }
}

fn not_lines(found: &str) -> StructureError {
    not_a_stream(found, "one line for each row of `atom_site`")
}

#[cfg(test)]
#[allow(clippy::pedantic, clippy::unwrap_used, reason = "tests fail by panicking")]
mod tests {
    use super::*;
    use crate::{Kind, SelectedBlocks, Selection, read, select};

    const HEAD: &str = "data_x\n_entry.id 1ABC\nloop_\n_atom_site.group_PDB\n_atom_site.type_symbol\n\
                        _atom_site.label_atom_id\n_atom_site.auth_comp_id\n_atom_site.auth_asym_id\n\
                        _atom_site.auth_seq_id\n_atom_site.label_seq_id\n_atom_site.Cartn_x\n_atom_site.Cartn_y\n\
                        _atom_site.Cartn_z\n";

    fn stored() -> Arc<StoredBytes> {
        Arc::new(StoredBytes::new(ScratchFile { file: tempfile::tempfile().unwrap(), meter: Arc::new(()) }))
    }

    type Row = (String, String, i32, Kind, [f64; 3]);

    fn of(structure: &Structure, len: usize) -> Vec<Row> {
        let s = structure;
        let row = |i: usize| {
            (
                s.chain.get(i).to_owned(),
                s.name.get(i).to_owned(),
                s.residue_number[i],
                s.kind[i],
                [s.x[i], s.y[i], s.z[i]],
            )
        };
        (0..len).map(row).collect()
    }

    /// Reads a text in blocks of `size` bytes. Returns all atoms and the number of blocks.
    fn blocks(text: &str, size: usize) -> Result<(Vec<Row>, usize), StructureError> {
        let (control, limits) = (Control::default(), ReadLimits::default());
        let mut blocks = Blocks::new(Box::new(text.as_bytes()), size, false, &stored(), &limits, &control)?;
        let (mut found, mut n) = (Vec::new(), 0);
        while let Some(block) = blocks.next(&control)? {
            found.extend(of(&block.structure, block.len));
            n += 1;
        }
        Ok((found, n))
    }

    fn whole(text: &str) -> Vec<Row> {
        let structure = read(text.as_bytes(), &ReadLimits::default()).unwrap();
        of(&structure, structure.len())
    }

    fn row(record: &str, name: &str, residue: &str, chain: &str, number: i32, sequence: &str) -> String {
        format!("{record} C {name} {residue} {chain} {number} {sequence} {}.5 1 {}\n", number, name.len())
    }

    /// Returns 200 residues: amino acids, modified ones that bonds join to them, and water.
    fn rows_of(chain: &str, sequence: bool) -> String {
        let residue = |i: i32| {
            let sequence = if sequence { i.to_string() } else { ".".to_owned() };
            let (record, name) = if i % 7 == 3 { ("HETATM", "XYZ") } else { ("ATOM", ["ALA", "GLY"][i as usize % 2]) };
            ["N", "C"].map(|atom| row(record, atom, name, chain, i, &sequence)).concat()
        };
        let water = |i: i32| row("HETATM", "O", "HOH", chain, i, ".");
        (0..150).map(residue).chain((150..200).map(water)).collect()
    }

    #[test]
    fn blocks_have_the_atoms_of_the_file() {
        for chains in [&["A"][..], &["A", "B", "A", "'C d'"]] {
            for sequence in [true, false] {
                let rows: String = chains.iter().map(|chain| rows_of(chain, sequence)).collect();
                let text = format!("{HEAD}{rows}# end\nloop_\n_x.y\n1\ndata_other\n_entity.id 1\n");
                let expected = whole(&text);
                assert!(
                    expected.iter().any(|row| row.3 == Kind::Protein) && expected.iter().any(|r| r.3 == Kind::Water)
                );
                for size in [1, 100, 1000, 5000] {
                    let (found, n) = blocks(&text, size).unwrap();
                    assert!(found == expected, "{chains:?} {sequence} {size}");
                    assert!(n > 1, "{n}");
                }
                assert_eq!(blocks(&text, BLOCK_BYTES), Ok((expected, 1)));
            }
        }
    }

    #[test]
    fn blocks_of_real_files_give_the_same_selection() {
        let root = std::path::Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../.."));
        let folders = ["samples", "tests/structures"];
        let entries = folders.iter().flat_map(|folder| std::fs::read_dir(root.join(folder)).unwrap());
        let paths: Vec<_> = entries.map(|entry| entry.unwrap().path()).filter(|path| path.is_file()).collect();
        let (control, limits) = (Control::default(), ReadLimits::default());
        let mut n_blocks = 0;
        for path in paths {
            let bytes = std::fs::read(&path).unwrap();
            let Ok(structure) = read(&bytes, &limits) else { continue };
            for atoms in ["polymer", "all", "byres elem P or resn HOH"] {
                let selection = Selection { atoms: atoms.parse().unwrap(), ..Selection::default() };
                let Ok(expected) = select(&structure, &selection) else { continue };
                for size in [10_000, 200_000] {
                    let mut blocks =
                        Blocks::new(Box::new(&bytes[..]), size, true, &stored(), &limits, &control).unwrap();
                    let (mut selected, mut found) = (SelectedBlocks::new(&control), Vec::new());
                    while let Some(block) = blocks.next(&control).unwrap() {
                        let first = u32::try_from(selected.n_atoms).unwrap();
                        let of_block = selected.add(&block, &selection, &limits, &control).unwrap();
                        found.extend(of_block.atoms.into_iter().map(|i| first + i));
                        n_blocks += 1;
                    }
                    let n_atoms = selected.n_atoms;
                    let ended = selected.finish(&selection, None).unwrap();
                    assert!(found == expected.atoms, "{} {atoms} {size}", path.display());
                    assert_eq!((ended.left_out, ended.model), (expected.left_out.clone(), expected.model));
                    assert_eq!(n_atoms, structure.len() as u64);
                }
            }
        }
        assert!(n_blocks > 30, "{n_blocks}");
    }

    /// Negative control: residues depend on those before, so blocks of any rows give other kinds.
    #[test]
    fn kinds_depend_on_adjacent_residues() {
        let text = HEAD.to_owned() + &rows_of("A", false);
        let kinds = |rows: &[Row]| rows.iter().map(|row| row.3).collect::<Vec<_>>();
        let apart: Vec<Row> = rows_of("A", false).lines().flat_map(|line| whole(&format!("{HEAD}{line}\n"))).collect();
        assert_ne!(kinds(&apart), kinds(&whole(&text)));
    }

    #[test]
    fn files_that_blocks_would_change_are_rejected() {
        let rows = rows_of("A", true);
        let entities = format!("{HEAD}{rows}loop_\n_entity.id\n_entity.type\n1 polymer\n");
        let same_line =
            format!("{}1 2 3\n", "data_x\nloop_\n_atom_site.Cartn_x\n_atom_site.Cartn_y\n_atom_site.Cartn_z ");
        let two_lines = HEAD.to_owned() + &rows.replace(" 1 ", "\n1 ");
        let one_line = format!("{HEAD}{rows}loop_ _entity.id _entity.type 1 polymer\n");
        // The tags follow a text field with lines that look like a data block and a text field.
        let behind_text = format!("{HEAD}{rows}_x.y\n;a\ndata_b\n ;\n;\nloop_\n_entity.id\n_entity.type\n1 polymer\n");
        // The last rows have sequence numbers of water, so those of all others have no meaning.
        let water = HEAD.to_owned() + &rows + &row("HETATM", "O", "HOH", "W", 1, "1");
        let two_blocks = format!("{HEAD}{rows}{}{rows}", HEAD.replace("data_x", "data_y"));
        let spheres = format!("{HEAD}{rows}loop_\n_ihm_sphere_obj_site.id\n_ihm_sphere_obj_site.Cartn_x\n1 0\n");
        // Residues that are ligands if the file has a polymer.
        let unknown =
            ["ALA", "GLY"].iter().fold(["A", "B", "C"].map(|chain| rows_of(chain, false)).concat(), |rows, name| {
                rows.replace(&format!("C N {name}"), "C C1 QQQ").replace(&format!("C C {name}"), "C C2 QQQ")
            });
        let unknown = HEAD.to_owned() + &unknown;
        let rejected =
            [entities, same_line, two_lines.clone(), one_line, behind_text, water, two_blocks, spheres, unknown];
        for text in rejected {
            let found = blocks(&text, 1000).unwrap_err();
            assert!(matches!(found, StructureError::NotAStream { .. }), "{found}");
            assert!(!whole(&text).is_empty());
        }
        for size in 1000..1100 {
            let found = blocks(&two_lines, size).unwrap_err();
            assert!(matches!(found, StructureError::NotAStream { .. }), "{size}: {found}");
        }
        // Controls: values that look like tags.
        let values = format!("{HEAD}{rows}_x.y\n;a\n_entity.id 1\n;\n_x.z '_entity.id 1' # _entity.id\n");
        assert_eq!(blocks(&values, 1000).unwrap().0, whole(&values));
    }

    #[test]
    fn faults_have_the_line_of_the_file() {
        let text = HEAD.to_owned() + &rows_of("A", true) + &row("ATOM", "C", "ALA", "B", 1, "x").replace("1.5", "y");
        let expected = read(text.as_bytes(), &ReadLimits::default()).unwrap_err();
        assert!(matches!(expected, StructureError::Syntax { line: 363.., .. }), "{expected}");
        for size in [1, 1000, 1 << 20] {
            assert_eq!(blocks(&text, size).unwrap_err(), expected);
        }
    }
}
