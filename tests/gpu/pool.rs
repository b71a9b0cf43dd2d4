//! Device pool with fake devices: distribution of jobs, shared submissions, retries and failures.

use crate::gpu_fakes;

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use gpu_fakes::Step::{Block, Fail, Finish, Hang, Lose, OmitResult, OutOfMemory, Panic};
use gpu_fakes::{
    FakeDevice, LOST, Running, SETTINGS, devices, job, lack_of_memory, pool, start, wait_for, wait_for_load,
};
use molmesh::gpu::{DevicePool, GpuError, MAX_REBUILDS, PoolSettings};
use molmesh::surface::SurfaceError;

const CANCELLED: GpuError = GpuError::Surface(SurfaceError::Cancelled);

fn join_all(running: Vec<Running>) -> Vec<String> {
    running.into_iter().map(|job| job.join().unwrap().unwrap()).collect()
}

/// Returns the calls of `n` small jobs that wait behind a blocked one, and the number of shared submissions.
fn calls_behind_a_slow_job(batch: usize, n: usize) -> (Vec<usize>, u64) {
    let fake = FakeDevice::new(&[Block, Finish]);
    let pool = pool(std::slice::from_ref(&fake), PoolSettings { batch, ..SETTINGS });
    let mut ran = vec![start(&pool, &job(1))];
    wait_for("the first job to run", || fake.calls() == [1]);
    ran.extend((0..n).map(|_| start(&pool, &job(1))));
    wait_for_load(&pool, 0, n + 1);
    fake.release();
    join_all(ran);
    let status = pool.status().remove(0);
    assert_eq!((status.finished, status.waiting), (n as u64 + 1, 0));
    assert!(!status.busy.is_zero());
    (fake.calls(), status.shared)
}

#[test]
fn small_jobs_share_a_submission() {
    assert_eq!(calls_behind_a_slow_job(16, 10), (vec![1, 10], 1));
    assert_eq!(calls_behind_a_slow_job(4, 10), (vec![1, 4, 4, 2], 3));
    // Negative control: one by one without sharing.
    assert_eq!(calls_behind_a_slow_job(1, 3), (vec![1, 1, 1, 1], 0));
}

#[test]
fn an_idle_device_releases_memory() {
    let fake = FakeDevice::new(&[Finish]);
    let pool_at = |idle| pool(std::slice::from_ref(&fake), PoolSettings { idle, ..SETTINGS });
    let releases = || fake.idle_releases.load(Ordering::SeqCst);
    // Negative control: without an idle time the memory is kept.
    let busy = pool_at(Duration::MAX);
    busy.run(&job(1)).unwrap();
    std::thread::sleep(Duration::from_millis(50));
    assert_eq!((releases(), busy.status()[0].held_bytes), (0, 4096));
    drop(busy);
    let idle = pool_at(Duration::from_millis(5));
    wait_for("a release", || releases() > 0);
    wait_for("its memory to be recorded", || idle.status()[0].held_bytes == 1024);
    // It runs another job and releases memory again.
    assert_eq!(idle.run(&job(1)).unwrap().device(), "fake 0");
    let before = releases();
    wait_for("another release", || releases() > before);
}

#[test]
fn a_service_reserves_readback_memory_before_the_first_job() {
    for readback_bytes in [None, Some(1 << 20)] {
        let fake = FakeDevice::new(&[Finish]);
        let pool = pool(std::slice::from_ref(&fake), PoolSettings { readback_bytes, ..SETTINGS });
        pool.run(&job(1)).unwrap();
        assert_eq!(*fake.reserved.lock().unwrap(), readback_bytes.map(|bytes| (bytes, 0)));
    }
}

