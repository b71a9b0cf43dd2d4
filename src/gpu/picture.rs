//! Pictures drawn by a device: the mesh rasterised four times, once for each sample of a pixel, then resolved and finished by
//! the same numbers as on the CPU. Offscreen; nothing but the pixels comes back.

use std::sync::{Mutex, PoisonError};

use wgpu::Adapter;

use super::backend::{arithmetic, describe};
use super::device;
use super::discover::Discovery;
use super::error::GpuError;
use super::picture_targets::Needs;
use super::picture_work::Painter;
use crate::picture::camera::Camera;
use crate::picture::{CpuRenderer, Image, PictureError, PictureParams, Rendered, Renderer};
use crate::surface::{Control, Mesh, Served, Vertices};

/// Draws on one device; the CPU stands in for it, and says so.
pub struct GpuRenderer {
    adapter: Adapter,
    name: String,
    /// The device with its driver.
    device: String,
    /// None once the device was lost; the next picture opens it again.
    painter: Mutex<Option<Painter>>,
    fallback: Option<CpuRenderer>,
}

impl GpuRenderer {
    /// A renderer on the first device that `discovery` takes. `fallback` draws what the device cannot; without one that is an
    /// error.
    ///
    /// # Errors
    /// [`GpuError::NoDevice`] if none is taken, and what the device says where it cannot be prepared.
    pub fn start(discovery: &Discovery, fallback: Option<CpuRenderer>) -> Result<Self, GpuError> {
        let mut taken = discovery.devices.iter().zip(&discovery.adapters).filter(|(found, _)| found.taken);
        let Some((found, adapter)) = taken.next() else {
            return Err(GpuError::NoDevice(discovery.why_none().unwrap_or_default()));
        };
        let name = format!("{} ({}, {})", found.facts.name, found.facts.kind.name(), found.facts.api);
        let device = describe(&found.facts);
        let painter = Mutex::new(Some(open(adapter)?));
        Ok(Self { adapter: adapter.clone(), name, device, painter, fallback })
    }

    fn paint(&self, mesh: &Mesh, params: &PictureParams, control: &Control<'_>) -> Result<(Image, f64), Why> {
        let Vertices::Single { positions, normals } = mesh.vertices() else {
            return Err(Why::Picture(PictureError::Quantized));
        };
        let check = || control.check().map_err(|error| Why::Picture(error.into()));
        let camera = Camera::new(positions, &mesh.triangles, params);
        check()?;
        let mut painter = self.painter.lock().unwrap_or_else(PoisonError::into_inner);
        // Waiting for others may have taken a while.
        check()?;
        if painter.is_none() {
            *painter = Some(open(&self.adapter).map_err(|error| Why::Device(error.to_string()))?);
        }
        let Some(ready) = painter.as_ref() else { return Err(Why::Device("it is not open".to_owned())) };
        Needs::of(mesh, params).check(&ready.limits()).map_err(Why::Device)?;
        let painted = ready.paint(positions, normals, &mesh.triangles, params, &camera);
        let pixels = painted.map_err(|error| {
            if matches!(error, GpuError::Lost(_)) {
                *painter = None;
            }
            Why::Device(error.to_string())
        })?;
        Ok((Image { width: params.width, height: params.height, pixels }, camera.pixel()))
    }
}

/// Opens a device and compiles what draws on it.
fn open(adapter: &Adapter) -> Result<Painter, GpuError> {
    let (device, queue) = device::open(adapter)?;
    Painter::new(device, queue)
}

/// Why the device has not drawn.
enum Why {
    /// Nothing would.
    Picture(PictureError),
    /// It could not, in words.
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
        self.name.clone()
    }

    fn render(&self, mesh: &Mesh, params: &PictureParams, control: &Control<'_>) -> Result<Rendered, PictureError> {
        match (self.paint(mesh, params, control), &self.fallback) {
            (Ok((image, pixel)), _) => Ok(Rendered { image, pixel, served: None }),
            (Err(Why::Picture(error)), _) => Err(error),
            (Err(Why::Device(why)), None) => Err(PictureError::Device { why }),
            (Err(Why::Device(why)), Some(cpu)) => {
                let fallback_reason = Some(format!("the GPU could not draw it: {}", why.replace('\n', " ")));
                let served = Served {
                    backend: cpu.name(),
                    arithmetic: cpu.arithmetic(),
                    device: cpu.describe(),
                    fallback_reason,
                };
                Ok(Rendered { served: Some(served), ..cpu.render(mesh, params, control)? })
            }
        }
    }
}
