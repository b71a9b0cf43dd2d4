//! The `molmesh` command.

fn main() {}
