//! Archives of structure files: tar, plain or compressed with gzip, and zip. Entries are read into memory one by one.
//!
//! An entry that cannot be used is refused by name, and the others are read. An archive that cannot be read to its end,
//! or exceeds a limit, is refused as a whole.

use std::cell::Cell;
use std::fs::File;
use std::io::{self, Read, Seek as _, SeekFrom};

use bytes::{Bytes, BytesMut};
use flate2::read::{DeflateDecoder, MultiGzDecoder};
use rawzip::{CompressionMethod, RECOMMENDED_BUFFER_SIZE, ZipArchive};
use tar::{Archive, Entry, EntryType, PaxExtensions};

use super::batch_names::{MAX_NAME_BYTES, ResultNames, check_name};
use super::problem::Problem;
use super::problem_types::ProblemType;
use crate::jobs::Budget;
use crate::structure::GZIP_MAGIC;
use crate::surface::{Control, Exceeded, Limit, OutOfMemory};

/// Maximum number of entries. Fixed: four times the default number of jobs of one client; each takes a line of the
/// batch's record.
pub(super) const MAX_ENTRIES: usize = 10_000;
/// Maximum size of the extended header of a tar entry, bytes. Names take a few hundred.
const MAX_HEADER_BYTES: u64 = 64 << 10;
/// Maximum length of the reason for which an archive cannot be read, characters.
const MAX_REASON: usize = 400;
/// Size of the pieces in which entries are read, bytes.
const PIECE: usize = 64 << 10;
/// First bytes of a zip archive: of its first entry, or of the end of an empty one.
const ZIP_MAGIC: [&[u8]; 2] = [b"PK\x03\x04", b"PK\x05\x06"];
/// Bits of a zip entry's mode that tell its kind, and the kind of a plain file.
const KIND: u32 = 0o170_000;
const PLAIN_FILE: u32 = 0o100_000;

/// Limits of an archive, bytes.
#[derive(Debug, Clone, Copy)]
pub(super) struct ArchiveLimits {
    /// Size of an entry.
    pub(super) entry: u64,
    /// Size of all entries together after decompression, with the headers of a tar archive.
    pub(super) total: u64,
}

/// Entry of an archive.
pub(super) struct ArchiveEntry {
    pub(super) name: String,
    /// The file, which holds its reservation, or the reason for which it was refused.
    pub(super) content: Result<Bytes, Problem>,
}

/// Reads the entries of an archive, charges each to `budget`, and passes it to `visit`. Folders have no entry.
/// `extensions` are those of the results of an entry.
pub(super) fn read(
    mut file: &File,
    limits: ArchiveLimits,
    extensions: &[&'static str],
    budget: &Budget,
    control: &Control<'_>,
    visit: impl FnMut(ArchiveEntry) -> Result<(), Problem>,
) -> Result<(), Problem> {
    let left = Cell::new(limits.total.saturating_add(1));
    let results = ResultNames::new(extensions);
    let reader = ArchiveReader { limits, budget, control, left: &left, entries: 0, results, visit };
    let mut start = [0; 4];
    let n = file.seek(SeekFrom::Start(0)).and_then(|_| file.read(&mut start)).map_err(Problem::internal)?;
    file.seek(SeekFrom::Start(0)).map_err(Problem::internal)?;
    if ZIP_MAGIC.contains(&&start[..n]) {
        reader.read_zip(file.try_clone().map_err(Problem::internal)?)
    } else if start.starts_with(GZIP_MAGIC) {
        reader.read_tar(MultiGzDecoder::new(file))
    } else {
        reader.read_tar(file)
    }
}

fn refused(detail: impl Into<String>) -> Problem {
    Problem::new(ProblemType::BadRequest, detail)
}

fn unreadable(error: impl std::fmt::Display) -> Problem {
    // The library quotes the header, which may be anything.
    let text = error.to_string();
    let why: String = text.chars().take(MAX_REASON).map(|c| if c.is_control() { '\u{fffd}' } else { c }).collect();
    refused(format!("the archive cannot be read: {why}"))
        .with("expected", "a tar archive, plain or compressed with gzip, or a zip archive")
}

/// Error of reading an entry.
enum EntryError {
    /// The other entries can be read.
    Refused(Problem),
    /// The rest of the archive cannot be read.
    Fatal(Problem),
    /// The bytes of the entry cannot be read.
    Io(io::Error),
}

struct ArchiveReader<'a, V> {
    limits: ArchiveLimits,
    budget: &'a Budget,
    control: &'a Control<'a>,
    /// Bytes that may still be decompressed; 0 once the limit is exceeded.
    left: &'a Cell<u64>,
    entries: usize,
    results: ResultNames<'a>,
    visit: V,
}

