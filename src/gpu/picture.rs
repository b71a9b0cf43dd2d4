//! Renderer on a device. Draws the mesh four times, once per sample of a pixel, and resolves and shades the samples
//! with the parameters of the CPU renderer.

use std::sync::{Mutex, TryLockError};
use std::thread;
use std::time::Duration;

use wgpu::Adapter;

use super::discover::{self, Discovery, arithmetic, describe};
use super::error::GpuError;
use super::picture_passes::PicturePasses;
use super::picture_targets::Requirements;
use crate::picture::camera::Camera;
use crate::picture::{CpuRenderer, Image, PictureError, PictureParams, Rendered, Renderer};
use crate::surface::{BackendIdentity, Control, Mesh, Vertices};

/// Interval of attempts to lock the passes, and of checks for cancellation meanwhile.
const LOCK_INTERVAL: Duration = Duration::from_millis(5);

/// Renderer on one device, with an optional fallback to the CPU.
pub struct GpuRenderer {
    adapter: Adapter,
    /// Description of the device.
    device: String,
    /// `None` after the device was lost; the next picture reopens it.
    passes: Mutex<Option<PicturePasses>>,
    fallback: Option<CpuRenderer>,
}

impl GpuRenderer {
    /// Creates a renderer on the first device that `discovery` selected. Without a `fallback`, a picture that the
    /// device cannot draw is an error.
    ///
    /// # Errors
    /// [`GpuError::NoDevice`] if no device is selected, and errors of opening the device.
    pub fn start(discovery: &Discovery, fallback: Option<CpuRenderer>) -> Result<Self, GpuError> {
        let Some((found, adapter)) = discovery.selected_adapters().next() else {
            return Err(GpuError::NoDevice(discovery.no_device_reason().unwrap_or_default()));
        };
        let passes = Mutex::new(Some(open(adapter)?));
        Ok(Self { adapter: adapter.clone(), device: describe(&found.facts), passes, fallback })
    }

    fn draw(&self, mesh: &Mesh, params: &PictureParams, control: &Control<'_>) -> Result<(Image, f64), DrawError> {
        let Vertices::Single { positions, normals } = mesh.vertices() else {
            return Err(DrawError::Picture(PictureError::Quantized));
        };
        let check = || control.check().map_err(|error| DrawError::Picture(error.into()));
        let camera = Camera::new(positions, &mesh.triangles, params);
        check()?;
        // Another picture may hold the lock for long.
        let mut passes = loop {
            match self.passes.try_lock() {
                Ok(passes) => break passes,
                Err(TryLockError::Poisoned(poisoned)) => break poisoned.into_inner(),
                Err(TryLockError::WouldBlock) => thread::sleep(LOCK_INTERVAL),
            }
            check()?;
        };
        let opened = match passes.take() {
            Some(opened) => opened,
            None => open(&self.adapter).map_err(|error| DrawError::Device(error.to_string()))?,
        };
        let fits = Requirements::new(mesh, params).check(&opened.limits());
        let drawn = fits
            .map_err(GpuError::Failed)
            .and_then(|()| opened.draw(positions, normals, &mesh.triangles, params, &camera, &control.cancel));
        if !matches!(drawn, Err(GpuError::Lost(_))) {
            *passes = Some(opened);
        }
        check()?;
        let pixels = drawn.map_err(|error| DrawError::Device(error.to_string()))?;
        Ok((Image { width: params.width, height: params.height, pixels }, camera.pixel()))
    }
}

/// Opens a device and compiles the passes.
fn open(adapter: &Adapter) -> Result<PicturePasses, GpuError> {
    let (device, queue) = discover::open(adapter)?;
    PicturePasses::new(device, queue)
}

/// Reason for which the device did not draw a picture.
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

    fn render(&self, mesh: &Mesh, params: &PictureParams, control: &Control<'_>) -> Result<Rendered, PictureError> {
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
