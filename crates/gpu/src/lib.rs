//! GPU backend: the only crate that names a graphics API.
//!
//! Callers prepare jobs (`job`, `plan`) on their own threads. The [`DevicePool`] queues them and owns one thread per
//! device; each thread runs them by an [`Executor`], normally the [`Engine`]. [`GpuBackend`] is the pool behind the
//! `Backend` trait, [`GpuRenderer`] draws pictures.
//!
//! A module names only modules of earlier lines:
//!
//! ```text
//! error, buffers
//! plan, readback, hang_limit, hardware, manifests, choose, picture_targets
//! sheets, shaders, device_errors, discover
//! job
//! partition_handle, pipelines, multi_device, picture_passes
//! executor, output_layout, queued_job
//! workspace, running_batch
//! device_queue
//! scheduler
//! recording, lifecycle
//! worker
//! pool
//! engine
//! submit
//! job_state, single_stages, backend, picture
//! count
//! output
//! run_partition
//! run
//! ```

pub mod backend;
mod buffers;
mod choose;
mod count;
mod device_errors;
mod device_queue;
pub mod discover;
pub mod engine;
pub mod error;
pub mod executor;
mod hang_limit;
mod hardware;
#[cfg(test)]
#[cfg(feature = "shuttle")]
mod interleavings;
pub mod job;
mod job_state;
mod lifecycle;
pub mod manifests;
mod multi_device;
mod output;
mod output_layout;
pub mod partition_handle;
pub mod picture;
mod picture_passes;
mod picture_targets;
mod pipelines;
pub mod plan;
pub mod pool;
mod queued_job;
mod readback;
mod recording;
mod run;
mod run_partition;
mod running_batch;
mod scheduler;
mod shaders;
mod sheets;
#[doc(hidden)]
pub mod single_stages;
mod submit;
mod worker;
mod workspace;

pub use backend::GpuBackend;
pub use discover::{Discovery, DiscoveryMode, discover};
pub use engine::{DeviceLimits, Engine};
pub use error::GpuError;
pub use executor::{Executor, NextJob};
pub use job::{Finished, GpuJob, JobResult, Prepared};
pub use manifests::{Manifest, manifests};
pub use partition_handle::PartitionHandle;
pub use picture::{GpuRenderer, PictureBuild, PictureExecutor, PictureJob};
pub use pool::{CompletedJob, DevicePool, DeviceWork, PoolDevice};
pub use scheduler::PoolSettings;
pub use shaders::stage_shaders;
pub use sheets::SheetBlocks;
pub use worker::{Build, MAX_REBUILDS};