#[test]
fn a_large_job_runs_alone_and_keeps_its_place() {
    let fake = FakeDevice::new(&[Block, Finish]);
    let pool = pool(std::slice::from_ref(&fake), SETTINGS);
    let mut ran = vec![start(&pool, &job(1))];
    wait_for("the first job to run", || fake.calls() == [1]);
    for (waiting, atoms) in [(2, 2), (3, 6_000), (4, 3), (5, 7_000), (6, 4)] {
        ran.push(start(&pool, &job(atoms)));
        wait_for_load(&pool, 0, waiting);
    }
    fake.release();
    join_all(ran);
    assert_eq!(fake.atoms(), [vec![1], vec![2, 3, 4], vec![6_000], vec![7_000]]);
}

#[test]
fn jobs_go_to_the_least_loaded_device() {
    let fakes = [FakeDevice::new(&[Block, Finish]), FakeDevice::new(&[Block, Finish])];
    let pool = pool(&fakes, SETTINGS);
    let mut ran = vec![start(&pool, &job(6_000))];
    wait_for_load(&pool, 0, 1);
    // A large job is a larger load than several small ones.
    for load in 1..=3 {
        ran.push(start(&pool, &job(1)));
        wait_for_load(&pool, 1, load);
    }
    assert_eq!(pool.status()[0].waiting, 1);
    ran.push(start(&pool, &job(6_000)));
    wait_for_load(&pool, 1, 4);
    ran.push(start(&pool, &job(1)));
    wait_for_load(&pool, 0, 2);
    for fake in &fakes {
        fake.release();
    }
    let devices = join_all(ran);
    assert_eq!(devices, ["fake 0", "fake 1", "fake 1", "fake 1", "fake 1", "fake 0"]);
}

#[test]
fn idle_devices_take_turns() {
    let fakes = [FakeDevice::new(&[]), FakeDevice::new(&[]), FakeDevice::new(&[])];
    let pool = pool(&fakes, SETTINGS);
    for _ in 0..9 {
        pool.run(&job(1)).unwrap();
    }
    assert_eq!(fakes.each_ref().map(|fake| fake.calls().len()), [3, 3, 3]);
}

#[test]
fn a_full_queue_makes_callers_wait() {
    let fake = FakeDevice::new(&[Block, Finish]);
    let pool = pool(std::slice::from_ref(&fake), PoolSettings { queue: 2, batch: 1, ..SETTINGS });
    let mut ran = vec![start(&pool, &job(1))];
    wait_for("the first job to run", || fake.calls() == [1]);
    ran.extend((0..2).map(|_| start(&pool, &job(1))));
    wait_for_load(&pool, 0, 3);
    let (last, cancelled) = (start(&pool, &job(1)), job(1));
    let left = start(&pool, &cancelled);
    std::thread::sleep(Duration::from_millis(50));
    assert_eq!(pool.status()[0].waiting, 3, "more than two wait");
    cancelled.cancel.cancel();
    assert_eq!(left.join().unwrap().unwrap_err(), CANCELLED);
    let mut late = job(1);
    late.deadline = Some(Instant::now() + Duration::from_millis(20));
    assert_eq!(pool.run(&late).map(|_| ()).unwrap_err(), GpuError::Surface(SurfaceError::Deadline));
    assert!(!last.is_finished());
    fake.release();
    ran.push(last);
    join_all(ran);
    assert_eq!(fake.calls().len(), 4);
}

#[test]
fn a_job_is_cancelled_while_it_waits_and_while_it_runs() {
    let fake = FakeDevice::new(&[Block, Finish]);
    let pool = pool(std::slice::from_ref(&fake), SETTINGS);
    let (running, waiting) = (job(1), job(2));
    let first = start(&pool, &running);
    wait_for("the first job to run", || fake.calls() == [1]);
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
    assert_eq!(fake.atoms(), [[1], [3]], "the one that waited never ran");
    assert_eq!((status.finished, status.failed, status.rebuilds, status.down), (1, 0, 0, None));
}

