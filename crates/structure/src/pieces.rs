//! Pieces of a structure file that several threads read at once.
//!
//! The result does not depend on the number of pieces. One piece is read by the calling thread.

use std::ops::Range;

use rayon::prelude::*;

/// Minimum size of a piece of a text, bytes. One thread reads it in 0.7 ms (PDB) to 1.5 ms (mmCIF). Smaller pieces gain
/// less than a busy thread pool may delay them.
const MIN_PIECE: usize = 512 << 10;
/// Maximum number of pieces per thread. With several, a thread that is busy with other work delays the end only
/// slightly.
const PIECES_PER_THREAD: usize = 4;

/// Returns the number of pieces for a text of this size, 1 if it is small or there is one thread.
pub(super) fn number(bytes: usize) -> usize {
    match bytes / MIN_PIECE {
        // Requesting the number of threads starts them.
        0 | 1 => 1,
        n => match rayon::current_num_threads() {
            1 => 1,
            threads => n.min(PIECES_PER_THREAD * threads),
        },
    }
}

/// Cuts `text[from..]` after line feeds into at most `n` pieces of similar size.
pub(super) fn cut(text: &[u8], from: usize, n: usize) -> Vec<Range<usize>> {
    let size = (text.len() - from).div_ceil(n).max(1);
    let mut pieces = Vec::with_capacity(n);
    let mut start = from;
    while start < text.len() {
        let least = (start + size).min(text.len());
        let end = memchr::memchr(b'\n', &text[least - 1..]).map_or(text.len(), |i| least + i);
        pieces.push(start..end);
        start = end;
    }
    pieces
}

/// Applies `work` to every item, in parallel if there are several, and returns the results in order.
pub(super) fn map<T: Send, R: Send>(items: &mut [T], work: impl Fn(&mut T) -> R + Sync) -> Vec<R> {
    match items {
        [item] => vec![work(item)],
        items => items.par_iter_mut().with_max_len(1).map(&work).collect(),
    }
}

#[cfg(test)]
#[allow(clippy::pedantic, clippy::unwrap_used, reason = "tests fail by panicking")]
mod tests {
    use std::path::Path;

    use proptest::prelude::*;

    use super::*;
    use crate::read::read_in_pieces;
    use crate::{ReadLimits, Structure, StructureError};

    fn atom(name: &str, residue: &str, number: i32, rest: &str) -> String {
        format!("ATOM      1 {name:<4} {residue:<5}{number:>4}    {number:>8.3}   2.000   3.000{rest}\n")
    }

    /// Returns PDB files in which a line affects atoms many lines later.
    fn stateful() -> Vec<(&'static str, String)> {
        let many = |name: &str, residue: &str| (1..30).map(|i| atom(name, residue, i, "")).collect::<String>();
        let plain = || many(" CA ", "ALA A");
        vec![
            ("repeated models", format!("MODEL        1\n{0}MODEL        1\n{0}MODEL        5\n{0}", plain())),
            ("ends of models", format!("{0}ENDMDL\n{0}END\nEND\nMODEL 7\n{0}ENDMDL\nMODEL\nENDMDL\n{0}", plain())),
            ("models without atoms", format!("MODEL 1\nMODEL 2\nENDMDL\nMODEL 2\n{0}{0}{0}", plain())),
            ("alignment of names", format!("{0}{1}{0}", many("CA  ", "LIG A"), many("C   ", "LIG A"))),
            ("two-letter chains", {
                let polymer = |i| atom(" CA ", ["ALAXA", "GLYXA"][usize::from(i % 2 == 0)], i, "");
                (1..30).map(polymer).collect::<String>() + &many(" CA ", "LIGXA")
            }),
            ("bonded residues", {
                let residue = |name: &str, i: i32| atom(" N  ", name, i, "") + &atom(" C  ", name, i, "");
                let chain = |first: &str, next: &str| {
                    let others: String = (1..15).map(|i| residue(next, i)).collect();
                    residue(first, 0) + &others.replace("ATOM  ", "HETATM")
                };
                chain("ALA A", "XYZ A") + &chain("ALA B", "XYZ B") + &chain("XYZ C", "XYZ C")
            }),
            ("parts and segments", {
                let part = |chain: &str, segment: &str| {
                    (1..15)
                        .map(|i| atom(" CA ", &format!("ALA {chain}"), i % 3, &format!("  1.00  0.00      {segment}")))
                        .collect::<String>()
                };
                format!("{0}END\n{0}END\n{1}END\n{2}", part("A", "PROA"), part("A", "PROB"), part("B", "PROB"))
            }),
            ("unknown residues", many(" C1 ", "QQQ A") + &plain()),
            ("listed residues", {
                let end = plain().replace("ATOM  ", "HETATM").replace("ALA", "XYZ");
                format!("TITLE     ONE\nSEQRES   1 A   15  XYZ\nHEADER{:>60}\n{}TITLE     TWO\n{end}", "1ABC", plain())
            }),
        ]
    }

