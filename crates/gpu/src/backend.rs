//! GPU backend: a device pool behind the `Backend` trait.

use std::sync::Arc;

use molmesh_surface::{
    Backend, BackendIdentity, BackendJob, Control, DeviceStatus, MeshOutput, Spheres, Stage, SurfaceError,
    SurfaceLimits, SurfaceParams, backend::one_atom,
};

use super::device_queue::single_line;
use super::discover::{self, Discovery, arithmetic, describe};
use super::engine::{DeviceLimits, Engine};
use super::error::GpuError;
use super::executor::Executor;
use super::job::{GpuJob, Prepared};
use super::pool::{self, DevicePool, PoolDevice};
use super::scheduler::PoolSettings;

/// Backend that meshes on devices.
pub struct GpuBackend {
    pool: DevicePool,
}

impl GpuBackend {
    /// Builds an engine on every device that `discovery` selected.
    ///
    /// # Errors
    /// [`GpuError::NoDevice`] with the reasons of all devices if none is selected or none could be built.
    pub fn start(discovery: &Discovery, settings: &PoolSettings) -> Result<Self, GpuError> {
        if let Some(why) = discovery.no_device_reason() {
            return Err(GpuError::NoDevice(why));
        }
        let devices = discovery.selected_adapters().map(|(device, adapter)| {
            let (adapter, readback_bytes) = (adapter.clone(), settings.readback_bytes);
            let build = Box::new(move || {
                let (device, queue) = discover::open(&adapter)?;
                let mut budget = DeviceLimits::of(&device.limits());
                if let Some(bytes) = readback_bytes {
                    budget.idle_bytes = [budget.idle_bytes[0].max(bytes), bytes];
                }
                Ok(Box::new(Engine::with_budget(device, queue, budget)?) as Box<dyn Executor>)
            });
            PoolDevice { number: device.number, name: describe(&device.facts), build }
        });
        let devices: Vec<_> = devices.collect();
        // On devices of different models or drivers, the bytes of a mesh would depend on which devices are idle.
        let identical = devices.windows(2).all(|pair| pair[0].name == pair[1].name);
        let min_partition_bricks = settings.min_partition_bricks.filter(|_| identical);
        let pool = DevicePool::start(devices, &PoolSettings { min_partition_bricks, ..*settings })?;
        Ok(Self::with_pool(pool))
    }

    /// Creates a backend with a running pool.
    #[must_use]
    pub const fn with_pool(pool: DevicePool) -> Self {
        Self { pool }
    }

    /// Returns the device pool.
    #[must_use]
    pub const fn pool(&self) -> &DevicePool {
        &self.pool
    }

    fn job(
        spheres: &Spheres,
        params: &SurfaceParams,
        limits: &SurfaceLimits,
        control: &Control<'_>,
    ) -> Result<GpuJob, SurfaceError> {
        let prepared = control.span(Stage::Bin, || Prepared::new(spheres, params, limits, control))?;
        Ok(GpuJob { prepared: Arc::new(prepared), cancel: control.cancel.clone(), deadline: control.deadline })
    }

    /// Meshes one atom on device `n`. Gives up the device if that fails.
    fn warm_device(&self, n: usize) -> Result<(), SurfaceError> {
        let (params, limits) = (SurfaceParams::default(), SurfaceLimits::default());
        let job = Self::job(&one_atom()?, &params, &limits, &Control::default())?;
        if let Err(error) = self.pool.run_on_device(n, &job) {
            self.pool.give_up(n, &format!("its first mesh failed: {error}"));
        }
        Ok(())
    }
}

impl Backend for GpuBackend {
    fn name(&self) -> &'static str {
        "gpu"
    }

    fn arithmetic(&self) -> String {
        let status = self.pool.status();
        let up = status.iter().find(|device| device.down.is_none());
        arithmetic(self.name(), up.map_or("no device", |device| device.name.as_str()))
    }

    fn arithmetics(&self) -> Vec<String> {
        let mut status = self.pool.status();
        // Results of a device that is down stay valid.
        status.sort_by_key(|device| device.down.is_some());
        let mut names: Vec<String> = Vec::new();
        for device in status {
            let name = arithmetic(self.name(), &device.name);
            if !names.contains(&name) {
                names.push(name);
            }
        }
        names
    }

    fn describe(&self) -> String {
        let status = self.pool.status();
        let up: Vec<&str> = status.iter().filter(|d| d.down.is_none()).map(|d| d.name.as_str()).collect();
        pool::describe(&up)
    }

    fn write(&self, job: &BackendJob<'_>) -> Result<MeshOutput, SurfaceError> {
        let BackendJob { spheres, params, limits, control, sink } = *job;
        control.check()?;
        let (metered, memory) = control.with_reservation();
        let gpu_job = Self::job(spheres, params, limits, &metered)?;
        let completed = self.pool.run(&gpu_job).and_then(|mut completed| {
            control.span(Stage::Measure, || completed.finished.measure(&gpu_job.prepared))?;
            Ok(completed)
        });
        let error = match completed {
            Ok(completed) => {
                memory.keep();
                completed.finished.stages.iter().for_each(|(stage, ns)| control.observer.elapsed(*stage, *ns));
                // Only identical devices share a job.
                let device = completed.devices.first().map_or("", |work| work.device.as_str());
                let arithmetic = arithmetic(self.name(), device);
                let made_by = BackendIdentity::new(self.name(), arithmetic, completed.device());
                let output = MeshOutput { made_by: Some(made_by), ..completed.finished.meshed };
                return output.deliver(params, control, sink);
            }
            Err(error) => error,
        };
        Err(match error {
            GpuError::Surface(error) => error,
            GpuError::OutOfMemory(error) => error.into(),
            error => SurfaceError::Device { why: single_line(&error.to_string()) },
        })
    }

    fn warm_up(&self) -> Result<(), SurfaceError> {
        let n_devices = self.pool.status().len();
        std::thread::scope(|scope| {
            let warming: Vec<_> = (0..n_devices).map(|n| scope.spawn(move || self.warm_device(n))).collect();
            warming.into_iter().try_for_each(|thread| thread.join().unwrap_or(Err(SurfaceError::Cancelled)))
        })?;
        if self.pool.status().iter().any(|device| device.down.is_none()) {
            return Ok(());
        }
        Err(SurfaceError::Device { why: self.describe() })
    }

    fn is_available(&self) -> bool {
        self.pool.status().iter().any(|device| device.down.is_none())
    }

    fn devices(&self) -> Vec<DeviceStatus> {
        self.pool.status()
    }
}