#[test]
fn a_deadline_ends_a_job_while_it_waits_and_while_it_runs() {
    let fake = FakeDevice::new(&[Block, Finish]);
    let pool = pool(std::slice::from_ref(&fake), SETTINGS);
    let within = |atoms, ms| {
        let mut job = job(atoms);
        job.deadline = Some(Instant::now() + Duration::from_millis(ms));
        job
    };
    let started = Instant::now();
    let first = start(&pool, &within(1, 200));
    wait_for("the first job to run", || fake.calls() == [1]);
    let ran = [first, start(&pool, &within(2, 30))];
    for job in ran {
        assert_eq!(job.join().unwrap().unwrap_err(), GpuError::Surface(SurfaceError::Deadline));
    }
    assert!(started.elapsed() >= Duration::from_millis(200));
    wait_for_load(&pool, 0, 0);
    // A job that is late from the start does not run.
    let mut late = job(3);
    late.deadline = Some(started);
    assert_eq!(pool.run(&late).map(|_| ()).unwrap_err(), GpuError::Surface(SurfaceError::Deadline));
    pool.run(&job(4)).unwrap();
    assert_eq!(fake.atoms(), [[1], [4]]);
}

#[test]
fn a_failed_device_is_rebuilt_and_its_job_is_retried() {
    for fault in [Lose, Fail, Panic, OmitResult] {
        let fake = FakeDevice::new(&[fault, Finish]);
        let pool = pool(std::slice::from_ref(&fake), SETTINGS);
        pool.run(&job(1)).unwrap();
        let status = pool.status().remove(0);
        assert_eq!(fake.calls(), [1, 1], "{fault:?}");
        assert_eq!((status.finished, status.failed, status.rebuilds, status.lost), (1, 1, 1, 1), "{fault:?}");
        assert_eq!((fake.builds.load(Ordering::SeqCst), fake.drops.load(Ordering::SeqCst)), (2, 1), "{fault:?}");
    }
}

#[test]
fn jobs_that_failed_together_are_retried_one_by_one() {
    let fake = FakeDevice::new(&[Block, Lose, Finish]);
    let pool = pool(std::slice::from_ref(&fake), SETTINGS);
    let mut ran = vec![start(&pool, &job(1))];
    wait_for("the first job to run", || fake.calls() == [1]);
    ran.extend((0..5).map(|_| start(&pool, &job(1))));
    wait_for_load(&pool, 0, 6);
    fake.release();
    join_all(ran);
    assert_eq!(fake.calls(), [1, 5, 1, 1, 1, 1, 1]);
}

#[test]
fn a_device_that_keeps_failing_is_given_up() {
    let fakes = [FakeDevice::new(&[Lose]), FakeDevice::new(&[Finish])];
    let pool = pool(&fakes, SETTINGS);
    for _ in 0..6 {
        let device = pool.run(&job(1)).unwrap().device();
        assert_eq!(device, "fake 1");
    }
    let status = pool.status();
    let why = status[0].down.as_deref().unwrap();
    assert!(why.contains("3 rebuilds") && why.contains("scripted"), "{why}");
    // The first executor and each rebuilt one failed one job.
    assert_eq!(status[0].rebuilds, MAX_REBUILDS as u64);
    assert_eq!(fakes[0].calls().len(), MAX_REBUILDS + 1);
    assert_eq!((status[1].finished, status[1].rebuilds, &status[1].down), (6, 0, &None));
    // The last failure is not followed by a rebuild.
    assert_eq!((status[0].lost, status[1].lost), (MAX_REBUILDS as u64 + 1, 0));
}

#[test]
fn a_finished_job_resets_the_count_of_rebuilds() {
    let fake = FakeDevice::new(&[Lose, Finish, Lose, Finish, Lose, Finish, Lose, Finish, Lose, Finish]);
    let pool = pool(std::slice::from_ref(&fake), SETTINGS);
    for _ in 0..5 {
        pool.run(&job(1)).unwrap();
    }
    let status = pool.status().remove(0);
    assert_eq!((status.rebuilds, status.finished, status.down), (5, 5, None));
}

