//! The device pool with devices that fail on purpose: who gets which job, what shares a submission, what becomes of a
//! job whose device does not survive it.
#![cfg(feature = "gpu")]
#![allow(clippy::unwrap_used, clippy::panic, reason = "tests say what they expect by panicking")]

mod gpu_fakes;

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use gpu_fakes::Step::{Fail, Forget, Hold, Lose, OutOfMemory, Panic, Serve};
use gpu_fakes::{LOST, Ran, Rig, SETTINGS, devices, job, pool, start, wait_for, wait_for_load};
use molmesh::gpu::{DevicePool, GpuError, MOST_REBUILDS, PoolSettings};
use molmesh::surface::SurfaceError;

const CANCELLED: GpuError = GpuError::Surface(SurfaceError::Cancelled);

fn served(ran: Vec<Ran>) -> Vec<String> {
    ran.into_iter().map(|job| job.join().unwrap().unwrap()).collect()
}

/// The calls that `n` small jobs make which all wait behind one that is held.
fn calls_behind_a_slow_job(batch: usize, n: usize) -> (Vec<usize>, u64) {
    let rig = Rig::new(&[Hold, Serve]);
    let pool = pool(std::slice::from_ref(&rig), PoolSettings { batch, ..SETTINGS });
    let mut ran = vec![start(&pool, &job(1))];
    wait_for("the first job to run", || rig.calls() == [1]);
    ran.extend((0..n).map(|_| start(&pool, &job(1))));
    wait_for_load(&pool, 0, n + 1);
    rig.let_go();
    served(ran);
    let status = pool.status().remove(0);
    assert_eq!((status.finished, status.waiting), (n as u64 + 1, 0));
    assert!(!status.busy.is_zero());
    (rig.calls(), status.shared)
}

#[test]
fn small_jobs_share_a_submission() {
    assert_eq!(calls_behind_a_slow_job(16, 10), (vec![1, 10], 1));
    assert_eq!(calls_behind_a_slow_job(4, 10), (vec![1, 4, 4, 2], 3));
    // Without sharing they come one by one: the counts above are not what any pool would give.
    assert_eq!(calls_behind_a_slow_job(1, 3), (vec![1, 1, 1, 1], 0));
}

#[test]
fn a_device_without_work_lets_go_what_it_keeps() {
    let rig = Rig::new(&[Serve]);
    let pool_at = |rest| pool(std::slice::from_ref(&rig), PoolSettings { rest, ..SETTINGS });
    let rests = || rig.rests.load(Ordering::SeqCst);
    // The control: one that waits for ever keeps it.
    let busy = pool_at(Duration::MAX);
    busy.run(&job(1)).unwrap();
    std::thread::sleep(Duration::from_millis(50));
    assert_eq!((rests(), busy.status()[0].held_bytes), (0, 4096));
    drop(busy);
    let idle = pool_at(Duration::from_millis(5));
    wait_for("a rest", || rests() > 0);
    wait_for("its memory to be booked", || idle.status()[0].held_bytes == 1024);
    // It works as before, and rests again.
    assert_eq!(idle.run(&job(1)).unwrap().1, "fake 0");
    let before = rests();
    wait_for("another rest", || rests() > before);
}

#[test]
fn a_large_job_runs_alone_and_keeps_its_place() {
    let rig = Rig::new(&[Hold, Serve]);
    let pool = pool(std::slice::from_ref(&rig), SETTINGS);
    let mut ran = vec![start(&pool, &job(1))];
    wait_for("the first job to run", || rig.calls() == [1]);
    for (waiting, atoms) in [(2, 2), (3, 6_000), (4, 3), (5, 7_000), (6, 4)] {
        ran.push(start(&pool, &job(atoms)));
        wait_for_load(&pool, 0, waiting);
    }
    rig.let_go();
    served(ran);
    assert_eq!(rig.atoms(), [vec![1], vec![2, 3, 4], vec![6_000], vec![7_000]]);
}

#[test]
fn jobs_go_to_the_least_loaded_device() {
    let rigs = [Rig::new(&[Hold, Serve]), Rig::new(&[Hold, Serve])];
    let pool = pool(&rigs, SETTINGS);
    let mut ran = vec![start(&pool, &job(6_000))];
    wait_for_load(&pool, 0, 1);
    // One large job outweighs several small ones.
    for load in 1..=3 {
        ran.push(start(&pool, &job(1)));
        wait_for_load(&pool, 1, load);
    }
    assert_eq!(pool.status()[0].waiting, 1);
    ran.push(start(&pool, &job(6_000)));
    wait_for_load(&pool, 1, 4);
    ran.push(start(&pool, &job(1)));
    wait_for_load(&pool, 0, 2);
    for rig in &rigs {
        rig.let_go();
    }
    let devices = served(ran);
    assert_eq!(devices, ["fake 0", "fake 1", "fake 1", "fake 1", "fake 1", "fake 0"]);
}

