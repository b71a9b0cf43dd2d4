//! The HTTP service: axum and tower only.
