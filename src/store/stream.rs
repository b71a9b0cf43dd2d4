//! Objects in pieces.

use std::ops::Range;

use futures_util::{StreamExt as _, TryStreamExt as _};
use object_store::GetResult;

use super::handle::Store;
use super::name::Name;
use super::object::{ByteStream, Meta, Pin};

/// Bytes of the first piece: all that is held for a reader that takes nothing.
const FIRST: u64 = 16 << 10;
/// Bytes of a later piece, at most: each wakes a thread and opens the file.
const PIECE: u64 = 256 << 10;

/// The bytes of `range`, read piece by piece as they are asked for. Between two pieces nothing is held but the pin: no
/// memory, no open file. A piece is as large as all before it together, from [`FIRST`] to [`PIECE`].
pub(super) fn pieces(pin: Pin, meta: Meta, range: Range<u64>) -> ByteStream {
    let start = range.start;
    futures_util::stream::try_unfold((pin, range), move |(pin, rest)| async move {
        if rest.is_empty() {
            return Ok(None);
        }
        let length = (rest.start - start).clamp(FIRST, PIECE);
        let end = rest.end.min(rest.start + length);
        let piece = pin.piece(meta, rest.start..end).await?;
        Ok(Some((piece, (pin, end..rest.end))))
    })
    .boxed()
}

/// The bytes of an object that a service sends as a stream.
pub(super) fn remote(store: Store, name: Name, opened: GetResult) -> ByteStream {
    opened.into_stream().map_err(move |e| store.0.backend.fail("read", &name.to_string(), &e)).boxed()
}