/// Reader that counts decompressed bytes and fails at their limit.
struct Counted<'a, R> {
    inner: R,
    left: &'a Cell<u64>,
    control: &'a Control<'a>,
    /// True once the end was reached.
    has_ended: bool,
}

impl<'a, R> Counted<'a, R> {
    fn new(inner: R, left: &'a Cell<u64>, control: &'a Control<'a>) -> Self {
        Self { inner, left, control, has_ended: false }
    }
}

impl<R: Read> Read for Counted<'_, R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        self.control.check().map_err(io::Error::other)?;
        let n = self.inner.read(buffer)?;
        self.has_ended |= n == 0 && !buffer.is_empty();
        let left = self.left.get().saturating_sub(n as u64);
        self.left.set(left);
        if n > 0 && left == 0 { Err(io::Error::other("the limit is exceeded")) } else { Ok(n) }
    }
}

impl<V: FnMut(ArchiveEntry) -> Result<(), Problem>> ArchiveReader<'_, V> {
    /// Returns the problem of an archive whose bytes cannot be read.
    fn failed(&self, error: impl std::fmt::Display) -> Problem {
        if let Err(stopped) = self.control.check() {
            return stopped.into();
        }
        if self.left.get() > 0 {
            return unreadable(error);
        }
        let exceeded = Exceeded::new(Limit::InflatedBytes, self.limits.total);
        Problem::from(&Exceeded { subject: "the archive".into(), ..exceeded })
    }

    fn count(&mut self) -> Result<(), Problem> {
        self.entries += 1;
        if self.entries <= MAX_ENTRIES {
            return Ok(());
        }
        let detail = format!("the archive has more than {MAX_ENTRIES} entries");
        Err(Problem::new(ProblemType::BodyTooLarge, detail).with("limit", MAX_ENTRIES))
    }

    /// Passes on an entry, after `content` has read it unless its name is refused.
    fn pass_on(
        &mut self,
        name: &[u8],
        content: impl FnOnce(&Self) -> Result<Bytes, EntryError>,
    ) -> Result<(), Problem> {
        let (name, valid) = match check_name(name) {
            Ok(name) => (name.to_owned(), Ok(())),
            Err(why) => {
                let shown = String::from_utf8_lossy(&name[..name.len().min(MAX_NAME_BYTES)]);
                (shown.into_owned(), Err(refused(format!("the name of the entry {why}"))))
            }
        };
        let content = match valid.and_then(|()| self.results.add(&name).map_err(refused)) {
            Err(problem) => Err(problem),
            Ok(()) => match content(self) {
                Ok(bytes) => Ok(bytes),
                Err(EntryError::Refused(problem)) => Err(problem),
                Err(EntryError::Fatal(problem)) => return Err(problem),
                Err(EntryError::Io(error)) => return Err(self.failed(format!("{name}: {error}"))),
            },
        };
        (self.visit)(ArchiveEntry { name, content })
    }

    /// Reads an entry of `size` bytes, as its header says.
    fn content(&self, mut entry: impl Read, size: u64) -> Result<Bytes, EntryError> {
        let too_large = || {
            let exceeded = Exceeded::new(Limit::BodyBytes, self.limits.entry);
            EntryError::Refused(Problem::from(&Exceeded { subject: "the entry".into(), ..exceeded }))
        };
        if size > self.limits.entry {
            return Err(too_large());
        }
        let no_memory = |error: OutOfMemory| match error {
            OutOfMemory::Limit { .. } => EntryError::Refused(error.into()),
            error => EntryError::Fatal(error.into()),
        };
        let reservation = self.budget.reservation();
        let (mut bytes, mut piece) = (BytesMut::new(), vec![0; PIECE]);
        loop {
            let n = entry.read(&mut piece).map_err(EntryError::Io)?;
            if n == 0 {
                break;
            }
            if (bytes.len() + n) as u64 > self.limits.entry {
                return Err(too_large());
            }
            reservation.extend(&mut bytes, &piece[..n], size).map_err(no_memory)?;
        }
        if bytes.len() as u64 != size {
            return Err(EntryError::Io(io::Error::other("it ends early")));
        }
        Ok(reservation.attach(bytes.freeze()))
    }

    /// Reads the headers of a tar archive one by one, since the library reads extended headers of any size.
    fn read_tar(mut self, reader: impl Read) -> Result<(), Problem> {
        let mut archive = Archive::new(Counted::new(reader, self.left, self.control));
        let mut extended = None;
        for entry in archive.entries().map_err(unreadable)?.raw(true) {
            let mut entry = entry.map_err(|error| match self.entries {
                0 => self.failed("it does not begin with the header of an entry"),
                _ => self.failed(error),
            })?;
            let kind = entry.header().entry_type();
            if kind.is_gnu_longname() || kind.is_pax_local_extensions() {
                let name = extended_name(&mut entry, kind).map_err(|error| self.failed(error))?;
                extended = name.or(extended);
                continue;
            }
            if kind.is_pax_global_extensions() || kind.is_gnu_longlink() {
                continue;
            }
            self.count()?;
            let name = extended.take().unwrap_or_else(|| entry.path_bytes().into_owned());
            if kind.is_dir() || name.ends_with(b"/") {
                continue;
            }
            let size = entry.size();
            self.pass_on(&name, |this| {
                if !(kind.is_file() || kind.is_contiguous()) {
                    return Err(EntryError::Refused(refused("the entry is a link, a device or another special file")));
                }
                this.content(&mut entry, size)
            })?;
        }
        let (mut rest, mut piece) = (archive.into_inner(), vec![0; PIECE]);
        // Only the empty block shows that the archive was not cut between two entries. Writers should end it with two
        // and may add more; some write a single one.
        if rest.has_ended {
            return Err(unreadable("it ends without an empty block; it is not complete"));
        }
        // The rest has the checksum of gzip, which is compared at the end. Further archives would be lost silently.
        loop {
            match rest.read(&mut piece).map_err(|error| self.failed(error))? {
                0 => return Ok(()),
                n if piece[..n].iter().any(|byte| *byte != 0) => {
                    return Err(unreadable("it has further data after its end"));
                }
                _ => {}
            }
        }
    }

    fn read_zip(mut self, file: File) -> Result<(), Problem> {
        let mut buffer = vec![0; RECOMMENDED_BUFFER_SIZE];
        let archive = ZipArchive::from_file(file, &mut buffer).map_err(unreadable)?;
        let mut entries = archive.entries(&mut buffer);
        while let Some(entry) = entries.next_entry().map_err(unreadable)? {
            self.count()?;
            if entry.is_dir() {
                continue;
            }
            self.pass_on(entry.file_path().as_bytes(), |this| {
                let refuse = |detail: String| EntryError::Refused(refused(detail));
                let (kind, method) = (entry.mode().value() & KIND, entry.compression_method());
                if entry.flags().is_encrypted() {
                    return Err(refuse("the entry is encrypted".to_owned()));
                }
                if kind != 0 && kind != PLAIN_FILE {
                    return Err(refuse("the entry is a link, a device or another special file".to_owned()));
                }
                let broken = |error: &dyn std::fmt::Display| refuse(format!("the entry cannot be read: {error}"));
                let found = archive.get_entry(entry.wayfinder()).map_err(|error| broken(&error))?;
                let counted = |inner| Counted::new(inner, this.left, this.control);
                let size = entry.uncompressed_size_hint();
                let content = match method {
                    CompressionMethod::STORE => {
                        let reader: Box<dyn Read> = Box::new(found.reader());
                        this.content(found.verifying_reader(counted(reader)), size)
                    }
                    CompressionMethod::DEFLATE => {
                        let reader: Box<dyn Read> = Box::new(DeflateDecoder::new(found.reader()));
                        this.content(found.verifying_reader(counted(reader)), size)
                    }
                    other => return Err(refuse(format!("the entry is compressed with {other}, expected deflate"))),
                };
                match content {
                    // The entries after a damaged one can be read.
                    Err(EntryError::Io(error)) if this.left.get() > 0 && this.control.check().is_ok() => {
                        Err(broken(&error))
                    }
                    content => content,
                }
            })?;
        }
        Ok(())
    }
}

