//! Where the parts of one job meet that several devices make: each says how much it has found, and learns what that makes
//! of the numbers of its vertices and triangles. What a part borrows of a later one's bricks is handed over here, too.

use std::fmt;
use std::ops::Range;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use super::engine::check;
use super::error::GpuError;
use super::executor::GpuJob;
use crate::surface::SharedBytes;
use crate::surface::SurfaceError;
use crate::surface::parts::Part;

/// How often a waiting part looks whether its job is still wanted. What the others say does not wait for it.
const TICK: Duration = Duration::from_millis(5);

/// One part's place in a job that is spread over devices.
#[derive(Clone)]
pub struct Share {
    all: Arc<All>,
    /// Its number among the parts, from 0.
    pub number: usize,
}

/// All parts.
struct All {
    parts: Vec<Part>,
    state: Mutex<State>,
    changed: Condvar,
}

struct State {
    counted: Vec<Option<Counts>>,
    abandoned: bool,
    flat: bool,
}

/// What a part has found.
#[derive(Clone)]
pub(super) struct Counts {
    pub(super) vertices: u64,
    pub(super) triangles: u64,
    /// Records and offsets of the bricks that earlier parts borrow, in the order of [`Share::lends`].
    pub(super) lent: SharedBytes,
}

/// Bricks of a later part, with what their owner knows of them.
pub(super) struct Borrowed {
    pub(super) bricks: Range<u32>,
    /// Where they lie in `lent`, in bricks: the run's first.
    pub(super) at: u64,
    /// How many bricks are lent there.
    pub(super) of: u64,
    pub(super) lent: SharedBytes,
    /// Vertices before their owner's part.
    pub(super) first_vertex: u64,
}

/// What a part learns from the others.
pub(super) struct Numbers {
    /// Vertices and triangles before the part.
    pub(super) first: [u64; 2],
    /// Vertices and triangles of all parts.
    pub(super) total: [u64; 2],
    pub(super) borrowed: Vec<Borrowed>,
}

impl Share {
    /// One for each part, in order.
    #[must_use]
    pub fn among(parts: Vec<Part>) -> Vec<Self> {
        let n = parts.len();
        let state = State { counted: vec![None; n], abandoned: false, flat: false };
        let all = Arc::new(All { parts, state: Mutex::new(state), changed: Condvar::new() });
        (0..n).map(|number| Self { all: Arc::clone(&all), number }).collect()
    }

    /// The part.
    #[must_use]
    pub fn part(&self) -> &Part {
        &self.all.parts[self.number]
    }

    /// Parts that have told what they found.
    #[must_use]
    pub fn n_counted(&self) -> usize {
        self.lock().counted.iter().flatten().count()
    }

    /// The job will not be finished this way: parts that wait for this one, or will, give up.
    pub fn abandon(&self) {
        self.lock().abandoned = true;
        self.all.changed.notify_all();
    }

    /// Fails once the job will not be finished this way.
    ///
    /// # Errors
    /// [`GpuError::Surface`] with [`SurfaceError::Cancelled`].
    pub(super) fn check(&self) -> Result<(), GpuError> {
        if self.lock().abandoned { Err(SurfaceError::Cancelled.into()) } else { Ok(()) }
    }

    /// Runs of this part's bricks that earlier ones borrow, in the order in which they are lent.
    pub(super) fn lends(&self) -> Vec<Range<u32>> {
        self.lent_by(self.number).map(|(_, run)| run).collect()
    }

    /// Runs that part `owner` lends, each with the part that borrows it.
    fn lent_by(&self, owner: usize) -> impl Iterator<Item = (usize, Range<u32>)> {
        let own = self.all.parts[owner].bricks.clone();
        let of = |(k, part): (usize, &'_ Part)| part.borrowed.clone().into_iter().map(move |run| (k, run));
        self.all.parts[..owner].iter().enumerate().flat_map(of).filter(move |(_, run)| own.contains(&run.start))
    }

    /// Tells the others what this part has found.
    pub(super) fn tell(&self, counts: Counts) {
        self.lock().counted[self.number] = Some(counts);
        self.all.changed.notify_all();
    }

    /// Waits until every part has told.
    ///
    /// # Errors
    /// [`GpuError::Surface`] with [`SurfaceError::Cancelled`] if a part will not tell, or nobody wants the job any more;
    /// [`GpuError::Deadline`].
    pub(super) fn hear(&self, job: &GpuJob) -> Result<Numbers, GpuError> {
        let mut state = self.lock();
        loop {
            check(job)?;
            if state.abandoned {
                return Err(SurfaceError::Cancelled.into());
            }
            let all: Option<Vec<Counts>> = state.counted.iter().cloned().collect();
            if let Some(all) = all {
                drop(state);
                return Ok(self.numbers(&all));
            }
            state = self.all.changed.wait_timeout(state, TICK).unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    fn numbers(&self, all: &[Counts]) -> Numbers {
        let before =
            |n: usize| all[..n].iter().fold([0, 0], |[v, t], counts| [v + counts.vertices, t + counts.triangles]);
        let length = |run: &Range<u32>| u64::from(run.end - run.start);
        let mut borrowed = Vec::new();
        for (owner, counts) in all.iter().enumerate().skip(self.number + 1) {
            let of = self.lent_by(owner).map(|(_, run)| length(&run)).sum();
            let mut at = 0;
            for (borrower, bricks) in self.lent_by(owner) {
                let n = length(&bricks);
                if borrower == self.number {
                    let (lent, [first_vertex, _]) = (Arc::clone(&counts.lent), before(owner));
                    borrowed.push(Borrowed { bricks, at, of, lent, first_vertex });
                }
                at += n;
            }
        }
        Numbers { first: before(self.number), total: before(all.len()), borrowed }
    }

    /// Some vertex of this part has no gradient.
    pub(super) fn note_flat(&self) {
        self.lock().flat = true;
    }

    /// Whether some vertex of some part has none.
    pub(super) fn is_flat(&self) -> bool {
        self.lock().flat
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        // No code under the lock can panic half way through a change, so a poisoned state is a sound one.
        self.all.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl fmt::Debug for Share {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Share({} of {})", self.number, self.all.parts.len())
    }
}
