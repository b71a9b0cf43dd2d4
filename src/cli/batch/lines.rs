//! Summary of a batch: one JSON line per input.

use std::fs::{File, OpenOptions};
use std::io::{self, BufRead as _, BufReader, Seek as _, SeekFrom, Write as _};
use std::path::Path;

use serde_json::Value;

use super::super::error::CliError;
use super::super::output::is_stdio;

/// Destination of the lines. Each line is complete or absent.
pub(super) enum SummaryLines {
    Stdout,
    Stderr,
    File {
        file: File,
        name: String,
        /// Length of the complete lines, bytes.
        len: u64,
    },
}

impl SummaryLines {
    /// Opens the file `path`; `-` is stdout. If `adds` is true, the lines of an existing file stay.
    pub(super) fn open(path: &Path, adds: bool) -> Result<Self, CliError> {
        if is_stdio(path) {
            return Ok(Self::Stdout);
        }
        let name = path.display().to_string();
        let open = || -> io::Result<(File, u64)> {
            // A pipe has no earlier lines, and a read would wait for them.
            let reads = adds && path.is_file();
            let mut file = OpenOptions::new().read(reads).write(true).create(true).truncate(!adds).open(path)?;
            if !reads {
                return Ok((file, 0));
            }
            let (mut reader, mut line, mut len) = (BufReader::new(&file), Vec::new(), 0);
            // A killed run may leave a part of a line.
            while reader.read_until(b'\n', &mut line)? > 0 && line.ends_with(b"\n") {
                len += line.len() as u64;
                line.clear();
            }
            file.set_len(len)?;
            file.seek(SeekFrom::Start(len))?;
            Ok((file, len))
        };
        match open() {
            Ok((file, len)) => Ok(Self::File { file, name, len }),
            Err(source) => Err(CliError::Output { name, source }),
        }
    }

    /// Writes a line.
    pub(super) fn write(&mut self, line: &Value) -> Result<(), CliError> {
        let line = format!("{line}\n");
        match self {
            Self::Stdout => super::super::print(&line),
            Self::Stderr => {
                let written = io::stderr().write_all(line.as_bytes());
                written.map_err(|source| CliError::Output { name: "stderr".to_owned(), source })
            }
            Self::File { file, name, len } => match file.write_all(line.as_bytes()) {
                Ok(()) => {
                    *len += line.len() as u64;
                    Ok(())
                }
                Err(source) => {
                    // The batch ends with the error of the write.
                    drop(file.set_len(*len));
                    Err(CliError::Output { name: name.clone(), source })
                }
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn lines_are_added_behind_complete_ones() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.jsonl");
        std::fs::write(&path, "{\"a\":1}\n{\"b").unwrap();
        SummaryLines::open(&path, true).unwrap().write(&json!({ "c": 3 })).unwrap();
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "{\"a\":1}\n{\"c\":3}\n");
        SummaryLines::open(&path, false).unwrap().write(&json!({ "d": 4 })).unwrap();
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "{\"d\":4}\n");
    }
}
