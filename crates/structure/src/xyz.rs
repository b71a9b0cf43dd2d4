//! Reader of XYZ files: frames of a line with the number of atoms, a comment line, and a line `El x y z` for each atom.
//!
//! Every frame is a model. Further fields of an atom are ignored. The `Properties` of extended XYZ tell which fields
//! are the element and the position.

use super::atoms::Structure;
use super::element;
use super::error::StructureError;
use super::fields::{Fields, MAX_FIELDS, Rows, TextLines};
use super::number;
use super::pdb::MAX_TITLE;
use super::read::Reading;
use super::source::{SourceFields, SourceFormat};
use super::text::{Fault, normalize};

/// Length of the shortest atom line, bytes.
const MIN_LINE: usize = "C 0 0 0\n".len();

/// Key of extended XYZ in the comment line.
const PROPERTIES: &[u8] = b"Properties=";

/// Fields of an atom line.
#[derive(Debug, Clone, Copy)]
struct AtomFields {
    element: usize,
    /// The first of three fields.
    position: usize,
}

/// Returns true if the text begins with a line with one integer, any second line and an atom line.
pub(super) fn is_xyz(head: &[u8]) -> bool {
    let mut lines = TextLines::new(head);
    let (Some(count), Some(comment), Some(atom)) = (lines.next(), lines.next(), lines.next()) else { return false };
    let [count, atom] = [count, atom].map(|line| Fields::split(head, line));
    let is_element = atom.len() > 1 && (atomic_number(atom.get(0)) != 0);
    let is_extended = memchr::memmem::find(&head[comment], PROPERTIES).is_some();
    count.len() == 1
        && number::integer(count.get(0)).is_some()
        && (is_extended || is_element || (1..4).all(|i| atom.real(i).is_some()))
}

/// Returns the atomic number of a symbol or a number; 0 if it is neither.
fn atomic_number(field: &[u8]) -> u8 {
    match number::integer(field).map(u8::try_from) {
        Some(Ok(z)) if usize::from(z) <= element::SYMBOLS.len() => z,
        Some(_) => 0,
        None => element::atomic_number(field),
    }
}

/// Reads an XYZ file.
///
/// # Errors
/// Returns [`StructureError::Syntax`] for a line that cannot be read, and the errors of limits, memory and
/// cancellation.
pub(super) fn read(text: &[u8], reading: &Reading<'_>) -> Result<Structure, StructureError> {
    let mut lines = TextLines::new(text);
    let mut rows: Option<Rows<'_>> = None;
    let (mut title, mut model) = (None, 0_i32);
    while let Some(line) = lines.next() {
        let fields = Fields::split(text, line);
        if let Some(rows) = &mut rows {
            rows.count_line()?;
        }
        if fields.len() == 0 {
            continue;
        }
        let count = number_of_atoms(&fields).map_err(|fault| fault.locate(text))?;
        let rows = rows.get_or_insert_with(|| Rows::new(reading, count.min(text.len() / MIN_LINE) + 1));
        let comment = lines.next().ok_or_else(|| ends(text, "a comment line".to_owned()))?;
        let frame_fields = atom_fields(text, comment.start, comment.end).map_err(|fault| fault.locate(text))?;
        if model == 0 {
            title = normalize(&text[comment], MAX_TITLE);
        }
        model = model.saturating_add(1);
        for row in 1..=count {
            let line = lines.next().ok_or_else(|| ends(text, format!("atom {row} of {count}")))?;
            rows.count_line()?;
            let fields = Fields::split(text, line);
            atom(text, &fields, frame_fields, rows, model)?;
        }
    }
    let Some(rows) = rows else {
        return Err(StructureError::NoAtoms { found: "an XYZ file of blank lines".to_owned() });
    };
    rows.finish(SourceFields { title, ..SourceFields::new(SourceFormat::Xyz) })
}

/// Reads an atom.
fn atom(
    text: &[u8],
    fields: &Fields<'_>,
    frame_fields: AtomFields,
    rows: &mut Rows<'_>,
    model: i32,
) -> Result<(), StructureError> {
    let AtomFields { element, position } = frame_fields;
    if fields.len() == 0 {
        return Err(fields.fault(0, "an element and three coordinates").locate(text));
    }
    let position = fields.position(position).map_err(|fault| fault.locate(text))?;
    let symbol = fields.get(element);
    if symbol.is_empty() {
        return Err(fields.fault(element, "an element").locate(text));
    }
    let z = atomic_number(symbol);
    let name = if z != 0 && symbol[0].is_ascii_digit() {
        let symbol = element::symbol(z).as_bytes();
        rows.tables.name.intern(symbol, 0, symbol.len())
    } else {
        let (start, end) = fields.range(element);
        rows.tables.name.intern(text, start, end)
    };
    let atom = rows.atom(position, z, name, model);
    rows.push(&atom)
}