#[test]
fn idle_devices_take_turns() {
    let rigs = [Rig::new(&[]), Rig::new(&[]), Rig::new(&[])];
    let pool = pool(&rigs, SETTINGS);
    for _ in 0..9 {
        pool.run(&job(1)).unwrap();
    }
    assert_eq!(rigs.each_ref().map(|rig| rig.calls().len()), [3, 3, 3]);
}

#[test]
fn a_full_queue_makes_callers_wait() {
    let rig = Rig::new(&[Hold, Serve]);
    let pool = pool(std::slice::from_ref(&rig), PoolSettings { queue: 2, batch: 1, ..SETTINGS });
    let mut ran = vec![start(&pool, &job(1))];
    wait_for("the first job to run", || rig.calls() == [1]);
    ran.extend((0..2).map(|_| start(&pool, &job(1))));
    wait_for_load(&pool, 0, 3);
    let (patient, cancelled) = (start(&pool, &job(1)), job(1));
    let left = start(&pool, &cancelled);
    std::thread::sleep(Duration::from_millis(50));
    assert_eq!(pool.status()[0].waiting, 3, "more than two wait");
    cancelled.cancel.cancel();
    assert_eq!(left.join().unwrap().unwrap_err(), CANCELLED);
    let mut late = job(1);
    late.deadline = Some(Instant::now() + Duration::from_millis(20));
    assert_eq!(pool.run(&late).map(|_| ()).unwrap_err(), GpuError::Deadline);
    assert!(!patient.is_finished());
    rig.let_go();
    ran.push(patient);
    served(ran);
    assert_eq!(rig.calls().len(), 4);
}

#[test]
fn a_job_is_cancelled_while_it_waits_and_while_it_runs() {
    let rig = Rig::new(&[Hold, Serve]);
    let pool = pool(std::slice::from_ref(&rig), SETTINGS);
    let (running, waiting) = (job(1), job(2));
    let first = start(&pool, &running);
    wait_for("the first job to run", || rig.calls() == [1]);
    let ran = [first, start(&pool, &waiting)];
    wait_for_load(&pool, 0, 2);
    waiting.cancel.cancel();
    wait_for_load(&pool, 0, 1);
    running.cancel.cancel();
    for job in ran {
        assert_eq!(job.join().unwrap().unwrap_err(), CANCELLED);
    }
    wait_for_load(&pool, 0, 0);
    pool.run(&job(3)).unwrap();
    let status = pool.status().remove(0);
    assert_eq!(rig.atoms(), [[1], [3]], "the one that waited never ran");
    assert_eq!((status.finished, status.failed, status.rebuilds, status.down), (1, 0, 0, None));
}

#[test]
fn a_deadline_ends_a_job_while_it_waits_and_while_it_runs() {
    let rig = Rig::new(&[Hold, Serve]);
    let pool = pool(std::slice::from_ref(&rig), SETTINGS);
    let within = |atoms, ms| {
        let mut job = job(atoms);
        job.deadline = Some(Instant::now() + Duration::from_millis(ms));
        job
    };
    let started = Instant::now();
    let first = start(&pool, &within(1, 200));
    wait_for("the first job to run", || rig.calls() == [1]);
    let ran = [first, start(&pool, &within(2, 30))];
    for job in ran {
        assert_eq!(job.join().unwrap().unwrap_err(), GpuError::Deadline);
    }
    assert!(started.elapsed() >= Duration::from_millis(200));
    wait_for_load(&pool, 0, 0);
    // One whose time is up before it comes does not run at all.
    let mut late = job(3);
    late.deadline = Some(started);
    assert_eq!(pool.run(&late).map(|_| ()).unwrap_err(), GpuError::Deadline);
    pool.run(&job(4)).unwrap();
    assert_eq!(rig.atoms(), [[1], [4]]);
}

#[test]
fn a_lost_device_is_rebuilt_and_its_job_is_done() {
    for fault in [Lose, Fail, Panic, Forget] {
        let rig = Rig::new(&[fault, Serve]);
        let pool = pool(std::slice::from_ref(&rig), SETTINGS);
        pool.run(&job(1)).unwrap();
        let status = pool.status().remove(0);
        assert_eq!(rig.calls(), [1, 1], "{fault:?}");
        assert_eq!((status.finished, status.failed, status.rebuilds, status.lost), (1, 1, 1, 1), "{fault:?}");
        assert_eq!((rig.builds.load(Ordering::SeqCst), rig.drops.load(Ordering::SeqCst)), (2, 1), "{fault:?}");
    }
}

#[test]
fn jobs_that_were_lost_together_are_tried_again_one_by_one() {
    let rig = Rig::new(&[Hold, Lose, Serve]);
    let pool = pool(std::slice::from_ref(&rig), SETTINGS);
    let mut ran = vec![start(&pool, &job(1))];
    wait_for("the first job to run", || rig.calls() == [1]);
    ran.extend((0..5).map(|_| start(&pool, &job(1))));
    wait_for_load(&pool, 0, 6);
    rig.let_go();
    served(ran);
    assert_eq!(rig.calls(), [1, 5, 1, 1, 1, 1, 1]);
}

