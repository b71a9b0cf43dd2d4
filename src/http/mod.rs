//! The HTTP service. axum, hyper and tower are used here and nowhere else.
//!
//! Nothing here computes a mesh or blocks the runtime: work goes to `jobs`, files are parsed on blocking
//! threads. A file uses only files of earlier groups in the list below; `tests/core/architecture.rs` checks this order.

// Protocol rules that use no other file.
mod observed_body;
mod pace;
mod problem_types;
mod range;
mod request_id;
mod signal;
mod socket;
mod store_health;
mod timing;

mod stop;

// Problems, and what can be checked without the state of the service.
mod problem;

mod conditional;
mod content_type;
mod errors;
mod json_body;
mod negotiate;

// State of the service, and the identity of clients.
mod state;

mod guard;

mod coding;

mod reading;

// Requests: preferences, bodies, structures, parameters.
mod atom_parameters;
mod batch_plan;
mod body_hasher;
mod color_parameters;
mod form;
mod preferences;
mod source;

mod upload;

mod parsed_request;

// Responses.
mod stream;

mod delivery;
mod document;

// Resources. `openapi` holds the parts of their description that they share.
mod openapi;

mod results;

mod jobs;

mod mesh_request;

mod areas;
mod atoms;
mod colors;
mod estimate;
mod events;
mod health;
mod job_list;
mod meshes;
mod metrics;
mod page;
mod problems;
mod structures;
mod tilesets;

// Batches.
mod batch_names;

mod batch_archive;
mod batch_state;

mod batch_request;

mod batches;

mod batch_results;

mod capabilities;

mod api_document;

// Table of the operations, and checks that follow from it.
mod operations;

mod signing;

// The service: middleware, routes, connections.
mod accept;
mod key_reload;
mod observe;

mod browsers;
mod origin;

mod middleware;

mod router;

mod wind_down;

mod server;

pub use crate::jobs::check_broker;
pub use page::has_viewer;
pub use server::{ServeError, Server};
pub use signing::check_signable;
pub use stop::{Stop, shutdown_signals};
pub use wind_down::Stopped;