/// Parses the first line of a frame.
fn number_of_atoms(fields: &Fields<'_>) -> Result<usize, Box<Fault>> {
    let count = number::integer(fields.get(0)).and_then(|count| usize::try_from(count).ok()).filter(|&count| count > 0);
    let count = count.ok_or_else(|| fields.fault(0, "the number of atoms of a frame, at least 1"))?;
    if fields.len() > 1 {
        return Err(fields.fault(1, "the end of the line after the number of atoms"));
    }
    Ok(count)
}

/// Returns the fields of the atoms of a frame, by the `Properties` of extended XYZ in its comment, such as
/// `species:S:1:pos:R:3:forces:R:3`.
fn atom_fields(text: &[u8], start: usize, end: usize) -> Result<AtomFields, Box<Fault>> {
    let Some(found) = memchr::memmem::find(&text[start..end], PROPERTIES) else {
        return Ok(AtomFields { element: 0, position: 1 });
    };
    let start = start + found + PROPERTIES.len();
    let quoted = text.get(start) == Some(&b'"');
    let start = start + usize::from(quoted);
    let is_end = |b: &u8| if quoted { *b == b'"' } else { *b <= b' ' };
    let end = text[start..end].iter().position(is_end).map_or(end, |len| start + len);
    let fault = |expected: &str| Fault::token(text, start, end, expected);
    let mut words = text[start..end].split(|b| *b == b':');
    let (mut element, mut position, mut field) = (None, None, 0_usize);
    while let Some(name) = words.next() {
        let (Some(kind), Some(width)) = (words.next(), words.next()) else {
            return Err(fault("properties as triples such as species:S:1"));
        };
        let width = number::integer(width).and_then(|width| usize::try_from(width).ok()).filter(|width| *width > 0);
        let width = width.ok_or_else(|| fault("a positive number of columns in each property"))?;
        match (name, kind, width) {
            (b"species", b"S", 1) | (b"Z", b"I", 1) => element = element.or(Some(field)),
            (b"pos", b"R", 3) => position = position.or(Some(field)),
            _ => {}
        }
        field = field.saturating_add(width);
    }
    match (element, position) {
        (Some(element), Some(position)) if element < MAX_FIELDS && position + 3 <= MAX_FIELDS => {
            Ok(AtomFields { element, position })
        }
        (Some(_), Some(_)) => Err(fault(&format!("species and pos among the first {MAX_FIELDS} columns"))),
        _ => Err(fault("properties with species:S:1 (or Z:I:1) and pos:R:3")),
    }
}

/// Returns the error for a file that ends too early.
fn ends(text: &[u8], expected: String) -> StructureError {
    Fault::words(text.len(), "the end of the file", expected).locate(text)
}

#[cfg(test)]
#[allow(clippy::pedantic, clippy::unwrap_used, reason = "tests fail by panicking")]
mod tests {
    use molmesh_surface::{Exceeded, Limit};

    use super::super::read::{ReadLimits, read};
    use super::super::select::{Selection, select};
    use super::*;

    const WATER: &str = "3\n  water  \nO 0.0 0.0 0.1173\nH 0.0 0.7572 -0.4692\nH 0.0 -0.7572 -0.4692\n";

    fn parse(text: &str) -> Result<Structure, StructureError> {
        read(text.as_bytes(), &ReadLimits::default())
    }

    #[test]
    fn a_frame_is_a_model() {
        let s = parse(&format!("{WATER}\n2\r\n\r\n6 1e1 -2 3.5 0.25\r\ncl 4 5 6\r\n\r\n")).unwrap();
        assert_eq!((s.format, s.title.as_deref()), (SourceFormat::Xyz, Some("water")));
        assert_eq!(s.element, [8, 1, 1, 6, 17]);
        assert_eq!(s.model, [1, 1, 1, 2, 2]);
        assert_eq!((s.x[3], s.y[3], s.z[3]), (10.0, -2.0, 3.5));
        assert_eq!((0..5).map(|i| s.name.get(i)).collect::<Vec<_>>(), ["O", "H", "H", "C", "cl"]);
        assert!(s.radius.is_empty() && s.warnings.is_empty());
    }

