//! The HTTP service. axum, hyper and tower are used here and nowhere else.
//!
//! Nothing here computes a mesh or blocks the runtime: work goes to [`crate::jobs`], files are parsed on blocking threads.
//! A file uses only files that are declared above it; `tests/architecture.rs` checks this order.

// Protocol rules that know no other file.
mod conditional;
mod kinds;
mod pace;
mod probe;
mod range;
mod request_id;
mod scopes;
mod socket;
mod stop;
mod timing;

// Problems: errors as responses.
mod problem;

mod embedded;
mod errors;
mod limit;
mod negotiate;

// State of the service, and the identity of clients.
mod state;

mod guard;
mod preferences;

// Requests: bodies, structures, parameters.
mod content_type;
mod form;
mod json_body;
mod source;
mod upload;

mod parsed_request;

// Responses.
mod stream;

mod delivery;

// Resources, with the parts of their OpenAPI description that they share.
mod openapi;

mod jobs;
mod results;

mod mesh_request;

mod atoms;
mod docs;
mod estimate;
mod events;
mod health;
mod meshes;
mod metrics;
mod page;
mod pdb;
mod problems;
mod structures;

mod capabilities;

mod api_document;

// The service: middleware, routes, connections.
mod accept;
mod browsers;
mod key_reload;
mod observe;

mod middleware;

mod router;

mod server;

pub use page::has_viewer;
pub use server::{Chosen, ServeError, Server};
pub use stop::{Stop, shutdown_signals};
