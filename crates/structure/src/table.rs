//! Table of the atoms of a file as CSV (RFC 4180, lines end in LF).

use std::io::{self, Write};
use std::ops::Range;

use super::atoms::Structure;
use super::element;

/// Names of the columns.
pub const COLUMNS: [&str; 9] =
    ["index", "name", "element", "residue_name", "residue_number", "insertion_code", "chain", "model", "kind"];
/// Bytes of text collected for one write.
const BLOCK_BYTES: usize = 1 << 16;

/// Writes one row for each atom of all models, in file order, after a row with the names of the columns: its index from
/// 0, its names as in the file, and the name of its kind. Numbers are decimal; an unknown element is `?`.
///
/// # Errors
/// Returns the errors of `out`.
pub fn write_csv(structure: &Structure, out: &mut dyn Write) -> io::Result<()> {
    write_rows(out, &COLUMNS, 0..structure.len(), |text, i| {
        put_columns(text, structure, i, 0..COLUMNS.len());
        Ok(())
    })
}

/// Writes the names of the columns, then `rows`. `put` appends the fields of a row, separated by commas.
///
/// # Errors
/// Returns the errors of `out` and `put`.
pub fn write_rows<R>(
    out: &mut dyn Write,
    names: &[&str],
    rows: impl IntoIterator<Item = R>,
    mut put: impl FnMut(&mut Vec<u8>, R) -> io::Result<()>,
) -> io::Result<()> {
    let mut text = Vec::with_capacity(2 * BLOCK_BYTES);
    text.extend_from_slice(names.join(",").as_bytes());
    text.push(b'\n');
    for row in rows {
        put(&mut text, row)?;
        text.push(b'\n');
        if text.len() >= BLOCK_BYTES {
            out.write_all(&text)?;
            text.clear();
        }
    }
    out.write_all(&text)
}

/// Appends the given [`COLUMNS`] of atom `i`.
pub fn put_columns(text: &mut Vec<u8>, structure: &Structure, i: usize, columns: Range<usize>) {
    let code = structure.insertion_code[i];
    let (mut index, mut number, mut model) = (itoa::Buffer::new(), itoa::Buffer::new(), itoa::Buffer::new());
    let mut bytes = [0; 4];
    let fields = [
        CsvField::Number(index.format(i)),
        CsvField::Text(structure.name.get(i)),
        CsvField::Text(element::symbol(structure.element[i])),
        CsvField::Text(structure.residue.get(i)),
        CsvField::Number(number.format(structure.residue_number[i])),
        CsvField::Text(if code == 0 { "" } else { char::from(code).encode_utf8(&mut bytes) }),
        CsvField::Text(structure.chain.get(i)),
        CsvField::Number(model.format(structure.model[i])),
        CsvField::Text(structure.kind[i].name()),
    ];
    for (n, field) in fields[columns].iter().enumerate() {
        if n > 0 {
            text.push(b',');
        }
        match field {
            CsvField::Number(number) => text.extend_from_slice(number.as_bytes()),
            CsvField::Text(name) => put_text(text, name),
        }
    }
}

/// Field of a row.
enum CsvField<'a> {
    Number(&'a str),
    Text(&'a str),
}

/// Appends a text, in quotes if it contains a separator or a quote. A spreadsheet would execute a text that begins with
/// one of `=+-@`, a tab or a line end as a formula, so an apostrophe precedes it.
pub fn put_text(rows: &mut Vec<u8>, text: &str) {
    let mark = if text.starts_with(['=', '+', '-', '@', '\t', '\r', '\n']) { "'" } else { "" };
    if !text.contains(['"', ',', '\n', '\r']) {
        rows.extend_from_slice(mark.as_bytes());
        rows.extend_from_slice(text.as_bytes());
        return;
    }
    rows.push(b'"');
    rows.extend_from_slice(mark.as_bytes());
    rows.extend_from_slice(text.replace('"', "\"\"").as_bytes());
    rows.push(b'"');
}

#[cfg(test)]
#[allow(clippy::pedantic, clippy::unwrap_used, reason = "tests fail by panicking")]
mod tests {
    use super::*;
    use crate::{ReadLimits, read};

    fn csv(text: &[u8]) -> String {
        let mut bytes = Vec::new();
        write_csv(&read(text, &ReadLimits::default()).unwrap(), &mut bytes).unwrap();
        String::from_utf8(bytes).unwrap()
    }

    #[test]
    fn rows_are_the_records_of_the_file() {
        let file = std::str::from_utf8(include_bytes!("../../../samples/4pti.pdb")).unwrap();
        let records: Vec<&str> = file.lines().filter(|l| l.starts_with("ATOM") || l.starts_with("HETATM")).collect();
        let table = csv(file.as_bytes());
        let rows: Vec<&str> = table.lines().collect();
        assert_eq!((rows[0], rows.len()), (COLUMNS.join(",").as_str(), records.len() + 1));
        for (i, (row, line)) in rows[1..].iter().zip(&records).enumerate() {
            let [name, residue, chain, number, code] = [12..16, 17..20, 21..22, 22..26, 26..27].map(|c| line[c].trim());
            let start = format!("{i},{name},{},{residue},{number},{code},{chain},1,", line[76..78].trim());
            assert!(row.starts_with(&start), "{row}\n{line}");
        }
        assert!(rows[1].ends_with(",protein") && rows[rows.len() - 1].ends_with(",water"));
    }

    #[test]
    fn names_with_separators_are_quoted() {
        let cif = "data_x\nloop_\n_atom_site.type_symbol\n_atom_site.auth_atom_id\n_atom_site.auth_comp_id\n\
                   _atom_site.auth_asym_id\n_atom_site.pdbx_PDB_ins_code\n_atom_site.auth_seq_id\n\
                   _atom_site.Cartn_x\n_atom_site.Cartn_y\n_atom_site.Cartn_z\n\
                   C 'O5\"' 'A,B' A B -7 0 0 0\nXx ? ? ? ? ? 4 0 0\nC =1+1 -x '@,' + 1 8 0 0\n";
        let rows: Vec<String> = csv(cif.as_bytes()).lines().skip(1).map(str::to_owned).collect();
        assert_eq!(rows[0], "0,\"O5\"\"\",C,\"A,B\",-7,B,A,1,polymer");
        assert_eq!(rows[1], "1,,?,,0,,,1,polymer");
        // Names that a spreadsheet would take for formulas.
        assert_eq!(rows[2], "2,'=1+1,C,'-x,1,'+,\"'@,\",1,polymer");
    }
}
