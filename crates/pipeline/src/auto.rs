//! Backend of `--backend auto`: GPUs, with the CPU as their fallback.

use std::sync::OnceLock;

use molmesh_surface::{Backend, BackendIdentity, BackendJob, DeviceStatus, MeshOutput, SurfaceError};

/// Backend that owns a CPU and a GPU backend.
pub struct AutoBackend {
    cpu: Box<dyn Backend>,
    gpu: Box<dyn Backend>,
}

impl AutoBackend {
    /// Combines two backends. `gpu` has no fallback of its own.
    #[must_use]
    pub fn new(cpu: Box<dyn Backend>, gpu: Box<dyn Backend>) -> Self {
        Self { cpu, gpu }
    }

    /// Returns the reason why no GPU accepts jobs; `None` if one does.
    fn down_reason(&self) -> Option<String> {
        if self.gpu.is_available() {
            return None;
        }
        let reason =
            |device: DeviceStatus| Some(format!("{} {}: {}", device.number, device.name, device.down.as_ref()?));
        let reasons: Vec<String> = self.gpu.devices().into_iter().filter_map(reason).collect();
        Some(format!("no device is up: {}", reasons.join("; ")))
    }
}

impl Backend for AutoBackend {
    fn name(&self) -> &'static str {
        if self.gpu.is_available() { self.gpu.name() } else { self.cpu.name() }
    }

    fn arithmetic(&self) -> String {
        if self.gpu.is_available() { self.gpu.arithmetic() } else { self.cpu.arithmetic() }
    }

    fn arithmetics(&self) -> Vec<String> {
        let mut all = self.gpu.arithmetics();
        all.extend(self.cpu.arithmetics());
        all
    }

    fn describe(&self) -> String {
        self.gpu.describe()
    }

    fn write(&self, job: &BackendJob<'_>) -> Result<MeshOutput, SurfaceError> {
        FallbackBackend::new(self).write(job)
    }

    fn for_job(&self) -> Option<Box<dyn Backend + '_>> {
        Some(Box::new(FallbackBackend::new(self)))
    }

    fn cpu(&self) -> Option<&dyn Backend> {
        Some(self.cpu.as_ref())
    }

    /// Warms up both backends. If the GPUs fail, the CPU gets every job.
    fn warm_up(&self) -> Result<(), SurfaceError> {
        self.cpu.warm_up()?;
        // The status of the devices states the reason of a failure.
        drop(self.gpu.warm_up());
        Ok(())
    }

    fn is_available(&self) -> bool {
        self.cpu.is_available() || self.gpu.is_available()
    }

    fn devices(&self) -> Vec<DeviceStatus> {
        self.gpu.devices()
    }
}

/// Backend of one job: the GPUs until they fail, then the CPU for the rest of the job.
struct FallbackBackend<'a> {
    auto: &'a AutoBackend,
    /// Reason why the CPU runs the job.
    failure: OnceLock<String>,
}

impl<'a> FallbackBackend<'a> {
    fn new(auto: &'a AutoBackend) -> Self {
        Self { auto, failure: auto.down_reason().map_or_else(OnceLock::new, OnceLock::from) }
    }

    /// Returns the backend that runs the job.
    fn backend(&self) -> &'a dyn Backend {
        let Self { auto, failure } = self;
        if failure.get().is_none() { auto.gpu.as_ref() } else { auto.cpu.as_ref() }
    }
}

impl Backend for FallbackBackend<'_> {
    fn name(&self) -> &'static str {
        self.backend().name()
    }

    fn arithmetic(&self) -> String {
        self.backend().arithmetic()
    }

    fn describe(&self) -> String {
        self.backend().describe()
    }

    fn write(&self, job: &BackendJob<'_>) -> Result<MeshOutput, SurfaceError> {
        if self.failure.get().is_none() {
            match self.auto.gpu.write(job) {
                Err(SurfaceError::Device { why }) => drop(self.failure.set(why)),
                written => return written,
            }
        }
        let output = self.auto.cpu.write(job)?;
        let fallback_reason = self.failure.get().map(|why| format!("the GPU failed: {why}"));
        let made_by = Some(BackendIdentity { fallback_reason, ..self.auto.cpu.identity() });
        Ok(MeshOutput { made_by, ..output })
    }
}
