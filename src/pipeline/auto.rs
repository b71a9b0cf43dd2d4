//! Backend that runs each job on the CPU or on GPUs, on the side that is predicted to finish it first. The CPU is the
//! fallback of the GPUs.

use std::num::NonZero;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use super::cost::{Assignment, Cost, Model, Side};
use super::host_cores::processor_time;
use super::work::mesh_work;
use crate::surface::{
    Backend, BackendIdentity, Control, DeviceStatus, MeshOutput, MeshSink, Spheres, SurfaceError, SurfaceKind,
    SurfaceLimits, SurfaceParams,
};

/// Time for the measurement of each backend.
const MEASURING: Duration = Duration::from_millis(400);

/// Backend that owns a CPU and a GPU backend. Until [`Backend::warm_up`] has measured both, GPUs get every job.
pub struct AutoBackend {
    cpu: Box<dyn Backend>,
    gpu: Box<dyn Backend>,
    model: Mutex<Model>,
    start: Instant,
}

impl AutoBackend {
    /// Combines two backends. `gpu` has no fallback of its own.
    #[must_use]
    pub fn new(cpu: Box<dyn Backend>, gpu: Box<dyn Backend>) -> Self {
        let cores = std::thread::available_parallelism().map_or(1, NonZero::get);
        Self { cpu, gpu, model: Mutex::new(Model::new(cores)), start: Instant::now() }
    }

    fn model(&self) -> MutexGuard<'_, Model> {
        // No code panics between two changes under the lock.
        self.model.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns the wall time since the start and the processor time of this process, s.
    fn now(&self) -> [f64; 2] {
        [self.start.elapsed().as_secs_f64(), processor_time()]
    }

    fn side(&self, side: Side) -> &dyn Backend {
        match side {
            Side::Cpu => self.cpu.as_ref(),
            Side::Gpu => self.gpu.as_ref(),
        }
    }

    /// Number of GPUs that accept jobs; 1 for a backend that lists no devices.
    fn gpus(&self) -> usize {
        let devices = self.gpu.devices();
        let up = devices.iter().filter(|device| device.down.is_none()).count();
        if devices.is_empty() { usize::from(self.gpu.is_available()) } else { up }
    }

    fn assign(&self, surface: SurfaceKind, work: f64) -> AssignedBackend<'_> {
        if !self.gpu.supports(surface) {
            let assignment = self.model().assign_to(Side::Cpu, self.now(), work, 0);
            return AssignedBackend::new(self, work, assignment, None);
        }
        let gpus = self.gpus();
        let assignment = self.model().assign(self.now(), work, gpus);
        let down = (gpus == 0).then(|| format!("no device is up: {}", self.down_reasons()));
        AssignedBackend::new(self, work, assignment, down)
    }

    fn down_reasons(&self) -> String {
        let devices = self.gpu.devices().into_iter();
        let reason =
            |device: DeviceStatus| Some(format!("{} {}: {}", device.number, device.name, device.down.as_ref()?));
        devices.filter_map(reason).collect::<Vec<_>>().join("; ")
    }
}

impl Backend for AutoBackend {
    /// Name of the backend that gets a job on an idle machine without measurements.
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

    fn write(
        &self,
        spheres: &Spheres,
        params: &SurfaceParams,
        limits: &SurfaceLimits,
        control: &Control<'_>,
        sink: Option<&dyn MeshSink>,
    ) -> Result<MeshOutput, SurfaceError> {
        let assigned = self.assign(params.surface, mesh_work(spheres.len() as f64, params.resolution));
        assigned.write(spheres, params, limits, control, sink)
    }

