//! Meshes a structure file and writes it as PLY: `cargo run --example mesh samples/4pti.pdb 4pti.ply`.
#![allow(clippy::print_stdout, reason = "an example prints its result")]

use std::error::Error;
use std::fs::File;
use std::io::BufWriter;

use molmesh::formats::{Encoder, Format, Meta, Storage};
use molmesh::surface::{Control, Measures, Validation};

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let (Some(input), Some(output)) = (arguments.next(), arguments.next()) else {
        return Err("usage: mesh STRUCTURE OUTPUT.ply".into());
    };
    let mesh = molmesh::mesh(&std::fs::read(input)?, &molmesh::Options::default())?;
    let measures = Measures::of(&mesh, Validation::Exact, &Control::default())?;
    println!("{:.1} Å², {:.1} Å³, watertight: {}", measures.area, measures.volume, measures.closed);
    let encoder = Encoder::new(Format::Ply, Storage::default(), &mesh, &Meta::default())?;
    encoder.write(&mut BufWriter::new(File::create(output)?))?;
    Ok(())
}
