//! molmesh: molecules in, proven surface meshes out.
//!
//! The crate is a meshing core ([`surface`]) with rooms around it: [`structure`] reads files into spheres,
//! [`formats`] writes meshes, [`picture`] draws them, [`pipeline`] ties these together, and the `server` feature
//! adds the HTTP service. `ARCHITECTURE.md` is the map; lengths are ångström everywhere.

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
