//! Interleavings of callers and device threads.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use molmesh_surface::{
    CancelToken, Control, DeviceStatus, GridStats, Mesh, MeshOutput, Spheres, SurfaceLimits, SurfaceParams,
};
use molmesh_sync::thread;

use super::device_queue::RunOutcome;
use super::error::GpuError;
use super::executor::Executor;
use super::job::{Finished, GpuJob, JobResult, Prepared};
use super::partition_handle::{PartitionCounts, PartitionHandle};
use super::pool::{DevicePool, PoolDevice};
use super::scheduler::{EnqueueError, PoolSettings, Scheduler};
use super::sheets::SheetBlocks;

/// Number of schedules of a test.
const SCHEDULES: usize = 10_000;

const SETTINGS: PoolSettings = PoolSettings {
    queue: 1,
    batch: 2,
    rebuild_pause: Duration::ZERO,
    idle: Duration::MAX,
    hang_timeout: Duration::MAX,
    cool_down: Duration::MAX,
    readback_bytes: None,
    min_partition_bricks: None,
};

/// Executor that fails until no failures are left. Then it returns empty meshes.
struct Flaky {
    failures: Arc<AtomicUsize>,
}

impl Flaky {
    fn result(&self) -> JobResult {
        let failed = self.failures.fetch_update(Ordering::SeqCst, Ordering::SeqCst, |left| left.checked_sub(1));
        if failed.is_ok() {
            return Err(GpuError::Lost("scripted".to_owned()));
        }
        Ok(Finished {
            meshed: MeshOutput::new(Mesh::default(), GridStats::default()),
            stages: Vec::new(),
            sheets: SheetBlocks::default(),
        })
    }
}

impl Executor for Flaky {
    fn run(&mut self, jobs: &[GpuJob]) -> Vec<JobResult> {
        thread::yield_now();
        jobs.iter().map(|_| self.result()).collect()
    }

    fn run_partition(&mut self, job: &GpuJob, partition: &PartitionHandle) -> JobResult {
        let finished = self.result()?;
        partition.publish(PartitionCounts { vertices: 0, triangles: 0, exported: Arc::new(Vec::new()) });
        partition.await_counts(job)?;
        Ok(finished)
    }

    fn held_bytes(&self) -> u64 {
        0
    }
}

/// Creates a job of several bricks.
fn job() -> GpuJob {
    let x = (0..12).map(|i| 3.0 * f64::from(i)).collect();
    let spheres = Spheres::new(x, vec![0.0; 12], vec![0.0; 12], vec![1.7; 12]).unwrap();
    let (params, limits) = (SurfaceParams::default(), SurfaceLimits::default());
    let prepared = Prepared::new(&spheres, &params, &limits, &Control::default()).unwrap();
    GpuJob { prepared: Arc::new(prepared), cancel: CancelToken::default(), deadline: None }
}

/// Runs `callers` jobs on two devices, of which the first fails `failures` times, and `disturb` at the same time.
/// Checks that every caller gets a mesh. Returns the status of the devices afterwards.
fn run(
    job: &GpuJob,
    callers: usize,
    failures: usize,
    settings: PoolSettings,
    disturb: impl FnOnce(&DevicePool),
) -> Vec<DeviceStatus> {
    let device = |number: usize| {
        let failures = Arc::new(AtomicUsize::new(if number == 0 { failures } else { 0 }));
        let build = move || Ok::<Box<dyn Executor>, GpuError>(Box::new(Flaky { failures: Arc::clone(&failures) }));
        PoolDevice { number, name: format!("device {number}"), build: Box::new(build) }
    };
    let pool = Arc::new(DevicePool::start((0..2).map(device).collect(), &settings).unwrap());
    let threads: Vec<_> = (0..callers)
        .map(|_| {
            let (pool, job) = (Arc::clone(&pool), job.clone());
            thread::spawn(move || pool.run(&job).map(drop))
        })
        .collect();
    disturb(&pool);
    for caller in threads {
        assert_eq!(caller.join().unwrap(), Ok(()));
    }
    pool.status()
}

