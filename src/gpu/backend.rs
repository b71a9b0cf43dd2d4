//! The backend: devices that share the work, and the one that stands in for them when they fail.

use std::sync::Arc;

use super::device::{self, Program};
use super::discover::Discovery;
use super::error::GpuError;
use super::executor::GpuJob;
use super::lane::one_line;
use super::pool::{self, DevicePool, PoolDevice, PoolSettings};
use super::prepare::Prepared;
use crate::surface::{
    Backend, Control, DeviceFacts, DeviceStatus, MeshOutput, MeshSink, Served, Spheres, Stage, SurfaceError,
    SurfaceLimits, SurfaceParams, backend::one_atom,
};

/// Meshes on devices.
pub struct GpuBackend {
    pool: DevicePool,
    name: &'static str,
    /// Serves what no device could, and says so in [`MeshOutput::served`].
    fallback: Option<Box<dyn Backend>>,
}

impl GpuBackend {
    /// Builds `program` on every device that `discovery` takes.
    ///
    /// # Errors
    /// [`GpuError::NoDevice`] with every device's reason if none is taken or none could be built.
    pub fn start(
        discovery: &Discovery,
        program: Program,
        settings: &PoolSettings,
        fallback: Option<Box<dyn Backend>>,
    ) -> Result<Self, GpuError> {
        if let Some(why) = discovery.why_none() {
            return Err(GpuError::NoDevice(why));
        }
        let taken = discovery.devices.iter().zip(&discovery.adapters).filter(|(device, _)| device.taken);
        let devices = taken.map(|(device, adapter)| {
            let adapter = adapter.clone();
            let build = Box::new(move || device::build(&adapter, program));
            PoolDevice { number: device.number, name: describe(&device.facts), build }
        });
        let devices: Vec<_> = devices.collect();
        // The program of 2010 knows no parts. Devices of different models or drivers would make a mesh whose bytes
        // depend on which of them were free.
        let alike = devices.windows(2).all(|pair| pair[0].name == pair[1].name);
        let spread_bricks = settings.spread_bricks.filter(|_| program == Program::Stages && alike);
        let pool = DevicePool::start(devices, &PoolSettings { spread_bricks, ..*settings })?;
        Ok(Self { name: program.name(), ..Self::over(pool, fallback) })
    }

    /// The backend over a pool that runs already.
    #[must_use]
    pub fn over(pool: DevicePool, fallback: Option<Box<dyn Backend>>) -> Self {
        Self { pool, name: Program::Stages.name(), fallback }
    }

    /// The pool of its devices.
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

    /// Makes one atom's surface on device `n`, which is given up if it cannot.
    fn warm_device(&self, n: usize) -> Result<(), SurfaceError> {
        let (params, limits) = (SurfaceParams::default(), SurfaceLimits::default());
        let job = Self::job(&one_atom()?, &params, &limits, &Control::default())?;
        if let Err(error) = self.pool.run_only_on(n, &job) {
            self.pool.give_up(n, &format!("its first mesh failed: {error}"));
        }
        Ok(())
    }
}

/// Name of the arithmetic of a device: model and driver, and the processor's, which prepares jobs and measures meshes.
pub(super) fn arithmetic(name: &str, device: &str) -> String {
    format!("{name} {device} {}", crate::surface::arithmetic())
}

/// A device for people, with its driver.
pub(super) fn describe(facts: &DeviceFacts) -> String {
    let DeviceFacts { name, kind, api, driver, .. } = facts;
    let driver = if driver.is_empty() { String::new() } else { format!(", {driver}") };
    format!("{name} ({}, {api}{driver})", kind.name())
}

