//! Reader of PQR files: atoms with charge and radius, in fields separated by white space.
//!
//! A line is `recordName serial atomName residueName [chainID] residueNumber X Y Z charge radius`. Supported
//! deviations: a serial number that touches the record name (`HETATM10000`), a chain that touches the residue number
//! (`A1000`), and fields that touch each other in the columns of PDB up to the coordinates. Serial numbers are ignored.
//! Radii replace those of the table.

use std::collections::HashMap;
use std::ops::Range;

use molmesh_surface::{MemoryMeter as _, OutOfMemory};

use super::atoms::{Atom, Structure};
use super::contents::Kind;
use super::element::{self, AtomName};
use super::error::StructureError;
use super::fields::{Fields, Rows, TextLines};
use super::models::{self, Mark, ModelBoundary};
use super::number::{self, single};
use super::read::{MAX_COORDINATE, Reading};
use super::source::{SourceFields, SourceFormat};
use super::text::{Fault, trimmed};

/// Maximum valid radius, Å. Larger numbers are probably from another column.
const MAX_RADIUS: f64 = 100.0;

/// Maximum radius of an atom of a force field, Å.
const PLAUSIBLE_RADIUS: f64 = 4.0;

/// Typical length of a line, bytes.
const BYTES_PER_LINE: usize = 64;

/// Fields from the atom name to the radius, without and with a chain.
const FIELDS: [usize; 2] = [8, 9];

/// Returns true for HETATM or false for ATOM, and the number of fields before the atom name; `None` for other records.
fn record(fields: &Fields<'_>) -> Option<(bool, usize)> {
    let word = fields.get(0);
    let (hetero, serial) = match word.strip_prefix(b"HETATM") {
        Some(serial) => (true, serial),
        None => (false, word.strip_prefix(b"ATOM")?),
    };
    let touches = !serial.is_empty();
    serial.iter().all(u8::is_ascii_digit).then_some((hetero, if touches { 1 } else { 2 }))
}

/// Columns of the coordinates in PDB files, before which the fields of a line may touch each other.
const COORDINATES: [usize; 3] = [30, 38, 46];
const COORDINATES_END: usize = 54;
/// Ends of the columns of the names of atom and residue in PDB files.
const NAME_END: usize = 16;
const RESIDUE_END: usize = 21;

/// Fields of an atom as byte ranges of the text.
#[derive(Debug, Clone, Copy)]
struct AtomFields {
    name: (usize, usize),
    residue: (usize, usize),
    chain: (usize, usize),
    /// Residue number with its insertion code.
    number: (usize, usize),
    position: [(usize, usize); 3],
    charge: (usize, usize),
    radius: (usize, usize),
    /// Element symbol after the radius; empty in most files.
    element: (usize, usize),
}

impl AtomFields {
    /// Finds the fields of a line, by white space or else by the columns of PDB; `None` if it has none of these forms.
    /// `first` is the number of fields before the atom name.
    fn find(text: &[u8], fields: &Fields<'_>, first: usize) -> Option<Self> {
        let found = Self::by_white_space(text, fields, first);
        // A name that crosses the end of its columns touches the next one.
        let crosses =
            |(start, end): (usize, usize), column: usize| (start + 1..end).contains(&(fields.line().start + column));
        let is_whole = |found: &Self| !crosses(found.name, NAME_END) && !crosses(found.residue, RESIDUE_END);
        match found {
            Some(found) if is_whole(&found) => Some(found),
            found => Self::by_columns(text, fields.line()).or(found),
        }
    }

    fn has_element(&self) -> bool {
        self.element.0 < self.element.1
    }

