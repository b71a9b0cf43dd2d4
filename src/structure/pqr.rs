//! Reader of PQR files: atoms with charge and radius, in fields separated by white space.
//!
//! A line is `recordName serial atomName residueName [chainID] residueNumber X Y Z charge radius`. Supported
//! deviations, which PDB2PQR writes: a serial number that touches the record name (`HETATM10000`), and a chain that
//! touches the residue number (`A1000`). Serial numbers are ignored. Radii replace those of the table. Charges are only
//! checked.

use std::collections::HashMap;

use super::annotations::Annotations;
use super::assembly::Assemblies;
use super::atoms::{Atom, SourceFields, SourceFormat, Structure};
use super::contents::Kind;
use super::element::{self, AtomName};
use super::error::StructureError;
use super::fields::{Fields, Rows, TextLines};
use super::kinds::Sequence;
use super::number::{self, single};
use super::read::Reading;
use super::text::Fault;
use crate::surface::OutOfMemory;

/// Maximum valid radius, Å. Larger numbers are probably from another column.
const MAX_RADIUS: f64 = 100.0;

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

/// Returns true if the first atom of a PDB or PQR file indicates PQR: it has the fields of PQR and either lacks the
/// columns of PDB or has more decimals than PDB.
pub(super) fn is_pqr(head: &[u8]) -> bool {
    for line in TextLines::new(head) {
        let fields = Fields::split(head, line.clone());
        if let Some((_, first)) = record(&fields) {
            let n = fields.len().saturating_sub(first);
            let last = first + n;
            if !FIELDS.contains(&n) || !(last - 5..last).all(|i| fields.real(i).is_some()) {
                return false;
            }
            // A PDB line without a B-factor has the same number of fields, but another column where PQR has the charge.
            let after_coordinates = fields.range(last - 2).0 >= line.start + 54;
            let precise = (last - 2..last).any(|i| decimals(fields.get(i)) > 2);
            return !has_pdb_columns(&head[line]) || (after_coordinates && precise);
        }
    }
    false
}

/// Returns true if the columns of coordinates, occupancy and B-factor hold numbers.
fn has_pdb_columns(line: &[u8]) -> bool {
    let number = |from: usize, to: usize| {
        let column = line.get(from..to.min(line.len())).unwrap_or_default().trim_ascii();
        (column.is_empty(), number::real(column, 0, column.len()).is_some())
    };
    [30, 38, 46].into_iter().all(|from| number(from, from + 8).1)
        && [54, 60].into_iter().all(|from| matches!(number(from, from + 6), (true, _) | (_, true)))
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
    let (mut radii, mut ended) = (Vec::new(), false);
    for line in TextLines::new(text) {
        file.rows.count_line()?;
        let fields = Fields::split(text, line);
        let Some((hetero, first)) = record(&fields) else {
            ended |= matches!(fields.get(0), b"MODEL" | b"ENDMDL" | b"END") && file.rows.len() > 0;
            continue;
        };
        file.model += i32::from(std::mem::take(&mut ended));
        let (atom, radius) = file.atom(text, &fields, hetero, first).map_err(|fault| fault.locate(text))?;
        file.rows.push(&atom)?;
        if radii.len() == radii.capacity() {
            let more = if radii.is_empty() { expected } else { radii.len() / 2 + 1024 };
            let needed = (size_of::<f32>() * more) as u64;
            reading.keep(needed)?;
            radii.try_reserve_exact(more).map_err(|_refused| OutOfMemory::System { needed })?;
        }
        radii.push(radius);
    }
    file.rows.finish(SourceFields {
        format: SourceFormat::Pqr,
        id: None,
        title: None,
        sequence: Sequence::default(),
        assemblies: Assemblies::default(),
        annotations: Annotations::default(),
        radii,
        warnings: Vec::new(),
    })
}

/// State of reading.
struct Pqr<'a> {
    rows: Rows<'a>,
    /// Elements guessed from the names of atom and residue.
    guesses: HashMap<(u32, u32), u8>,
    model: i32,
}

