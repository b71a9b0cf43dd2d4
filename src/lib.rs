//! Watertight molecular-surface meshes from PDB, mmCIF and BinaryCIF files.
//!
//! [`surface`] is the meshing core: spheres in, mesh out. [`structure`] reads files into spheres, [`formats`] encodes
//! meshes, [`picture`] renders them, and [`pipeline`] runs one job from bytes to report. The `gpu` feature adds the GPU
//! backend and the `server` feature the HTTP service. All lengths are ångström. `ARCHITECTURE.md` describes the
//! folders.

pub mod formats;
pub mod picture;
pub mod pipeline;
pub mod structure;
pub mod surface;

#[cfg(feature = "server")]
pub mod access;
#[cfg(feature = "server")]
pub mod archive;
#[cfg(feature = "server")]
pub mod config;
#[cfg(feature = "gpu")]
pub mod gpu;
#[cfg(feature = "server")]
pub mod http;
#[cfg(feature = "server")]
pub mod jobs;
#[cfg(feature = "server")]
mod single_flight;
#[cfg(feature = "server")]
pub mod store;
#[cfg(feature = "server")]
pub mod telemetry;
#[cfg(feature = "server")]
mod tls;