#[test]
fn the_error_of_a_job_takes_precedence_over_the_reasons_of_devices() {
    let fake = FakeDevice::new(&[Lose]);
    let pool = pool(std::slice::from_ref(&fake), SETTINGS);
    // Two attempts each; the device is down after the fourth loss.
    for _ in 0..2 {
        assert_eq!(pool.run(&job(1)).map(|_| ()).unwrap_err(), GpuError::Lost(LOST.to_owned()));
    }
    let error = pool.run(&job(1)).map(|_| ()).unwrap_err().to_string();
    assert!(error.contains("no device is up") && error.contains("0 fake 0: down after 3"), "{error}");
}

#[test]
fn a_device_that_cannot_be_rebuilt_is_given_up() {
    let fakes = [FakeDevice::building(&[Lose], 1), FakeDevice::new(&[])];
    let pool = pool(&fakes, SETTINGS);
    let device = pool.run(&job(1)).unwrap().device();
    assert_eq!(device, "fake 1");
    wait_for("the first device to be given up", || pool.status()[0].down.is_some());
    assert_eq!(fakes[0].builds.load(Ordering::SeqCst), 1 + MAX_REBUILDS);
    assert!(pool.status()[0].down.as_deref().unwrap().contains("scripted build failure"), "{:?}", pool.status()[0]);
}

#[test]
fn a_device_that_cannot_be_built_is_down_from_the_start() {
    let fakes = [FakeDevice::building(&[], 0), FakeDevice::new(&[])];
    let running = pool(&fakes, SETTINGS);
    let status = running.status();
    assert!(
        status[0].down.as_deref().unwrap().contains("scripted build failure") && status[1].down.is_none(),
        "{status:?}"
    );
    let none = DevicePool::start(devices(&[FakeDevice::building(&[], 0), FakeDevice::building(&[], 0)]), &SETTINGS)
        .err()
        .unwrap();
    let GpuError::NoDevice(why) = none else { panic!("{none}") };
    assert!(why.contains("0 fake 0: ") && why.contains("1 fake 1: "), "{why}");
    assert!(DevicePool::start(Vec::new(), &SETTINGS).is_err());
}

#[test]
fn a_lack_of_memory_does_not_discard_the_executor() {
    let fake = FakeDevice::new(&[OutOfMemory, Finish]);
    let pool = pool(std::slice::from_ref(&fake), SETTINGS);
    let error = pool.run(&job(1)).map(|_| ()).unwrap_err();
    assert_eq!(error, GpuError::OutOfMemory(Box::new(lack_of_memory())));
    pool.run(&job(1)).unwrap();
    assert_eq!((fake.calls().len(), pool.status()[0].rebuilds), (2, 0));
}

#[test]
fn a_dropped_pool_joins_its_threads() {
    let fakes = [FakeDevice::new(&[]), FakeDevice::new(&[Block])];
    let running = pool(&fakes, SETTINGS);
    let mut held = job(6_000);
    held.deadline = Some(Instant::now() + Duration::from_millis(80));
    running.run(&job(1)).unwrap();
    assert_eq!(running.run(&held).map(|_| ()).unwrap_err(), GpuError::Surface(SurfaceError::Deadline));
    assert_eq!(running.status()[0].held_bytes, 4096);
    drop(Arc::into_inner(running).unwrap());
    // Each thread owns its executor, so the threads have ended.
    assert_eq!(fakes.each_ref().map(|fake| fake.drops.load(Ordering::SeqCst)), [1, 1]);
}

#[test]
fn a_hung_device_is_taken_out_and_its_job_retried() {
    let fakes = [FakeDevice::new(&[Hang]), FakeDevice::new(&[])];
    let hang_timeout = Duration::from_millis(50);
    let pool = pool(&fakes, PoolSettings { hang_timeout, ..SETTINGS });
    let begun = Instant::now();
    // The first job hangs on the first device; the others run on the second one.
    let first = start(&pool, &job(1));
    wait_for("the first job to run", || fakes[0].calls() == [1]);
    for _ in 0..3 {
        assert_eq!(pool.run(&job(1)).unwrap().device(), "fake 1");
    }
    assert_eq!(first.join().unwrap().unwrap(), "fake 1");
    assert!(begun.elapsed() >= hang_timeout);
    let status = pool.status().remove(0);
    let why = status.down.unwrap();
    assert!(why.contains("hung") && why.contains("150 ms"), "{why}");
    assert_eq!((status.hung, status.lost, status.finished, status.waiting), (1, 0, 0, 0));
    // A result that comes later is dropped with the executor.
    fakes[0].release();
    wait_for("the old thread to end", || fakes[0].drops.load(Ordering::SeqCst) == 1);
    let status = pool.status().remove(0);
    assert_eq!((status.finished, status.down.is_some(), fakes[0].calls().len()), (0, true, 1));
}