    fn by_white_space(text: &[u8], fields: &Fields<'_>, first: usize) -> Option<Self> {
        let has_element = fields.len() > first && is_element(fields.get(fields.len() - 1));
        let n = fields.len().saturating_sub(first + usize::from(has_element));
        let number = first + n.checked_sub(6)?;
        if !FIELDS.contains(&n) || !(number + 1..number + 6).all(|i| fields.real(i).is_some()) {
            return None;
        }
        let (start, end) = fields.range(number);
        let touches = n == FIELDS[0] && text[start].is_ascii_alphabetic();
        let (chain, start) = match (n == FIELDS[1], touches) {
            (true, _) => (fields.range(number - 1), start),
            (false, true) => ((start, start + 1), start + 1),
            (false, false) => ((start, start), start),
        };
        Some(Self {
            name: fields.range(first),
            residue: fields.range(first + 1),
            chain,
            number: (start, end),
            position: [1, 2, 3].map(|k| fields.range(number + k)),
            charge: fields.range(number + 4),
            radius: fields.range(number + 5),
            element: if has_element { fields.range(number + 6) } else { (start, start) },
        })
    }

    /// Uses the columns of PDB up to the coordinates. Residue names may have five letters, as there are no alternative
    /// locations.
    fn by_columns(text: &[u8], line: Range<usize>) -> Option<Self> {
        let end = line.start + COORDINATES_END;
        if line.end < end {
            return None;
        }
        let rest = Fields::split(text, end..line.end);
        let field = |from: usize, to: usize| {
            let (start, end) = trimmed(&text[line.start + from..line.start + to]);
            (line.start + from + start, line.start + from + end)
        };
        let found = Self {
            name: field(12, 16),
            residue: field(16, 21),
            chain: field(21, 22),
            number: field(22, 27),
            position: COORDINATES.map(|from| field(from, from + 8)),
            charge: rest.range(0),
            radius: rest.range(1),
            element: rest.range(2),
        };
        let is_number = |(start, end): (usize, usize)| start < end && number::real(text, start, end).is_some();
        let numbers = || found.position.into_iter().chain([found.charge, found.radius]);
        let is_end = rest.len() == 2 || (rest.len() == 3 && is_element(rest.get(2)));
        (is_end && numbers().all(is_number)).then_some(found)
    }
}

/// Returns true for a field that is an element symbol, which some programs write after the radius.
fn is_element(field: &[u8]) -> bool {
    field.len() <= 2 && field.iter().all(u8::is_ascii_alphabetic) && element::stated(field).is_some()
}

/// Returns true if the first atom of a PDB or PQR file indicates PQR: it has the fields of PQR and either lacks the
/// columns of PDB or has more decimals than PDB.
pub(super) fn is_pqr(head: &[u8]) -> bool {
    for line in TextLines::new(head) {
        let fields = Fields::split(head, line.clone());
        let Some((_, first)) = record(&fields) else { continue };
        let Some(found) = AtomFields::find(head, &fields, first) else { return false };
        // A PDB line without a B-factor has the same number of fields, but another column where PQR has the charge.
        let after_coordinates = found.charge.0 >= line.start + COORDINATES_END;
        let precise = [found.charge, found.radius].iter().any(|&(start, end)| decimals(&head[start..end]) > 2);
        let has_number = residue_number(&head[found.number.0..found.number.1]).is_some();
        let line = &head[line];
        // An element follows the B-factor of many PDB lines, so other columns than those of PDB are no proof.
        return if found.has_element() {
            has_number && crosses_columns(line) && !line.contains(&b'\t')
        } else {
            !has_pdb_columns(line) || (after_coordinates && precise)
        };
    }
    false
}

/// Returns a warning if the occupancies and B-factors of a PDB file may be the charges and radii of PQR: the first
/// atoms have no other fields after them, B-factors that could be radii, and occupancies that differ.
pub(super) fn ambiguity(text: &[u8]) -> Option<String> {
    const LINES: usize = 1000;
    let mut charges = Vec::new();
    for line in TextLines::new(text).take(LINES) {
        let fields = Fields::split(text, line.clone());
        let Some((_, first)) = record(&fields) else { continue };
        let found = AtomFields::find(text, &fields, first)
            .filter(|found| !found.has_element() && found.charge.0 >= line.start + COORDINATES_END)?;
        let radius = number::real(text, found.radius.0, found.radius.1)?;
        if !(0.0..=PLAUSIBLE_RADIUS).contains(&radius) {
            return None;
        }
        let charge = &text[found.charge.0..found.charge.1];
        if radius > 0.0 && !charges.contains(&charge) {
            charges.push(charge);
        }
    }
    (charges.len() > 1).then(|| {
        "the occupancies and B-factors may be the charges and radii of a PQR file; read as PDB, with radii of elements"
            .to_owned()
    })
}

