//! Documents about the atoms of a structure: written into memory that is charged before it is allocated.

use std::io::{self, BufWriter, Write};

use bytes::{Bytes, BytesMut};

use super::problem::Problem;
use crate::jobs::{Failure, MemoryReservation};
use crate::pipeline::JobError;
use crate::surface::{Control, MemoryMeter as _, OutOfMemory, SurfaceError};

/// Bytes that are collected for one write.
const BLOCK_BYTES: usize = 64 << 10;

/// Collects the output of `write`, and charges it to `reservation`. Stops when the request is cancelled or the memory
/// budget is used up.
pub(super) fn collect(
    reservation: MemoryReservation,
    control: &Control<'_>,
    write: impl FnOnce(&mut dyn Write) -> io::Result<()>,
) -> Result<Bytes, Problem> {
    // Memory that this request holds elsewhere: the structure and its columns.
    if let Some([_, held]) = control.memory.budget() {
        reservation.also_held(held);
    }
    let mut document = Document { reservation, control, bytes: BytesMut::new() };
    let mut writer = BufWriter::with_capacity(BLOCK_BYTES, &mut document);
    let written = write(&mut writer).and_then(|()| writer.flush());
    // After an error, the rest is not written.
    drop(writer.into_parts());
    written.map_err(problem)?;
    Ok(document.reservation.attach(document.bytes.freeze()))
}

/// Document that is being written.
struct Document<'a> {
    reservation: MemoryReservation,
    control: &'a Control<'a>,
    bytes: BytesMut,
}

impl Write for Document<'_> {
    fn write(&mut self, data: &[u8]) -> io::Result<usize> {
        self.control.check().map_err(io::Error::other)?;
        self.reservation.extend(&mut self.bytes, data, 0).map_err(io::Error::other)?;
        Ok(data.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Converts an error of [`Document`], or of memory that `write` reserved.
fn problem(error: io::Error) -> Problem {
    let error = match error.downcast::<OutOfMemory>() {
        Ok(refused) => return refused.into(),
        Err(error) => error,
    };
    match error.downcast::<SurfaceError>() {
        Ok(error) => Failure::from(JobError::from(error)).into(),
        Err(error) => Problem::internal(error),
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use axum::http::StatusCode;
    use axum::response::IntoResponse as _;

    use super::*;
    use crate::jobs::Budget;
    use crate::surface::CancelToken;

    /// Returns the document of `n` bytes, written in pieces, with a limit of 1 MiB.
    fn written(n: usize, cancel: &CancelToken) -> Result<(Bytes, Budget), Problem> {
        let budget = Budget::new(1 << 20);
        let control = Control { cancel: cancel.clone(), ..Control::default() };
        let write = |out: &mut dyn Write| (0..n).try_for_each(|i| out.write_all(&[i.to_le_bytes()[0]]));
        Ok((collect(budget.reservation(), &control, write)?, budget))
    }

    #[test]
    fn documents_are_charged_and_limited() {
        let (bytes, budget) = written(200_000, &CancelToken::default()).unwrap();
        assert!(bytes.len() == 200_000 && bytes.iter().enumerate().all(|(i, byte)| *byte == i.to_le_bytes()[0]));
        assert!((200_000..=400_000).contains(&budget.used()), "{}", budget.used());
        drop(bytes);
        assert_eq!(budget.used(), 0);
        let refused = written(2 << 20, &CancelToken::default()).unwrap_err();
        assert_eq!(refused.into_response().status(), StatusCode::UNPROCESSABLE_ENTITY);
    }

    #[test]
    fn a_document_that_does_not_fit_beside_its_structure_is_too_large() {
        let budget = Budget::new(1 << 20);
        let columns = Arc::new(budget.reservation());
        columns.grow(700 << 10).unwrap();
        let control = Control { memory: columns, ..Control::default() };
        let collected = collect(budget.reservation(), &control, |out| out.write_all(&vec![7; 400 << 10]));
        assert_eq!(collected.unwrap_err().into_response().status(), StatusCode::UNPROCESSABLE_ENTITY);
    }

    #[test]
    fn cancelled_documents_end() {
        let cancel = CancelToken::default();
        cancel.cancel();
        assert!(written(1 << 10, &cancel).is_err());
    }
}
