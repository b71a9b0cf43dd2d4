//! Virtual sites of force fields: charge sites of water models, lone pairs, mass centres, Drude particles.

use std::collections::HashMap;

use super::atoms::{Columns, Tables};
use super::contents::Kind;
use super::residue;

/// Maximum distance of a Drude particle from its atom, Å. No two atoms are this close.
const DRUDE_DISTANCE: f64 = 0.4;

/// Marks virtual sites: by name if the element is unknown, Drude particles by name and distance.
pub(super) fn mark(columns: &mut Columns, tables: &Tables) {
    by_name(columns, tables);
    drude(columns, tables);
}

/// Residues in which an atom of a given name, without a known element, is a virtual site.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Site {
    /// All: TIP4P's `MW` and `EPW`, lone pairs such as `LP1`.
    Anywhere,
    /// Amino acids and nucleotides: mass centres such as `MCB1`, lone pairs such as `LG1`.
    InPolymer,
    /// Water only, where every site without an element is virtual.
    InWater,
}

impl Site {
    fn of(name: &str) -> Self {
        let begins = |prefix: &str| name.get(..prefix.len()).is_some_and(|n| n.eq_ignore_ascii_case(prefix));
        if ["EP", "LP", "MW"].into_iter().any(begins) {
            Self::Anywhere
        } else if ["L", "M"].into_iter().any(begins) {
            Self::InPolymer
        } else {
            Self::InWater
        }
    }
}

/// Returns true if an atom with this name and without a known element is a virtual site in residues other than water.
pub(super) fn is_site(name: &str) -> bool {
    Site::of(name) != Site::InWater
}

/// CHARMM name for the charge site of four-site water models. Its first letter suggests an oxygen.
const OXYGEN_LIKE: &str = "OM";

fn by_name(columns: &mut Columns, tables: &Tables) {
    let oxygen_like = tables.name.texts().any(|name| name == OXYGEN_LIKE);
    if !oxygen_like && !columns.element.contains(&0) {
        return;
    }
    let sites: Vec<Site> = tables.name.texts().map(Site::of).collect();
    let polymer: Vec<bool> = tables.residue.texts().map(residue::is_polymer).collect();
    for i in 0..columns.len() {
        let (name, residue) = (columns.name[i], columns.residue[i] as usize);
        let is_water = columns.kind[i] == Kind::Water;
        let site = if columns.element[i] == 0 {
            match sites[name as usize] {
                Site::Anywhere => true,
                Site::InPolymer => polymer[residue] || is_water,
                Site::InWater => is_water,
            }
        } else {
            oxygen_like
                && tables.name.text(name) == OXYGEN_LIKE
                && residue::is_water(tables.residue.text(columns.residue[i]))
        };
        if site {
            columns.kind[i] = Kind::VirtualSite;
        }
    }
}

/// Marks Drude particles, which follow their atom, have its name prefixed with `D`, and lie within [`DRUDE_DISTANCE`].
fn drude(columns: &mut Columns, tables: &Tables) {
    if !tables.name.texts().any(|name| name.len() > 1 && name.starts_with('D')) {
        return;
    }
    let ids: HashMap<&str, u32> = tables.name.texts().zip(0..).collect();
    let parents: Vec<Option<u32>> =
        tables.name.texts().map(|name| name.strip_prefix('D').and_then(|parent| ids.get(parent).copied())).collect();
    for i in 1..columns.len() {
        if parents[columns.name[i] as usize] != Some(columns.name[i - 1]) {
            continue;
        }
        let step = [&columns.x, &columns.y, &columns.z].map(|axis| axis[i] - axis[i - 1]);
        if step.iter().map(|d| d * d).sum::<f64>() <= DRUDE_DISTANCE * DRUDE_DISTANCE {
            columns.kind[i] = Kind::VirtualSite;
        }
    }
}