    /// Returns PDB files with faults, warnings, and unusual lines.
    fn odd() -> Vec<(&'static str, String)> {
        let lines: Vec<String> = (1..40).map(|i| atom(" N  ", "GLY B", i, "  1.00  0.00")).collect();
        let with = |at: &[usize], line: &str| {
            let mut lines = lines.clone();
            at.iter().for_each(|&i| line.clone_into(&mut lines[i]));
            lines.concat()
        };
        let warning = atom(" N  ", "GLY B", 1, "  oops  0.00");
        vec![
            ("no fault", lines.concat()),
            ("atoms of one position", with(&(3..30).collect::<Vec<_>>(), &lines[0])),
            ("warnings", with(&(5..35).collect::<Vec<_>>(), &warning)),
            ("fault after warnings", with(&[1, 2, 38], &warning) + "ATOM\n"),
            ("two bad coordinates", with(&[7, 31], &lines[0].replace("2.000", "2.0x0"))),
            ("short line", with(&[20], "ATOM      1  N   GLY B\n")),
            ("bad model, then bad atom", with(&[10], "MODEL  x\n") + "ATOM\n"),
            ("bad atom, then bad model", with(&[10], "HETATM\n") + "MODEL x\n"),
            ("tabs", with(&[4, 5, 30], "ATOM\t1\tN\tGLY B  1\t10.0\t20.0\t30.0\t0.5\n") + &lines.concat()),
            ("blank lines", with(&[2, 3, 17, 30], "\n  \n\t\n\r\n")),
            ("line ends", lines.join("\r\n") + &lines.concat().replace('\n', "\r") + "\n\r" + &lines.concat()),
            ("no line end", lines.concat().trim_end().to_owned()),
            ("no atoms", "REMARK nothing\n".repeat(40)),
        ]
    }

    /// Returns mmCIF files with plain and special rows.
    fn cif() -> Vec<(&'static str, String)> {
        let head =
            "data_x\nloop_\n_atom_site.Cartn_x\n_atom_site.Cartn_y\n_atom_site.Cartn_z\n_atom_site.auth_asym_id\n";
        let rows: Vec<String> = (0..50).map(|i| format!("{i}.5 2 3 {}\n", ["A", "B", "'C'"][i / 20])).collect();
        let with = |row: &str| format!("{head}{}{row}{}", rows[..30].concat(), rows[30..].concat());
        vec![
            ("plain rows", with("") + "#\nloop_\n_entity.id\n_entity.type\n1 polymer\n"),
            ("several rows in a line", with("1 2 3 A 4 5 6 B\n")),
            ("row of several lines", with("1\n2\n3\nA\n")),
            ("text field", with("1 2 3\n;1 2 3 A\n4 5 6 B\n;\n")),
            ("comment", with("# 1 2 3 A\n")),
            ("quoted blank", with("1 2 3 'A B'\n")),
            ("bad coordinate", with("1 x 3 A\n") + "y 2 3 A\n"),
            ("incomplete row", with("1 2 3\n")),
            ("loop ends", with("_entry.id Y\n")),
            ("another block", with("data_y\n")),
            // Comments at the end are left out of a single piece; several pieces need the general path.
            ("warning in the first row", {
                let head = head.replace("_atom_site.Cartn_x\n", "_atom_site.occupancy\n_atom_site.Cartn_x\n");
                let row = |occupancy: &str| format!("{occupancy} {}", rows[0]);
                format!("{head}{}{}{}", row("x"), row("1").repeat(20), "# comment\n".repeat(60))
            }),
        ]
    }