#[test]
fn a_device_that_keeps_failing_is_given_up_and_the_other_serves() {
    let rigs = [Rig::new(&[Lose]), Rig::new(&[Serve])];
    let pool = pool(&rigs, SETTINGS);
    for _ in 0..6 {
        let (_, device) = pool.run(&job(1)).unwrap();
        assert_eq!(device, "fake 1");
    }
    let status = pool.status();
    let why = status[0].down.as_deref().unwrap();
    assert!(why.contains("3 rebuilds") && why.contains("as told"), "{why}");
    // The first build, then as many rebuilds as are allowed: each has lost one job, and no job goes there any more.
    assert_eq!(status[0].rebuilds, MOST_REBUILDS as u64);
    assert_eq!(rigs[0].calls().len(), MOST_REBUILDS + 1);
    assert_eq!((status[1].finished, status[1].rebuilds, &status[1].down), (6, 0, &None));
    // The last failure has no rebuild any more.
    assert_eq!((status[0].lost, status[1].lost), (MOST_REBUILDS as u64 + 1, 0));
}

#[test]
fn a_finished_job_starts_the_count_anew() {
    let rig = Rig::new(&[Lose, Serve, Lose, Serve, Lose, Serve, Lose, Serve, Lose, Serve]);
    let pool = pool(std::slice::from_ref(&rig), SETTINGS);
    for _ in 0..5 {
        pool.run(&job(1)).unwrap();
    }
    let status = pool.status().remove(0);
    assert_eq!((status.rebuilds, status.finished, status.down), (5, 5, None));
}

#[test]
fn without_a_device_that_is_up_the_reason_is_what_the_job_met_with() {
    let rig = Rig::new(&[Lose]);
    let pool = pool(std::slice::from_ref(&rig), SETTINGS);
    // Two attempts each, until the device is given up at the fourth loss.
    for _ in 0..2 {
        assert_eq!(pool.run(&job(1)).map(|_| ()).unwrap_err(), GpuError::Lost(LOST.to_owned()));
    }
    let error = pool.run(&job(1)).map(|_| ()).unwrap_err().to_string();
    assert!(error.contains("no device is up") && error.contains("0 fake 0: given up after 3"), "{error}");
}

#[test]
fn a_device_that_cannot_be_rebuilt_is_given_up() {
    let rigs = [Rig::building(&[Lose], 1), Rig::new(&[])];
    let pool = pool(&rigs, SETTINGS);
    let (_, device) = pool.run(&job(1)).unwrap();
    assert_eq!(device, "fake 1");
    wait_for("the first device to be given up", || pool.status()[0].down.is_some());
    assert_eq!(rigs[0].builds.load(Ordering::SeqCst), 1 + MOST_REBUILDS);
    assert!(pool.status()[0].down.as_deref().unwrap().contains("no build as told"), "{:?}", pool.status()[0]);
}

#[test]
fn a_device_that_cannot_be_built_is_not_there_from_the_start() {
    let rigs = [Rig::building(&[], 0), Rig::new(&[])];
    let running = pool(&rigs, SETTINGS);
    let status = running.status();
    assert!(status[0].down.as_deref().unwrap().contains("no build as told") && status[1].down.is_none(), "{status:?}");
    let none = DevicePool::start(devices(&[Rig::building(&[], 0), Rig::building(&[], 0)]), &SETTINGS).err().unwrap();
    let GpuError::NoDevice(why) = none else { panic!("{none}") };
    assert!(why.contains("0 fake 0: ") && why.contains("1 fake 1: "), "{why}");
    assert!(DevicePool::start(Vec::new(), &SETTINGS).is_err());
}

#[test]
fn too_little_memory_is_no_defect_of_the_device() {
    let rig = Rig::new(&[OutOfMemory, Serve]);
    let pool = pool(std::slice::from_ref(&rig), SETTINGS);
    let error = pool.run(&job(1)).map(|_| ()).unwrap_err();
    assert_eq!(error, GpuError::OutOfMemory { needed: 9, available: 5, suggested_resolution: 1.5 });
    pool.run(&job(1)).unwrap();
    assert_eq!((rig.calls().len(), pool.status()[0].rebuilds), (2, 0));
}

#[test]
fn a_dropped_pool_joins_its_threads() {
    let rigs = [Rig::new(&[]), Rig::new(&[Hold])];
    let running = pool(&rigs, SETTINGS);
    let mut held = job(6_000);
    held.deadline = Some(Instant::now() + Duration::from_millis(80));
    running.run(&job(1)).unwrap();
    assert_eq!(running.run(&held).map(|_| ()).unwrap_err(), GpuError::Deadline);
    assert_eq!(running.status()[0].held_bytes, 4096);
    drop(Arc::into_inner(running).unwrap());
    // The threads own the executors: those are gone, so these are.
    assert_eq!(rigs.each_ref().map(|rig| rig.drops.load(Ordering::SeqCst)), [1, 1]);
}