    #[test]
    fn atoms_are_selected_by_default_without_hydrogens() {
        let s = parse(WATER).unwrap();
        let selected = select(&s, &Selection::default()).unwrap();
        assert_eq!((&selected.atoms[..], selected.left_out.hydrogens), (&[0][..], 2));
        assert_eq!(selected.spheres(&s).unwrap().radii(), [1.52]);
    }

    #[test]
    fn extended_files_are_read_in_any_order_of_columns() {
        let frame = |properties: &str, row: &str| {
            parse(&format!("1\nLattice=\"9 0 0\" Properties={properties} pbc=\"T\"\n{row}\n"))
        };
        for (properties, row) in [
            ("species:S:1:pos:R:3:charge:R:1", "C 1 2 3 0.5 x"),
            ("pos:R:3:species:S:1", "1 2 3 C"),
            ("id:I:1:species:S:1:pos:R:3", "7 C 1 2 3"),
            ("forces:R:3:pos:R:3:Z:I:1", "9 9 9 1 2 3 6"),
            ("\"species:S:1:pos:R:3\"", "C 1 2 3"),
        ] {
            let s = frame(properties, row).unwrap();
            assert_eq!((s.element[0], s.x[0], s.y[0], s.z[0]), (6, 1.0, 2.0, 3.0), "{properties}");
        }
        for (properties, expected) in [
            ("pos:R:3:mass:R:1", "properties with species:S:1"),
            ("species:S:1:pos", "properties as triples"),
            ("species:S:0:pos:R:3", "a positive number of columns"),
            ("stress:R:40:species:S:1:pos:R:3", "species and pos among the first 32 columns"),
        ] {
            let error = frame(properties, "C 1 2 3").unwrap_err().to_string();
            assert!(error.starts_with("line 2, column 28: found") && error.contains(expected), "{error}");
        }
        let error = frame("pos:R:3:species:S:1", "1 2 3").unwrap_err().to_string();
        assert!(error.ends_with("expected an element"), "{error}");
    }

    #[test]
    fn dummy_atoms_are_unknown_elements() {
        let s = parse("2\n\nX 0 0 0\nC 3 0 0\n").unwrap();
        assert_eq!((&s.element[..], s.warnings.len()), (&[0, 6][..], 1));
    }

    #[test]
    fn errors_name_line_column_and_expectation() {
        for (text, said) in [
            ("2\n\nC 0 0 0\n", "line 4, column 1: found the end of the file, expected atom 2 of 2"),
            ("2\n\nC 0 0 0\n\n", "line 4, column 1: found the end of the line, expected an element and three"),
            ("1\n\nC 0 0\n", "line 3, column 6: found the end of the line, expected the z coordinate in Å"),
            ("1\n\nC 0 a 0\n", "line 3, column 5: found `a`, expected the y coordinate in Å, within ±100000"),
            ("1\n\nC 0 0 1e9\n", "line 3, column 7: found `1e9`, expected the z coordinate in Å"),
            ("1\n\nC 0 0 0\nC 1 1 1\n", "line 4, column 1: found `C`, expected the number of atoms of a frame"),
            ("0\n\nC 0 0 0\n", "line 1, column 1: found `0`, expected the number of atoms of a frame, at least 1"),
            ("1\n\nC 0 0 0\n1 2\n\nC 0 0 0\n", "line 4, column 3: found `2`, expected the end of the line"),
        ] {
            let error = parse(text).unwrap_err().to_string();
            assert!(error.starts_with(said), "{error} is not {said}");
        }
    }

    #[test]
    fn other_texts_are_not_xyz() {
        for text in ["12\nhello\nworld", "2244\n  -OEChem-0\n\n  1  0  0 V2000\n", "x\n\nC 0 0 0", "1\n"] {
            assert!(matches!(parse(text), Err(StructureError::UnknownFormat { .. })), "{text}");
        }
    }

    #[test]
    fn limits_hold() {
        let rows: String = (0..50).map(|i| format!("C {i} 0 0\n")).collect();
        let text = format!("50\n\n{rows}");
        let limits = ReadLimits { max_atoms: 49, ..ReadLimits::default() };
        assert_eq!(read(text.as_bytes(), &limits), Err(Exceeded::new(Limit::Atoms, 49).error()));
        assert_eq!(parse(&text).unwrap().len(), 50);
        // No memory is allocated for more atoms than the file can contain.
        assert!(parse("2000000000\n\nC 0 0 0\n").is_err());
    }
}
