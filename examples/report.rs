//! Prints the report of a mesh as JSON: `cargo run --example report samples/4pti.pdb surface=ses resolution=1`.
#![allow(clippy::print_stdout, reason = "an example prints its result")]

use std::error::Error;

use molmesh::pipeline::{self, Choice, JobLimits, params};
use molmesh::surface::{Control, CpuBackend};

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let input = arguments.next().ok_or("usage: report STRUCTURE [PARAMETER=VALUE…]")?;
    // The names and values of the command line and of the HTTP query.
    let pairs: Vec<String> = arguments.collect();
    let options = params::parse(pairs.iter().map(|pair| pair.split_once('=').unwrap_or((pair, ""))))?.options;
    let backend = CpuBackend::new(None)?;
    let choice = Choice { backend: &backend, reason: "example" };
    let limits = JobLimits::default();
    let bytes = std::fs::read(input)?;
    let product = pipeline::run(&bytes, &options, &limits, &choice, &Control::default(), &(), None)?;
    println!("{}", serde_json::to_string_pretty(&product.report)?);
    Ok(())
}
