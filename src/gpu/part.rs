//! One part of a job that several devices make: its bricks are counted and its vertices made without the others; its
//! triangles need the numbers of vertices that belong to later parts.

use std::ops::Range;
use std::sync::Arc;

use super::engine::{Engine, Loaded, check};
use super::error::GpuError;
use super::executor::{Finished, GpuJob};
use super::flight::values;
use super::landing::Landing;
use super::output::{failed, narrow};
use super::progress::Progress;
use super::share::{Borrowed, Counts, Share};
use super::submit::Flight;
use crate::surface::layout::Record;
use crate::surface::parts::n_in;
use crate::surface::plan::check_totals;

/// Bytes that are lent of a brick: its record and where its vertices and triangles begin.
const RECORD: u64 = size_of::<Record>() as u64;
const OFFSET: u64 = 8;

/// Bytes of what some runs of bricks lend, in a landing: a mapped range is a multiple of 8 bytes.
fn lent_bytes(runs: &[Range<u32>]) -> u64 {
    (n_in(runs) * (RECORD + OFFSET)).next_multiple_of(8)
}

impl Engine {
    /// Makes the part of `job` that `share` tells.
    pub(super) fn make_part(&mut self, job: &GpuJob, share: &Share) -> Result<Finished, GpuError> {
        check(job)?;
        let chunks = self.chunks(job, Some(share.part()))?;
        let loaded = self.load(job, Some(share.part()), chunks, Self::no_rows())?;
        let mut progress = Progress::new(loaded);
        let result = self.run_part(&mut progress, share);
        self.workspaces.push(progress.loaded.workspace);
        result
    }

    fn run_part(&mut self, progress: &mut Progress<'_>, share: &Share) -> Result<Finished, GpuError> {
        let job = progress.loaded.job;
        let n_chunks = progress.loaded.chunks.len();
        let mut counted = Vec::with_capacity(n_chunks);
        let mut lent = None;
        for chunk in 0..n_chunks {
            check(job)?;
            share.check()?;
            let sent = self.send_count(progress, chunk)?;
            if chunk + 1 == n_chunks {
                lent = Some(self.lend(&progress.loaded, share)?);
            }
            self.settle(progress)?;
            let count = self.take_count(progress, chunk, sent)?;
            // What is too large by itself is refused below, with the numbers of all parts.
            if progress.within_limits(1).is_ok() {
                let pieces = self.pieces(progress, &[(chunk, &count)]);
                self.make_room(progress, &pieces)?;
                self.send_pieces(progress, chunk, &pieces, [true, false])?;
            }
            counted.push(count);
        }
        let lent: Arc<Landing> = match lent {
            Some(flight) => self.land(flight)?.pop().ok_or_else(|| failed("nothing was lent".to_owned()))?,
            None => return Err(failed("a part without bricks".to_owned())),
        };
        let [vertices, triangles] = progress.total;
        share.tell(Counts { vertices, triangles, lent });
        // The vertices are on their way meanwhile.
        let numbers = share.hear(job)?;
        let prepared = &job.prepared;
        let [all_vertices, all_triangles] = numbers.total;
        check_totals(&prepared.lattice, &prepared.params, &prepared.limits, all_vertices, all_triangles)?;
        let base = narrow(numbers.first[0])?;
        for borrowed in &numbers.borrowed {
            self.borrow(&progress.loaded, borrowed, base)?;
        }
        progress.loaded.params.base_vertex = base;
        self.output(progress, &counted, [false, true])?;
        if progress.flat {
            share.note_flat();
        }
        progress.assemble()
    }

    /// Submits the copies of what earlier parts borrow of this one's bricks.
    fn lend(&self, loaded: &Loaded<'_>, share: &Share) -> Result<Flight, GpuError> {
        let runs = share.lends();
        let bytes = lent_bytes(&runs).max(8);
        let landing = self.landings.get(&self.device, bytes);
        let target = landing.buffer().map_err(failed)?;
        let mut recording = self.recording();
        for (name, each, mut at) in [("records", RECORD, 0), ("offsets", OFFSET, RECORD * n_in(&runs))] {
            for run in &runs {
                let (from, n) = (each * u64::from(run.start), each * u64::from(run.end - run.start));
                recording.encoder.copy_buffer_to_buffer(loaded.workspace.buffer(name), from, target, at, n);
                at += n;
            }
        }
        self.launch(recording, vec![(landing, bytes)])
    }

    /// Writes what the owner of some bricks knows of them. Vertices are numbered from `base` on here.
    fn borrow(&self, loaded: &Loaded<'_>, borrowed: &Borrowed, base: u32) -> Result<(), GpuError> {
        let Borrowed { bricks, at, of, lent, first_vertex } = borrowed;
        let (n, first) = (u64::from(bricks.end - bricks.start), u64::from(bricks.start));
        let lent: &[u8] = (**lent).as_ref();
        let records: &[u8] = values(lent, RECORD * at, RECORD * n).map_err(failed)?;
        let offsets: &[[u32; 2]] = values(lent, RECORD * of + OFFSET * at, n).map_err(failed)?;
        // The shader adds the base again; what wraps around here comes back there.
        let step = narrow(*first_vertex)?.wrapping_sub(base);
        let offsets: Vec<[u32; 2]> = offsets.iter().map(|[v, t]| [v.wrapping_add(step), *t]).collect();
        let write = |name: &str, at: u64, bytes: &[u8]| {
            self.queue.write_buffer(loaded.workspace.buffer(name), at, bytes);
        };
        write("records", RECORD * first, records);
        write("offsets", OFFSET * first, bytemuck::cast_slice(&offsets));
        Ok(())
    }
}