    fn for_job(&self, surface: SurfaceKind, work: f64) -> Option<Box<dyn Backend + '_>> {
        Some(Box::new(self.assign(surface, work)))
    }

    /// Warms up and measures both backends. If the GPUs fail, the CPU gets every job.
    fn warm_up(&self) -> Result<(), SurfaceError> {
        self.cpu.warm_up()?;
        // The status of the devices states the reason of a failure.
        if self.gpu.warm_up().is_ok()
            && let Ok(gpu) = Cost::measure(self.gpu.as_ref(), MEASURING)
        {
            let cpu = Cost::measure(self.cpu.as_ref(), MEASURING)?;
            self.model().set_costs(cpu, gpu);
        }
        Ok(())
    }

    fn is_available(&self) -> bool {
        self.cpu.is_available() || self.gpu.is_available()
    }

    fn devices(&self) -> Vec<DeviceStatus> {
        self.gpu.devices()
    }
}

/// Backend of one job. All meshes of the job come from one backend, unless its devices fail.
struct AssignedBackend<'a> {
    auto: &'a AutoBackend,
    work: f64,
    state: Mutex<AssignedState>,
}

struct AssignedState {
    assignment: Assignment,
    /// Reason why no GPU runs the job, if one should.
    failure: Option<String>,
    /// Wall time and processor time at the end of the last mesh, s; `None` if it failed.
    ended: Option<[f64; 2]>,
}

impl<'a> AssignedBackend<'a> {
    fn new(auto: &'a AutoBackend, work: f64, assignment: Assignment, failure: Option<String>) -> Self {
        Self { auto, work, state: Mutex::new(AssignedState { assignment, failure, ended: None }) }
    }

    fn state(&self) -> MutexGuard<'_, AssignedState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns the backend to which the job is assigned.
    fn backend(&self) -> &'a dyn Backend {
        let side = self.state().assignment.side;
        self.auto.side(side)
    }

    /// Moves the job to the CPU.
    fn fall_back(&self, why: String) {
        let mut state = self.state();
        let mut model = self.auto.model();
        let now = self.auto.now();
        model.remove(now, &state.assignment);
        state.assignment = model.assign_to(Side::Cpu, now, self.work, 0);
        state.failure = Some(why);
    }
}

impl Drop for AssignedBackend<'_> {
    fn drop(&mut self) {
        let state = self.state();
        let mut model = self.auto.model();
        match state.ended {
            Some(end) => model.finish(end, &state.assignment),
            None => model.remove(self.auto.now(), &state.assignment),
        }
    }
}

impl Backend for AssignedBackend<'_> {
    fn name(&self) -> &'static str {
        self.backend().name()
    }

    fn arithmetic(&self) -> String {
        self.backend().arithmetic()
    }

    fn describe(&self) -> String {
        self.backend().describe()
    }

    fn write(
        &self,
        spheres: &Spheres,
        params: &SurfaceParams,
        limits: &SurfaceLimits,
        control: &Control<'_>,
        sink: Option<&dyn MeshSink>,
    ) -> Result<MeshOutput, SurfaceError> {
        let side = self.state().assignment.side;
        self.state().ended = None;
        let output = match self.auto.side(side).write(spheres, params, limits, control, sink) {
            Err(SurfaceError::Device { why }) if side == Side::Gpu => {
                self.fall_back(why);
                self.auto.cpu.write(spheres, params, limits, control, sink)?
            }
            written => written?,
        };
        let mut state = self.state();
        state.ended = Some(self.auto.now());
        let (assignment, failure) = (state.assignment, state.failure.clone());
        drop(state);
        let backend = self.auto.side(assignment.side);
        let made_by = output.made_by.clone().unwrap_or_else(|| backend.identity());
        let made_by = BackendIdentity {
            prediction: assignment.ends.map(prediction).or(made_by.prediction),
            fallback_reason: failure.map(|why| format!("the GPU failed: {why}")).or(made_by.fallback_reason),
            ..made_by
        };
        Ok(MeshOutput { made_by: Some(made_by), ..output })
    }
}

/// Describes the predicted ends of a job.
fn prediction([cpu, gpu]: [f64; 2]) -> String {
    format!("predicted to end in {:.1} ms on the CPU, {:.1} ms on a GPU", cpu * 1e3, gpu * 1e3)
}