#[test]
fn a_device_that_hangs_while_it_is_rebuilt_is_taken_out() {
    let fakes = [FakeDevice::hanging_in_build(&[Lose], 1), FakeDevice::new(&[])];
    let pool = pool(&fakes, PoolSettings { hang_timeout: Duration::from_millis(50), ..SETTINGS });
    // The retry waits for the device until the rebuild has taken too long.
    assert_eq!(pool.run(&job(1)).unwrap().device(), "fake 1");
    let status = pool.status().remove(0);
    assert!(status.down.unwrap().contains("hung") && status.hung == 1 && status.waiting == 0);
    fakes[0].release();
}

#[test]
fn a_device_that_hangs_while_it_is_built_is_left_out() {
    let settings = PoolSettings { hang_timeout: Duration::from_millis(50), ..SETTINGS };
    let fakes = [FakeDevice::hanging_in_build(&[], 0), FakeDevice::new(&[])];
    let begun = Instant::now();
    let started = pool(&fakes, settings);
    assert!(begun.elapsed() >= 3 * settings.hang_timeout, "a build has more time than a submission");
    assert_eq!(started.run(&job(1)).unwrap().device(), "fake 1");
    let status = started.status().remove(0);
    let why = status.down.unwrap();
    assert!(why.contains("hung") && why.contains("150 ms") && status.hung == 1, "{why}");
    let ending = Instant::now();
    drop(Arc::into_inner(started).unwrap());
    assert!(ending.elapsed() < Duration::from_secs(10), "it waits for the hung thread");
    assert_eq!(fakes[0].drops.load(Ordering::SeqCst), 0, "it did not hang");
    fakes[0].release();
    // Without another device there is no pool, and the reason is given.
    let alone = FakeDevice::hanging_in_build(&[], 0);
    let failed = DevicePool::start(devices(std::slice::from_ref(&alone)), &settings).map(|_| ()).unwrap_err();
    assert!(matches!(&failed, GpuError::NoDevice(why) if why.contains("the device hung")), "{failed}");
    alone.release();
}

#[test]
fn a_device_that_hung_while_it_was_built_is_built_again() {
    let fakes = [FakeDevice::hanging_in_build(&[], 0), FakeDevice::new(&[])];
    let times = [50, 20].map(Duration::from_millis);
    let pool = pool(&fakes, PoolSettings { hang_timeout: times[0], cool_down: times[1], ..SETTINGS });
    wait_for("the device to be up", || pool.status()[0].down.is_none());
    assert_eq!((pool.status()[0].hung, fakes[0].builds.load(Ordering::SeqCst)), (1, 2));
    // The end of the first build, after its time limit, has no effect.
    fakes[0].release();
    wait_for("the old thread to end", || fakes[0].drops.load(Ordering::SeqCst) == 1);
    assert_eq!(pool.status()[0].down, None);
}

#[test]
fn a_slow_device_that_submits_is_not_hung() {
    let fake = FakeDevice::new(&[Block, Finish]);
    let pool = pool(std::slice::from_ref(&fake), PoolSettings { hang_timeout: Duration::from_millis(300), ..SETTINGS });
    let running = start(&pool, &job(1));
    wait_for("the job to run", || fake.calls() == [1]);
    let begun = Instant::now();
    while begun.elapsed() < Duration::from_millis(900) {
        fake.submissions.fetch_add(1, Ordering::Relaxed);
        std::thread::sleep(Duration::from_millis(5));
    }
    assert_eq!(pool.status()[0].down, None);
    fake.release();
    assert_eq!(running.join().unwrap().unwrap(), "fake 0");
}

