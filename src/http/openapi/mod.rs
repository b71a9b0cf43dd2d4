//! Building blocks of the OpenAPI description: parameters, bodies and responses that several handlers share.
//! `document` assembles the document.

mod access;
pub(super) mod bodies;
mod components;
mod document;
mod entries;
pub(super) mod meshes;
pub(super) mod parameters;
pub(super) mod problems;
mod yaml;

pub(super) use document::{DocumentTexts, texts};
pub(super) use problems::problem_responses;
