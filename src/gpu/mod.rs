//! The GPU room: the only module that may name a graphics API.
//!
//! `discover` asks the drivers what there is and `choose` judges it; `device` opens what is taken and builds the
//! [`Engine`](engine::Engine) there. `prepare` turns spheres into what a device needs, on the caller's thread; an
//! [`Executor`](executor::Executor) runs prepared jobs on one device; the [`DevicePool`](pool::DevicePool) owns one
//! thread per device and decides which job runs where; [`GpuBackend`](backend::GpuBackend) is what the rest of the
//! crate sees.

mod assemble;
pub mod backend;
mod choose;
mod device;
pub mod discover;
pub mod engine;
pub mod error;
pub mod executor;
mod flight;
mod hardware;
mod health;
mod landing;
mod lane;
pub mod manifests;
mod output;
mod part;
pub mod picture;
mod picture_targets;
mod picture_work;
mod pipelines;
pub mod pool;
pub mod prepare;
#[doc(hidden)]
pub mod probe;
mod progress;
mod queue;
mod record;
mod run;
mod shaders;
pub mod share;
mod spread;
mod submit;
mod worker;
mod workspace;

pub use backend::GpuBackend;
pub use discover::{Discovery, Look, discover};
pub use engine::{Budget, Engine};
pub use error::GpuError;
pub use executor::{Executor, Finished, GpuJob};
pub use manifests::{Manifest, manifests};
pub use picture::GpuRenderer;
pub use pool::{DevicePool, PoolDevice, PoolSettings, Ran, Work};
pub use prepare::Prepared;
pub use shaders::stage_shaders;
pub use share::Share;
pub use worker::{Build, MOST_REBUILDS};
