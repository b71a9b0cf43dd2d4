//! Renderer on a device. Draws the mesh four times, once per sample of a pixel, and resolves and shades the samples
//! with the parameters of the CPU renderer.
//!
//! A thread that waits for a driver cannot be interrupted. Separate threads therefore open and use the device, and are
//! abandoned if they take too long.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::mpsc::sync_channel;
use std::sync::{Arc, Mutex, TryLockError};
use std::thread;
use std::time::{Duration, Instant};

use molmesh_picture::camera::Camera;
use molmesh_picture::{CpuRenderer, Image, MeshColumns, PictureError, PictureParams, Rendered, Renderer};
use molmesh_surface::{BackendIdentity, CancelToken, Control, Mesh, Vertices};

use super::discover::{self, Discovery, arithmetic, describe};
use super::error::GpuError;
use super::hang_limit;
use super::lifecycle::MAX_COOL_DOWN;
use super::picture_passes::PicturePasses;
use super::picture_targets::Requirements;
use super::scheduler::PoolSettings;

/// Interval between attempts to lock the device. Each attempt is followed by a check for cancellation.
const LOCK_INTERVAL: Duration = Duration::from_millis(5);

/// Picture to draw.
pub struct PictureJob {
    mesh: Arc<Mesh>,
    params: PictureParams,
    camera: Camera,
    cancel: CancelToken,
}

impl PictureJob {
    /// Amount of work: pixels and triangles.
    fn work(&self) -> u64 {
        u64::from(self.params.width) * u64::from(self.params.height) + self.mesh.n_triangles() as u64
    }
}

/// Draws pictures on one device.
pub trait PictureExecutor: Send {
    /// Returns the pixels in rows from the top, or no pixels after a cancellation.
    ///
    /// # Errors
    /// [`GpuError::Failed`] or [`GpuError::Lost`] as reported by the device.
    fn draw(&mut self, job: &PictureJob) -> Result<Vec<[u8; 4]>, GpuError>;
}

impl PictureExecutor for PicturePasses {
    fn draw(&mut self, job: &PictureJob) -> Result<Vec<[u8; 4]>, GpuError> {
        let PictureJob { mesh, params, camera, cancel } = job;
        let columns = MeshColumns::of(mesh).map_err(|error| GpuError::Failed(error.to_string()))?;
        Requirements::new(mesh, params).check(&self.limits()).map_err(GpuError::Failed)?;
        self.draw_mesh(columns, params, camera, cancel)
    }
}

/// Opens a device for pictures: at the start, and after each failure.
pub type PictureBuild = Arc<dyn Fn() -> Result<Box<dyn PictureExecutor>, GpuError> + Send + Sync>;

/// Renderer on one device, with an optional fallback to the CPU.
pub struct GpuRenderer {
    /// Description of the device.
    device: String,
    build: PictureBuild,
    state: Mutex<RendererState>,
    settings: PoolSettings,
    fallback: Option<CpuRenderer>,
}

/// State of the device.
struct RendererState {
    /// Open device; `None` after it was lost or hung. The next picture opens it again.
    executor: Option<Box<dyn PictureExecutor>>,
    /// Reason why the device is down, and the end of its cool-down; an end of `None` means that it stays down.
    down: Option<(GpuError, Option<Instant>)>,
    /// Pause after the next hang.
    cool_down: Duration,
    /// Shortest time per unit of work of any picture, s.
    fastest: Option<f64>,
}

impl GpuRenderer {
    /// Creates a renderer on the first device that `discovery` selected and that can be opened. Without a `fallback`, a
    /// picture that the device cannot draw is an error.
    ///
    /// # Errors
    /// [`GpuError::NoDevice`] if no device is selected, or the error of opening the last one.
    pub fn start(
        discovery: &Discovery,
        settings: &PoolSettings,
        fallback: Option<CpuRenderer>,
    ) -> Result<Self, GpuError> {
        let mut failed = GpuError::NoDevice(discovery.no_device_reason().unwrap_or_default());
        for (found, adapter) in discovery.selected_adapters() {
            let adapter = adapter.clone();
            let build: PictureBuild = Arc::new(move || {
                let (device, queue) = discover::open(&adapter)?;
                Ok(Box::new(PicturePasses::new(device, queue)?))
            });
            match Self::with_build(describe(&found.facts), build, settings, fallback) {
                Ok(renderer) => return Ok(renderer),
                Err(error) => failed = error,
            }
        }
        Err(failed)
    }

    /// Creates a renderer on the device that `build` opens.
    ///
    /// # Errors
    /// Errors of `build`; [`GpuError::Hung`].
    pub fn with_build(
        device: String,
        build: PictureBuild,
        settings: &PoolSettings,
        fallback: Option<CpuRenderer>,
    ) -> Result<Self, GpuError> {
        let executor = Some(open(&build, settings.hang_timeout)?);
        let state = RendererState { executor, down: None, cool_down: settings.cool_down, fastest: None };
        Ok(Self { device, build, state: Mutex::new(state), settings: *settings, fallback })
    }

