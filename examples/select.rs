//! Meshes the atoms that match an expression: `cargo run --example select samples/1crn.cif "within 5 of (resi 10)"`.
#![allow(clippy::print_stdout, reason = "an example prints its result")]

use std::error::Error;

use molmesh::Options;
use molmesh::structure::{ReadLimits, Selection, read, select};

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let (Some(input), Some(expression)) = (arguments.next(), arguments.next()) else {
        return Err("usage: select STRUCTURE EXPRESSION".into());
    };
    let selection = Selection { atoms: expression.parse()?, ..Selection::default() };
    let bytes = std::fs::read(input)?;
    let selected = select(&read(&bytes, &ReadLimits::default())?, &selection)?;
    println!("{} atoms, {} other atoms left out", selected.atoms.len(), selected.left_out.total);
    let mesh = molmesh::mesh(&bytes, &Options { selection, ..Options::default() })?;
    println!("{} vertices, {} triangles", mesh.n_vertices(), mesh.n_triangles());
    Ok(())
}
