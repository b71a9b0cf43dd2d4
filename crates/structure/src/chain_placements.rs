//! Operators that place the chains of an assembly.

use std::ops::Range;

use super::assembly::Operator;
use super::copies::PlacedCopy;

/// Operators that place the chains of an assembly.
#[derive(Debug)]
pub struct Placements {
    /// Operator of each copy, in the order of the file: by rule and operator.
    pub operators: Vec<Operator>,
    /// Numbers of the chains that each rule copies, ascending, with its copies.
    pub(crate) rules: Vec<(Vec<u32>, Range<usize>)>,
}

impl Placements {
    /// Returns the numbers of the chains in the order of the assembly.
    #[must_use]
    pub fn chains(&self) -> Vec<u32> {
        self.rules.iter().flat_map(|(chains, _)| chains).copied().collect()
    }

    /// Returns the copies of each chain, by its number.
    #[must_use]
    pub fn copies_by_chain(&self) -> Vec<Vec<Range<usize>>> {
        let n = self.chains().into_iter().max().map_or(0, |last| last as usize + 1);
        let mut by_chain = vec![Vec::new(); n];
        for (chains, copies) in &self.rules {
            for chain in chains {
                by_chain[*chain as usize].push(copies.clone());
            }
        }
        by_chain
    }

    /// Returns the copies without their atoms.
    #[must_use]
    pub fn copies(&self) -> Vec<PlacedCopy> {
        self.operators.iter().map(|operator| PlacedCopy { rows: 0..0, operator: *operator }).collect()
    }
}
