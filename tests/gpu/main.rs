//! Tests of the GPU backend, on any Vulkan device; continuous integration runs them on lavapipe.

#![allow(clippy::unwrap_used, clippy::panic, reason = "tests fail by panicking")]

#[path = "../cli_support/mod.rs"]
mod cli_support;
#[path = "../gpu_fakes/mod.rs"]
mod gpu_fakes;
#[path = "../gpu_support/mod.rs"]
mod gpu_support;
#[path = "../measure_support/mod.rs"]
mod measure_support;
#[path = "../tools/mod.rs"]
mod tools;

mod backend;
mod cancellation;
mod divided;
mod meshes;
mod multi_device;
mod overlap;
mod picture;
mod pool;
mod recovery;
mod rounded;
mod stages;
