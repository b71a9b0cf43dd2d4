//! Detection of the file format of decompressed bytes from their content.

use super::decoder::{GZIP_MAGIC, ZSTD_MAGIC};
use super::error::StructureError;
use super::source::SourceFormat;
use super::text::quote;
use super::{pqr, xyz};

/// Record names that identify a PDB file. `END` and `TER` are common words and do not count.
const PDB_RECORDS: [&[u8]; 33] = [
    b"ATOM", b"HETATM", b"HEADER", b"TITLE", b"REMARK", b"COMPND", b"SOURCE", b"CRYST1", b"MODEL", b"ENDMDL",
    b"OBSLTE", b"SPLIT", b"CAVEAT", b"KEYWDS", b"EXPDTA", b"NUMMDL", b"MDLTYP", b"AUTHOR", b"REVDAT", b"SPRSDE",
    b"JRNL", b"DBREF", b"SEQRES", b"HELIX", b"SHEET", b"SSBOND", b"LINK", b"ORIGX1", b"SCALE1", b"MTRIX1", b"ANISOU",
    b"CONECT", b"MASTER",
];

/// Bytes examined before a text is reported as unknown.
const LOOKED_AT: usize = 256 << 10;

/// Returns the format of `text`, which must not begin with a byte order mark.
pub(super) fn sniff(text: &[u8]) -> Result<SourceFormat, StructureError> {
    let unknown = |found: String| Err(StructureError::UnknownFormat { found });
    if is_binary_cif(text) {
        return Ok(SourceFormat::BinaryCif);
    }
    if let Some(found) = binary(text) {
        return unknown(found);
    }
    if text.iter().all(u8::is_ascii_whitespace) {
        return unknown(if text.is_empty() { "nothing (0 bytes)" } else { "only white space" }.to_owned());
    }
    let head = &text[..text.len().min(LOOKED_AT)];
    if is_cif(head) {
        return Ok(SourceFormat::Mmcif);
    }
    if let Some(name) = molecule_file(head) {
        return unknown(name.to_owned());
    }
    // The comment of an XYZ file may begin with the name of a PDB record.
    if xyz::is_xyz(head) {
        return Ok(SourceFormat::Xyz);
    }
    if head.split(|&b| b == b'\n' || b == b'\r').any(is_pdb_record) {
        return Ok(if pqr::is_pqr(head) { SourceFormat::Pqr } else { SourceFormat::Pdb });
    }
    unknown(words(head))
}

/// Returns true if the first token after comments is a data block. Categories without a data block are accepted too.
fn is_cif(head: &[u8]) -> bool {
    let mut rest = head;
    loop {
        let Some(start) = rest.iter().position(|&b| b > b' ') else { return false };
        rest = &rest[start..];
        if rest[0] != b'#' {
            break;
        }
        let end = rest.iter().position(|&b| b == b'\n' || b == b'\r').unwrap_or(rest.len());
        rest = &rest[end..];
    }
    let starts = |word: &[u8]| rest.get(..word.len()).is_some_and(|r| r.eq_ignore_ascii_case(word));
    starts(b"data_") || starts(b"loop_") || starts(b"global_") || starts(b"_atom_site.") || starts(b"_entry.")
}

fn is_pdb_record(line: &[u8]) -> bool {
    let word = &line[..line.len().min(6)];
    let end = word.iter().position(|&b| b <= b' ').unwrap_or(word.len());
    PDB_RECORDS.contains(&&word[..end]) || (word.starts_with(b"ATOM ") && word.len() == 6)
}

/// Returns true if the bytes begin with a MessagePack map.
fn is_map(bytes: &[u8]) -> bool {
    matches!(bytes.first(), Some(0x80..=0x8F | 0xDE | 0xDF))
}

/// Returns true if one of the keys occurs near the beginning.
fn has_key(bytes: &[u8], keys: [&[u8]; 2]) -> bool {
    let head = &bytes[..bytes.len().min(4096)];
    keys.iter().any(|key| memchr::memmem::find(head, key).is_some())
}

fn is_mmtf(bytes: &[u8]) -> bool {
    is_map(bytes) && has_key(bytes, [b"mmtfVersion", b"mmtfProducer"])
}

/// Returns true for BinaryCIF: a MessagePack map of encoder, version and data blocks, in any order.
fn is_binary_cif(bytes: &[u8]) -> bool {
    is_map(bytes) && !is_mmtf(bytes) && has_key(bytes, [b"dataBlocks", b"encoder"])
}

