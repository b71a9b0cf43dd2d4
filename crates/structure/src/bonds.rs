//! Bonds between adjacent residues of a chain, which make unknown residues part of a polymer.

use std::ops::Range;

use molmesh_surface::vector::squared_distance;

use super::atoms::Slices;
use super::contents::Kind;
use super::kinds::{Declared, residue_end, residue_start, same_chain};

/// Maximum length of a bond between carbon and nitrogen of a peptide, Å. The usual length is 1.33 Å; non-bonded
/// contacts are longer.
const PEPTIDE_BOND: f64 = 2.0;
/// Maximum length of a bond between O3' and the next phosphorus, Å. The usual length is 1.6 Å.
const PHOSPHATE_BOND: f64 = 2.2;
/// Maximum distance between the alpha carbons of adjacent residues, Å. The usual distance is 3.8 Å.
const ALPHA_CARBON_DISTANCE: f64 = 4.5;

/// Backbone atoms that join the residues of a chain.
#[derive(Debug, Clone, Copy)]
pub(super) enum Joint {
    /// Carbon of a peptide bond.
    C,
    /// Nitrogen of a peptide bond.
    N,
    /// Oxygen before the phosphorus of the next nucleotide.
    O3,
    /// Phosphorus.
    P,
    /// Alpha carbon. It joins residues that have no other atoms of the backbone.
    AlphaCarbon,
}

impl Joint {
    pub(super) fn of(name: &str) -> Option<Self> {
        match name {
            "C" => Some(Self::C),
            "N" => Some(Self::N),
            "O3'" | "O3*" => Some(Self::O3),
            "P" => Some(Self::P),
            "CA" => Some(Self::AlphaCarbon),
            _ => None,
        }
    }
}

/// The first atom of each [`Joint`] in a residue.
#[derive(Debug, Clone, Copy, Default)]
struct Joints([Option<[f64; 3]>; 5]);

impl Joints {
    /// Returns true if a bond joins this residue to the `next` one.
    fn lead_to(&self, next: &Self) -> bool {
        let near = |a: Joint, b: Joint, limit: f64| match (self.0[a as usize], next.0[b as usize]) {
            (Some(a), Some(b)) => squared_distance(a, b) <= limit * limit,
            _ => false,
        };
        let is_trace = self.0[Joint::C as usize].is_none() && next.0[Joint::N as usize].is_none();
        near(Joint::C, Joint::N, PEPTIDE_BOND)
            || near(Joint::O3, Joint::P, PHOSPHATE_BOND)
            || (is_trace && near(Joint::AlphaCarbon, Joint::AlphaCarbon, ALPHA_CARBON_DISTANCE))
    }
}

/// Sets the kind of HETATM residues to polymer if backbone bonds join them to a polymer residue, unless the entity of
/// their chain is known. `joints` are by name id.
pub(super) fn bonded(columns: &mut Slices<'_>, joints: &[Option<Joint>], declared: &Declared<'_>) {
    let open = |columns: &Slices<'_>, i: usize| {
        columns.kind[i] == Kind::Ligand && columns.hetero[i] && declared.of_entity(columns.label_chain[i]).is_none()
    };
    if !(0..columns.len()).any(|i| open(columns, i) && joints[columns.name[i] as usize].is_some()) {
        return;
    }
    // A group is a sequence of residues joined by bonds.
    let (mut group, mut has_polymer, mut has_open) = (0, false, false);
    let (mut before, mut first) = (Joints::default(), 0);
    loop {
        let (end, here) = residue_from(columns, first, joints);
        let at_end = first == columns.len();
        if at_end || !(first > 0 && same_chain(columns, first - 1, first) && before.lead_to(&here)) {
            if has_polymer && has_open {
                for i in group..first {
                    if open(columns, i) {
                        columns.kind[i] = Kind::Polymer;
                    }
                }
            }
            (group, has_polymer, has_open) = (first, false, false);
        }
        if at_end {
            return;
        }
        if !has_open {
            // Only the residue before the next open one matters.
            let Some(next) = (first..columns.len()).find(|&i| open(columns, i)) else { return };
            let near = residue_start(columns, next.saturating_sub(1).max(first));
            if near > first {
                (before, first, group, has_polymer) = (Joints::default(), near, near, false);
                continue;
            }
        }
        has_polymer |= columns.kind[first] == Kind::Polymer;
        has_open |= open(columns, first);
        (before, first) = (here, end);
    }
}

/// Returns true if a bond joins a residue to the one before or after it in its chain.
pub(super) fn is_bonded(columns: &Slices<'_>, rows: Range<usize>, joints: &[Option<Joint>]) -> bool {
    let of_residue = |first: usize| residue_from(columns, first, joints).1;
    let here = of_residue(rows.start);
    let has_before = rows.start > 0 && same_chain(columns, rows.start - 1, rows.start);
    let has_after = rows.end < columns.len() && same_chain(columns, rows.start, rows.end);
    (has_before && of_residue(residue_start(columns, rows.start - 1)).lead_to(&here))
        || (has_after && here.lead_to(&of_residue(rows.end)))
}

/// Returns the end of the residue that begins with atom `first`, and its joints.
fn residue_from(columns: &Slices<'_>, first: usize, joints: &[Option<Joint>]) -> (usize, Joints) {
    let mut found = Joints::default();
    if first == columns.len() {
        return (first, found);
    }
    let end = residue_end(columns, first);
    for i in first..end {
        if let Some(joint) = joints[columns.name[i] as usize] {
            found.0[joint as usize].get_or_insert([columns.x[i], columns.y[i], columns.z[i]]);
        }
    }
    (end, found)
}
