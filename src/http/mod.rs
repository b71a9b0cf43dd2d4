//! The HTTP service: requests to jobs, jobs to answers. axum, hyper and tower live here and nowhere else.
//!
//! [`router`](self) is the table of contents, `middleware` the order of what every request goes through, `kinds` the
//! only table of status codes. One file per resource. Nothing here computes a mesh or blocks the runtime: work goes
//! to [`crate::jobs`], files are read on threads that may block.

mod accept;
mod ask;
mod atoms;
mod browsers;
mod capabilities;
mod conditional;
mod declared;
mod delivery;
mod docs;
mod document;
mod estimate;
mod events;
mod form;
mod guard;
mod health;
mod io;
mod jobs;
mod kinds;
mod meshes;
mod metrics;
mod middleware;
mod negotiate;
mod observe;
mod openapi;
mod pace;
mod packed;
mod page;
mod pdb;
mod probe;
mod problem;
mod problems;
mod range;
mod renew;
mod request_id;
mod results;
mod router;
mod scopes;
mod server;
mod state;
mod stop;
mod stream;
mod structures;
mod timing;
mod unfit;
mod upload;
mod wish;

pub use page::has_viewer;
pub use server::{Chosen, ServeError, Server};
pub use stop::{Stop, shutdown_signals};
