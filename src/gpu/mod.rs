//! The GPU room: the only module that may name a graphics API.
//!
//! `prepare` turns spheres into what a device needs, on the caller's thread; an [`Executor`](executor::Executor) runs
//! prepared jobs on one device; the pool above owns one thread per device and decides which job runs where.

mod assemble;
pub mod bench;
pub mod engine;
pub mod error;
pub mod executor;
mod flight;
mod health;
mod landing;
pub mod meter;
pub mod paper;
mod paper_pipelines;
mod pipelines;
pub mod prepare;
#[doc(hidden)]
pub mod probe;
mod progress;
mod record;
mod run;
mod shaders;
mod workspace;
pub mod yardstick;

pub use engine::{Budget, Engine};
pub use error::GpuError;
pub use executor::{Executor, Finished, GpuJob};
pub use paper::Paper;
pub use prepare::Prepared;

/// Why no GPU can be used, for the banner, reports and logs.
#[must_use]
pub const fn unavailable() -> &'static str {
    "this version has no GPU stages"
}
