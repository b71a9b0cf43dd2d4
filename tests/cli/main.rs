//! Tests of the command line, through the built binary, and of files that describe it.

#![allow(clippy::unwrap_used, clippy::panic, reason = "tests fail by panicking")]

#[path = "../access_support/mod.rs"]
mod access_support;
#[path = "../bcif_support/mod.rs"]
mod bcif_support;
#[path = "../cli_support/mod.rs"]
mod cli_support;
#[path = "../deploy_support/mod.rs"]
mod deploy_support;
#[path = "../http_support/mod.rs"]
mod http_support;
#[path = "../tools/mod.rs"]
mod tools;

mod access;
mod areas;
mod batch;
mod browser;
mod config_print;
mod deploy;
mod devices;
mod doctor;
mod exit_codes;
mod gallery;
mod help;
mod interrupt;
mod memory;
mod mesh;
mod readme;
mod render;
mod serve;
mod stop;
mod tileset;
