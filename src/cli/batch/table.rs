//! Table of the areas of all inputs: their tables one after another, with the input in the first column.

use std::io::Write as _;
use std::path::Path;

use molmesh::structure::table::put_text;
use molmesh::surface::CancelToken;

use super::super::error::CliError;
use super::super::output::Output;

/// Name of the first column.
const INPUT: &str = "input";

/// Open table of all inputs.
pub(super) struct JoinedTable {
    output: Output,
    /// Header of the table of an input, without the line break.
    header: Option<Vec<u8>>,
}

impl JoinedTable {
    /// Opens the file `path`; `-` is stdout.
    pub(super) fn open(path: &Path, cancel: &CancelToken) -> Result<Self, CliError> {
        Ok(Self { output: Output::open(path, cancel)?, header: None })
    }

    /// Adds the table of an input.
    pub(super) fn add(&mut self, input: &Path, table: &[u8]) -> Result<(), CliError> {
        let mut text = Vec::with_capacity(2 * table.len());
        let mut records = records(table);
        let header = records.next().unwrap_or_default();
        match &self.header {
            None => {
                text.extend_from_slice(INPUT.as_bytes());
                text.push(b',');
                text.extend_from_slice(header);
                text.push(b'\n');
                self.header = Some(header.to_owned());
            }
            Some(expected) if expected == header => {}
            Some(_) => {
                let message = format!("the table of `{}` has other columns than those before it", input.display());
                let hint = "tables of skipped inputs were written with other options; run without --skip-existing";
                return Err(CliError::usage_with_hint(message, hint));
            }
        }
        let mut name = Vec::new();
        put_text(&mut name, &input.display().to_string());
        for record in records {
            text.extend_from_slice(&name);
            text.push(b',');
            text.extend_from_slice(record);
            text.push(b'\n');
        }
        self.output.write_all(&text).map_err(|source| self.output.failure(source))
    }

    /// Completes the file.
    pub(super) fn finish(self) -> Result<(), CliError> {
        Output::finish(vec![self.output])
    }
}

/// Returns the records of a table without their line breaks. A quoted field may contain line breaks.
fn records(table: &[u8]) -> impl Iterator<Item = &[u8]> {
    let mut is_quoted = false;
    let ends_record = move |byte: &u8| {
        is_quoted ^= *byte == b'"';
        *byte == b'\n' && !is_quoted
    };
    table.strip_suffix(b"\n").unwrap_or(table).split(ends_record)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quoted_line_breaks_do_not_end_a_record() {
        let found: Vec<_> = records(b"name,area\n\"a\n\"\"b\",1\nc,2\n").collect();
        assert_eq!(found, [&b"name,area"[..], b"\"a\n\"\"b\",1", b"c,2"]);
    }

    #[test]
    fn tables_are_joined_under_one_header() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("all.csv");
        let mut table = JoinedTable::open(&path, &CancelToken::default()).unwrap();
        table.add(Path::new("a.pdb"), b"chain,area\nA,1\nB,2\n").unwrap();
        table.add(Path::new("b,c.pdb"), b"chain,area\nA,3\n").unwrap();
        assert_eq!(table.add(Path::new("d.pdb"), b"chain,atoms\nA,3\n").unwrap_err().code(), 2);
        table.finish().unwrap();
        let text = std::fs::read_to_string(&path).unwrap();
        assert_eq!(text, "input,chain,area\na.pdb,A,1\na.pdb,B,2\n\"b,c.pdb\",A,3\n");
    }
}