    fn draw(&self, mesh: &Arc<Mesh>, params: &PictureParams, control: &Control<'_>) -> Result<(Image, f64), DrawError> {
        let Vertices::Single { positions, .. } = mesh.vertices() else {
            return Err(DrawError::Picture(PictureError::Quantized));
        };
        let check = || control.check().map_err(|error| DrawError::Picture(error.into()));
        let camera = Camera::new(positions, &mesh.triangles, params);
        check()?;
        let job = PictureJob { mesh: Arc::clone(mesh), params: *params, camera, cancel: control.cancel.clone() };
        // Another picture may hold the lock for a long time.
        let mut state = loop {
            match self.state.try_lock() {
                Ok(state) => break state,
                Err(TryLockError::Poisoned(poisoned)) => break poisoned.into_inner(),
                Err(TryLockError::WouldBlock) => thread::sleep(LOCK_INTERVAL),
            }
            check()?;
        };
        let drawn = self.draw_unless_down(&mut state, job);
        drop(state);
        check()?;
        let pixels = drawn.map_err(|error| DrawError::Device(error.to_string()))?;
        Ok((Image { width: params.width, height: params.height, pixels }, camera.pixel()))
    }

    /// Draws a picture, unless the device is cooling down.
    fn draw_unless_down(&self, state: &mut RendererState, job: PictureJob) -> Result<Vec<[u8; 4]>, GpuError> {
        if let Some((why, end)) = &state.down
            && end.is_none_or(|end| Instant::now() < end)
        {
            return Err(why.clone());
        }
        state.down = None;
        let drawn = self.draw_now(state, job);
        if let Err(why @ GpuError::Hung { .. }) = &drawn {
            state.down = Some((why.clone(), Instant::now().checked_add(state.cool_down)));
            let maximum = self.settings.cool_down.saturating_mul(MAX_COOL_DOWN);
            state.cool_down = state.cool_down.saturating_mul(2).min(maximum);
        }
        drawn
    }

    fn draw_now(&self, state: &mut RendererState, job: PictureJob) -> Result<Vec<[u8; 4]>, GpuError> {
        let mut executor = match state.executor.take() {
            Some(executor) => executor,
            None => open(&self.build, self.settings.hang_timeout)?,
        };
        let work = job.work();
        let limit = hang_limit::of_submission(self.settings.hang_timeout, work, state.fastest);
        let begun = Instant::now();
        let (executor, drawn) = on_thread(limit, move || {
            let drawn = executor.draw(&job);
            // A lost device is closed on this thread, because closing may hang as well.
            let is_lost = matches!(drawn, Err(GpuError::Lost(_)));
            (Some(executor).filter(|_| !is_lost), drawn)
        })?;
        state.executor = executor;
        if drawn.is_ok() {
            let per_unit = begun.elapsed().as_secs_f64() / work.max(1) as f64;
            state.fastest = Some(state.fastest.map_or(per_unit, |fastest| fastest.min(per_unit)));
            state.cool_down = self.settings.cool_down;
        }
        drawn
    }
}

/// Opens a device within the time limit of a build.
fn open(build: &PictureBuild, hang_timeout: Duration) -> Result<Box<dyn PictureExecutor>, GpuError> {
    let build = Arc::clone(build);
    on_thread(hang_limit::of_build(hang_timeout), move || build())?
}

/// Runs `work` on a thread of its own, which is abandoned after `limit`.
///
/// # Errors
/// [`GpuError::Hung`]; [`GpuError::Failed`] if `work` panicked or the thread cannot be started.
fn on_thread<T: Send + 'static>(limit: Duration, work: impl FnOnce() -> T + Send + 'static) -> Result<T, GpuError> {
    let (sender, result) = sync_channel(1);
    let run = move || {
        // If the thread was abandoned, there is no receiver, and the result is freed here.
        drop(sender.send(catch_unwind(AssertUnwindSafe(work))));
    };
    let started = thread::Builder::new().name("molmesh-gpu-picture".to_owned()).spawn(run);
    started.map_err(|e| GpuError::Failed(format!("the thread of a picture cannot be started: {e}")))?;
    let after_ms = u64::try_from(limit.as_millis()).unwrap_or(u64::MAX);
    let done = result.recv_timeout(limit).map_err(|_late| GpuError::Hung { after_ms })?;
    done.map_err(|_logged| GpuError::Failed("it panicked".to_owned()))
}

/// Reason why the device did not draw a picture.
enum DrawError {
    /// No renderer could draw it.
    Picture(PictureError),
    /// The device failed.
    Device(String),
}

impl Renderer for GpuRenderer {
    fn name(&self) -> &'static str {
        "gpu"
    }

    fn arithmetic(&self) -> String {
        arithmetic(self.name(), &self.device)
    }

    fn describe(&self) -> String {
        self.device.clone()
    }

    fn render(
        &self,
        mesh: &Arc<Mesh>,
        params: &PictureParams,
        control: &Control<'_>,
    ) -> Result<Rendered, PictureError> {
        match (self.draw(mesh, params, control), &self.fallback) {
            (Ok((image, pixel)), _) => Ok(Rendered { image, pixel, made_by: None }),
            (Err(DrawError::Picture(error)), _) => Err(error),
            (Err(DrawError::Device(why)), None) => Err(PictureError::Device { why }),
            (Err(DrawError::Device(why)), Some(cpu)) => {
                let fallback_reason = Some(format!("the GPU could not draw it: {}", why.replace('\n', " ")));
                let made_by = BackendIdentity { fallback_reason, ..cpu.identity() };
                Ok(Rendered { made_by: Some(made_by), ..cpu.render(mesh, params, control)? })
            }
        }
    }
}