/// Returns true if the columns of coordinates, occupancy and B-factor hold numbers, and no number crosses the end of
/// the occupancy or of the B-factor.
fn has_pdb_columns(line: &[u8]) -> bool {
    let number = |from: usize, to: usize| {
        let column = line.get(from..to.min(line.len())).unwrap_or_default().trim_ascii();
        (column.is_empty(), number::real(column, 0, column.len()).is_some())
    };
    COORDINATES.into_iter().all(|from| number(from, from + 8).1)
        && [54, 60].into_iter().all(|from| matches!(number(from, from + 6), (true, _) | (_, true)))
        && !crosses_columns(line)
}

/// Returns true if a number crosses the end of the occupancy or of the B-factor of PDB.
fn crosses_columns(line: &[u8]) -> bool {
    [60, 66].into_iter().any(|border| {
        let is_inside = |i: &usize| line.get(*i).is_some_and(|b| *b > b' ');
        let start = (0..border).rev().take_while(is_inside).last();
        let end = (border..line.len()).take_while(is_inside).last();
        start.zip(end).is_some_and(|(start, end)| number::real(line, start, end + 1).is_some())
    })
}

/// Returns the number of decimals. In PDB, occupancies and B-factors have two; in PQR, charges and radii have three or
/// four.
fn decimals(field: &[u8]) -> usize {
    memchr::memchr(b'.', field).map_or(0, |point| field.len() - point - 1)
}

/// Reads a PQR file.
///
/// # Errors
/// Returns [`StructureError::Syntax`] for a line that cannot be read, and the errors of limits, memory and
/// cancellation.
pub(super) fn read(text: &[u8], reading: &Reading<'_>) -> Result<Structure, StructureError> {
    let expected = text.len() / BYTES_PER_LINE + 1;
    let mut file = Pqr { rows: Rows::new(reading, expected), guesses: HashMap::new(), model: 1 };
    let (mut radii, mut charges, mut marks) = (Vec::new(), Vec::new(), Vec::new());
    for line in TextLines::new(text) {
        file.rows.count_line()?;
        let fields = Fields::split(text, line);
        let Some((hetero, first)) = record(&fields) else {
            let boundary = match fields.get(0) {
                b"MODEL" | b"ENDMDL" => ModelBoundary::Ends,
                b"END" => ModelBoundary::EndsPart,
                _ => continue,
            };
            let mark = Mark { row: file.rows.len(), boundary };
            if marks.last() != Some(&mark) {
                reading.text.grow(size_of::<Mark>() as u64)?;
                marks.push(mark);
            }
            continue;
        };
        // The final number follows from all parts. Until then, atoms of different parts may have the same position.
        file.model = i32::try_from(marks.len()).unwrap_or(i32::MAX);
        let (atom, charge, radius) = file.atom(text, &fields, hetero, first).map_err(|fault| fault.locate(text))?;
        file.rows.push(&atom)?;
        if radii.len() == radii.capacity() {
            let more = if radii.is_empty() { expected } else { radii.len() / 2 + 1024 };
            let needed = (2 * size_of::<f32>() * more) as u64;
            reading.keep(needed)?;
            let reserve = |column: &mut Vec<f32>| column.try_reserve_exact(more);
            [&mut radii, &mut charges]
                .into_iter()
                .try_for_each(reserve)
                .map_err(|_refused| OutOfMemory::System { needed })?;
        }
        radii.push(radius);
        charges.push(charge);
    }
    models::number(&marks, file.rows.columns_mut());
    file.rows.finish(SourceFields { radii, charges, ..SourceFields::new(SourceFormat::Pqr) })
}

