//! Building blocks of the OpenAPI description: parameters, bodies and responses that several handlers share.
//! `api_document` assembles the document.

pub(super) mod access;
pub(super) mod bodies;
pub(super) mod components;
pub(super) mod meshes;
pub(super) mod parameters;
pub(super) mod problems;

pub(super) use problems::problem_responses;