/// Reads the name in an extended header; `None` if it has none.
fn extended_name(header: &mut Entry<'_, impl Read>, kind: EntryType) -> io::Result<Option<Vec<u8>>> {
    if header.size() > MAX_HEADER_BYTES {
        return Err(io::Error::other(format!("an extended header has more than {MAX_HEADER_BYTES} bytes")));
    }
    let mut text = Vec::new();
    header.read_to_end(&mut text)?;
    if kind.is_gnu_longname() {
        text.truncate(text.iter().position(|byte| *byte == 0).unwrap_or(text.len()));
        return Ok(Some(text));
    }
    let mut name = None;
    for extension in PaxExtensions::new(&text) {
        let extension = extension?;
        match extension.key_bytes() {
            b"path" => name = Some(extension.value_bytes().to_vec()),
            // Only files above 8 GiB need it.
            b"size" => return Err(io::Error::other("the size of an entry is in an extended header")),
            _ => {}
        }
    }
    Ok(name)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the names of the entries of an archive, or the reason for which it is refused.
    fn names_in(bytes: &[u8]) -> Result<Vec<String>, String> {
        let mut file = tempfile::tempfile().unwrap();
        std::io::Write::write_all(&mut file, bytes).unwrap();
        let limits = ArchiveLimits { entry: 1 << 20, total: 1 << 20 };
        let (budget, mut names) = (Budget::new(1 << 20), Vec::new());
        let visit = |entry: ArchiveEntry| {
            names.push(entry.name);
            Ok(())
        };
        let read = read(&file, limits, &["glb"], &budget, &Control::default(), visit);
        read.map(|()| names).map_err(Problem::into_detail)
    }

    #[test]
    fn a_tar_archive_ends_with_an_empty_block() {
        let mut builder = tar::Builder::new(Vec::new());
        for name in ["a.pdb", "b.pdb"] {
            let mut header = tar::Header::new_gnu();
            header.set_size(700);
            builder.append_data(&mut header, name, &[b'x'; 700][..]).unwrap();
        }
        let whole = builder.into_inner().unwrap();
        let (entry, block) = (512 + 1024, 512);
        assert_eq!(whole.len(), 2 * entry + 2 * block);
        let gzip = |bytes: &[u8]| {
            let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
            std::io::Write::write_all(&mut encoder, bytes).unwrap();
            encoder.finish().unwrap()
        };
        let padded = [&whole[..], &[0; 10_240]].concat();
        for complete in [&whole[..], &whole[..2 * entry + block], &whole[..2 * entry + block + 100], &padded] {
            for bytes in [complete.to_vec(), gzip(complete)] {
                assert_eq!(names_in(&bytes).unwrap(), ["a.pdb", "b.pdb"]);
            }
        }
        for cut in [entry, 2 * entry, 2 * entry - 10, 2 * entry + 100, entry + 100] {
            for bytes in [whole[..cut].to_vec(), gzip(&whole[..cut])] {
                let error = names_in(&bytes).unwrap_err();
                assert!(error.starts_with("the archive cannot be read: "), "{cut}: {error}");
            }
        }
        assert!(names_in(&whole[..entry]).unwrap_err().contains("without an empty block"));
        let damaged = [&whole[..entry], &b"a\x1b[2J\x07\n".repeat(512)].concat();
        let error = names_in(&damaged).unwrap_err();
        assert!(error.contains("numeric field") && !error.contains(char::is_control), "{error}");
        for other in [include_bytes!("../../samples/4pti.pdb").to_vec(), gzip(b"HEADER"), b"BZh91AY".repeat(100)] {
            assert!(names_in(&other).unwrap_err().contains("does not begin with the header of an entry"));
        }
    }
}