    /// Returns the files of the repository that the readers accept.
    fn files() -> Vec<(String, Vec<u8>)> {
        let root = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../.."));
        let folders = [
            "samples",
            "tests/cases/atoms",
            "tests/bcif_support",
            "fuzz/corpus/pdb",
            "fuzz/corpus/mmcif",
            "fuzz/corpus/binarycif",
        ];
        let entries = folders.iter().flat_map(|folder| std::fs::read_dir(root.join(folder)).unwrap());
        let paths = entries.map(|entry| entry.unwrap().path()).filter(|path| path.is_file());
        let read: Vec<_> = paths.map(|path| (path.display().to_string(), std::fs::read(path).unwrap())).collect();
        assert!(read.len() > 10);
        let made = stateful().into_iter().chain(odd()).chain(cif());
        made.map(|(name, text)| (name.to_owned(), text.into_bytes())).chain(read).collect()
    }

    fn limits() -> [ReadLimits; 3] {
        let limits = ReadLimits::default();
        [limits, ReadLimits { max_atoms: 45, ..limits }, ReadLimits { max_duplicates: 2, ..limits }]
    }

    type Read = Result<Structure, StructureError>;

    fn reads(bytes: &[u8], n: usize) -> [Read; 3] {
        limits().map(|limits| read_in_pieces(bytes, &limits, n))
    }

    #[test]
    fn pieces_are_whole_lines() {
        let text = b"one\ntwo\nthree\nfour";
        let cuts = |from, n| cut(text, from, n).into_iter().map(|piece| &text[piece]).collect::<Vec<_>>();
        assert_eq!(cuts(0, 1), [&text[..]]);
        assert_eq!(cuts(0, 2), [&b"one\ntwo\nthree\n"[..], b"four"]);
        assert_eq!(cuts(4, 100), [&b"two\n"[..], b"three\n", b"four"]);
        assert!(cut(b"", 0, 3).is_empty());
    }

    #[test]
    fn results_do_not_depend_on_the_number_of_pieces() {
        for (name, bytes) in files() {
            let whole = reads(&bytes, 1);
            for n in (2..12).chain([40, 1000]) {
                assert_eq!(reads(&bytes, n), whole, "{name} in {n} pieces");
            }
        }
    }

    /// Negative control: pieces that are read independently give other results.
    #[test]
    fn pieces_depend_on_those_before() {
        for (name, text) in stateful() {
            let whole = read_in_pieces(text.as_bytes(), &ReadLimits::default(), 1).unwrap();
            let pieces = cut(text.as_bytes(), 0, 4);
            let apart =
                pieces.into_iter().map(|piece| read_in_pieces(&text.as_bytes()[piece], &limits()[0], 1).unwrap());
            let columns = |s: &Structure| {
                (0..s.len())
                    .map(|i| (s.model[i], s.element[i], s.chain.get(i).to_owned(), s.kind[i]))
                    .collect::<Vec<_>>()
            };
            assert_ne!(apart.flat_map(|s| columns(&s)).collect::<Vec<_>>(), columns(&whole), "{name}");
        }
    }

    proptest! {
        #[test]
        fn mixed_lines_give_the_same_in_any_number_of_pieces(
            kind in 0..3_usize,
            picks in proptest::collection::vec(0..10_000_usize, 1..80),
            n in 2..20_usize,
        ) {
            let sources = match kind {
                0 => stateful(),
                1 => stateful().into_iter().chain(odd()).collect(),
                _ => cif(),
            };
            let lines: Vec<&str> = sources.iter().flat_map(|(_, text)| text.split_inclusive('\n')).collect();
            let head = lines[if kind == 2 { 0..6 } else { 1..2 }].concat();
            let text = head + &picks.iter().map(|&pick| lines[pick % lines.len()]).collect::<String>();
            prop_assert_eq!(reads(text.as_bytes(), n), reads(text.as_bytes(), 1));
        }
    }
}
