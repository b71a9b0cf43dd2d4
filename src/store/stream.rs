//! Streams of objects.

use std::ops::Range;

use futures_util::{StreamExt as _, TryStreamExt as _};
use object_store::GetResult;

use super::error::StoreError;
use super::handle::Store;
use super::name::Name;
use super::object::{ByteStream, Meta, Pin};

/// Size of the first piece, bytes, which is all the memory that a stalled reader holds.
const FIRST: u64 = 16 << 10;
/// Largest size of later pieces, bytes. Each piece wakes a thread and opens the file.
const PIECE: u64 = 256 << 10;

/// Streams the bytes of `range`, one piece on demand at a time. Between pieces it holds only the pin: no memory, no
/// open file. Each piece is as large as all earlier ones together, from [`FIRST`] to [`PIECE`].
pub(super) fn pieces(pin: Pin, meta: Meta, range: Range<u64>) -> ByteStream {
    let start = range.start;
    futures_util::stream::try_unfold((pin, range), move |(pin, rest)| async move {
        if rest.is_empty() {
            return Ok(None);
        }
        let length = (rest.start - start).clamp(FIRST, PIECE);
        let end = rest.end.min(rest.start + length);
        let piece = pin.store.piece(&pin.name, meta, rest.start..end).await?;
        Ok(Some((piece, (pin, end..rest.end))))
    })
    .boxed()
}

/// Streams the bytes of an object from S3.
pub(super) fn remote(store: Store, name: Name, opened: GetResult) -> ByteStream {
    opened.into_stream().map_err(move |e| store.0.backend.fail_at("read", &name)(e)).boxed()
}

/// Clips a range to `size` bytes.
pub(super) fn within(range: Range<u64>, size: u64) -> Result<Range<u64>, StoreError> {
    if range.start >= range.end.min(size) {
        return Err(StoreError::Range { start: range.start, end: range.end, size });
    }
    Ok(range.start..range.end.min(size))
}
