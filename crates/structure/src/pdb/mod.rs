//! Reader of PDB files, including common deviations from the format.
//!
//! Code counts columns from 0; comments and messages count from 1, as the format description (wwPDB, version 3.3) does.
//! The reader uses ATOM, HETATM, MODEL, ENDMDL, END, HEADER, TITLE, SEQRES, MODRES, HELIX, SHEET and REMARK 350
//! records. It ignores atom serial numbers, so their overflow is harmless. Supported deviations: lines that end after
//! the coordinates, hybrid-36 and five-digit residue numbers, four-letter residue names, two-letter chain names,
//! missing element columns, entry id and line number in columns 73-80 (before 1996), tabs, any line ending.
//!
//! A first pass over the pieces of the file finds its [`records`], a second one reads the [`atoms`].

mod assemblies;
mod atoms;
mod card;
mod chains;
mod lines;
mod records;
mod sequence;

use std::collections::HashSet;

use self::assemblies::Remark350;
use self::atoms::{Atoms, File};
use self::lines::Lines;
use self::records::{Line, PieceRecords};
use super::annotations::Annotations;
use super::atoms::{Columns, Slices, Structure, join};
use super::error::StructureError;
use super::kinds::Sequence;
use super::models::{self, Mark};
use super::read::Reading;
use super::source::{SourceFields, SourceFormat};
use super::text::{self, normalize};
use super::warnings::Warnings;
use super::{pieces, pqr};

/// Maximum length of a title, characters.
pub(super) const MAX_TITLE: usize = 1000;

pub(super) fn read(text: &[u8], reading: &Reading<'_>) -> Result<Structure, StructureError> {
    let file = File::new(text);
    let mut ranges = pieces::cut(text, 0, reading.n_pieces(text.len()));
    let found = pieces::map(&mut ranges, |range| PieceRecords::find(&file, range.clone(), reading));
    let mut found = found.into_iter().collect::<Result<Vec<_>, _>>()?;
    let fault = found.iter().position(|records| records.fault.is_some()).and_then(|last| {
        found.truncate(last + 1);
        found[last].fault.take()
    });
    let n_atoms: usize = found.iter().map(|records| records.atoms.len()).sum();
    reading.limits.check_atoms(n_atoms)?;
    let memory = reading.reserve(Columns::bytes(n_atoms))?;
    let mut columns = Columns::zeroed(n_atoms);
    let mut rest = columns.slices();
    let mut parts = Vec::with_capacity(found.len());
    for records in &found {
        let (rows, others) = rest.split(records.atoms.len());
        parts.push((&records.atoms[..], rows));
        rest = others;
    }
    let mut read = read_atoms(&file, &mut parts, reading)?;
    if let Some(fault) = read.iter_mut().find_map(|atoms| atoms.fault.take()).or(fault) {
        return Err(fault.locate(text));
    }
    if n_atoms == 0 {
        return Err(StructureError::NoAtoms { found: describe(text) });
    }
    let mut warnings = Warnings::default();
    for records in &found {
        warnings.append(records.warnings.clone());
    }
    let tables = join(parts.into_iter().zip(read).map(|((_, rows), atoms)| {
        warnings.append(atoms.warnings);
        (rows, atoms.tables)
    }));
    reading.keep(tables.bytes())?;
    memory.keep();
    let mut marks = Vec::new();
    let mut first_row = 0;
    for records in &found {
        marks.extend(records.marks.iter().map(|mark| Mark { row: first_row + mark.row, ..*mark }));
        first_row += records.atoms.len();
    }
    models::number(&marks, &mut columns);
    let (mut id, mut title, mut listed) = (None, Vec::new(), HashSet::new());
    let (mut assemblies, mut annotations) = (Remark350::default(), Annotations::default());
    for records in found {
        id = id.or(records.id);
        title.extend(records.title);
        listed.extend(records.listed);
        annotations.secondary.extend(records.secondary);
        for (start, end) in records.assemblies {
            assemblies.line(&text[start..end], reading)?;
        }
    }
    let mut messages = warnings.messages(|fault| fault.locate(text));
    messages.extend(pqr::ambiguity(text));
    let source = SourceFields {
        id,
        title: normalize(&title, MAX_TITLE),
        sequence: Sequence { listed, ..Sequence::default() },
        assemblies: assemblies.finish(reading)?,
        annotations,
        warnings: messages,
        ..SourceFields::new(SourceFormat::Pdb)
    };
    columns.finish(tables, source, reading)
}

/// Lines of the atoms of a piece, and their rows.
type PieceAtoms<'a> = (&'a [Line], Slices<'a>);

/// Reads the atoms of all pieces, each into its rows.
fn read_atoms<'f>(
    file: &'f File<'f>,
    parts: &mut [PieceAtoms<'_>],
    reading: &Reading<'_>,
) -> Result<Vec<Atoms<'f>>, StructureError> {
    let pass = |parts: &mut [PieceAtoms<'_>], left_justified| {
        let read = pieces::map(parts, |(lines, rows)| Atoms::read(file, left_justified, lines, rows, reading));
        read.into_iter().collect::<Result<Vec<_>, _>>()
    };
    let mut read = pass(parts, false)?;
    // An unreliable alignment of names in one piece affects the guesses of all later pieces.
    if let Some(first) = read.iter().position(|atoms| atoms.left_justified)
        && read[first + 1..].iter().any(Atoms::has_guesses)
    {
        read.truncate(first + 1);
        read.extend(pass(&mut parts[first + 1..], true)?);
    }
    Ok(read)
}

/// Describes the content of a file without atoms.
fn describe(text: &[u8]) -> String {
    /// Number of lines searched for record names.
    const LINES: usize = 10_000;
    let mut records: Vec<String> = Vec::new();
    for (start, end) in Lines::new(text).take(LINES) {
        let line = &text[start..end];
        let word = text::decode(line[..line.len().min(6)].trim_ascii()).into_owned();
        if records.len() < 10 && !word.is_empty() && !records.contains(&word) {
            records.push(word);
        }
    }
    let (n_lines, _) = text::line_and_column(text, text.len().saturating_sub(1));
    format!(
        "a PDB file of {n_lines} lines without ATOM and HETATM; it has {}",
        text::list(records.iter().cloned(), records.len())
    )
}
