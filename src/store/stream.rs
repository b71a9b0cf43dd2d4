//! Objects in pieces.

use std::fs::File;
use std::io::{self, Read as _, Seek as _, SeekFrom};
use std::ops::Range;

use bytes::Bytes;
use futures_util::{StreamExt as _, TryStreamExt as _};
use object_store::{GetResult, GetResultPayload};
use tokio::task::spawn_blocking;

use super::handle::Store;
use super::name::Name;
use super::object::ByteStream;

/// Bytes of a file that are read at once: a thread is woken for each piece.
const PIECE: u64 = 256 << 10;

/// What is in memory, in one piece.
pub(super) fn of(bytes: &Bytes, range: Range<u64>) -> ByteStream {
    let at = |offset: u64| usize::try_from(offset).unwrap_or(usize::MAX).min(bytes.len());
    futures_util::stream::once(std::future::ready(Ok(bytes.slice(at(range.start)..at(range.end))))).boxed()
}

/// What was opened.
pub(super) fn read(store: Store, name: Name, opened: GetResult) -> ByteStream {
    match opened.payload {
        GetResultPayload::File(file, _) => {
            let pieces = futures_util::stream::try_unfold((Some(file), opened.range), |(file, range)| async move {
                let Some(file) = file.filter(|_| !range.is_empty()) else { return Ok(None) };
                let read = spawn_blocking(move || piece(file, range)).await.unwrap_or_else(|e| Err(e.into()));
                read.map(|(bytes, file, rest)| Some((bytes, (Some(file), rest))))
            });
            pieces.map_err(move |e: io::Error| store.0.backend.fail("read", &name.to_string(), &e)).boxed()
        }
        GetResultPayload::Stream(pieces) => {
            pieces.map_err(move |e| store.0.backend.fail("read", &name.to_string(), &e)).boxed()
        }
    }
}

/// The first piece of a range, and what is left of it.
fn piece(mut file: File, range: Range<u64>) -> io::Result<(Bytes, File, Range<u64>)> {
    let end = range.end.min(range.start + PIECE);
    let mut bytes = vec![0; usize::try_from(end - range.start).map_err(io::Error::other)?];
    file.seek(SeekFrom::Start(range.start))?;
    file.read_exact(&mut bytes)?;
    Ok((bytes.into(), file, end..range.end))
}