/// Names unsupported binary formats, recognized by their first bytes.
fn binary(bytes: &[u8]) -> Option<String> {
    let head = &bytes[..bytes.len().min(4096)];
    if is_mmtf(bytes) {
        return Some("MMTF (MessagePack)".to_owned());
    }
    let magic: [(&[u8], &str); 14] = [
        (GZIP_MAGIC, "gzip inside a compressed file"),
        (ZSTD_MAGIC, "zstd inside a compressed file"),
        (b"PK\x03\x04", "a ZIP archive"),
        (b"BZh", "bzip2 data"),
        (b"\xfd7zXZ\0", "xz data"),
        (b"7z\xbc\xaf", "a 7z archive"),
        (b"\x1f\x9d", "compress (.Z) data"),
        (b"%PDF", "a PDF document"),
        (b"\x89PNG", "a PNG image"),
        (b"\xff\xd8\xff", "a JPEG image"),
        (b"glTF", "a GLB mesh"),
        (b"\x7fELF", "a program"),
        (b"\xff\xfe", "UTF-16 text"),
        (b"\xfe\xff", "UTF-16 text"),
    ];
    if let Some((_, name)) = magic.iter().find(|(m, _)| bytes.starts_with(m)) {
        return Some((*name).to_owned());
    }
    if bytes.get(257..262) == Some(b"ustar") {
        return Some("a tar archive".to_owned());
    }
    let odd = head.iter().filter(|&&b| b < b' ' && !b.is_ascii_whitespace()).count();
    (odd * 10 > head.len()).then(|| format!("binary data beginning with {}", hex(head)))
}

/// Names file formats of small molecules, whose comments may look like other formats.
fn molecule_file(head: &[u8]) -> Option<&'static str> {
    let lines = || head.split(|&b| b == b'\n');
    if lines().any(|line| line.starts_with(b"@<TRIPOS>")) {
        return Some("Tripos MOL2");
    }
    // The fourth line has the version.
    let counts = lines().nth(3)?.trim_ascii_end();
    (counts.ends_with(b" V2000") || counts.ends_with(b" V3000")).then_some("an MDL molfile (SDF)")
}

/// Names unsupported text formats, recognized by typical words.
fn words(head: &[u8]) -> String {
    let trimmed = head.trim_ascii_start();
    let has = |word: &[u8]| memchr::memmem::find(&head[..head.len().min(4096)], word).is_some();
    let lower = trimmed[..trimmed.len().min(15)].to_ascii_lowercase();
    if lower.starts_with(b"<!doctype html") || lower.starts_with(b"<html") {
        return "an HTML page".to_owned();
    }
    if lower.starts_with(b"<?xml") || lower.starts_with(b"<") {
        return if has(b"PDBx") { "PDBML (XML)" } else { "XML" }.to_owned();
    }
    if lower.starts_with(b"{") || lower.starts_with(b"[") {
        return "JSON".to_owned();
    }
    let line = trimmed.split(|&b| b == b'\n' || b == b'\r').next().unwrap_or_default();
    format!("text beginning with {}", quote(line))
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().take(8).map(|b| format!("{b:02x}")).collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
#[allow(clippy::pedantic, clippy::unwrap_used, reason = "tests fail by panicking")]
mod tests {
    use super::*;

    #[test]
    fn formats_are_told_by_content() {
        for pdb in [
            "\n\nHEADER x",
            "ATOM      1",
            "REMARK\r\n",
            "junk\nmore junk\rHETATM    1",
            "MODEL        1",
            "CRYST1   1",
        ] {
            assert_eq!(sniff(pdb.as_bytes()).unwrap(), SourceFormat::Pdb, "{pdb}");
        }
        for bcif in [&b"\x83\xa7encoder\xb6mol*/ciftools"[..], b"\xdf\0\0\0\x01\xaadataBlocks\x90"] {
            assert_eq!(sniff(bcif).unwrap(), SourceFormat::BinaryCif, "{bcif:?}");
        }
        for cif in ["data_1ABC\n", "# comment\n#\n\n  DATA_x", "loop_\n_atom_site.id", "_entry.id X"] {
            assert_eq!(sniff(cif.as_bytes()).unwrap(), SourceFormat::Mmcif, "{cif}");
        }
    }

    #[test]
    fn everything_else_is_named() {
        let cases: [(&[u8], &str); 18] = [
            (b"", "nothing (0 bytes)"),
            (b" \n\t", "only white space"),
            (b"\x83\xa7encoded\xb6mol*/ciftools", "`"),
            (b"encoder of dataBlocks", "`encoder of dataBlocks`"),
            (b"\xde\x00\x20\xabmmtfVersion\xa51.0.0", "MMTF"),
            (b"PK\x03\x04rest", "ZIP"),
            (b"\xfd7zXZ\0", "xz"),
            (b"\xff\xfed\0a\0t\0a\0", "UTF-16"),
            (b"<!DOCTYPE html><html>", "HTML"),
            (b"<?xml version=\"1.0\"?><PDBx:datablock", "PDBML"),
            (b"{\"a\": 1}", "JSON"),
            (b"@<TRIPOS>MOLECULE\n", "MOL2"),
            (b"x\n  y\n\n  1  0  0 V2000\n", "SDF"),
            (b"hello world\n", "`hello world`"),
            (b"\0\x01\x02\x03", "binary data beginning with 00 01 02 03"),
            (b"\x1f\x8bxx", "gzip inside"),
            (b"END\n", "`END`"),
            (b"ATOMIC bomb\n", "`ATOMIC bomb`"),
        ];
        for (bytes, found) in cases {
            let message = sniff(bytes).unwrap_err().to_string();
            assert!(message.contains(found), "{message} does not name {found}");
        }
    }
}
