//! Tests of the core: structures, surfaces, formats and pictures, and of the source tree itself.

#![allow(clippy::unwrap_used, clippy::panic, reason = "tests fail by panicking")]

#[path = "../bcif_support/mod.rs"]
mod bcif_support;
#[path = "../measure_support/mod.rs"]
mod measure_support;
#[path = "../tools/mod.rs"]
mod tools;

mod architecture;
mod bcif_oracles;
mod bcif_stream;
mod cancellation;
mod cavities;
mod cut;
mod degenerate;
mod exact_areas;
mod exact_measures;
mod formats_meshopt;
mod formats_oracles;
mod formats_quantized;
mod formats_roundtrip;
mod formats_storage;
mod instances;
mod language;
mod level_sets;
mod links;
mod make_test;
mod maps;
mod peers;
mod picture;
mod pockets;
mod quality;
mod real_structures;
mod simplify;
mod spacing;
mod sphere_surfaces;
mod split;
mod structure_archive;
mod structure_assembly;
mod structure_bcif;
mod structure_cases;
mod structure_hostile;
mod structure_kinds;
mod structure_mmcif;
mod structure_pdb;
mod structure_real;
mod structure_select;
mod surface;
mod tileset;
