//! Collects the residue names of chains in SEQRES and MODRES records.
//!
//! A HETATM residue with a listed name is part of the chain. Standard names are excluded: an amino acid in HETATM
//! records may be a ligand of a chain that contains the same amino acid.

use std::collections::HashSet;

use super::super::kinds::{self, Listed};
use super::super::residue;

/// Adds the names of a SEQRES record. The chain is in column 12, or 11 and 12. Thirteen names start at column 20.
pub(super) fn of_chain(line: &[u8], listed: &mut HashSet<Listed>) {
    for name in line.get(19..).unwrap_or_default().chunks(4).take(13) {
        add(line.get(10..12), name.get(..3), listed);
    }
}

/// Adds the name of a MODRES record, in columns 13 to 15. The chain is in column 17, or 16 and 17.
pub(super) fn of_residue(line: &[u8], listed: &mut HashSet<Listed>) {
    add(line.get(15..17), line.get(12..15), listed);
}

fn add(chain: Option<&[u8]>, name: Option<&[u8]>, listed: &mut HashSet<Listed>) {
    let (Some(chain), Some(name)) = (chain, name) else { return };
    let (chain, name) = (chain.trim_ascii(), name.trim_ascii());
    let standard = std::str::from_utf8(name).is_ok_and(residue::is_standard);
    if !name.is_empty() && !standard {
        listed.extend(kinds::listed(chain, name));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_listed_by_chain() {
        let mut listed = HashSet::new();
        of_chain(b"SEQRES   1 A   15  ACE MSE ALA  DG SEP NH2", &mut listed);
        of_chain(b"SEQRES   1AB   15  GLY MVA", &mut listed);
        of_chain(b"SEQRES   1", &mut listed);
        of_residue(b"MODRES 1ABC TPO C  160  THR  PHOSPHOTHREONINE", &mut listed);
        of_residue(b"MODRES 1ABC ASN C  161  ASN  GLYCOSYLATION SITE", &mut listed);
        of_residue(b"MODRES 1ABC", &mut listed);
        let mut found: Vec<&[u8; 5]> = listed.iter().collect();
        found.sort_unstable();
        assert_eq!(found, [b" AACE", b" AMSE", b" ANH2", b" ASEP", b" CTPO", b"ABMVA"]);
    }
}
