//! Overlap of jobs: a device begins the next job while the results of the current one are transferred.

#![expect(clippy::unwrap_used, reason = "tests may panic")]

use crate::gpu_fakes;
use crate::gpu_support;

use std::sync::Mutex;

use gpu_fakes::Step::{Block, Finish, Lose};
use gpu_fakes::{FakeDevice, SETTINGS, pool, start, wait_for, wait_for_load};
use gpu_support::{Random, SURFACES, engine_with, params, run, sample, spheres};
use molmesh::gpu::{DeviceLimits, Engine, Executor, GpuError, GpuJob, NextJob};
use molmesh::surface::CancelToken;

/// Returns `job` at the first call.
fn once(job: &GpuJob) -> NextJob {
    let job = Mutex::new(Some(job.clone()));
    Box::new(move || job.lock().unwrap().take())
}

/// Two jobs that are counted first, and one that is not.
fn jobs() -> [GpuJob; 3] {
    let params = params(SURFACES[0], 0.5);
    let cloud = spheres(&Random(7).cloud(400, 20.0));
    [sample("1crn.cif"), cloud, spheres(&[[0.0, 0.0, 0.0, 1.7]])].map(|spheres| gpu_support::job(&spheres, &params))
}

/// Limit of the output of a small job that only the last of [`jobs`] keeps.
const SMALL_BYTES: u64 = 500_000;

fn engine(memory: Option<u64>) -> Engine {
    engine_with(|b| {
        (b.small_bytes, b.idle_bytes) = (SMALL_BYTES, [1 << 30, 0]);
        b.memory = memory.unwrap_or(b.memory);
    })
}

#[test]
fn the_next_job_is_submitted_before_the_results_of_the_first_are_collected() {
    let jobs = jobs();
    let alone = jobs.each_ref().map(|job| {
        let mut engine = engine(None);
        (run(&mut engine, job).unwrap().meshed.mesh, engine.submissions())
    });
    let mut both = engine(None);
    both.set_next_job(once(&jobs[1]));
    for n in 0..2 {
        assert!(run(&mut both, &jobs[n]).unwrap().meshed.mesh == alone[n].0, "{n}");
        let ahead = u64::from(n == 0);
        assert_eq!(both.submissions(), alone[..=n].iter().map(|(_, n)| n).sum::<u64>() + ahead, "{n}");
    }
    // The results of the first job have not been collected when the second one is requested: it fails with the device.
    let (device, queue) = gpu_support::device();
    let budget = DeviceLimits { small_bytes: SMALL_BYTES, ..DeviceLimits::of(&device.limits()) };
    let mut lost = Engine::with_budget(device.clone(), queue, budget).unwrap();
    lost.set_next_job(Box::new(move || {
        device.destroy();
        None
    }));
    assert!(matches!(run(&mut lost, &jobs[0]), Err(GpuError::Lost(_))));
}

#[test]
fn a_job_is_not_begun_if_it_is_small_cancelled_or_exceeds_the_memory() {
    let jobs = jobs();
    let submissions = |memory, next: &GpuJob| {
        let mut engine = engine(memory);
        engine.set_next_job(once(next));
        run(&mut engine, &jobs[0]).unwrap();
        engine.submissions()
    };
    let mut alone = engine(None);
    let cases = alone.held_bytes();
    run(&mut alone, &jobs[0]).unwrap();
    alone.release_idle_memory();
    let (workspace, expected) = (alone.held_bytes() - cases, alone.submissions());
    assert_eq!(submissions(None, &jobs[1]), expected + 1, "control");
    assert_eq!(submissions(Some(workspace), &jobs[1]), expected, "the memory suffices for one job");
    assert_eq!(submissions(None, &jobs[2]), expected, "small");
    let cancelled = GpuJob { cancel: CancelToken::default(), ..jobs[1].clone() };
    cancelled.cancel.cancel();
    assert_eq!(submissions(None, &cancelled), expected, "cancelled");
}

#[test]
fn a_job_that_was_begun_may_be_discarded() {
    let jobs = jobs();
    let expected = run(&mut engine(None), &jobs[2]).unwrap().meshed.mesh;
    let mut engine = engine(None);
    engine.set_next_job(once(&jobs[1]));
    drop(run(&mut engine, &jobs[0]).unwrap());
    let held = engine.held_bytes();
    // Another job comes first; the workspaces are reused.
    assert!(run(&mut engine, &jobs[2]).unwrap().meshed.mesh == expected);
    assert!(run(&mut engine, &jobs[1]).is_ok());
    engine.release_idle_memory();
    assert!(engine.held_bytes() <= held + (4 << 20), "{} {held}", engine.held_bytes());
}

#[test]
fn a_device_knows_the_next_large_job() {
    let fake = FakeDevice::new(&[Block]);
    let pool = pool(std::slice::from_ref(&fake), SETTINGS);
    let next = || fake.next_job().map(|job| job.prepared.lattice.atoms.len());
    let [first, mut second, third] = [6000, 7000, 1].map(gpu_fakes::job);
    second.cancel = CancelToken::default();
    let mut running = vec![start(&pool, &first)];
    wait_for("the first job to run", || fake.calls() == [1]);
    assert_eq!(next(), None, "no job waits");
    let waiting = start(&pool, &second);
    wait_for_load(&pool, 0, 2);
    assert_eq!(next(), Some(7000));
    running.push(start(&pool, &third));
    wait_for_load(&pool, 0, 3);
    assert_eq!(next(), Some(7000), "the order of the queue");
    second.cancel.cancel();
    assert!(waiting.join().unwrap().is_err());
    assert_eq!(next(), None, "small jobs share a submission");
    fake.release();
    for job in running {
        assert!(job.join().unwrap().is_ok());
    }
}

#[test]
fn a_job_that_has_failed_runs_alone() {
    let fake = FakeDevice::new(&[Lose, Block, Finish]);
    let pool = pool(std::slice::from_ref(&fake), SETTINGS);
    let [first, second] = [6000, 7000].map(gpu_fakes::job);
    let first = start(&pool, &first);
    wait_for("the second attempt", || fake.calls().len() == 2);
    let second = start(&pool, &second);
    wait_for_load(&pool, 0, 2);
    assert!(fake.next_job().is_none());
    fake.release();
    assert!(first.join().unwrap().is_ok() && second.join().unwrap().is_ok());
}