/// State of reading.
struct Pqr<'a> {
    rows: Rows<'a>,
    /// Elements guessed from the names of atom and residue.
    guesses: HashMap<(u32, u32), u8>,
    model: i32,
}

impl Pqr<'_> {
    /// Reads an atom, its charge and its radius. `first` is the number of fields before its name.
    fn atom(
        &mut self,
        text: &[u8],
        fields: &Fields<'_>,
        hetero: bool,
        first: usize,
    ) -> Result<(Atom, f32, f32), Box<Fault>> {
        let found = AtomFields::find(text, fields, first).ok_or_else(|| fields_fault(fields, first))?;
        let fault = |(start, end): (usize, usize), expected: String| Fault::token(text, start, end, expected);
        let (start, end) = found.number;
        let (residue_number, insertion_code) = residue_number(&text[start..end])
            .ok_or_else(|| fault(found.number, "a residue number, with an optional insertion code".to_owned()))?;
        let mut position = [0.0; 3];
        for ((value, field), axis) in position.iter_mut().zip(found.position).zip(["x", "y", "z"]) {
            *value = number::real(text, field.0, field.1)
                .filter(|value| value.abs() <= MAX_COORDINATE)
                .ok_or_else(|| fault(field, format!("the {axis} coordinate in Å, within ±{MAX_COORDINATE}")))?;
        }
        let radius = number::real(text, found.radius.0, found.radius.1).filter(|r| (0.0..=MAX_RADIUS).contains(r));
        let radius = radius.ok_or_else(|| fault(found.radius, format!("the radius in Å, from 0 to {MAX_RADIUS}")))?;
        let charge = number::real(text, found.charge.0, found.charge.1);
        let charge = charge.ok_or_else(|| fault(found.charge, "the charge in e".to_owned()))?;
        let tables = &mut self.rows.tables;
        let name = tables.name.intern(text, found.name.0, found.name.1);
        let residue = tables.residue.intern(text, found.residue.0, found.residue.1);
        let chain = tables.chain.intern(text, found.chain.0, found.chain.1);
        let stated = element::stated(&text[found.element.0..found.element.1]);
        let guess = || {
            let name = AtomName { text: &text[found.name.0..found.name.1], columns: None };
            element::guess(name, tables.residue.text(residue))
        };
        let element = stated.unwrap_or_else(|| *self.guesses.entry((name, residue)).or_insert_with(guess));
        let plain = self.rows.atom(position, element, name, self.model);
        let kind = if hetero { Kind::Ligand } else { Kind::Polymer };
        let atom = Atom { residue, chain, residue_number, insertion_code, hetero, kind, ..plain };
        Ok((atom, single(charge), single(radius)))
    }
}

/// Returns the fault of a line that does not have the fields of PQR: their number, or the first that is no number.
#[cold]
#[expect(clippy::unnecessary_box_returns, reason = "a boxed fault keeps results small")]
fn fields_fault(fields: &Fields<'_>, first: usize) -> Box<Fault> {
    let n = fields.len().saturating_sub(first);
    if !FIELDS.contains(&n) {
        // A serial number that touches the record name is no field of its own.
        let [fewest, most] = FIELDS.map(|n| n + first);
        let expected = format!(
            "{fewest} or {most} fields: record, serial, atom, residue, chain (optional), residue number, x, y, z, charge \
             and radius"
        );
        return Fault::words(fields.range(0).0, format!("{} fields", fields.len()), expected);
    }
    let numbers = first + n - 5;
    if let Err(fault) = fields.position(numbers) {
        return fault;
    }
    match fields.real(numbers + 3) {
        None => fields.fault(numbers + 3, "the charge in e"),
        Some(_) => fields.fault(numbers + 4, format!("the radius in Å, from 0 to {MAX_RADIUS}")),
    }
}