#[test]
fn a_job_that_hangs_everywhere_leaves_devices_to_others() {
    let fakes = [(); 3].map(|()| FakeDevice::new(&[Hang]));
    let pool = pool(&fakes, PoolSettings { hang_timeout: Duration::from_millis(30), ..SETTINGS });
    let error = pool.run(&job(1)).map(|_| ()).unwrap_err();
    assert_eq!(error, GpuError::Hung { after_ms: 90 });
    assert_eq!(pool.status().iter().filter(|device| device.down.is_some()).count(), 2);
    for fake in &fakes {
        fake.release();
    }
}

#[test]
fn a_device_is_used_again_after_its_cool_down() {
    let settings =
        PoolSettings { hang_timeout: Duration::from_millis(50), cool_down: Duration::from_millis(100), ..SETTINGS };
    let fake = FakeDevice::new(&[Hang, Finish]);
    let hung = pool(std::slice::from_ref(&fake), settings);
    let begun = Instant::now();
    assert_eq!(hung.run(&job(1)).map(|_| ()).unwrap_err(), GpuError::Hung { after_ms: 150 });
    wait_for("the device to be up", || hung.status()[0].down.is_none());
    assert!(begun.elapsed() >= settings.hang_timeout + settings.cool_down);
    // The first thread still hangs.
    assert_eq!((hung.run(&job(1)).unwrap().device().as_str(), fake.drops.load(Ordering::SeqCst)), ("fake 0", 0));
    let status = hung.status().remove(0);
    assert_eq!((status.hung, status.rebuilds, status.finished), (1, 1, 1));
    fake.release();
    // A device that failed too often returns as well.
    let fake = FakeDevice::new(&[Lose, Lose, Lose, Lose, Finish]);
    let given_up = pool(std::slice::from_ref(&fake), settings);
    for _ in 0..2 {
        given_up.run(&job(1)).map(|_| ()).unwrap_err();
    }
    wait_for("the device to be up", || given_up.status()[0].down.is_none());
    given_up.run(&job(1)).unwrap();
}

#[test]
fn each_cool_down_is_longer() {
    let fake = FakeDevice::building(&[Lose], 1);
    let settings = PoolSettings { cool_down: Duration::from_millis(10), ..SETTINGS };
    let pool = pool(std::slice::from_ref(&fake), settings);
    assert!(pool.run(&job(1)).is_err());
    wait_for("three cool-downs", || fake.builds.load(Ordering::SeqCst) > MAX_REBUILDS + 3);
    std::thread::sleep(Duration::from_secs(1));
    // Pauses of 10 ms would allow a hundred builds by now.
    assert!(fake.builds.load(Ordering::SeqCst) < MAX_REBUILDS + 15);
}

#[test]
fn a_pool_with_a_hung_device_ends_in_bounded_time() {
    for is_noticed in [false, true] {
        let fake = FakeDevice::new(&[Hang]);
        let hang_timeout = Duration::from_millis(if is_noticed { 30 } else { 200 });
        let pool = pool(std::slice::from_ref(&fake), PoolSettings { hang_timeout, ..SETTINGS });
        let mut job = job(1);
        job.deadline = Some(Instant::now() + Duration::from_millis(if is_noticed { 20_000 } else { 10 }));
        let error = pool.run(&job).map(|_| ()).unwrap_err();
        assert_eq!(matches!(error, GpuError::Hung { .. }), is_noticed, "{error}");
        let begun = Instant::now();
        drop(Arc::into_inner(pool).unwrap());
        assert!(begun.elapsed() < Duration::from_secs(10), "{:?}", begun.elapsed());
        assert_eq!(fake.drops.load(Ordering::SeqCst), 0, "it did not hang");
        fake.release();
    }
}