impl Backend for GpuBackend {
    fn name(&self) -> &'static str {
        self.name
    }

    fn arithmetic(&self) -> String {
        let status = self.pool.status();
        let up = status.iter().find(|device| device.down.is_none());
        match (up, &self.fallback) {
            (Some(device), _) => arithmetic(self.name, &device.name),
            (None, Some(fallback)) => fallback.arithmetic(),
            (None, None) => arithmetic(self.name, "no device"),
        }
    }

    fn describe(&self) -> String {
        let status = self.pool.status();
        let up: Vec<&str> = status.iter().filter(|d| d.down.is_none()).map(|d| d.name.as_str()).collect();
        pool::describe(&up)
    }

    fn write(
        &self,
        spheres: &Spheres,
        params: &SurfaceParams,
        limits: &SurfaceLimits,
        control: &Control<'_>,
        sink: Option<&dyn MeshSink>,
    ) -> Result<MeshOutput, SurfaceError> {
        control.check()?;
        let job = Self::job(spheres, params, limits, control)?;
        let error = match self.pool.ran(&job) {
            Ok(ran) => {
                ran.finished.stages.iter().for_each(|(stage, ns)| control.observer.elapsed(*stage, *ns));
                // Several devices make one job only if they are alike.
                let device = ran.by.first().map_or("", |work| work.device.as_str());
                let arithmetic = arithmetic(self.name, device);
                let served = Served { backend: self.name(), arithmetic, device: ran.device(), fallback_reason: None };
                let output = MeshOutput { served: Some(served), ..ran.finished.meshed };
                return output.deliver(params, control, sink);
            }
            Err(error) => error,
        };
        // The atoms on their way to a device are not needed for what follows.
        drop(job);
        match (error, &self.fallback) {
            (GpuError::Surface(error), _) => Err(error),
            (GpuError::Deadline, _) => Err(SurfaceError::Deadline),
            (GpuError::OutOfMemory { needed, available, suggested_resolution }, _) => {
                Err(SurfaceError::DeviceMemory { needed, available, suggested_resolution })
            }
            (error, None) => Err(SurfaceError::Device { why: one_line(&error.to_string()) }),
            (error, Some(fallback)) => {
                let output = fallback.write(spheres, params, limits, control, sink)?;
                let served = Served {
                    backend: fallback.name(),
                    arithmetic: fallback.arithmetic(),
                    device: fallback.describe(),
                    fallback_reason: Some(one_line(&format!("the GPU failed: {error}"))),
                };
                Ok(MeshOutput { served: Some(served), ..output })
            }
        }
    }

    fn warm(&self) -> Result<(), SurfaceError> {
        let n_devices = self.pool.status().len();
        std::thread::scope(|scope| {
            let warming: Vec<_> = (0..n_devices).map(|n| scope.spawn(move || self.warm_device(n))).collect();
            warming.into_iter().try_for_each(|thread| thread.join().unwrap_or(Err(SurfaceError::Cancelled)))
        })?;
        if self.pool.status().iter().any(|device| device.down.is_none()) {
            return Ok(());
        }
        match &self.fallback {
            Some(fallback) => fallback.warm(),
            None => Err(SurfaceError::Device { why: self.describe() }),
        }
    }

    fn able(&self) -> bool {
        self.fallback.is_some() || self.pool.status().iter().any(|device| device.down.is_none())
    }

    fn devices(&self) -> Vec<DeviceStatus> {
        self.pool.status()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::DeviceKind;

    #[test]
    fn model_and_driver_are_part_of_the_arithmetic() {
        let facts = |name: &str, driver: &str| DeviceFacts {
            name: name.to_owned(),
            kind: DeviceKind::Discrete,
            api: "vulkan",
            driver: driver.to_owned(),
            bus: String::new(),
            binding_bytes: 0,
            buffer_bytes: 0,
            workgroup_bytes: 0,
            workgroup_size: 0,
            storage_buffers: 0,
            timestamps: false,
            subgroups: None,
        };
        let of = |name, driver| arithmetic("gpu", &describe(&facts(name, driver)));
        assert_eq!(of("card", "driver 1"), of("card", "driver 1"));
        assert_ne!(of("card", "driver 1"), of("card", "driver 2"));
        assert_ne!(of("card", "driver 1"), of("other card", "driver 1"));
        assert!(of("card", "driver 1").ends_with(&crate::surface::arithmetic()), "the processor takes part");
    }
}