/// Parses a residue number and its insertion code.
fn residue_number(field: &[u8]) -> Option<(i32, u8)> {
    match field {
        [digits @ .., code] if code.is_ascii_alphabetic() => number::integer(digits).map(|number| (number, *code)),
        digits => number::integer(digits).map(|number| (number, 0)),
    }
}

#[cfg(test)]
#[allow(clippy::pedantic, clippy::unwrap_used, reason = "tests fail by panicking")]
mod tests {
    use molmesh_surface::{Exceeded, Limit};

    use super::super::read::{ReadLimits, read};
    use super::super::select::{Selection, select};
    use super::super::source::SourceFormat;
    use super::*;

    const FILE: &str = "REMARK   1 PQR file generated by PDB2PQR\n\
        ATOM      1  N   ARG A   1      32.231  15.281 -13.143 -0.3000 1.8240\n\
        ATOM      2  HA  ARG A   1      32.184  14.697 -14.090  0.1560 0.0000\r\n\
        ATOM 3 CA ARG A -2B 30.5 1 2 0.1 1.9\n\
        TER\n\
        HETATM10000 ZN  ZN 7 1 2 3 2 1.1\n\
        ATOM  10001  O   HOH A1000 4 5 6 -0.8 1.7\n\
        END\n\
        ATOM 1 C GLY 1 0 0 0 0 2\n";

    fn parse(text: &str) -> Result<Structure, StructureError> {
        read(text.as_bytes(), &ReadLimits::default())
    }

    #[test]
    fn every_field_is_read() {
        let s = parse(FILE).unwrap();
        assert_eq!((s.format, s.len()), (SourceFormat::Pqr, 6));
        assert_eq!(s.radius, [1.824, 0.0, 1.9, 1.1, 1.7, 2.0]);
        assert_eq!(s.charge, [-0.3, 0.156, 0.1, 2.0, -0.8, 0.0]);
        assert_eq!(s.element, [7, 1, 6, 30, 8, 6]);
        assert_eq!((s.x[0], s.y[0], s.z[0]), (32.231, 15.281, -13.143));
        let texts = |column: &super::super::TextColumn| (0..6).map(|i| column.get(i).to_owned()).collect::<Vec<_>>();
        assert_eq!(texts(&s.name), ["N", "HA", "CA", "ZN", "O", "C"]);
        assert_eq!(texts(&s.residue), ["ARG", "ARG", "ARG", "ZN", "HOH", "GLY"]);
        assert_eq!(texts(&s.chain), ["A", "A", "A", "", "A", ""]);
        assert_eq!(s.residue_number, [1, 1, -2, 7, 1000, 1]);
        assert_eq!(s.insertion_code, [0, 0, b'B', 0, 0, 0]);
        // END separates frames only if they have the same atoms.
        assert_eq!(s.model, [1; 6]);
        assert_eq!(parse(&FILE.repeat(2)).unwrap().model[..7], [1; 7]);
        let frame = "ATOM 1 C GLY 1 0 0 0 0 2\nEND\n";
        assert_eq!(parse(&frame.repeat(3)).unwrap().model, [1, 2, 3]);
        assert_eq!(parse(&FILE.replace("TER", "ENDMDL")).unwrap().model, [1, 1, 1, 2, 2, 3]);
        assert_eq!(s.hetero, [false, false, false, true, false, false]);
        let kinds: Vec<&str> = s.kind.iter().map(|kind| kind.name()).collect();
        assert_eq!(kinds, ["protein", "virtual", "protein", "ion", "water", "protein"]);
    }

    #[test]
    fn spheres_have_the_radii_of_the_file() {
        let s = parse(FILE).unwrap();
        let selected = select(&s, &Selection::default()).unwrap();
        assert_eq!(selected.atoms, [0, 2, 5]);
        assert_eq!(selected.spheres(&s).unwrap().radii(), [1.824, 1.9, 2.0]);
        // Control: the same atom in a PDB file has the radius of the table.
        let pdb = parse("ATOM      1  N   ARG A   1      32.231  15.281 -13.143  1.00 28.28           N\n").unwrap();
        let selected = select(&pdb, &Selection::default()).unwrap();
        assert_eq!(selected.spheres(&pdb).unwrap().radii(), [1.55]);
    }

