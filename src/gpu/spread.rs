//! One large job on several devices: who gets a part, how the parts become one mesh, what becomes of a part that fails.
//!
//! The bricks are cut into as many runs as there are devices. Each device computes its own, tells how many vertices and
//! triangles there are, and makes its vertices; when all have told, each numbers its triangles through. The mesh is that of
//! one device, byte for byte: see [`Share`] for what they tell each other.

use std::sync::mpsc::RecvTimeoutError;

use super::error::GpuError;
use super::executor::{Finished, GpuJob};
use super::pool::{DevicePool, Ran, TICK, Work, over, thread_ended};
use super::queue::{Answer, Place};
use super::share::Share;
use crate::surface::{Column, GridStats, Mesh, MeshOutput, Quantized, Stage, SurfaceError};

/// How many devices of `free` ones make a job of `n_bricks`: as many as get `least` bricks each. 1: it is not spread.
pub(super) fn n_parts(n_bricks: u64, free: usize, least: Option<u64>) -> usize {
    let by_size = least.map_or(1, |least| n_bricks / least.max(1));
    free.min(usize::try_from(by_size).unwrap_or(usize::MAX)).max(1)
}

/// What came of a job that was to be spread.
pub(super) enum Spread {
    Done(Box<Ran>),
    /// The job's own end: its fault, its deadline, its cancellation.
    Over(GpuError),
    /// Devices failed: how often each, by its place in the pool, and the first one's reason.
    Failed(Vec<usize>, GpuError),
    /// It is too small, or fewer than two devices are free.
    No,
}

impl DevicePool {
    /// Makes a large job on the devices that have nothing large to do.
    pub(super) fn spread(&self, job: &GpuJob) -> Spread {
        let free = self.queues.free();
        let plan = &job.prepared.plan;
        let n = n_parts(plan.bricks.len() as u64, free.len(), self.spread_bricks);
        if n < 2 {
            return Spread::No;
        }
        let shares = Share::among(plan.parts(n));
        let (Some(first), true) = (shares.first().cloned(), shares.len() > 1) else { return Spread::No };
        let Some(places) = self.queues.place_parts(job, free.into_iter().zip(shares).collect()) else {
            return Spread::No;
        };
        let answers = self.gather(job, &places, &first);
        let (mut made, mut failures, mut ends) = (Vec::new(), vec![0; self.names.len()], Vec::new());
        let mut why = None;
        for (place, answer) in places.iter().zip(answers) {
            match answer {
                Ok(finished) => made.push((place.lane, finished)),
                Err(error) if error.is_the_devices() => {
                    // One that has too little memory for a part has too little for the whole.
                    let all = matches!(error, GpuError::OutOfMemory { .. });
                    failures[place.lane] = if all { usize::MAX } else { 1 };
                    why.get_or_insert(error);
                }
                Err(error) => ends.push(error),
            }
        }
        if let Err(error) = over(job) {
            return Spread::Over(error);
        }
        if let Some(why) = why {
            return Spread::Failed(failures, why);
        }
        // Parts that were given up for another's sake say that they were cancelled.
        let cancelled = |error: &GpuError| *error == GpuError::Surface(SurfaceError::Cancelled);
        ends.sort_by_key(cancelled);
        match ends.into_iter().next() {
            Some(error) => Spread::Over(error),
            None => Spread::Done(Box::new(self.joined(made, first.is_flat()))),
        }
    }

    /// Waits for every part. Where one fails, the others are told, and waited for all the same: a device that works on has no
    /// time for what comes next. Where nobody wants the job any more, nobody is waited for.
    fn gather(&self, job: &GpuJob, places: &[Place], share: &Share) -> Vec<Answer> {
        let mut answers: Vec<Option<Answer>> = places.iter().map(|_| None).collect();
        loop {
            for (answer, place) in answers.iter_mut().zip(places).filter(|(answer, _)| answer.is_none()) {
                // The first that is missing is waited for, so that the last one is not looked for now and then.
                let result = match place.answer.recv_timeout(TICK) {
                    Ok(result) => result,
                    Err(RecvTimeoutError::Disconnected) => Err(thread_ended()),
                    Err(RecvTimeoutError::Timeout) => continue,
                };
                if result.is_err() {
                    share.abandon();
                }
                *answer = Some(result);
            }
            if answers.iter().all(Option::is_some) {
                break;
            }
            if let Err(error) = over(job) {
                share.abandon();
                for (answer, place) in answers.iter_mut().zip(places).filter(|(answer, _)| answer.is_none()) {
                    self.queues.forget(place);
                    *answer = Some(Err(error.clone()));
                }
                break;
            }
        }
        answers.into_iter().flatten().collect()
    }