impl Pqr<'_> {
    /// Reads an atom and its radius. `first` is the number of fields before its name.
    fn atom(
        &mut self,
        text: &[u8],
        fields: &Fields<'_>,
        hetero: bool,
        first: usize,
    ) -> Result<(Atom, f32), Box<Fault>> {
        let n = fields.len().saturating_sub(first);
        if !FIELDS.contains(&n) {
            // A serial number that touches the record name is no field of its own.
            let [fewest, most] = FIELDS.map(|n| n + first);
            let expected = format!(
                "{fewest} or {most} fields: record, serial, atom, residue, chain (optional), residue number, x, y, z, \
                 charge and radius"
            );
            return Err(Fault::words(fields.range(0).0, format!("{} fields", fields.len()), expected));
        }
        let number = first + n - 6;
        let (start, end) = fields.range(number);
        let touches = n == FIELDS[0] && text[start].is_ascii_alphabetic();
        let (chain, digits) = match (n == FIELDS[1], touches) {
            (true, _) => (fields.range(number - 1), start),
            (false, true) => ((start, start + 1), start + 1),
            (false, false) => ((start, start), start),
        };
        let (residue_number, insertion_code) = residue_number(&text[digits..end])
            .ok_or_else(|| fields.fault(number, "a residue number, with an optional insertion code"))?;
        let position = fields.position(number + 1)?;
        fields.real(number + 4).ok_or_else(|| fields.fault(number + 4, "the charge in e"))?;
        let radius = fields.real(number + 5).filter(|radius| (0.0..=MAX_RADIUS).contains(radius));
        let radius =
            radius.ok_or_else(|| fields.fault(number + 5, format!("the radius in Å, from 0 to {MAX_RADIUS}")))?;
        let tables = &mut self.rows.tables;
        let ((a, b), (c, d)) = (fields.range(first), fields.range(first + 1));
        let (name, residue) = (tables.name.intern(text, a, b), tables.residue.intern(text, c, d));
        let chain = tables.chain.intern(text, chain.0, chain.1);
        let element = *self.guesses.entry((name, residue)).or_insert_with(|| {
            element::guess(AtomName { text: fields.get(first), columns: None }, tables.residue.text(residue))
        });
        let plain = self.rows.atom(position, element, name, self.model);
        let kind = if hetero { Kind::Ligand } else { Kind::Polymer };
        Ok((Atom { residue, chain, residue_number, insertion_code, hetero, kind, ..plain }, single(radius)))
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
    use super::super::atoms::SourceFormat;
    use super::super::read::{ReadLimits, read};
    use super::super::select::{Selection, select};
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
        assert_eq!(s.element, [7, 1, 6, 30, 8, 6]);
        assert_eq!((s.x[0], s.y[0], s.z[0]), (32.231, 15.281, -13.143));
        let texts = |column: &super::super::TextColumn| (0..6).map(|i| column.get(i).to_owned()).collect::<Vec<_>>();
        assert_eq!(texts(&s.name), ["N", "HA", "CA", "ZN", "O", "C"]);
        assert_eq!(texts(&s.residue), ["ARG", "ARG", "ARG", "ZN", "HOH", "GLY"]);
        assert_eq!(texts(&s.chain), ["A", "A", "A", "", "A", ""]);
        assert_eq!(s.residue_number, [1, 1, -2, 7, 1000, 1]);
        assert_eq!(s.insertion_code, [0, 0, b'B', 0, 0, 0]);
        assert_eq!(s.model, [1, 1, 1, 1, 1, 2]);
        assert_eq!(s.hetero, [false, false, false, true, false, false]);
        let kinds: Vec<&str> = s.kind.iter().map(|kind| kind.name()).collect();
        assert_eq!(kinds, ["protein", "virtual", "protein", "ion", "water", "protein"]);
    }

    #[test]
    fn spheres_have_the_radii_of_the_file() {
        let s = parse(FILE).unwrap();
        let selected = select(&s, &Selection::default()).unwrap();
        assert_eq!(selected.atoms, [0, 2]);
        assert_eq!(selected.spheres(&s).unwrap().radii(), [1.824, 1.9]);
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
            let text = pqr.replace("-13.143-0.300", "-13.143 -0.300");
            assert_eq!(format(&text), SourceFormat::Pqr, "{pqr}");
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
        assert_eq!(read(text.as_bytes(), &limits), Err(StructureError::TooManyAtoms { limit: 49 }));
        assert_eq!(parse(&text).unwrap().len(), 50);
    }
}