#[test]
fn every_caller_gets_a_mesh_although_a_device_fails() {
    let job = job();
    molmesh_sync::explore(
        move || {
            let status = run(&job, 3, 2, SETTINGS, |_| {});
            assert_eq!(status.iter().map(|device| device.finished).sum::<u64>(), 3);
            assert!(status.iter().all(|device| device.waiting == 0 && device.down.is_none()));
        },
        SCHEDULES,
    );
}

#[test]
fn every_caller_gets_a_mesh_although_a_device_is_given_up() {
    let job = job();
    molmesh_sync::explore(
        move || {
            let status = run(&job, 3, 0, SETTINGS, |pool| pool.give_up(0, "scripted"));
            assert!(status[0].down.is_some() && status[1].down.is_none() && status[0].waiting == 0);
        },
        SCHEDULES,
    );
}

#[test]
fn every_caller_gets_a_mesh_although_a_running_device_is_considered_hung() {
    let job = job();
    molmesh_sync::explore(
        move || {
            let status = run(&job, 3, 0, SETTINGS, |pool| pool.check_devices(0..1, Duration::ZERO));
            assert!(status.iter().all(|device| device.waiting == 0) && status[1].down.is_none());
            assert_eq!(status[0].hung > 0, status[0].down.is_some());
        },
        SCHEDULES,
    );
}

#[test]
fn a_device_that_hung_is_used_again() {
    let job = job();
    let settings = PoolSettings { cool_down: Duration::ZERO, ..SETTINGS };
    molmesh_sync::explore(
        move || {
            for min_partition_bricks in [None, Some(1)] {
                let settings = PoolSettings { min_partition_bricks, ..settings };
                let status = run(&job, 2, 1, settings, |pool| pool.check_devices(0..1, Duration::ZERO));
                assert!(status.iter().all(|device| device.waiting == 0));
            }
        },
        SCHEDULES,
    );
}

#[test]
fn partitions_of_several_jobs_never_wait_for_each_other() {
    let job = job();
    let settings = PoolSettings { queue: 2, min_partition_bricks: Some(1), ..SETTINGS };
    molmesh_sync::explore(
        move || {
            for failures in [0, 1] {
                let status = run(&job, 2, failures, settings, |_| {});
                assert!(status.iter().all(|device| device.waiting == 0 && device.down.is_none()));
            }
        },
        SCHEDULES,
    );
}

#[test]
fn a_cancelled_job_leaves_no_load() {
    let job = job();
    molmesh_sync::explore(
        move || {
            let scheduler = Arc::new(Scheduler::new(&[(0, "device".to_owned())], SETTINGS));
            let thread = scheduler.begin_thread(0);
            scheduler.mark_up(thread);
            let device = thread::spawn({
                let scheduler = Arc::clone(&scheduler);
                move || {
                    while let Some(batch) = scheduler.next_batch(thread, &Arc::default()) {
                        let results = batch.iter().map(|_| Err(GpuError::Failed("scripted".to_owned()))).collect();
                        let outcome = RunOutcome { time: Duration::ZERO, held_bytes: 0, failed: false, down: None };
                        scheduler.finish_batch(thread, batch, results, outcome);
                    }
                }
            });
            let callers: Vec<_> = (0..2)
                .map(|_| {
                    let (scheduler, job) = (Arc::clone(&scheduler), job.clone());
                    thread::spawn(move || {
                        let job = GpuJob { cancel: CancelToken::default(), ..job };
                        let ticket = loop {
                            match scheduler.enqueue(&job, &[0], 1, Duration::MAX) {
                                Ok(ticket) => break ticket,
                                Err(EnqueueError::Full) => {}
                                Err(EnqueueError::NoDevice(why)) => unreachable!("{why}"),
                            }
                        };
                        job.cancel.cancel();
                        scheduler.cancel(&ticket);
                        // A result, or the end of the channel.
                        drop(ticket.result.recv());
                    })
                })
                .collect();
            for caller in callers {
                caller.join().unwrap();
            }
            scheduler.close();
            device.join().unwrap();
            assert_eq!((scheduler.status()[0].waiting, scheduler.idle_devices()), (0, vec![0]));
        },
        SCHEDULES,
    );
}