    /// The parts, in order, as one mesh.
    fn joined(&self, made: Vec<(usize, Finished)>, flat: bool) -> Ran {
        let mut mesh = Mesh::default();
        let (mut positions, mut normals, mut triangles, mut atom_ids) = (vec![], vec![], vec![], vec![]);
        let (mut step, mut rounded) = (None, (vec![], vec![]));
        let mut grid = GridStats::default();
        let mut by = Vec::with_capacity(made.len());
        let mut before = (0, 0);
        for (lane, Finished { meshed, stages }) in made {
            let part = meshed.mesh;
            mesh.centre = part.centre;
            mesh.parts.extend(part.parts.iter().map(|(v, t)| (before.0 + v, before.1 + t)));
            before = (before.0 + part.n_vertices(), before.1 + part.n_triangles());
            positions.push(part.positions);
            normals.push(part.normals);
            if let Some(quantized) = part.quantized {
                step = Some(quantized.step);
                rounded.0.push(quantized.positions);
                rounded.1.push(quantized.normals);
            }
            triangles.push(part.triangles);
            atom_ids.extend(part.atom_ids);
            let surface_bricks = grid.surface_bricks + meshed.grid.surface_bricks;
            grid = GridStats { surface_bricks, ..meshed.grid };
            by.push(Work { device: self.names[lane].clone(), stages });
        }
        mesh.positions = Column::from_chunks(positions);
        mesh.normals = Column::from_chunks(normals);
        let (rounded_positions, rounded_normals) = (Column::from_chunks(rounded.0), Column::from_chunks(rounded.1));
        mesh.quantized = step.map(|step| Quantized { step, positions: rounded_positions, normals: rounded_normals });
        mesh.triangles = Column::from_chunks(triangles);
        mesh.atom_ids = (!atom_ids.is_empty()).then(|| Column::from_chunks(atom_ids));
        if flat {
            mesh.fill_flat_normals();
        }
        Ran { finished: Finished { meshed: MeshOutput::new(mesh, grid), stages: longest(&by) }, by }
    }
}

/// Per stage the longest time of a device: they run beside one another.
fn longest(by: &[Work]) -> Vec<(Stage, u64)> {
    let mut stages: Vec<(Stage, u64)> = Vec::new();
    for &(stage, ns) in by.iter().flat_map(|work| &work.stages) {
        match stages.iter_mut().find(|(known, _)| *known == stage) {
            Some((_, most)) => *most = ns.max(*most),
            None => stages.push((stage, ns)),
        }
    }
    stages.sort_unstable();
    stages
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_job_is_spread_where_every_device_gets_enough() {
        let parts = |n_bricks, free| n_parts(n_bricks, free, Some(100));
        assert_eq!([parts(0, 4), parts(199, 4), parts(200, 4), parts(350, 4), parts(9000, 4)], [1, 1, 2, 3, 4]);
        assert_eq!([parts(9000, 1), parts(9000, 0), n_parts(1 << 40, 8, None)], [1, 1, 1]);
        assert_eq!(n_parts(5, 3, Some(0)), 3);
    }

    #[test]
    fn the_longest_time_of_a_stage_counts() {
        let work = |stages: &[(Stage, u64)]| Work { device: String::new(), stages: stages.to_vec() };
        let by = [work(&[(Stage::Bin, 5), (Stage::Field, 9)]), work(&[]), work(&[(Stage::Bin, 7), (Stage::Emit, 1)])];
        assert_eq!(longest(&by), [(Stage::Bin, 7), (Stage::Field, 9), (Stage::Emit, 1)]);
    }
}