    #[test]
    fn pdb_and_pqr_are_told_apart() {
        let format = |line: &str| parse(line).unwrap().format;
        for pdb in [
            "ATOM      1  N   ARG A   1      32.231  15.281 -13.143",
            "ATOM      1  N   ARG A   1      32.231  15.281 -13.143  1.00 28.28",
            "ATOM      1  N   ARG A   1      32.231  15.281 -13.143  1.00",
            "ATOM      1  N   ARG 2   1      32.231  15.281 -13.143  1.00",
            "ATOM      1  N   ARG     1      32.231  15.281 -13.143  1.00 28.28",
            "ATOM      1  N   ARG     1      32.231  15.281 -13.143  1.00 28.28   5",
            "ATOM      1  N   ARG A   1      32.231  15.281 -13.143  1.00 28.28           N",
            "ATOM      1  N   ARG A   1      32.231  15.281 -13.143  1.00100.00",
        ] {
            assert_eq!(format(pdb), SourceFormat::Pdb, "{pdb}");
        }
        for pqr in [
            "ATOM      1  N   ARG A   1      32.231  15.281 -13.143 -0.3000 1.8240",
            "ATOM      1  N   ARG     1      32.231  15.281 -13.143  -0.300   1.824",
            "ATOM      1  N   ARG A   1      32.231  15.281 -13.143-0.300 1.824",
            "ATOM 1 N ARG 1 32.2 15.3 -13.1 1.00 28.28",
            "HETATM12345  N   ARG A   1      32.231  15.281 -13.143  0.0000 1.5000",
        ] {
            assert_eq!(format(pqr), SourceFormat::Pqr, "{pqr}");
        }
    }

    #[test]
    fn errors_name_line_column_and_expectation() {
        for (row, said) in [
            ("ATOM 2 N ARG 1 1 2 3 0", "line 2, column 1: found 9 fields, expected 10 or 11 fields"),
            ("ATOM 2 N ARG A 1 1 2 3 0 1 9", "line 2, column 1: found 12 fields, expected 10 or 11 fields"),
            ("HETATM10000 N ARG 1 1 2 3 0", "line 2, column 1: found 8 fields, expected 9 or 10 fields"),
            ("ATOM 2 N ARG A x1 1 2 3 0 1", "line 2, column 16: found `x1`, expected a residue number"),
            ("ATOM 2 N ARG 1 1 2 nan 0 1", "line 2, column 20: found `nan`, expected the z coordinate in Å"),
            ("ATOM 2 N ARG 1 1 2 3 zero 1", "line 2, column 22: found `zero`, expected the charge in e"),
            ("ATOM 2 N ARG 1 1 2 3 0 -1", "line 2, column 24: found `-1`, expected the radius in Å, from 0 to 100"),
            ("ATOM 2 N ARG 1 1 2 3 0 101", "line 2, column 24: found `101`, expected the radius in Å, from 0 to 100"),
        ] {
            let error = parse(&format!("ATOM 1 N ARG 1 0 0 0 0 1\n{row}\n")).unwrap_err().to_string();
            assert!(error.starts_with(said), "{error} is not {said}");
        }
    }

    #[test]
    fn limits_hold() {
        let text: String = (0..50).map(|i| format!("ATOM {i} N ARG {i} {i} 0 0 0 1\n")).collect();
        let limits = ReadLimits { max_atoms: 49, ..ReadLimits::default() };
        assert_eq!(read(text.as_bytes(), &limits), Err(Exceeded::new(Limit::Atoms, 49).error()));
        assert_eq!(parse(&text).unwrap().len(), 50);
    }
}
